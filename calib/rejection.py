"""Observations that take no part in an estimate, each with the cause and the numbers of its test."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from boresight.calib.estimate import Rejected, TargetResiduals, WhyRejected
from boresight.calib.strips import PreparedStrip
from boresight.geometry.sightings import StripSightings

__all__ = ["rejected_observations"]


def rejected_observations(
    strips: Sequence[StripSightings],
    prepared: Sequence[PreparedStrip],
    limit: float,
    residuals: TargetResiduals | None = None,
) -> tuple[Rejected, ...]:
    """Rejected stars, exposures, targets and strips, strip by strip.

    `limit` is that of the tests of stars and targets; without `residuals` no target has been tested.
    """
    out: list[Rejected] = []
    for strip, ready in zip(strips, prepared):
        out += _stars_and_exposures(strip, ready, limit)
        out += _targets(ready, limit, residuals)
    return tuple(out)


def _stars_and_exposures(strip: StripSightings, ready: PreparedStrip, limit: float) -> Iterator[Rejected]:
    for k, exposure in enumerate(strip.exposures):
        rows = ready.attitudes.stars(k)
        kept, statistic = ready.attitudes.kept[rows], ready.attitudes.squared_mahalanobis[rows]
        n_good, n_all = int(kept.sum()), len(kept)
        if not ready.used[k]:
            yield Rejected(
                strip_id=strip.strip_id,
                exposure_id=exposure.exposure_id,
                kind="exposure",
                name=exposure.exposure_id,
                why=WhyRejected.ATTITUDE_NOT_FIXED,
                n_good=n_good,
                n_all=n_all,
            )
            continue
        for star in np.flatnonzero(~kept):
            yield Rejected(
                strip_id=strip.strip_id,
                exposure_id=exposure.exposure_id,
                kind="star",
                name=str(exposure.hip[star]),
                why=WhyRejected.STAR_RESIDUAL,
                statistic=float(statistic[star]),
                limit=limit,
                n_good=n_good,
                n_all=n_all,
            )


def _targets(ready: PreparedStrip, limit: float, residuals: TargetResiduals | None) -> Iterator[Rejected]:
    name = ready.strip_id
    if not ready.inside.any():
        why, n = WhyRejected.NO_TARGET_COVERED, int(ready.used.sum())
        yield Rejected(strip_id=name, kind="strip", name=name, why=why, n_good=n, n_all=len(ready.inside))
        return
    kinds = np.where(ready.is_star, "star", "target").tolist()
    for j in np.flatnonzero(~ready.inside):
        target = str(ready.target_id[j])
        yield Rejected(strip_id=name, kind=kinds[j], name=target, why=WhyRejected.NOT_COVERED)
    if residuals is None:
        return
    own = np.flatnonzero(residuals.strip_id == name)
    for n_own in np.flatnonzero(ready.inside & ~residuals.kept[own]):
        j = own[n_own]
        others = residuals.rivals[int(j)]
        yield Rejected(
            strip_id=name,
            kind=kinds[n_own],
            name=str(residuals.target_id[j]),
            why=WhyRejected.TARGET_RESIDUAL,
            statistic=float(residuals.statistic[j]),
            limit=limit,
            rivals=tuple(sorted(f"{residuals.strip_id[n]}/{residuals.target_id[n]}" for n in others)),
        )
