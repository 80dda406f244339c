"""The printed page, and the page of a run without a result."""

import re
import shutil
import unicodedata

import pytest
from command_line import ran
from pypdf import PdfReader

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.report import pdf
from boresight.pipeline.results.identity import identity_of_result


def test_without_a_browser_the_message_says_what_is_needed(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    (tmp_path / "report.html").write_text("<p>page</p>")
    with pytest.raises(RawDataError, match=r"no Chromium.*chromium.*print report\.html from a browser"):
        pdf.print_page(tmp_path / "report.html")
    assert not (tmp_path / "report.pdf").exists()


@pytest.mark.skipif(pdf.chromium() is None, reason="NO CHROMIUM FOUND: nothing was printed")
def test_the_report_is_printed_on_a4(result):
    assert "report.pdf" in ran("report", result, "--pdf").output
    content = (result / "report.pdf").read_bytes()
    assert content.startswith(b"%PDF-")
    sizes = re.findall(rb"/MediaBox\s*\[\s*0 0 ([\d.]+) ([\d.]+)", content)
    width, height = (float(size) for size in sizes[0])
    assert (width, height) == pytest.approx((595.3, 841.9), abs=1.0)  # points: 210 x 297 mm
    assert 5 < len(sizes) <= 12  # pages: two sheets to be signed, then tables, cards, settings, inputs
    texts = [page.extract_text() for page in PdfReader(result / "report.pdf").pages]
    pages = [unicodedata.normalize("NFKC", text) for text in texts]  # a digest may hold the ligature of "ff"
    assert "1σ, m on the ground" in pages[0] and "Result to be signed" not in pages[0]
    assert "Result to be signed" in pages[1]
    # The last row of the last table of the second sheet: it holds all of them.
    assert "approver" in pages[1] and "Uncertainty budget" in pages[1]
    own = identity_of_result(result).result
    for n, text in enumerate(pages, 1):
        assert f"{n} of {len(pages)}" in text and f"boresight result {own}" in text


def test_a_run_without_a_result_leaves_a_page_that_names_the_cause(handmade, tmp_path):
    ran("calibrate", handmade, "--out", tmp_path / "r", "--workers", 1, status=1)
    text = (tmp_path / "r" / "report.html").read_text(encoding="utf-8")
    assert "<strong>No result.</strong>" in text and "None of 4 exposures can be used" in text
    assert text.count("<td>exposure</td>") == 4
    assert not (tmp_path / "r" / "installation.json").exists()
