"""Units done by other processes: some die, some raise errors, none outlives the run. What a killed run leaves
on the disk: `faults/test_interrupted.py`.
"""

import errno
import mmap
import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from boresight.pipeline.errors import WorkerError
from boresight.pipeline.run.executor import InOrder, executor_for


def test_unit_whose_process_dies_is_done_by_another(tmp_path: Path) -> None:
    marker = tmp_path / "died once"

    def fragile(number: int) -> int:
        if number == 2 and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return number * number

    counts: list[int] = []
    with executor_for(2, None, 0) as executor:
        assert executor.map(fragile, [0, 1, 2, 3], lambda n, outcome: counts.append(n)) == [0, 1, 4, 9]
    assert marker.exists()
    assert counts[-1] == 4


def test_unit_that_kills_every_process_is_named() -> None:
    def deadly(number: int) -> int:
        if number == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return number

    with (
        executor_for(2, None, 0) as executor,
        pytest.raises(WorkerError, match=r"unit 2 of 3: .* died 3 times"),
    ):
        executor.map(deadly, [0, 1, 2], lambda n, outcome: None)


def test_units_fewer_than_processes_have_their_parts_done_by_the_others() -> None:
    def done_by(part: int) -> tuple[int, int]:
        time.sleep(0.05)  # or one process does them all
        return part, os.getpid()

    def unit(number: int) -> tuple[int, list[tuple[int, int]]]:
        return os.getpid(), parts.map(done_by, range(6), lambda n, outcome: None)

    with executor_for(4, None, 0) as executor:
        for units, count in ((1, 4), (2, 2), (3, 1), (5, 1)):
            parts = executor.share(units)
            for own, outcome in executor.map(unit, range(units), lambda n, outcome: None):
                assert [part for part, _ in outcome] == list(range(6))
                assert len({process for _, process in outcome}) == count
                assert all((process == own) == (count == 1) for _, process in outcome)


def test_error_of_a_unit_is_told_by_the_first_process_with_the_place_where_it_arose() -> None:
    def full(number: int) -> int:
        raise OSError(errno.ENOSPC, "no space left", f"unit {number}")

    with executor_for(2, None, 0) as executor, pytest.raises(OSError, match="no space left") as caught:
        executor.map(full, [0, 1], lambda n, outcome: None)
    assert caught.value.errno == errno.ENOSPC
    assert "in full" in caught.value.__notes__[0]


def test_processes_share_the_units_and_are_gone_afterwards() -> None:
    def slow(number: int) -> tuple[int, int]:
        time.sleep(0.05)
        return number, os.getpid()

    with executor_for(2, None, 0) as executor:
        outcomes = executor.map(slow, range(8), lambda n, outcome: None)
    assert [number for number, _ in outcomes] == list(range(8))
    workers = {process for _, process in outcomes}
    assert len(workers) == 2 and os.getpid() not in workers
    for process in workers:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="others keep no freed memory below used")
def test_freed_memory_is_no_part_of_processes() -> None:
    def resident_mib(pid: int) -> float:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * mmap.PAGESIZE / 2**20

    blocks = [os.urandom(60_000) for _ in range(2000)]  # 114 MiB, none given back by itself
    kept, before = blocks[::50], resident_mib(os.getpid())
    del blocks
    with executor_for(2, None, 0) as executor:
        own = executor.map(lambda unit: resident_mib(os.getpid()), [0, 1], lambda n, outcome: None)
    assert max(resident_mib(os.getpid()), *own) < before - 100.0, len(kept)


def test_workers_of_a_killed_run_end_by_themselves(tmp_path: Path) -> None:
    program = """
import os, sys, time
from pathlib import Path
from boresight.pipeline.run.executor import Processes

def slow(number):
    Path(sys.argv[1], str(os.getpid())).touch()
    time.sleep(0.1)

Processes(2).map(slow, range(1000), lambda n, outcome: None)
"""
    first = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)])
    while len(workers := [int(path.name) for path in tmp_path.iterdir()]) < 2:
        time.sleep(0.01)
    first.kill()
    first.wait()
    deadline = time.monotonic() + 20.0
    while any(Path("/proc", str(worker)).exists() for worker in workers) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not any(Path("/proc", str(worker)).exists() for worker in workers)


def test_one_worker_and_a_single_unit_need_no_other_process() -> None:
    with executor_for(2, None, 0) as executor:
        assert executor.map(lambda n: (n, os.getpid()), [3], lambda n, outcome: None) == [(3, os.getpid())]
    with executor_for(1, None, 10**12) as executor:
        assert isinstance(executor, InOrder)
        assert executor.map(lambda n: (n, os.getpid()), [3], lambda n, outcome: None) == [(3, os.getpid())]
