"""Pictures of the report and of the sheets to be signed show what the present code prints."""

import re
import runpy
import shutil
import unicodedata
from pathlib import Path

import pytest
from command_line import ran
from drawn_pictures import assert_alike
from PIL import Image
from pypdf import PdfReader

from boresight.pipeline.report.pdf import chromium

ROOT = Path(__file__).parents[2]
# By its path: other modules of that folder have the names of modules of tests.
MADE_BY = runpy.run_path(str(ROOT / "scripts" / "figures" / "report.py"))
# What differs from run to run, or with the fonts of a machine: the block of identity, the foot of each page.
OF_THE_RUN = re.compile(r"Which result this is.*?(?=Rcs: takes)|boresight result \w+|\d+ of \d+", re.DOTALL)


def shown_in(text: str) -> str:
    """Text of a sheet without what differs from run to run; ligatures are single letters."""
    return OF_THE_RUN.sub("", unicodedata.normalize("NFKC", text))


@pytest.mark.skipif(chromium() is None, reason="NO CHROMIUM FOUND: pictures are not compared")
def test_pictures_of_report_and_sheets_show_the_words_and_numbers_of_the_present_code(demo, tmp_path):
    result, images = tmp_path / "demo-result", ROOT / "docs" / "images"
    shutil.copytree(demo / "demo-result", result, ignore=shutil.ignore_patterns("work"))
    ran("validate", result, "--dump", ROOT / "fixtures" / "mini")
    now = MADE_BY["words_of"](result / "report.html", tmp_path)
    assert "Consistent: 8 of 8 checks hold" in now and "check point" in now
    with Image.open(images / "report.png") as picture:
        assert_alike(picture.text["Description"], now, "report.png")
    (tmp_path / "about.toml").write_text(MADE_BY["ABOUT"])
    ran("report", result, "--about", tmp_path / "about.toml", "--require-arcsec", "10", "--pdf")
    for n, page in enumerate(PdfReader(result / "report.pdf").pages[:2], 1):
        with Image.open(images / f"signed-{n}.png") as picture:
            kept = shown_in(picture.text["Description"])
        assert_alike(kept, shown_in(page.extract_text()), f"signed-{n}.png")
