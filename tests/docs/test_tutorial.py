"""The tutorial's commands are run, and what they print is what the page shows."""

import re
import shutil
import sys
from pathlib import Path

import pytest
from outside import DEMO

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

from refresh_tutorial import (  # noqa: E402
    BLOCK,
    FIRST_SCREEN,
    FIRST_YEAR,
    README,
    TUTORIAL,
    first_screen,
    prepared,
    run,
    steps,
)

NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
# a file's length and digest are those of its numbers' last digits
TIMES = re.compile(r"\d+\.\d+ s(?= ->)|\d+ bytes(?= ->)|\b[0-9a-f]{16,32}\b")


@pytest.fixture(scope="module")
def blocks() -> list[re.Match[str]]:
    return list(BLOCK.finditer(TUTORIAL.read_text()))


def test_every_command_prints_what_the_page_shows(blocks, demo, tmp_path, monkeypatch):
    monkeypatch.chdir(prepared(tmp_path))
    shutil.copytree(demo / "demo-result", tmp_path / "demo-result")
    first, *others = [(b[1], step) for b in blocks for step in steps(b[1], b[2], b[3] or "")]
    assert first[1].command == " ".join(("boresight", *DEMO))
    assert_same((demo / "printed").read_text(), first[1].shown, first[1].command)
    for kind, step in others:
        assert_same(run(kind, step), step.shown, step.command)
    assert len(others) >= 7


def test_the_first_year_of_a_mission_prints_what_its_page_shows(tmp_path, monkeypatch):
    monkeypatch.chdir(prepared(tmp_path))
    text = FIRST_YEAR.read_text()
    of_page = list(BLOCK.finditer(text))
    assert text.count("```console") == len(of_page) >= 4
    for block in of_page:
        for step in steps(block[1], block[2], block[3] or ""):
            assert_same(run(block[1], step), step.shown, step.command)


def test_every_program_of_the_page_is_run(blocks):
    text = TUTORIAL.read_text()
    assert text.count("<!-- run -->") == len(blocks)
    assert set(re.findall(r"^\$ (\S+ ?\S*)", text, re.MULTILINE)) <= {
        "boresight calibrate",
        "boresight status",
        "boresight report",
        "boresight validate",
        "boresight geolocate",
        "boresight export",
        "cat pixels.csv",
    }


def test_the_first_screen_of_the_readme_is_the_tutorials_run():
    found = FIRST_SCREEN.search(README.read_text())
    assert found is not None
    of_the_tutorial = first_screen(TUTORIAL.read_text())
    assert TIMES.sub("", found[1]) == TIMES.sub("", of_the_tutorial), "run scripts/refresh_tutorial.py"


def assert_same(printed: str, shown: str, command: str) -> None:
    """Words and counts exactly; decimal numbers to four units of their last printed digit, or to 2e-9.

    Between the kernels of OpenBLAS, NumPy and OpenCV for several processors theta of the demo differs by up
    to 2e-9 rad, 5e-5 of its sigma. How long it took, how long a file is and digests are not
    compared.
    """
    printed, shown = TIMES.sub("so much", printed), TIMES.sub("so much", shown)
    where = f"{command}: printed\n{printed}\nthe page shows\n{shown}\nrun scripts/refresh_tutorial.py"
    assert NUMBER.sub("#", printed).split() == NUMBER.sub("#", shown).split(), where
    for got, expected in zip(NUMBER.findall(printed), NUMBER.findall(shown)):
        mantissa, _, exponent = expected.lower().partition("e")
        unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
        most = max(4.01 * unit, 2e-9) if "." in mantissa else 0.0
        assert abs(float(got) - float(expected)) <= most, where
