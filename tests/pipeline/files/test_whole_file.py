"""Temporary files of killed processes are removed, those of others are not."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files import whole_file
from boresight.pipeline.files.whole_file import remove_abandoned, write_inside, write_whole

KILLED = """
import os, signal, sys
from pathlib import Path
from boresight.pipeline.files.whole_file import write_whole

def write(path):
    path.write_bytes(b"half")
    os.kill(os.getpid(), signal.SIGKILL)

write_whole(Path(sys.argv[1]), write)
"""


def killed_while_writing(path: Path) -> Path:
    ran = subprocess.run([sys.executable, "-c", KILLED, str(path)], timeout=60)
    assert ran.returncode == -signal.SIGKILL
    (left,) = path.parent.glob(f".{path.name}.*.tmp")
    return left


def test_only_temporary_files_of_dead_processes_of_ours_are_removed(tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    left = killed_while_writing(tmp_path / "work" / "unit.parquet")
    others = [tmp_path / ".users.tmp", tmp_path / "work" / "plain.tmp", tmp_path / ".x.boresight-1-2-3.tmp"]
    for other in others:
        other.write_text("not ours")
    during: list[bool] = []

    def write(path: Path) -> None:
        path.write_text("whole")
        remove_abandoned(tmp_path)
        during.append(path.exists())

    write_whole(tmp_path / "file", write)
    assert during == [True]  # this process lives: its own temporary file stays
    assert not left.exists()
    assert all(other.read_text() == "not ours" for other in others)
    assert (tmp_path / "file").read_text() == "whole"


def test_folder_that_becomes_a_link_during_a_run_is_not_followed(tmp_path: Path) -> None:
    folder, outside = tmp_path / "sightings", tmp_path / "outside"
    outside.mkdir()
    write_inside(folder / "first", lambda path: path.write_text("1"))
    folder.rename(tmp_path / "aside")
    folder.symlink_to(outside)
    with pytest.raises(RawDataError, match="sightings: folder of the result: found a link"):
        write_inside(folder / "second", lambda path: path.write_text("2"))
    assert not list(outside.iterdir())


def test_temporary_file_of_another_machine_stays_for_a_day(tmp_path, monkeypatch):
    left = killed_while_writing(tmp_path / "unit")
    monkeypatch.setattr(whole_file.platform, "node", lambda: "another")
    remove_abandoned(tmp_path)
    assert left.exists()
    now = whole_file.time.time()
    monkeypatch.setattr(whole_file.time, "time", lambda: now + 86_401.0)
    remove_abandoned(tmp_path)
    assert not left.exists()
