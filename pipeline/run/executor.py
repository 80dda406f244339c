"""Executors apply a function to many items: in this process, in others of this machine, or on a cluster.

Where the system can fork, a process starts in milliseconds and shares this one's memory: libraries, terrain,
the items themselves. Only the number of an item and its outcome are transferred. Each process computes one
unit at a time, so the number of images in memory is the number of processes. A unit whose process dies is
given to another one; a unit that kills three processes is an error that names it.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkContext, SpawnContext
from pathlib import Path
from typing import Any, Protocol, TypeVar

from boresight.pipeline.errors import WorkerError
from boresight.records.record import record

__all__ = ["FORKS", "Executor", "InOrder", "Processes", "executor_for"]

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


class Executor(Protocol):
    """Applies a function to many items, in this process or in others."""

    def map(
        self, function: Callable[[Item], Outcome], items: Sequence[Item], done: Callable[[int, Outcome], None]
    ) -> list[Outcome]:
        """Outcomes in the order of the items; calls `done(n, outcome)` as each ends, n of them finished."""

    def share(self, count: int) -> Executor:
        """What each of `count` items has for its own parts, where it is computed."""


@record(by_value=True)
class InOrder:
    """Applies the function in this process, one item after another."""

    def map(
        self, function: Callable[[Item], Outcome], items: Sequence[Item], done: Callable[[int, Outcome], None]
    ) -> list[Outcome]:
        """Outcomes in the order of the items."""
        outcomes = []
        for n, item in enumerate(items):
            outcomes.append(function(item))
            done(n + 1, outcomes[-1])
        return outcomes

    def share(self, count: int) -> InOrder:
        """This process."""
        return self


# Times that the process of one unit may die before the run ends: memory may be short once.
MAX_DEATHS = 3
DIED = (EOFError, ConnectionError)  # of a pipe whose other end is closed
# Other systems have no fork, or have libraries that do not survive one.
START: ForkContext | SpawnContext = (
    multiprocessing.get_context("fork") if sys.platform == "linux" else multiprocessing.get_context("spawn")
)
FORKS = START.get_start_method() == "fork"  # a process has what this one has, functions without a name too


@record(by_value=True)
class Processes:
    """An executor of `count` processes, which are started for each list of items."""

    count: int

    def map(
        self, function: Callable[[Item], Outcome], items: Sequence[Item], done: Callable[[int, Outcome], None]
    ) -> list[Outcome]:
        """Outcomes in the order of the items; `WorkerError` if an item stops its process again and again."""
        if len(items) == 1:  # a copy of this process would take longer, and what it loads would be lost
            return InOrder().map(function, items, done)
        waiting = [*range(len(items))][::-1]
        outcomes: dict[int, Outcome] = {}
        deaths: Counter[int] = Counter()
        started: list[_Process] = []
        busy: dict[Any, _Process] = {}

        def begin(process: _Process) -> None:
            process.begin(waiting.pop())
            busy[process.pipe] = process

        def start() -> None:
            started.append(_Process(function, items))
            begin(started[-1])

        with suppress(OSError, TypeError, AttributeError):  # glibc alone has it
            ctypes.CDLL(None).malloc_trim(0)  # a process that uses freed heap again would get a copy of it
        try:
            for _ in range(min(self.count, len(items))):
                start()
            while busy:
                for pipe in wait(list(busy)):
                    process = busy.pop(pipe)
                    n = process.unit
                    try:
                        outcome, failure = process.pipe.recv()
                    except DIED as error:
                        deaths[n] += 1
                        if deaths[n] == MAX_DEATHS:
                            message = f"unit {n + 1} of {len(items)}: its process died {MAX_DEATHS} times"
                            raise WorkerError(message) from error
                        waiting.append(n)
                        start()
                        continue
                    if failure is not None:
                        raise failure
                    if waiting:  # it computes while its outcome is counted here
                        begin(process)
                    outcomes[n] = outcome
                    done(len(outcomes), outcome)
        finally:
            for process in started:  # all at once: its memory takes a while to go
                process.process.kill()
            for process in started:
                process.stop()
        return [outcomes[n] for n in range(len(items))]

    def share(self, count: int) -> Processes | InOrder:
        """An equal share of the processes; the item's own process where that is one or none."""
        return Processes(self.count // count) if 0 < 2 * count <= self.count else InOrder()


class _Process:
    """A process that computes one unit after another, and the pipe to it. No daemon: it may start others."""

    def __init__(self, function: Callable[[Any], Any], items: Sequence[Any]) -> None:
        self.pipe, other_end = multiprocessing.Pipe()
        ends = other_end, self.pipe
        self.process = START.Process(target=_serve, args=(*ends, function, items))
        self.process.start()
        other_end.close()
        self.unit = -1

    def begin(self, unit: int) -> None:
        self.unit = unit
        with suppress(ConnectionError):  # a dead process is noticed when its answer is awaited
            self.pipe.send(unit)

    def stop(self) -> None:
        self.process.join()
        self.pipe.close()


def _serve(
    pipe: Connection, far_end: Connection, function: Callable[[Any], Any], items: Sequence[Any]
) -> None:
    """Compute the units received over the connection, until the other end closes."""
    far_end.close()  # or this process itself would keep the pipe open
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process receives it too and stops the others
    sys.stdout, sys.stderr = sys.__stdout__, sys.__stderr__  # those of a progress bar may stay locked
    with suppress(*DIED):
        while True:
            unit = pipe.recv()
            answer: tuple[Any, Exception | None]
            try:
                answer = function(items[unit]), None
            except Exception as error:
                error.add_note(traceback.format_exc())
                answer = None, error
            pipe.send(answer)


SMALL_JOB_PIXELS = 20_000_000  # one full-size exposure: a second of work


@contextmanager
def executor_for(
    workers: int | None,
    scheduler: str | None,
    pixels: int,
    *,
    probes: Sequence[Path] = (),
    wait_s: float | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Iterator[Executor]:
    """This process for one worker; that many processes of this machine; or the cluster at an address.

    `workers` None means one for each core, and this process alone for a job of so few `pixels` that starting
    others would take longer than the job. On a cluster every worker must read the files `probes` as this
    process does; `wait_s` is the longest time without any usable worker, and `say` is called with remarks.
    `WorkerError` where dask is missing or no worker can be used.
    """
    if scheduler is not None:
        try:
            from boresight.pipeline.run.cluster import on_cluster  # dask is of the extra `cluster`
        except ImportError as error:
            remedy = "pip install 'boresight[cluster]'"
            raise WorkerError(f"a scheduler needs dask: {remedy} ({error})") from error
        with on_cluster(scheduler, probes, wait_s, say) as executor:
            yield executor
        return
    count = workers or (_processors() if pixels >= SMALL_JOB_PIXELS else 1)
    yield InOrder() if count == 1 else Processes(count)


def _processors() -> int:
    """Number of processors that this machine lends to the program."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
