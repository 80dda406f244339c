"""What several folders here use of the one-strip dump and its result."""

import shutil
from pathlib import Path

import pytest
from command_line import ran
from outside import ROOT

from boresight.pipeline.calibration.calibrate import DumpCalibration, calibrate_dump
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.results.folder import store_of


@pytest.fixture(scope="session")
def calibration(finished: tuple[Path, Path]) -> DumpCalibration:
    """The one-strip dump from its finished units."""
    found = calibrate_dump(open_dump(finished[0]), store=store_of(finished[1]))
    assert found.n_computed == 0
    return found


@pytest.fixture
def result(finished: tuple[Path, Path], tmp_path: Path) -> Path:
    """A copy of the finished result, without its units; a test may change it."""
    return shutil.copytree(finished[1], tmp_path / "result", ignore=shutil.ignore_patterns("work"))


@pytest.fixture(scope="session")
def sky_result(made_once) -> Path:
    """What the command makes of `fixtures/sky`. Read only."""
    sky = ROOT / "fixtures" / "sky"
    return made_once("sky-result", lambda folder: ran("calibrate", sky, "--out", folder, "--workers", 1))
