"""Errors that a user can act on, and the record of what a calibration does not use."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from enum import StrEnum

from boresight.geometry.record import record, scalar

__all__ = ["Cause", "DataNotSufficientError", "Omission", "RawDataError", "WorkerError", "printable"]


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

    def __init__(self, message: str, omissions: Sequence[Omission] = ()) -> None:
        super().__init__(message)
        self.omissions: tuple[Omission, ...] = tuple(omissions)


class WorkerError(Exception):
    """A unit could not be computed: its process died repeatedly, no worker can do it, a store is silent."""


class Cause(StrEnum):
    """Why something is not used. A target that was not matched has the matcher's reason instead."""

    UNREADABLE = "file not usable"
    NOT_IDENTIFIED = "not identified"
    NOT_COVERED = "not covered by orbit or star exposures"
    NO_TARGET = "no target matched"
    NOT_A_SKY_STRIP = "not a strip of the sky"
    OTHER_SMEAR = "not the images that its TDI stages make"
    NOT_CALIBRATED = "no result"
    MARKED_INVALID = "marked invalid"
    REPEATED = "given twice"
    SAME_PIXELS = "same pixels as another"
    OUT_OF_VIEW = "in no strip"
    OUTSIDE_CHIP = "outside chip"
    NOT_NEEDED = "not near a strip"
    ATTITUDES_NOT_NEEDED = "with attitudes not near a strip"
    INTERNAL_ERROR = "internal error"


@record
class Omission:
    """Something that the calibration does not use, counted and reported."""

    kind: str = scalar("exposure, head, strip, ccd, chip, target, star or dump")
    name: str = scalar('id in the dump; a target of a strip is "strip/target"')
    file: str = scalar("file concerned, or empty", default="")
    reason: str = scalar("one sentence with the numbers", default="")
    cause: str = scalar("a `Cause`, or the matcher's reason", default=Cause.UNREADABLE)

    @property
    def target_id(self) -> str:
        """The target alone, of "strip/target, CCD 1" or of a chip's name."""
        return self.name.rpartition("/")[2].partition(",")[0]

    def because(self, reason: str, cause: str = Cause.UNREADABLE) -> Omission:
        """This item with a reason."""
        return dataclasses.replace(self, reason=reason, cause=str(cause))


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
