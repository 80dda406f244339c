"""Errors that a user can act on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from boresight.records.ledger import Entry

__all__ = ["DataNotSufficientError", "RawDataError", "WorkerError", "printable", "refusing"]


class RawDataError(Exception):
    """A file is missing, damaged or out of range.

    `file` is the path as the user knows it (relative to the dump where there is one), `field` the key,
    column, row or byte offset concerned, `found` its content, `expected` what is allowed. Characters that are
    not printable are escaped in all of them.
    """

    def __init__(self, file: str, field: str, found: object, expected: str) -> None:
        super().__init__(file, field, found, expected)
        self.file: str = printable(file)
        self.field: str = _short(field)
        self.found: str = _short(found)
        self.expected: str = printable(expected)
        self.others: tuple[RawDataError, ...] = ()  # further errors of that file, for `boresight dump check`

    def __str__(self) -> str:
        return f"{self.file}: {self.field}: found {self.found}, expected {self.expected}"


class DataNotSufficientError(Exception):
    """All files could be read, but their data do not fix the result (exit status 1). The message says what is
    missing; `omissions` is what was not used until then, with reasons.
    """

    def __init__(self, message: str, omissions: Sequence[Entry] = ()) -> None:
        super().__init__(message)
        self.omissions: tuple[Entry, ...] = tuple(omissions)


class WorkerError(Exception):
    """A unit could not be computed: its process died repeatedly, no worker can do it, a store is silent."""


@contextmanager
def refusing(
    file: str,
    field: str,
    expected: str,
    kinds: type[Exception] | tuple[type[Exception], ...] = ValueError,
    found: object = None,
) -> Iterator[None]:
    """Errors of these kinds become a `RawDataError` about a field of a file; `found` is else their text."""
    try:
        yield
    except kinds as error:
        raise RawDataError(file, field, str(error) if found is None else found, expected) from error


def printable(text: str) -> str:
    """`text` as one line: control, escape and direction characters are written as escapes (`\\x1b`)."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def _short(found: object) -> str:
    """`found` as one printable line of at most 160 characters: a hostile file must not flood a terminal."""
    try:
        text = found if isinstance(found, str) else repr(found)
    except (ValueError, RecursionError):  # an integer of thousands of digits
        text = f"a {type(found).__name__} too long to be shown"
    text = printable(text[:200])
    return text if len(text) <= 160 else text[:157] + "..."
