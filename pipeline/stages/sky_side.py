"""The strips of the sky of a dump: found once, named with every new estimate of the mounting."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC
from boresight.geometry.line_camera import LineCamera
from boresight.geometry.record import Floats, array, record, scalar
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.errors import Omission
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_tables import survey_of
from boresight.pipeline.settings import Settings
from boresight.pipeline.stages.cached import StageRunner
from boresight.pipeline.stages.coverage import attitudes_around, span_s
from boresight.pipeline.stages.head import HeadSightings
from boresight.pipeline.stages.sky_strip import (
    NamedStars,
    SkyTask,
    find_sky_stars,
    name_sky_stars,
    sky_sightings,
)
from boresight.pipeline.stages.strip import orbit_around
from boresight.pipeline.stages.strip_sightings import strip_sightings
from boresight.star_id.strip_stars.find import StripStars

__all__ = ["SkySide", "find_in_sky_strips", "name_in_sky_strips", "named_sightings"]


@record(kw_only=True)
class SkySide:
    """Strips of the sky with their detections."""

    tasks: tuple[SkyTask, ...] = array("S", "strips that orbit and star exposures cover")
    found: tuple[StripStars, ...] = array("S", "detections in the same strips")
    omissions: tuple[Omission, ...] = scalar("strips that cannot be used, with the reasons")
    computed: tuple[bool, ...] = scalar("of each strip, whether it was computed now or kept")


def find_in_sky_strips(
    dump: Dump, reference: HeadSightings, settings: Settings, runner: StageRunner
) -> SkySide:
    """Detections in all strips of the sky."""
    tasks, omitted = _tasks(dump, reference, settings)
    if not tasks:
        return SkySide(tasks=(), found=(), omissions=tuple(omitted), computed=())
    outcomes, computed = runner.run(find_sky_stars, tasks, folder="sky-stars")
    good = [n for n, one in enumerate(outcomes) if isinstance(one, StripStars)]
    return SkySide(
        tasks=tuple(tasks[n] for n in good),
        found=tuple(outcomes[n] for n in good),
        omissions=(*omitted, *(one for one in outcomes if isinstance(one, Omission))),
        computed=tuple(computed),
    )


def name_in_sky_strips(
    dump: Dump, side: SkySide, R_cs: Rotation, sigma_rad: Floats, *, known: bool
) -> tuple[NamedStars, ...]:
    """Named stars of each strip, by a mounting and its 1-sigma (3,), rad; see `name_sky_stars`."""
    if not side.tasks:
        return ()
    vibration = dump.errors.vibration_arcsec * ARCSEC / dump.line_camera.pixel_rad
    scatter = float(np.hypot(dump.errors.look_distortion_px, vibration))
    survey = survey_of(dump.star_catalogue)
    return tuple(
        name_sky_stars(task, found, survey, R_cs, sigma_rad, known=known, scatter_px=scatter)
        for task, found in zip(side.tasks, side.found)
    )


def named_sightings(
    side: SkySide, named: Sequence[NamedStars], heads: Sequence[HeadSightings]
) -> list[StripSightings]:
    """The strips with at least one named star."""
    return [
        strip_sightings(task.strip.strip_id, sky_sightings(task, one), task.t_attitude_s, task.nominal, heads)
        for task, one in zip(side.tasks, named)
        if len(one.rows)
    ]


def _tasks(dump: Dump, reference: HeadSightings, settings: Settings) -> tuple[list[SkyTask], list[Omission]]:
    """A task for each strip of the sky that orbit and star exposures cover, an omission for each other."""
    tasks, omitted = [], []
    attitudes, margin = reference.attitudes, settings.run.exposure_margin_s
    camera = dump.line_camera
    for strip in dump.sky_strips:
        near = attitudes_around(dump, strip, reference, margin)
        if isinstance(near, Omission):
            omitted.append(near)
            continue
        times = np.array([reference.stars[k].t_s for k in near])
        first, last = span_s(dump, strip)
        to_c = dump.R_cs0.as_matrix()
        spread = np.einsum("ab,nbc,dc->nad", to_c, attitudes.covariance_s[near], to_c)[:, :2, :2]
        tasks.append(
            SkyTask(
                strip=strip,
                camera=camera,
                stages=camera.tdi_stages if isinstance(camera, LineCamera) else 1,
                bit_depth=dump.remote_bit_depth,
                orbit=orbit_around(dump.orbit, first - margin, last + margin),
                t_attitude_s=times,
                R_si=Rotation.from_matrix(attitudes.R_si[near]),
                sigma_attitude_rad=float(np.sqrt(np.median(np.linalg.eigvalsh(spread)[:, 1]))),
                R_cs0=dump.R_cs0,
                settings=settings.sky_strips,
                interpolation=reference.head.interpolation,
            )
        )
    return tasks, omitted
