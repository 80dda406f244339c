"""What can be wrong with a file, and how it is told: which file, which field, what was found, what was
expected.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["DataNotSufficientError", "Omission", "RawDataError", "WorkerError"]


class RawDataError(Exception):
    """A file is missing, damaged or says something that cannot be. Four facts, always all four.

    `file` is the path as the user knows it (relative to the dump where there is one), `field` the key,
    column, row or byte offset concerned, `found` what stands there, `expected` what would have been right.
    """

    def __init__(self, file: str, field: str, found: object, expected: str) -> None:
        super().__init__(file, field, found, expected)
        self.file, self.field, self.found, self.expected = file, field, _short(found), expected

    def __str__(self) -> str:
        return f"{self.file}: {self.field}: found {self.found}, expected {self.expected}"


class DataNotSufficientError(Exception):
    """Everything could be read, and still there is no answer in it (exit status 1). The message says what
    lacks.
    """


class WorkerError(Exception):
    """A unit could not be done: its process died again and again, or no worker can be reached."""


@dataclass(frozen=True, slots=True)
class Omission:
    """Something that was left out of the calibration, counted and reported.

    `kind` is one of exposure, strip, ccd, chip, target; `name` its id in the dump (a strip's target is
    "strip/target"); `file` the file concerned or ""; `reason` one sentence with the numbers in it.
    """

    kind: str
    name: str
    file: str
    reason: str


def _short(found: object) -> str:
    """What was found, as one printable line of bounded length: a hostile file must not flood a terminal."""
    try:
        text = found if isinstance(found, str) else repr(found)
    except (ValueError, RecursionError):  # an integer of thousands of digits
        text = f"a {type(found).__name__} too long to be shown"
    text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text[:200])
    return text if len(text) <= 160 else text[:157] + "..."
