"""The worked examples run, and print what the documentation site shows."""

import re
import runpy
import sys
from pathlib import Path

import matplotlib
import pytest
from drawn_pictures import same_picture
from PIL import Image

MOST_LINES = 40  # of code, without comments
ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "docs" / "examples").glob("*.py"))
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def test_there_are_four_examples_with_their_output_and_pictures() -> None:
    assert len(EXAMPLES) == 4
    for path in EXAMPLES:
        assert path.with_suffix(".txt").is_file()
        assert list((ROOT / "docs" / "images").glob(f"example_{path.stem}.*"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_is_short(path: Path) -> None:
    code = path.read_text(encoding="utf-8").split('"""\n', 1)[1]
    lines = [line for line in code.splitlines() if line.strip() and not line.strip().startswith("#")]
    assert len(lines) <= MOST_LINES


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_prints_what_the_site_shows(path, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(path), str(tmp_path)])
    monkeypatch.chdir(tmp_path)  # no file of a checkout is at hand
    with matplotlib.rc_context({"backend": "agg"}):
        runpy.run_path(str(path), run_name="__main__")
    out = capsys.readouterr().out
    shown = path.with_suffix(".txt").read_text(encoding="utf-8")
    assert NUMBER.sub("#", out).split() == NUMBER.sub("#", shown).split()
    printed, expected = (list(map(float, NUMBER.findall(text))) for text in (out, shown))
    # the last digit may differ between versions of NumPy and OpenCV; probabilities by their exponents
    assert printed == pytest.approx(expected, rel=0.02, abs=2e-3)
    kept = sorted((ROOT / "docs" / "images").glob(f"example_{path.stem}.*"))
    assert sorted(file.name for file in tmp_path.iterdir()) == [file.name for file in kept]
    for file in kept:
        with Image.open(file) as shown, Image.open(tmp_path / file.name) as drawn:
            assert same_picture(shown, drawn), file.name
