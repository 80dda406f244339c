"""Runs killed at every step of writing, and disks that are full: what is there is whole, and runs go on."""

import errno
import os
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from unittest.mock import patch

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command_line import ended
from fixture_strips import stopped_run
from readers import write_sound_files

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.table_files import read_parquet
from boresight.pipeline.files.whole_file import write_whole
from boresight.pipeline.results.status import run_status, status_lines
from boresight.pipeline.run.unit_store import UnitStore

# One process after another goes on with a run; each kills itself a little later than the one before, at a
# moment after a file was written under its temporary name, after it was flushed, or after it got its own.
KILLED = """
import os, signal, sys
from pathlib import Path
import cv2
cv2.setNumThreads(1)
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.results.folder import begin_result, store_of
from boresight.pipeline.results.writing import write_result
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.run.executor import InOrder

dump, result = open_dump(Path(sys.argv[1])), Path(sys.argv[2])

def dying_after(steps):
    left = [steps]
    def counted(function):
        def step(*arguments, **named):
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            outcome = function(*arguments, **named)
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return outcome
        return step
    os.fsync, Path.replace = counted(os.fsync), counted(Path.replace)

def run(steps):
    dying_after(steps)
    begin_result(result)
    found = calibrate_dump(dump, Settings(), store_of(result), InOrder())
    write_result(result, found, Settings())

made = {}
for steps in range(1, 200, 7):
    child = os.fork()
    if not child:
        run(steps)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    left = [str(path) for path in result.rglob("*.tmp")]
    print(os.WIFSIGNALED(status), (result / "installation.json").exists(), len(left), flush=True)
    for path in result.glob("work/*/*.parquet"):  # no finished unit is made twice
        assert made.setdefault(path, path.stat().st_mtime_ns) == path.stat().st_mtime_ns, path
    if not os.WIFSIGNALED(status):
        sys.exit(os.WEXITSTATUS(status))
"""

# A process that kills itself at one moment of writing a unit.
KILLED_AT = """
import os, signal, sys
from pathlib import Path
import pyarrow as pa
from boresight.pipeline.run.unit_store import UnitStore

def die(*arguments, **named):
    os.kill(os.getpid(), signal.SIGKILL)

where = {"written": (os, "fsync"), "flushed": (Path, "replace"), "renamed": (Path, "unlink")}
setattr(*where[sys.argv[1]], die)
UnitStore(Path(sys.argv[2])).write("stage", "s1", "new", pa.table({"a": [1.0, 2.0]}), {"id": "s1"})
"""


@pytest.fixture
def begun(finished: tuple[Path, Path], tmp_path: Path) -> tuple[Path, Path, bytes]:
    """A dump, a folder where the last matching is missing, and the installation.json that must come out."""
    dump, result = finished
    out = tmp_path / "result"
    stopped_run(out, [dump], result)
    for unit in (out / "work" / "matching-0").iterdir():
        unit.unlink()
    return dump, out, (result / "installation.json").read_bytes()


def test_run_killed_at_every_step_of_writing_ends_with_the_same_bytes(begun):
    dump, out, expected = begun
    (out / "installation.json").write_text("{}")  # of an earlier run
    sorted((out / "work" / "exposures").iterdir())[5].unlink()
    units = {path: path.stat().st_mtime_ns for path in out.glob("work/*/*.parquet")}
    ran = subprocess.run(
        [sys.executable, "-c", KILLED, str(dump), str(out)], capture_output=True, text=True, timeout=300
    )
    assert ran.returncode == 0, ran.stderr
    deaths = [line.split() for line in ran.stdout.splitlines()]
    assert len(deaths) >= 5 and all(killed == "True" for killed, _, _ in deaths[:-1])
    assert any(left == "1" for _, _, left in deaths)  # some died with a file half written
    # The file that says that all is there, an earlier run's removed, was there only once everything was.
    assert [finished for _, finished, _ in deaths[:-2]] == ["False"] * (len(deaths) - 2)
    assert (out / "installation.json").read_bytes() == expected
    assert len(units) == 13 and all(path.stat().st_mtime_ns == made for path, made in units.items())
    for path in out.rglob("*.parquet"):
        read_parquet(path)
    lines = status_lines(run_status(out))
    assert "star exposures            14 done" in lines and lines[-1].startswith("finished")


@pytest.mark.parametrize("step", ["written", "flushed", "renamed"])
def test_unit_is_the_old_one_or_the_new_one_whenever_its_process_is_killed(step: str, tmp_path: Path) -> None:
    store, table = UnitStore(tmp_path), pa.table({"a": [1.0, 2.0]})
    store.write("stage", "s1", "old", table, {"id": "s1"})
    ran = subprocess.run([sys.executable, "-c", KILLED_AT, step, str(tmp_path)], timeout=60)
    assert ran.returncode == -signal.SIGKILL
    assert store.read("stage", "s1", "old") is not None
    assert (store.read("stage", "s1", "new") is not None) == (step == "renamed")


def no_space(*arguments: object, **named: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def half_written(table: pa.Table, target: Path, **named: object) -> None:
    """What pyarrow does on a full disk: some bytes, then an error that names no file."""
    Path(target).write_bytes(b"PAR1" + bytes(1000))
    no_space()


@contextmanager
def files_limited(size: int) -> Iterator[None]:
    """No file of this process may become larger."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


NO_SPACE = "No space left on device"
FULL = {
    "unit half written": (partial(patch.object, pq, "write_table", half_written), "matching-0/", NO_SPACE),
    "unit not flushed": (partial(patch.object, os, "fsync", no_space), "matching-0/", NO_SPACE),
    "unit too large": (partial(files_limited, 8192), "matching-0/", "too large"),
    "table": (partial(patch.object, pq, "ParquetWriter", no_space), "sightings/stars.parquet", NO_SPACE),
    "installation.json": (partial(patch.object, Path, "write_text", no_space), "installation.json", NO_SPACE),
}


@pytest.mark.parametrize("what", FULL)
def test_full_disk_is_told_with_the_file_and_the_run_goes_on_when_there_is_room(what, begun, capsys):
    (dump, out, expected), (full, named, says) = begun, FULL[what]
    command = ("calibrate", dump, "--out", out, "--workers", 1, "--no-report")
    if named != "matching-0/":  # its units are there already
        shutil.copytree(dump.parent / "result" / "work", out / "work", dirs_exist_ok=True)
    units = {path: path.stat().st_mtime_ns for path in out.glob("work/*/*.parquet")}
    with full():
        status, told = ended(capsys, *command)
    told = told.replace("\n", "")
    assert status == 1
    assert "error: " in told and named in told and says in told, told
    assert not (out / "installation.json").exists()
    assert not list(out.rglob("*.tmp"))
    assert {path: path.stat().st_mtime_ns for path in out.glob("work/*/*.parquet")} == units
    assert ended(capsys, *command)[0] == 0
    assert (out / "installation.json").read_bytes() == expected
    assert all(path.stat().st_mtime_ns == made for path, made in units.items())


def test_unit_damaged_on_the_disk_is_made_anew_and_counted_by_status(tmp_path: Path) -> None:
    """Any single byte of a unit's data changed: it is rejected."""
    root = write_sound_files(tmp_path)
    store = UnitStore(root / "run/work")
    path = store.path("exposures", "e1", "0" * 32)
    sound = path.read_bytes()
    content = store.read("exposures", "e1", "0" * 32)
    for at in range(0, len(sound), 7):
        damaged = bytearray(sound)
        damaged[at] ^= 0x10
        path.write_bytes(bytes(damaged))
        table = store.read("exposures", "e1", "0" * 32)
        # Some bytes bear no meaning: statistics, the name of the writer.
        assert table is None or table.to_pylist() == content.to_pylist()
    path.write_bytes(sound[:-100])
    assert "star exposures            0 done, 1 damaged files" in status_lines(run_status(root / "run"))


def test_error_of_a_file_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"No space left on device.*table.csv"):
        write_whole(tmp_path / "table.csv", no_space)
    with pytest.raises(RawDataError, match=r"table.parquet: file: found no such file, expected the table"):
        read_parquet(tmp_path / "table.parquet")


def test_interrupted_run_says_what_is_kept_and_what_it_still_needs(handmade, tmp_path, monkeypatch, capsys):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    result = tmp_path / "a result"
    monkeypatch.setattr("boresight.pipeline.stages.head.fit_exposures", interrupt)
    status, told = ended(capsys, "calibrate", handmade, "--out", result, "--workers", 1)
    said = told.splitlines()
    assert status == 130
    assert f"finished units are kept in {result}: 4 of star exposures" in said
    assert f"go on with: boresight calibrate {handmade} --out '{result}' --workers 1" in said
    assert f"look at it with: boresight status '{result}'" in said and said[-1] == "interrupted"
    lines = status_lines(run_status(result))
    assert (
        "star exposures            4 done, 4 not used" in lines
        and "needs                     targets, round 1: 1 more: s1" in lines
    )
    assert sum(line.startswith("  exposure 000") for line in lines) == 4
    assert lines[-1] == "not finished: no installation.json yet; the same `boresight calibrate` goes on"
    shutil.rmtree(handmade)
    assert any(line.startswith("what is missing is not known: ") for line in status_lines(run_status(result)))
