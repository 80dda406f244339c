"""Strips with what was measured in them and the attitudes around them, as the estimate takes them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import NominalMotion
from boresight.geometry.sightings import HeadAttitudes, StripSightings
from boresight.pipeline.stages.head import HeadSightings
from boresight.pipeline.stages.sky_strip import NamedStars, SkyTask, sky_sightings
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, ground_sightings
from boresight.records.record import Floats

__all__ = ["sighted_strips", "strip_sightings"]


def sighted_strips(
    tasks: Sequence[StripTask | SkyTask],
    measured: Sequence[MatchedTargets | NamedStars],
    heads: Sequence[HeadSightings],
) -> list[StripSightings]:
    """Strips with at least one matched target or named star, with the exposures around them and their
    attitudes; `tasks` hold those of `measured`, by id.
    """
    by_id = {task.strip.strip_id: task for task in tasks}
    having = [one for one in measured if len(one.rows if isinstance(one, NamedStars) else one.target_id)]
    return [strip_sightings(by_id[one.strip_id], one, heads) for one in having]


def strip_sightings(
    task: StripTask | SkyTask, measured: MatchedTargets | NamedStars, heads: Sequence[HeadSightings]
) -> StripSightings:
    """One strip with the exposures (K,) of the reference head, the first of `heads`, around it; without any
    where another head carries the strip.
    """
    nominal: NominalMotion
    if isinstance(task, StripTask):
        assert isinstance(measured, MatchedTargets)
        sightings, nominal, earth = ground_sightings(measured, task), task.orbit, task.orbit.earth.prediction
    else:
        assert isinstance(measured, NamedStars)
        sightings, nominal, earth = sky_sightings(task, measured), task.nominal, ""
    reference, t_attitude_s = heads[0], task.t_attitude_s
    by_time = {s.t_s: k for k, s in enumerate(reference.stars)}
    own = task.carrier in ("", reference.head.name)
    rows = np.array([by_time[t] for t in t_attitude_s.tolist()] if own else [], dtype=np.int64)
    return StripSightings(
        strip_id=task.strip.strip_id,
        exposures=tuple(reference.stars[k] for k in rows),
        ground=sightings,
        R_oi_exposures=nominal.R_oi(t_attitude_s) if own else Rotation.identity(0),
        R_oi_targets=nominal.R_oi(sightings.t_s),
        attitudes=reference.attitudes.take(rows),
        noise=reference.head.noise,
        others=tuple(_around(other, reference, t_attitude_s, nominal) for other in heads[1:]),
        gyro=reference.head.gyro_around(t_attitude_s, nominal),
        interpolation=task.interpolation,
        earth=earth,
    )


def _around(
    other: HeadSightings, reference: HeadSightings, t_attitude_s: Floats, nominal: NominalMotion
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
