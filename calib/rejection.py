"""What a calibration left out, one line a thing, with the reason."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from boresight.calib.estimate import Rejected, TargetResiduals
from boresight.calib.strips import PreparedStrip
from boresight.geometry.sightings import StripSightings

__all__ = ["left_out"]


def left_out(
    strips: Sequence[StripSightings],
    prepared: Sequence[PreparedStrip],
    residuals: TargetResiduals | None = None,
) -> tuple[Rejected, ...]:
    """Stars, exposures, targets and strips that do not take part, strip by strip."""
    out: list[Rejected] = []
    for strip, ready in zip(strips, prepared):
        out += _stars_and_exposures(strip, ready)
        out += _targets(ready, residuals)
    return tuple(out)


def _stars_and_exposures(strip: StripSightings, ready: PreparedStrip) -> Iterator[Rejected]:
    at = 0
    for k, exposure in enumerate(strip.exposures):
        n = len(exposure.hip)
        rows = slice(at, at + n)
        kept, normalised = ready.attitudes.kept[rows], ready.attitudes.normalised[rows]
        at += n
        where = (strip.strip_id, exposure.exposure_id)
        if not ready.used[k]:
            reason = f"{int(kept.sum())} good stars of {n} do not fix the attitude"
            yield Rejected(*where, "exposure", exposure.exposure_id, reason, float("nan"))
            continue
        for star in np.flatnonzero(~kept):
            size = np.sqrt(normalised[star])
            reason = f"{size:.1f} sigma from the attitude of the other {int(kept.sum())} stars"
            yield Rejected(*where, "star", str(exposure.hip[star]), reason, float(normalised[star]))


def _targets(ready: PreparedStrip, residuals: TargetResiduals | None) -> Iterator[Rejected]:
    where = (ready.strip_id, "")
    if not ready.inside.any():
        reason = f"{int(ready.used.sum())} usable exposures cover none of {len(ready.inside)} targets"
        yield Rejected(*where, "strip", ready.strip_id, reason, float("nan"))
        return
    for name in ready.target_id[~ready.inside]:
        reason = "its instant lies more than half a step outside the usable exposures"
        yield Rejected(*where, "target", str(name), reason, float("nan"))
    if residuals is None:
        return
    mine = np.flatnonzero(residuals.strip_id == ready.strip_id)
    for j in mine[ready.inside & ~residuals.kept[mine]]:
        size = np.sqrt(residuals.normalised[j])
        reason = f"{size:.1f} sigma from where the other targets put it"
        yield Rejected(*where, "target", str(residuals.target_id[j]), reason, float(residuals.normalised[j]))
