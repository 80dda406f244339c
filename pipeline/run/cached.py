"""Stages run over many tasks, with finished work kept on disk where there is a store.

A stage is a function from a task to a record. Its entry in the store is known by a digest of the task and of
everything installed that the outcome depends on (`program`). An entry that exists is read, not computed.
A failure ends its own task, whose reason names the exception, and not the run.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import field
from pathlib import Path
from typing import Any, Protocol, get_args, get_type_hints

from boresight.pipeline.errors import printable
from boresight.pipeline.files.content import Identity, remember_digest, with_identity
from boresight.pipeline.files.record_tables import record_from_table, table_from_record
from boresight.pipeline.run.digests import digest, files_in
from boresight.pipeline.run.executor import Executor, InOrder
from boresight.pipeline.run.program_key import program_digest
from boresight.pipeline.run.unforeseen import UNFORESEEN, internal_error
from boresight.pipeline.run.unit_store import UnitStore, read_meta
from boresight.records.ledger import Entry, Reason
from boresight.records.record import record, scalar

__all__ = ["Progress", "StageRunner", "Task", "Unit", "log_unit"]

Progress = Callable[[str, int, int], None]  # name of the stage, tasks done, tasks in all


class Task(Protocol):
    """Everything that one outcome of a stage depends on. `item` names what is processed, without a reason."""

    @property
    def item(self) -> Entry:
        """What is processed."""


@record
class Unit:
    """A finished task."""

    outcome: Any = scalar("what the stage returned")
    computed: bool = scalar("whether it was computed now")
    contents: tuple[tuple[Path, Identity, str], ...] = scalar("its files with their digests", default=())


@record(by_value=True)
class StageRunner:
    """Runs stages: store of finished units (None: none is kept), executor, progress callback; and counts the
    units that were computed (True) or read from the store.
    """

    store: UnitStore | None = None
    executor: Executor = field(default_factory=InOrder)
    progress: Progress = lambda stage, done, total: None
    computed: Counter[bool] = field(default_factory=Counter)

    def run(
        self, stage: Callable[..., Any], tasks: Sequence[Task], *, folder: str, in_parts: bool = False
    ) -> list[Any]:
        """Outcomes of the function `stage` in the order of its tasks.

        An outcome is of a type that `stage` is declared to return, `Entry` among them: this is also what
        an unforeseen error becomes. `folder` is that of the entries in the store. With `in_parts` the stage
        gets, after its task, an executor for parts of it: fewer tasks than processes are divided.
        """

        def ended(n: int, unit: Unit) -> None:
            for content in unit.contents:
                remember_digest(*content)
            self.computed[unit.computed] += 1
            log_unit(folder, unit.outcome, unit.computed)
            self.progress(folder, n, len(tasks))

        self.progress(folder, 0, len(tasks))
        if self.store is not None:
            program_digest(stage.__module__, __name__)  # once, for all processes that are forked from here
        more = (self.executor.share(len(tasks)),) if in_parts else ()
        done = self.executor.map(Cached(stage, self.store, folder, more), tasks, ended)
        return [unit.outcome for unit in done]


@record(by_value=True)
class Cached:
    """A stage with a store around it."""

    stage: Callable[..., Any]
    store: UnitStore | None
    folder: str
    more: tuple[Executor, ...] = ()  # arguments after the task, on which no outcome depends

    def __call__(self, task: Task) -> Unit:
        if self.store is None:
            return Unit(self._computed(task), True)
        code = program_digest(self.stage.__module__, __name__)
        name, key = task.item.subject.name, digest(self.stage.__name__, code, task)
        records = get_args(get_type_hints(self.stage)["return"])
        if (kept := self.store.read(self.folder, name, key)) is not None:
            return Unit(record_from_table(records, kept, read_meta(kept)), False, _contents(task))
        table, values = table_from_record(self._computed(task))
        self.store.write(self.folder, name, key, table, values)
        return Unit(record_from_table(records, table, values), True, _contents(task))

    def _computed(self, task: Task) -> Any:
        try:
            return self.stage(task, *self.more)
        except UNFORESEEN as error:
            reason = internal_error(error, self.stage.__name__)
            return task.item.because(Reason.INTERNAL_ERROR, reason)


def _contents(task: Task) -> tuple[tuple[Path, Identity, str], ...]:
    """Digests of the files of a task, which its key has needed: for the process that counts them."""
    with suppress(OSError):  # missing: the outcome says so
        return tuple((path, *with_identity(path)) for path in files_in(task))
    return ()


log = logging.getLogger("boresight.commands.units")  # shown by commands with --verbose, kept by --log-file


def log_unit(stage: str, outcome: Any, computed: bool) -> None:
    """Log the outcome of one exposure or strip of a stage, and each reason why something is not used."""
    if not log.isEnabledFor(logging.DEBUG):
        return
    lines = outcome.told() if hasattr(outcome, "told") else [type(outcome).__name__]
    if isinstance(outcome, Entry):
        lines = [f"{outcome.subject.name}: not used, {outcome.text}"]
    found = "" if computed else " (from an earlier run)"
    for n, line in enumerate(lines):
        log.debug("%s", printable(f"{stage} {line}{found}" if n == 0 else f"    {line}"))
