"""Who does the units of work: this process, several of this machine, or a dask cluster by its address.

On a cluster, too, each process works on one unit at a time, and at most one more waits for it. A unit whose
process dies is given to another one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from boresight.pipeline.errors import WorkerError
from boresight.pipeline.work.executor import Executor, InOrder
from boresight.pipeline.work.processes import Processes

__all__ = ["executor_for"]

SMALL_JOB_PIXELS = 20_000_000  # one full-size exposure: a second of work

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


@dataclass(frozen=True, slots=True)
class OnCluster:
    """An executor with a dask client. Outcomes come back in the order of the items."""

    client: Any

    def map(
        self, function: Callable[[Item], Outcome], items: Sequence[Item], done: Callable[[int], None]
    ) -> list[Outcome]:
        from distributed import as_completed
        from distributed.scheduler import KilledWorker

        waiting = iter(enumerate(items))
        place: dict[str, int] = {}
        outcomes: dict[int, Outcome] = {}
        room = 2 * max(1, len(self.client.scheduler_info(n_workers=-1)["workers"]))

        def submit() -> list[Any]:
            for n, item in waiting:
                future = self.client.submit(function, item, pure=False, retries=0)
                place[future.key] = n
                return [future]
            return []

        running = as_completed([future for _ in range(room) for future in submit()])
        for future in running:
            n = place.pop(future.key)
            try:
                outcomes[n] = future.result()
            except KilledWorker as error:
                raise WorkerError(f"unit {n + 1} of {len(items)}: {error}") from error
            future.release()
            done(len(outcomes))
            running.update(submit())
        return [outcomes[n] for n in range(len(items))]


@contextmanager
def executor_for(workers: int | None, scheduler: str | None, pixels: int) -> Iterator[Executor]:
    """This process for one worker; that many processes of this machine; or the cluster at an address.

    `workers` None means as many as this machine has cores for us, and this process alone where the job has so
    few `pixels` that starting others would take longer than the job.
    """
    if scheduler is not None:
        with _client(scheduler) as client:
            yield OnCluster(client)
        return
    count = workers if workers is not None else (1 if pixels < SMALL_JOB_PIXELS else _cores())
    yield InOrder() if count == 1 else Processes(count)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _client(address: str) -> Iterator[Any]:
    from distributed import Client

    try:
        client = Client(address, timeout=30)
    except (OSError, TimeoutError, ValueError) as error:
        raise WorkerError(f"no scheduler at {address}: {error}") from error
    with client:
        yield client
