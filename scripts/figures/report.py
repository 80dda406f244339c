"""The first screen of the demo's report in a headless Chromium, and its two sheets to be signed, which
poppler's `pdftoppm` draws from the PDF: `python scripts/figures/report.py`.

The pictures of the sheets hold the words that they show (PNG text `Description`); tests/docs/test_pictures.py
compares these with the present code.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo
from pypdf import PdfReader

from boresight.pipeline.report.pdf import chromium

ROOT = Path(__file__).parents[2]
SHEETS = ROOT / "docs" / "images"  # signed-1.png, signed-2.png
DOTS_PER_INCH = 100
ABOUT = """mission = "Mini"
document = "MINI-CAL-001"
author = "A. Calibrator"
reviewer = "R. Reviewer"
"""
PICTURE = ROOT / "docs" / "images" / "report.png"
SIZE_PX = 1280, 900


def main() -> None:
    """Calibrate and validate fixtures/mini, and take the picture of its report."""
    browser = chromium()
    if browser is None:
        raise SystemExit("no Chromium found: the picture is taken by one")
    if (pdftoppm := shutil.which("pdftoppm")) is None:
        raise SystemExit("no pdftoppm found: it draws the sheets (package poppler-utils)")
    boresight = (sys.executable, "-m", "boresight")
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "fixtures").symlink_to(ROOT / "fixtures")
        fixture, result = "fixtures/mini", f"{folder}/demo-result"
        subprocess.run([*boresight, "calibrate", fixture, "--out", "demo-result"], check=True, cwd=folder)
        subprocess.run([*boresight, "validate", "demo-result", "--dump", fixture], check=True, cwd=folder)
        command = [str(browser), "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        command += [f"--user-data-dir={folder}/profile", "--window-size={},{}".format(*SIZE_PX)]
        page = Path(result, "report.html").as_uri()
        subprocess.run(
            [*command, f"--screenshot={PICTURE}", page], check=True, capture_output=True, timeout=120
        )
        about = Path(folder, "about.toml")
        about.write_text(ABOUT)
        asked = ["report", result, "--about", str(about), "--require-arcsec", "10", "--pdf"]
        subprocess.run([*boresight, *asked], check=True, cwd=folder)
        drawn = ["-png", "-gray", "-r", str(DOTS_PER_INCH), "-f", "1", "-l", "2"]
        paged = Path(folder, "page")
        subprocess.run([pdftoppm, *drawn, f"{result}/report.pdf", paged], check=True)
        for n, page_png in enumerate(sorted(Path(folder).glob("page-*.png")), 1):
            words = PngInfo()
            words.add_itxt("Description", PdfReader(f"{result}/report.pdf").pages[n - 1].extract_text())
            with Image.open(page_png) as picture:
                picture.save(SHEETS / f"signed-{n}.png", optimize=True, pnginfo=words)


if __name__ == "__main__":
    main()
