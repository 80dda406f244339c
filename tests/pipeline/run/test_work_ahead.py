"""Work done ahead by a process beside the others: the same outcomes, however far it came."""

from __future__ import annotations

import os
import signal
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from boresight.pipeline.run.executor import InOrder
from boresight.pipeline.run.work_ahead import work_ahead
from boresight.pipeline.run.workers import executor_for

forked = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")


@forked
@pytest.mark.parametrize("last", [1, 3])
def test_outcomes_are_the_same_however_far_the_process_came_before_it_died(tmp_path: Path, last: int) -> None:
    first, long = os.getpid(), bytes(2**20)  # longer than a pipe holds

    def unit(number: int) -> tuple[int, bytes]:
        (tmp_path / f"{number} {os.getpid()}").touch()
        if number == last and len(list(tmp_path.iterdir())) == last + 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return number, long

    with (
        executor_for(2, None, 0) as executor,
        work_ahead(executor, {str(n): partial(unit, n) for n in range(4)}) as ahead,
    ):
        while not list(tmp_path.glob(f"{last} *")):
            time.sleep(0.01)
        found = ahead(["0", "1", "2", "3"])
    assert found == {str(n): (n, long) for n in range(4)}
    made = {path.name for path in tmp_path.iterdir()}
    assert len(made) == 5, made  # none twice but the one that ended the process
    processes = {int(name.split()[1]) for name in made}
    assert first not in processes
    for process in processes:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


@forked
def test_process_is_gone_when_nothing_is_asked_of_it(tmp_path: Path) -> None:
    def slow() -> None:
        (tmp_path / str(os.getpid())).touch()
        time.sleep(60.0)

    with executor_for(2, None, 0) as executor, work_ahead(executor, {"a": slow}):
        while not (begun := list(tmp_path.iterdir())):
            time.sleep(0.01)
    with pytest.raises(ProcessLookupError):
        os.kill(int(begun[0].name), 0)


def test_one_process_computes_only_what_is_asked_for() -> None:
    made: list[int] = []
    with work_ahead(InOrder(), {"a": partial(made.append, 1), "b": partial(made.append, 2)}) as ahead:
        assert made == []
        assert ahead(["b"]) == {"b": None}
    assert made == [2]
