"""The accuracy that a user requires of the matrix, kept beside the result as requirement.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from boresight.geometry.record import record, scalar
from boresight.pipeline.results.writing import write_json

__all__ = ["FILE", "Requirement", "write_requirement"]

FILE = "requirement.json"


@record
class Requirement:
    """Largest 1-sigma that is allowed about each axis of the remote-sensing camera; None: not required."""

    arcsec: float | None = scalar("of the rotation, arc-seconds", default=None)
    m: float | None = scalar(
        "of its effect on the ground, m: X, Y at the axis, Z at the swath's edge", default=None
    )

    def __bool__(self) -> bool:
        return self.arcsec is not None or self.m is not None


def write_requirement(result: Path, requirement: Requirement) -> bool:
    """Keep a requirement in the folder of a result; whether one was given. An earlier one is replaced."""
    if not requirement:
        return False
    content: dict[str, Any] = {"arcsec": requirement.arcsec, "m": requirement.m}
    write_json(result / FILE, content)
    return True
