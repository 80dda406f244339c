"""What a shell offers for values."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from boresight.features.exports.formats import FORMATS

ROOT = Path(__file__).parents[3]
PROGRAM = "import sys; sys.argv = ['boresight']; import boresight.console as c; c.run_command_line()"


def offered(*words: str) -> list[str]:
    """The answers of bash for the last of these words."""
    typed = ["boresight", *words]
    given = {
        "_BORESIGHT_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(typed),
        "COMP_CWORD": str(len(typed) - 1),
    }
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=os.environ | given, capture_output=True, text=True, cwd=ROOT
    )
    return ran.stdout.split()


@pytest.mark.parametrize(
    ("words", "answers"),
    [
        (("export", "r", "--format", "geo"), ["geojson"]),
        (("export", "r", "--format", "spice,r"), ["spice,rpc"]),
        (("experiment", "tab"), ["table4", "table5"]),
        (("simulate", "p"), ["paper"]),
        (("import", "sentinel2", "x", "--band", "B8"), ["B8A"]),
        (("targets", "suggest", "x", "--heights", "egm2"), ["egm2008"]),
        (("match", "fixtures/mini", "--strip", "s0"), ["s01", "s02", "s03"]),
        (("match", "no-such-folder", "--strip", "s0"), []),
    ],
)
def test_values_are_offered(words: tuple[str, ...], answers: list[str]) -> None:
    assert offered(*words) == answers


def test_every_format_is_offered() -> None:
    assert offered("export", "r", "--format", "") == list(FORMATS)
