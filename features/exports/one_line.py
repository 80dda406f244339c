"""Texts of a dump made safe for line-oriented formats."""

from __future__ import annotations

__all__ = ["one_line"]


def one_line(text: str) -> str:
    """The text with every control or other unprintable character replaced by a space."""
    return "".join(c if c.isprintable() else " " for c in text)
