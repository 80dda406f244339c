"""`StripSightings` from the targets, or stars, of a strip and the attitudes of all star cameras around it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import NominalMotion
from boresight.geometry.sightings import GroundSightings, HeadAttitudes, StripSightings
from boresight.pipeline.stages.head import HeadSightings

__all__ = ["strip_sightings"]

Array = NDArray[np.float64]


def strip_sightings(
    strip_id: str,
    sightings: GroundSightings,
    t_attitude_s: Array,
    nominal: NominalMotion,
    heads: Sequence[HeadSightings],
    carrier: str = "",
    *,
    earth: str = "",
) -> StripSightings:
    """One strip with the exposures (K,) of the reference head, the first of `heads`, around it; without any
    where another head, `carrier`, covers the strip. `earth` is the prediction of Earth orientation.
    """
    reference = heads[0]
    by_time = {s.t_s: k for k, s in enumerate(reference.stars)}
    own = carrier in ("", reference.head.name)
    rows = np.array([by_time[t] for t in t_attitude_s.tolist()] if own else [], dtype=np.int64)
    return StripSightings(
        strip_id=strip_id,
        exposures=tuple(reference.stars[k] for k in rows),
        ground=sightings,
        R_oi_exposures=nominal.R_oi(t_attitude_s) if own else Rotation.identity(0),
        R_oi_targets=nominal.R_oi(sightings.t_s),
        attitudes=reference.attitudes.take(rows),
        noise=reference.head.noise,
        others=tuple(_around(other, reference, t_attitude_s, nominal) for other in heads[1:]),
        gyro=reference.head.gyro_around(t_attitude_s, nominal),
        interpolation=next((h for h in heads if h.head.name == carrier), reference).head.interpolation,
        earth=earth,
    )


def _around(
    other: HeadSightings, reference: HeadSightings, t_attitude_s: Array, nominal: NominalMotion
) -> HeadAttitudes:
    """Attitudes of a further head around a strip."""
    times = np.array([exposure.t_s for exposure in other.stars])
    first, last = t_attitude_s[0], t_attitude_s[-1]
    rows = np.flatnonzero(other.attitudes.usable & (times >= first) & (times <= last))
    return HeadAttitudes(
        head=other.head.name,
        t_s=times[rows],
        R_hi=Rotation.from_matrix(other.attitudes.R_si[rows]) if len(rows) else Rotation.identity(0),
        covariance_h=other.attitudes.covariance_s[rows],
        noise=other.head.noise,
        R_oi=nominal.R_oi(times[rows]),
        R_sh=reference.head.R_cs0.inv() * other.head.R_cs0,
    )
