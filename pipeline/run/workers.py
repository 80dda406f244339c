"""The executor that the user asks for: this process, several of this machine, or a dask cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from boresight.pipeline.errors import WorkerError
from boresight.pipeline.run.executor import Executor, InOrder
from boresight.pipeline.run.processes import Processes

__all__ = ["executor_for"]

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
            raise WorkerError(
                f"a scheduler needs dask: pip install 'boresight[cluster]' ({error})"
            ) from error
        with on_cluster(scheduler, probes, wait_s, say) as executor:
            yield executor
        return
    count = workers or (_processors() if pixels >= SMALL_JOB_PIXELS else 1)
    yield InOrder() if count == 1 else Processes(count)


def _processors() -> int:
    """Number of processors that this machine lends to the program."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
