"""Work that is asked for later, done by a process that takes what processor time the others leave.

Processes wait for one another: while one strip is searched alone, for the last of three strips, and while the
first process writes. What nothing else depends on fills these gaps. Outcomes go into a file without a name:
they may be larger than a pipe holds while nobody reads it.
"""

from __future__ import annotations

import os
import pickle
import signal
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import IO, Any, TypeVar

from boresight.pipeline.run.executor import Executor
from boresight.pipeline.run.processes import FORKS, START, Processes

__all__ = ["Ahead", "work_ahead"]

Key = TypeVar("Key")
Item = TypeVar("Item")
Outcome = TypeVar("Outcome")
Ahead = Callable[[Sequence[Key]], dict[Key, Outcome]]
LEAST_URGENT = 19  # of the system's niceness


@contextmanager
def work_ahead(
    executor: Executor, function: Callable[[Item], Outcome], items: Mapping[Key, Item]
) -> Iterator[Ahead[Key, Outcome]]:
    """Outcomes of items by their keys, when these are asked for. What is not done by then is left to the
    executor: everything unless it is one of forked processes.
    """
    with tempfile.TemporaryFile() as kept:
        process = START.Process(target=_one_after_another, args=(kept, function, list(items.values())))
        if begun := FORKS and isinstance(executor, Processes) and bool(items):
            process.start()

        def stop() -> None:
            if begun:
                process.kill()
                process.join()

        def outcomes(keys: Sequence[Key]) -> dict[Key, Outcome]:
            stop()
            done = dict(zip(items, _outcomes(kept)))
            rest = [key for key in keys if key not in done]
            more = executor.map(function, [items[key] for key in rest], lambda n, outcome: None)
            return done | dict(zip(rest, more))

        try:
            yield outcomes
        finally:
            stop()


def _one_after_another(kept: IO[bytes], function: Callable[[Any], Any], items: Sequence[Any]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process receives it too and stops this one
    os.nice(LEAST_URGENT)
    for item in items:
        pickle.dump(function(item), kept)
        kept.flush()


def _outcomes(kept: IO[bytes]) -> Iterator[Any]:
    """What a process that is gone has written; the last outcome may be incomplete."""
    kept.seek(0)
    try:
        while True:
            yield pickle.load(kept)
    except (EOFError, pickle.UnpicklingError):
        return
