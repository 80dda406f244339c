"""The accuracy that a user requires of the matrix, kept beside the result as requirement.json."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from boresight.calib.verdict import Outcome
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.files.text_files import json_if_there
from boresight.pipeline.files.whole_file import write_json
from boresight.records.record import record, scalar

__all__ = ["FILE", "Requirement", "is_met", "requirement_lines", "saved_requirement", "write_requirement"]

FILE = "requirement.json"  # name of the file in a result's folder


@record
class Requirement:
    """Largest 1-sigma that is allowed about each axis of the remote-sensing camera; None: not required."""

    arcsec: float | None = scalar("of the rotation, arc-seconds", default=None)
    m: float | None = scalar("on the ground, m: X, Y at the axis, Z at the swath's edge", default=None)

    def __bool__(self) -> bool:
        return self.arcsec is not None or self.m is not None


def write_requirement(result: Path, requirement: Requirement) -> bool:
    """Keep a requirement in the folder of a result; whether one was given. An earlier one is replaced."""
    if not requirement:
        return False
    content: dict[str, Any] = {"arcsec": requirement.arcsec, "m": requirement.m}
    write_json(result / FILE, content)
    return True


def saved_requirement(result: Path) -> dict[str, Any]:
    """The accuracy required of a result: largest 1-sigma about an axis, `arcsec`, and on the ground, `m`;
    null where none is, empty for a result without a requirement.
    """
    return json_if_there(result / FILE)


def is_met(requirement: Mapping[str, Any], installation: Mapping[str, Any]) -> bool:
    """Whether the matrix of an installation.json meets every limit of a requirement."""
    return all(met for _, met in _judged(requirement, installation))


def requirement_lines(requirement: Mapping[str, Any], installation: Mapping[str, Any]) -> list[str]:
    """Whether the matrix of an installation.json meets a requirement, a line for each limit."""
    return [line for line, _ in _judged(requirement, installation)]


def _judged(requirement: Mapping[str, Any], installation: Mapping[str, Any]) -> Iterator[tuple[str, bool]]:
    """Each limit for each camera."""
    verdict = (installation.get("verdict") or {}).get("outcome", "not assessed")
    for matrix in installation.get("cameras") or (installation,):
        of_camera = f" of camera {matrix['name']}" if "name" in matrix else ""
        sigma_rad = np.sqrt(np.diag(np.array(matrix["covariance_rad2"])))
        per_rad: Sequence[float | None] = matrix["ground_m_per_rad"]
        on_ground = sigma_rad * np.array([np.nan if value is None else value for value in per_rad])
        in_arcsec = "arcsec", "arcsec about each axis", sigma_rad / ARCSEC
        for key, words, sigma in (in_arcsec, ("m", "m on the ground", on_ground)):
            if requirement.get(key) is None:
                continue
            limit = float(requirement[key])
            missed = [f"{axis} {value:.4g}" for axis, value in zip("XYZ", sigma) if not value <= limit]
            outcome = f"not met about {', '.join(missed)}" if missed else "met"
            if verdict not in (Outcome.CONSISTENT.value, Outcome.FINDINGS.value):
                outcome = f"cannot be judged, the verdict is {verdict}"
            if np.isnan(sigma).any():
                outcome = "not known, no strip sees the ground"
            yield f"{'required 1 sigma':26s}{limit:g} {words}{of_camera}: {outcome}", outcome == "met"
