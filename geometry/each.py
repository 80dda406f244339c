"""A calculation in parts that do not depend on one another, and who computes them."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

__all__ = ["Each"]

Each = Callable[[Callable[[Any], Any], Sequence[Any]], Iterable[Any]]  # as `map`, perhaps by many at once
