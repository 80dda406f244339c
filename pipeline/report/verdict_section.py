"""The saved verdict as a report shows it: outcome, checks with p-values, inputs to look at, weakest axis."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from boresight.calib.verdict import Outcome
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.report.page_template import Number, number_from
from boresight.pipeline.results.summary import kind_of, two_digits
from boresight.records.record import inner, record, scalar

__all__ = ["BlindRow", "CheckRow", "VerdictView", "verdict_view"]

# What makes the error about an axis of c smaller, where that axis is the weakest.
REMEDIES = {
    "X": "more strips average errors of position across the track; a position with a smaller error",
    "Y": "more strips average errors of position along the track and of the clock; a better clock",
    "Z": "targets near both ends of the swath, and more strips",
}
# Numbers of a check and their forms.
FORMS = {"statistic": ".4g", "expected": ".4g", "n": ".0f"}
FORMS |= dict.fromkeys(("p_value", "p_plain", "limit"), ".2g")
# Outcomes of a check by the keys of the verdict that say so; the first that holds.
OUTCOMES = {"holds": "holds", "is_caution": "smaller than stated", "fails": "fails"}


@record(kw_only=True)
class CheckRow:
    """One check of the verdict."""

    kind: str = scalar("what was tested")
    statistic: Number = scalar("chi-square or count")
    expected: Number = scalar("expected of consistent data")
    n: Number = scalar("degrees of freedom or number of observations")
    p_value: Number = scalar("probability if the data are consistent, errors within the tolerance")
    p_plain: Number = scalar("the same with the errors as stated")
    limit: Number = scalar("p-value below which the check fails")
    outcome: str = scalar("holds, fails, smaller than stated, not applicable")
    look_at: tuple[str, ...] = scalar("inputs to look at if the check fails")
    names: tuple[str, ...] = scalar("items concerned, one text per group")


@record(kw_only=True)
class BlindRow:
    """An error that the data cannot show, or show too late."""

    cause: str = scalar("what would be wrong")
    item: str = scalar("what it concerns")
    unit: str = scalar("of its size")
    where: str = scalar("file and field that state the input")
    axis: str = scalar("X, Y or Z: the axis that it moves most")
    effect_arcsec: Number = scalar("rotation about that axis by one unit")
    detectable: Number = scalar("smallest size that is found with probability 0.9")
    hidden_sigma: Number = scalar("by how much that moves theta, in its 1-sigma")
    is_unseen: bool = scalar("nothing shows it")
    kind = inner[str]("cause", "the cause without its direction", of=kind_of)

    @property
    def amount(self) -> str:
        """A unit of the error in words."""
        return "all of it" if self.unit == "times" else f"1 {self.unit}"


@record(kw_only=True)
class VerdictView:
    """The verdict of installation.json."""

    outcome: str = scalar("value of `calib.verdict.Outcome`")
    sentence: str = scalar("the outcome in one line, as on the console")
    checks: tuple[CheckRow, ...] = scalar("all checks")
    false_alarm: Number = scalar("probability that consistent data are refuted")
    weakest_axis: str = scalar("X, Y or Z: the axis of c nearest to the direction with the largest 1-sigma")
    weakest_arcsec: Number = scalar("that 1-sigma")
    direction: tuple[Number, ...] = scalar("unit vector of that direction, frame c")
    blind: tuple[BlindRow, ...] = scalar("errors that the data cannot show, or show too late", default=())

    @property
    def unseen(self) -> tuple[BlindRow, ...]:
        """One row of each kind that nothing shows, those with most effect a unit first."""
        kinds: dict[str, BlindRow] = {}
        for row in self.blind:
            if row.is_unseen:
                kinds.setdefault(row.kind, row)
        return tuple(kinds.values())

    @property
    def is_usable(self) -> bool:
        """Whether the matrix and its 1-sigma may be used."""
        return self.outcome in (Outcome.CONSISTENT.value, Outcome.FINDINGS.value)

    @property
    def failed(self) -> tuple[CheckRow, ...]:
        """Checks that fail, the smallest p-value first."""
        failed = (c for c in self.checks if c.outcome == "fails")
        return tuple(sorted(failed, key=lambda c: c.p_value.exact))

    @property
    def cautions(self) -> tuple[CheckRow, ...]:
        """Checks by which residuals are smaller than stated."""
        return tuple(check for check in self.checks if check.outcome == "smaller than stated")

    @property
    def remedy(self) -> str:
        """What reduces the largest 1-sigma."""
        return REMEDIES.get(self.weakest_axis, "")


def verdict_view(installation: dict[str, Any], source: str = "installation.json") -> VerdictView:
    """The verdict in the content of the file `source`."""
    verdict, number = installation["verdict"], partial(number_from, installation, source)
    return VerdictView(
        outcome=str(verdict["outcome"]),
        sentence=str(verdict["sentence"]),
        checks=tuple(
            CheckRow(
                kind=str(check["kind"]),
                **{name: number(f"verdict.checks.{n}.{name}", form) for name, form in FORMS.items()},
                outcome=next((words for key, words in OUTCOMES.items() if check[key]), "not applicable"),
                look_at=tuple(map(str, check["look_at"])),
                names=tuple(" = ".join(map(str, group)) for group in check["names"]),
            )
            for n, check in enumerate(verdict["checks"])
        ),
        false_alarm=number("verdict.probability_false_alarm", ".1g"),
        weakest_axis="XYZ"[int(np.argmax(np.abs(verdict["weakest_axis_c"])))],
        weakest_arcsec=number("verdict.weakest_sigma_rad", ".4f", scale=1.0 / ARCSEC),
        direction=tuple(number(f"verdict.weakest_axis_c.{axis}", "+.3f") for axis in range(3)),
        blind=tuple(
            _blind_row(installation, source, n) for n, _ in enumerate(installation.get("blind_spots", ()))
        ),
    )


def _blind_row(installation: dict[str, Any], source: str, n: int) -> BlindRow:
    one = installation["blind_spots"][n]
    axis = int(np.argmax(np.abs(one["effect_rad"])))
    number, at = partial(number_from, installation, source), f"blind_spots.{n}"
    effect_arcsec, found = one["effect_rad"][axis] / ARCSEC, float(one["detectable"] or np.inf)
    return BlindRow(
        cause=str(one["cause"]),
        item=str(one["item"]),
        unit=str(one["unit"]),
        where=f"{one['file']} {one['field']}".strip(),
        axis="XYZ"[axis % 3],
        effect_arcsec=number(f"{at}.effect_rad.{axis}", f"+{two_digits(effect_arcsec)}", scale=1.0 / ARCSEC),
        detectable=number(f"{at}.detectable", two_digits(found)),
        hidden_sigma=number(f"{at}.hidden_sigma", ".1f"),
        is_unseen=bool(one["is_unseen"]),
    )
