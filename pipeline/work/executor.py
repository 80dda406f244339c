"""Something that applies a function to many items: this process, or others (`pipeline.work.workers`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

__all__ = ["Executor", "InOrder"]

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


class Executor(Protocol):
    """Something that applies a function to many items, here or elsewhere."""

    def map(
        self, function: Callable[[Item], Outcome], items: Sequence[Item], done: Callable[[int], None]
    ) -> list[Outcome]:
        """Outcomes in the order of the items; calls `done(n)` with the number finished."""


@dataclass(frozen=True, slots=True)
class InOrder:
    """The executor that works in this process, one item after another."""

    def map(
        self, function: Callable[[Item], Outcome], items: Sequence[Item], done: Callable[[int], None]
    ) -> list[Outcome]:
        outcomes = []
        for n, item in enumerate(items):
            outcomes.append(function(item))
            done(n + 1)
        return outcomes
