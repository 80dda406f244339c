"""Progress of long work: bars on a terminal; elsewhere, and in a log file, a line a stage and each tenth."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from boresight.pipeline.console.messages import log, shows_bars
from boresight.pipeline.run.stage_words import stage_words

__all__ = ["progress_bars"]


@contextmanager
def progress_bars() -> Iterator[Callable[[str, int, int | None], None]]:
    """A listener to a run's progress (stage, done, in all or None): a bar a stage, gone at the end."""
    tenths: dict[str, int] = {}

    def noted(stage: str, done: int, total: int | None) -> None:
        tenth = 10 * done // total if total else 0
        if tenths.get(stage, -1) < tenth:
            tenths[stage] = tenth
            log.info(
                "%s: %d of %s",
                stage_words(stage),
                done,
                "?" if total is None else total,
                extra={"progress": True},
            )

    if sys.stderr is None or not (sys.stderr.isatty() and shows_bars()):
        yield noted
        return
    from rich import console, progress  # 20 ms to load

    columns = (
        progress.TextColumn("{task.description}", markup=False),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        progress.TimeElapsedColumn(),
    )
    errors = console.Console(stderr=True, highlight=False, emoji=False, markup=False)
    with progress.Progress(*columns, console=errors, transient=True) as bar:
        bars: dict[str, Any] = {}

        def shown(stage: str, done: int, total: int | None) -> None:
            noted(stage, done, total)
            if stage not in bars:
                bars[stage] = bar.add_task(stage_words(stage), total=total)
            bar.update(bars[stage], completed=done, total=total)

        yield shown
