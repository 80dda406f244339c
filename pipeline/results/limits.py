"""Limits that figures must keep, for continuous integration: which are missed, as text and as JUnit XML."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from boresight.pipeline.errors import printable
from boresight.records.record import record, scalar

if TYPE_CHECKING:  # whoever states limits need not load the models of geo-positioning, 0.2 s
    from boresight.pipeline.results.validate import TruthErrors

__all__ = ["Limit", "given_limits", "junit_xml", "limit_lines", "validation_limits"]


@record(kw_only=True)
class Limit:
    """One figure and the limit that it must keep."""

    name: str = scalar("option that gives the limit, without dashes: max-..., min-...")
    found: float = scalar("the figure; NaN where there is none, which counts as missed")
    limit: float = scalar("largest value allowed; of min-... the smallest")
    what: str = scalar("the figure in words, with its unit")

    @property
    def holds(self) -> bool:
        """Whether the limit is kept."""
        if self.name.startswith("min-"):
            return bool(self.found >= self.limit)
        return bool(self.found <= self.limit)

    @property
    def text(self) -> str:
        """One line: kept or missed, the figure, the limit."""
        word = "at least" if self.name.startswith("min-") else "at most"
        kept = "kept" if self.holds else "MISSED"
        return f"{kept:6s}  {self.name}: {self.what} {self.found:.4g}, {word} {self.limit:g} is allowed"


def validation_limits(
    validation: TruthErrors,
    max_error_sigma: float | None = None,
    max_nees: float | None = None,
    max_ground_m: float | None = None,
) -> list[Limit]:
    """The limits that are given, against the errors of a result: largest error of an axis in stated sigmas,
    NEES, and the larger of the rms errors along and across the track at the check points.
    """
    sigmas = float(np.max(np.abs(validation.error_rad) / validation.sigma_rad))
    ground_m = max(validation.after.rms_m) if len(validation.after.along_m) else np.nan
    figures = (
        ("max-error-sigma", sigmas, max_error_sigma, "largest error of an axis, in stated sigmas,"),
        ("max-nees", validation.nees, max_nees, "NEES"),
        ("max-ground-m", ground_m, max_ground_m, "rms along or across, m,"),
    )
    return given_limits(figures)


def given_limits(figures: Iterable[tuple[str, float, float | None, str]]) -> list[Limit]:
    """The limits that are given, of name, figure, limit and words."""
    return [
        Limit(name=n, found=float(f), limit=limit, what=w) for n, f, limit, w in figures if limit is not None
    ]


def limit_lines(limits: Sequence[Limit]) -> list[str]:
    """A line for each limit, and how many are missed."""
    missed = sum(not one.holds for one in limits)
    counts = f"{missed} of {len(limits)} limits missed" if missed else f"all {len(limits)} limits kept"
    return [*(one.text for one in limits), counts] if limits else []


def junit_xml(suite: str, limits: Sequence[Limit], seconds: float) -> str:
    """JUnit XML: one test suite, one test case a limit, one failure a missed limit."""
    missed = sum(not one.holds for one in limits)
    counts = {"tests": str(len(limits)), "failures": str(missed), "errors": "0", "time": f"{seconds:.3f}"}
    root = ElementTree.Element("testsuites", {"name": "boresight", **counts})
    within = ElementTree.SubElement(root, "testsuite", {"name": printable(suite), "skipped": "0", **counts})
    for one in limits:
        given = {"classname": f"boresight.{printable(suite)}", "name": one.name, "time": "0.000"}
        case = ElementTree.SubElement(within, "testcase", given)
        if not one.holds:
            failure = ElementTree.SubElement(case, "failure", {"message": one.text, "type": "LimitMissed"})
            failure.text = one.text
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"
