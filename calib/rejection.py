"""Observations that take no part in an estimate, each with the reason and the numbers of its test."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from boresight.calib.estimate import TargetResiduals
from boresight.calib.strips import PreparedStrip
from boresight.geometry.sightings import StripSightings
from boresight.records.ledger import Entry, Kind, Reason, Subject

__all__ = ["rejected_observations"]


def rejected_observations(
    strips: Sequence[StripSightings],
    prepared: Sequence[PreparedStrip],
    limit: float,
    residuals: TargetResiduals | None = None,
) -> tuple[Entry, ...]:
    """Rejected stars, exposures, targets and strips, pass by pass; an exposure once.

    `limit` is that of the tests of stars and targets; without `residuals` no target is covered.
    """
    entries: list[Entry] = []
    for strip, ready in zip(strips, prepared):
        entries += _stars_and_exposures(strip, ready, limit)
        for name, _, _ in strip.parts:
            entries += _targets(name, ready, limit, residuals)
    return tuple(entries)


def _stars_and_exposures(strip: StripSightings, ready: PreparedStrip, limit: float) -> Iterator[Entry]:
    for k, exposure in enumerate(strip.exposures):
        rows = ready.attitudes.stars(k)
        kept, statistic = ready.attitudes.kept[rows], ready.attitudes.squared_mahalanobis[rows]
        counts = float(kept.sum()), float(len(kept))
        if not ready.attitudes.usable[k]:
            subject = Subject(Kind.EXPOSURE, exposure=exposure.exposure_id)
            yield Entry(subject, Reason.ATTITUDE_NOT_FIXED, more=counts)
            continue
        for row in np.flatnonzero(~kept):
            yield Entry(
                Subject(Kind.STAR, exposure=exposure.exposure_id, id=str(exposure.hip[row])),
                Reason.STAR_RESIDUAL,
                value=float(statistic[row]),
                limit=limit,
                more=counts,
            )


def _targets(
    name: str, ready: PreparedStrip, limit: float, residuals: TargetResiduals | None
) -> Iterator[Entry]:
    """Targets of the strip `name` that are not covered, or fail their test; or that none is covered."""
    inside = ready.inside[ready.strip == name]
    if residuals is None or not inside.any():
        counts = float(ready.attitudes.usable.sum()), float(len(inside))
        yield Entry(Subject(Kind.STRIP, strip=name), Reason.NO_TARGET_COVERED, more=counts)
        return
    own = np.flatnonzero(residuals.strip_id == name)
    for row in own[~inside].tolist():
        yield Entry(residuals.subject(row), Reason.NOT_BETWEEN_EXPOSURES)
    for row in own[inside & ~residuals.kept[own]].tolist():
        # One that loses all weight to a rejected one, being surely the wrong one of both, was not searched.
        rivals = {residuals.subject(int(other)) for other in residuals.rivals.get(row, ())}
        yield Entry(
            residuals.subject(row),
            Reason.TARGET_RESIDUAL,
            value=float(residuals.statistic[row]),
            limit=limit,
            rivals=tuple(sorted(rivals, key=lambda rival: rival.name)),
        )
