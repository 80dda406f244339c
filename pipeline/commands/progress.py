"""Progress bars of long work, on stderr."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # rich takes 0.15 s to import, and most commands print one line
    from rich.console import Console
    from rich.progress import Progress

__all__ = ["progress_bar", "progress_bars", "remarks"]


@lru_cache(maxsize=1)
def remarks() -> Console:
    """The console of progress bars and remarks: stderr."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, emoji=False, markup=False)


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A bar that vanishes when the work is done."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=remarks(), transient=True) as bar:
        yield bar


@contextmanager
def progress_bars() -> Iterator[Callable[[str, int, int], None]]:
    """A listener to a run's progress (stage, done, in all): one bar a stage."""
    with progress_bar() as bar:
        bars: dict[str, Any] = {}

        def told(stage: str, done: int, total: int) -> None:
            if stage not in bars:
                bars[stage] = bar.add_task(stage, total=total)
            bar.update(bars[stage], completed=done)

        yield told
