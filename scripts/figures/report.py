"""The first screen of the demo's report in a headless Chromium, and its two sheets to be signed, which
poppler's `pdftoppm` draws from the PDF: `python scripts/figures/report.py`.

The pictures hold the words that they show (PNG text `Description`); tests/docs/test_pictures.py compares
these with the present code.
"""

from __future__ import annotations

import html
import re
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
LONGEST_S = 120.0  # that Chromium may take
ABOUT = """mission = "Mini"
document = "MINI-CAL-001"
author = "A. Calibrator"
reviewer = "R. Reviewer"
"""
PICTURE = ROOT / "docs" / "images" / "report.png"
SIZE_PX = 1280, 900
# Leaves in the page what its first part shows once its own script has run.
WRITE_WORDS = """<script>addEventListener("load", () => {
  const words = document.createElement("pre");
  words.id = "words-shown";
  words.textContent = document.querySelector("header .front").innerText
    + [...document.querySelectorAll("#map svg text")].map((one) => "\\n" + one.textContent).join("");
  document.body.append(words);
});</script></body>"""


def words_of(page: Path, folder: Path) -> str:
    """The words and numbers that Chromium shows in the first part of a report, map and all; `folder` is for
    files that it needs.
    """
    asking = folder / "asking.html"
    text = page.read_text(encoding="utf-8")
    text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", text)
    asking.write_text(text.replace("</body>", WRITE_WORDS), encoding="utf-8")
    shown = subprocess.run(
        [*browser_command(folder), "--dump-dom", asking.as_uri()],
        check=True,
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
    )
    found = re.search(r'<pre id="words-shown">(.*?)</pre>', shown.stdout, re.DOTALL)
    assert found is not None, shown.stderr
    return html.unescape(found[1])


def browser_command(folder: Path) -> list[str]:
    """A Chromium without a window, of the picture's size, and its switches."""
    if (browser := chromium()) is None:
        raise SystemExit("no Chromium found: the picture is taken by one")
    switches = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    return [browser, *switches, f"--user-data-dir={folder}/profile", "--window-size={},{}".format(*SIZE_PX)]


def main() -> None:
    """Calibrate and validate fixtures/mini, and take the picture of its report."""
    if (pdftoppm := shutil.which("pdftoppm")) is None:
        raise SystemExit("no pdftoppm found: it draws the sheets (package poppler-utils)")
    boresight = (sys.executable, "-m", "boresight")
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "fixtures").symlink_to(ROOT / "fixtures")
        fixture, result = "fixtures/mini", f"{folder}/demo-result"
        subprocess.run([*boresight, "calibrate", fixture, "--out", "demo-result"], check=True, cwd=folder)
        subprocess.run([*boresight, "validate", "demo-result", "--dump", fixture], check=True, cwd=folder)
        page = Path(result, "report.html")
        command = [*browser_command(Path(folder)), f"--screenshot={folder}/report.png", page.as_uri()]
        subprocess.run(command, check=True, capture_output=True, timeout=LONGEST_S)
        keep(Path(folder, "report.png"), PICTURE, words_of(page, Path(folder)))
        about = Path(folder, "about.toml")
        about.write_text(ABOUT)
        asked = ["report", result, "--about", str(about), "--require-arcsec", "10", "--pdf"]
        subprocess.run([*boresight, *asked], check=True, cwd=folder)
        drawn = ["-png", "-gray", "-r", str(DOTS_PER_INCH), "-f", "1", "-l", "2"]
        paged = Path(folder, "page")
        subprocess.run([pdftoppm, *drawn, f"{result}/report.pdf", paged], check=True)
        for n, page_png in enumerate(sorted(Path(folder).glob("page-*.png")), 1):
            words = PdfReader(f"{result}/report.pdf").pages[n - 1].extract_text()
            keep(page_png, SHEETS / f"signed-{n}.png", words)


def keep(drawn: Path, place: Path, words: str) -> None:
    """Save a picture with the words that it shows."""
    text = PngInfo()
    text.add_itxt("Description", words)
    with Image.open(drawn) as picture:
        picture.save(place, optimize=True, pnginfo=text)


if __name__ == "__main__":
    main()
