"""Executors apply a function to many items: in this process, or in others (`pipeline.run.workers`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeVar

__all__ = ["Executor", "InOrder"]

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


class Executor(Protocol):
    """Applies a function to many items, in this process or in others."""

    @property
    def at_once(self) -> int:
        """Items that this machine computes at the same time."""

    def map(
        self, function: Callable[[Item], Outcome], items: Sequence[Item], done: Callable[[int, Outcome], None]
    ) -> list[Outcome]:
        """Outcomes in the order of the items; calls `done(n, outcome)` as each ends, n of them finished."""

    def share(self, count: int) -> Executor:
        """What each of `count` items has for its own parts, where it is computed."""

    def beside(self, function: Callable[[], object]) -> AbstractContextManager[None]:
        """A block of code beside which the function runs, in another process or after it; both have ended
        when it is left.
        """

    def ahead(
        self, function: Callable[[Item], Outcome], items: Sequence[Item]
    ) -> AbstractContextManager[dict[int, Outcome]]:
        """A block of code, while a processor without other work applies the function to items, in their
        order, as far as it comes; once the block has been left, the outcomes by the numbers of their items.
        """


@dataclass(frozen=True, slots=True)
class InOrder:
    """Applies the function in this process, one item after another."""

    at_once: ClassVar[int] = 1

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

    @contextmanager
    def beside(self, function: Callable[[], object]) -> Iterator[None]:
        """A block of code, and the function after it."""
        yield
        function()

    @contextmanager
    def ahead(
        self, function: Callable[[Item], Outcome], items: Sequence[Item]
    ) -> Iterator[dict[int, Outcome]]:
        """A block of code, and no outcome: one process has no time to spare."""
        yield {}
