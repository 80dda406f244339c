"""Executors apply a function to many items: in this process, or in others (`pipeline.run.workers`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

__all__ = ["Executor", "InOrder"]

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


@dataclass(frozen=True, slots=True)
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
