"""The tutorial's commands are run, and what they print is what the page shows."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

from refresh_tutorial import (  # noqa: E402
    BLOCK,
    FIRST_SCREEN,
    README,
    TUTORIAL,
    first_screen,
    prepared,
    run,
    steps,
)

NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
TIMES = re.compile(r"\d+\.\d+ s(?= ->)")


@pytest.fixture(scope="module")
def blocks() -> list[re.Match[str]]:
    return list(BLOCK.finditer(TUTORIAL.read_text()))


def test_every_command_prints_what_the_page_shows(blocks, tmp_path, monkeypatch):
    monkeypatch.chdir(prepared(tmp_path))
    commands = 0
    for block in blocks:
        for step in steps(block[1], block[2], block[3] or ""):
            printed = run(block[1], step)
            assert_same(printed, step.shown, step.command)
            commands += 1
    assert commands >= 8


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
    """Words exactly; numbers to one unit of their last printed digit, for rounding on another processor. How
    long it took is not compared.
    """
    printed, shown = TIMES.sub("some time", printed), TIMES.sub("some time", shown)
    where = f"{command}: printed\n{printed}\nthe page shows\n{shown}\nrun scripts/refresh_tutorial.py"
    assert NUMBER.sub("#", printed).split() == NUMBER.sub("#", shown).split(), where
    for got, expected in zip(NUMBER.findall(printed), NUMBER.findall(shown)):
        mantissa, _, exponent = expected.lower().partition("e")
        unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
        assert abs(float(got) - float(expected)) <= 1.01 * unit, where
