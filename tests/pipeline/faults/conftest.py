"""The modules of this folder can be imported by its tests; a calibration of images with a fault."""

import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from boresight.pipeline.calibration.calibrate import DumpCalibration, calibrate_dump
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.results.folder import store_of

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def ends_in_time() -> Iterator[None]:
    """A read that blocks is an error of the test, not a hang; a busy machine may be slow."""

    def expired(*_: object) -> None:
        raise TimeoutError("600 s")

    before = signal.signal(signal.SIGALRM, expired)
    signal.alarm(600)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="session")
def sound(made_once) -> Path:
    """Measured points of three strips and two heads, without a fault. Read only."""
    from fault_dumps import sound_dump

    return made_once("measured-points", lambda folder: sound_dump("points", 1, folder)) / "points-1"


@pytest.fixture
def with_fault(made_once, request, tmp_path: Path) -> Callable[..., DumpCalibration]:
    """What a calibration of a dump of images gives, of a kind of `fault_dumps` and a seed, with a fault: what
    the fault leaves unchanged is computed once; of fixtures it is there already.
    """
    from fault_dumps import linked, sound_dump

    def fill(name: str, seed: int, folder: Path) -> None:
        if (name, seed) == ("ground", 1):
            shutil.copytree(request.getfixturevalue("demo") / "demo-result" / "work", folder / "work")
        elif (name, seed) == ("sky", 1):
            shutil.copytree(request.getfixturevalue("sky_result") / "work", folder / "work")
        else:
            (folder / "work").mkdir()
        if (name, seed) == ("points", 1):
            shutil.copytree(request.getfixturevalue("sound"), folder / "points-1")
        if name == "trackers":  # the images of scans, rendered once
            shutil.copytree(made("scans", seed) / f"scans-{seed}", folder / f"scans-{seed}")
        sound = sound_dump(name, seed, folder)
        if sound.parent != folder:  # a fixture, perhaps on another file system: no links to it
            shutil.copytree(sound, folder / f"{name}-{seed}")

    def made(name: str, seed: int) -> Path:
        return made_once(f"of-{name}-{seed}", partial(fill, name, seed))

    def calibrated(name: str, make: Callable[[Path], None], seed: int = 1) -> DumpCalibration:
        folder = made(name, seed)
        linked(folder / f"{name}-{seed}", tmp_path / "dump")
        make(tmp_path / "dump")
        return calibrate_dump(open_dump(tmp_path / "dump"), store=store_of(folder))

    return calibrated
