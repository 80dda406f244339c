"""Work that is asked for later, done by a process that takes what processor time the others leave.

Processes wait for one another: while one strip is searched alone, for the last of three strips, and while the
first process writes. What nothing else depends on fills these gaps. Outcomes go into a file in memory, since
a pipe holds less than one of them until it is read.
"""

from __future__ import annotations

import io
import os
import pickle
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from operator import call
from typing import IO, Any, TypeVar

from boresight.pipeline.run.executor import Executor
from boresight.pipeline.run.processes import FORKS, START, Processes

__all__ = ["Ahead", "work_ahead"]

Key = TypeVar("Key")
Outcome = TypeVar("Outcome")
Ahead = Callable[[Sequence[Key]], dict[Key, Outcome]]
LEAST_URGENT = 19  # of the system's niceness


@contextmanager
def work_ahead(
    executor: Executor, work: Mapping[Key, Callable[[], Outcome]]
) -> Iterator[Ahead[Key, Outcome]]:
    """Outcomes of pieces of work by their keys, when these are asked for. What is not done by then is left to
    the executor: everything unless it is one of forked processes.
    """
    forks = FORKS and isinstance(executor, Processes) and bool(work)
    with open(os.memfd_create("work ahead"), "w+b") if forks else io.BytesIO() as kept:
        process = START.Process(target=_one_after_another, args=(kept, list(work.values())))
        if forks:
            process.start()

        def stop() -> None:
            if forks:
                process.kill()
                process.join()

        def outcomes(keys: Sequence[Key]) -> dict[Key, Outcome]:
            stop()
            done = dict(zip(work, _outcomes(kept)))
            rest = [key for key in keys if key not in done]
            more = executor.map(call, [work[key] for key in rest], lambda n, outcome: None)
            return done | dict(zip(rest, more))

        try:
            yield outcomes
        finally:
            stop()


def _one_after_another(kept: IO[bytes], work: Sequence[Callable[[], Any]]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process receives it too and stops this one
    os.nice(LEAST_URGENT)
    with suppress(Exception):  # it arises again where the rest is done
        for piece in work:
            pickle.dump(piece(), kept)
            kept.flush()


def _outcomes(kept: IO[bytes]) -> Iterator[Any]:
    """What a process that is gone has written; the last outcome may be incomplete."""
    kept.seek(0)
    try:
        while True:
            yield pickle.load(kept)
    except (EOFError, pickle.UnpicklingError):
        return
