"""Dumps for the tests of pipeline/: one written by hand, and one strip of the committed `fixtures/mini`."""

from __future__ import annotations

from pathlib import Path

import pytest
from fixture_strips import strip_of_fixture
from handmade import write_handmade_dump
from typer.testing import CliRunner

from boresight.pipeline.cli import app


@pytest.fixture
def handmade(tmp_path: Path) -> Path:
    """A fresh dump written by hand; a test may damage it as it likes."""
    return write_handmade_dump(tmp_path / "handmade")


@pytest.fixture
def one_strip(tmp_path: Path) -> Path:
    """The first strip of `fixtures/mini` and the exposures around it, without truth."""
    return strip_of_fixture(tmp_path / "one-strip", 1)


@pytest.fixture(scope="session")
def finished(made_once) -> tuple[Path, Path]:
    """One strip of the fixture, carried through by the command itself: the dump and its result. Read only."""

    def fill(folder: Path) -> None:
        dump = strip_of_fixture(folder / "dump", 1)
        ran = CliRunner().invoke(
            app, ["calibrate", str(dump), "--out", str(folder / "result"), "--workers", "1"]
        )
        assert ran.exit_code == 0, ran.output

    folder = made_once("finished", fill)
    return folder / "dump", folder / "result"
