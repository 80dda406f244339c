"""The first screen of the demo's report in a headless Chromium: `python scripts/figures/report.py`."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from boresight.pipeline.report.pdf import chromium

ROOT = Path(__file__).parents[2]
PICTURE = ROOT / "docs" / "images" / "report.png"
SIZE_PX = 1280, 900


def main() -> None:
    """Calibrate and validate fixtures/mini, and take the picture of its report."""
    browser = chromium()
    if browser is None:
        raise SystemExit("no Chromium found: the picture is taken by one")
    fixture, boresight = str(ROOT / "fixtures" / "mini"), (sys.executable, "-m", "boresight")
    with tempfile.TemporaryDirectory() as folder:
        result = f"{folder}/result"
        subprocess.run([*boresight, "calibrate", fixture, "--out", result], check=True, cwd=ROOT)
        subprocess.run([*boresight, "validate", result, "--dump", fixture], check=True, cwd=ROOT)
        command = [str(browser), "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        command += [f"--user-data-dir={folder}/profile", "--window-size={},{}".format(*SIZE_PX)]
        page = Path(result, "report.html").as_uri()
        subprocess.run(
            [*command, f"--screenshot={PICTURE}", page], check=True, capture_output=True, timeout=120
        )


if __name__ == "__main__":
    main()
