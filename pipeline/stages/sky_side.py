"""The strips of the sky of a dump: found once, named with every new estimate of the mounting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.slow_motion import FEWEST_SHOW
from boresight.geometry.attitude import ConstantRate
from boresight.geometry.constants import ARCSEC
from boresight.geometry.line_camera import LineCamera
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_tables import survey_of
from boresight.pipeline.run.cached import StageRunner
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.coverage import attitudes_in_s, covered_strips, stated_mountings
from boresight.pipeline.stages.head import HeadSightings, before_calibration
from boresight.pipeline.stages.sky_strip import NamedStars, SkyTask, find_sky_stars, name_sky_stars
from boresight.records.ledger import Entry
from boresight.records.record import Floats, Ints, array, record, scalar
from boresight.star_id.strip_stars.find import StripStars

__all__ = ["SkySide", "find_in_sky_strips", "name_in_sky_strips", "scatter_px"]


@record(kw_only=True)
class SkySide:
    """Strips of the sky with their detections."""

    tasks: tuple[SkyTask, ...] = array("S", "strips that orbit and star exposures cover")
    found: tuple[StripStars, ...] = array("S", "detections in the same strips")
    omissions: tuple[Entry, ...] = scalar("strips that cannot be used, with the reasons")

    def only(self, n: int) -> SkySide:
        """One of the strips, without what was left out of them."""
        return replace(self, tasks=(self.tasks[n],), found=(self.found[n],), omissions=())

    def aligned(self, heads: Sequence[HeadSightings], mountings: Mapping[str, Rotation]) -> SkySide:
        """Strips of the sky with attitudes turned to frame s by the matrices `mountings`, where another head
        carries them, and not by those stated before launch.
        """
        reference, stated = heads[0].head.name, stated_mountings(heads)

        def turned(task: SkyTask) -> SkyTask:
            if task.carrier == reference:
                return task
            before, now = (each[reference].inv() * each[task.carrier] for each in (stated, mountings))
            return replace(task, R_si=now * before.inv() * task.R_si)

        return replace(self, tasks=tuple(map(turned, self.tasks)))


def find_in_sky_strips(
    dump: Dump, heads: Sequence[HeadSightings], settings: Settings, runner: StageRunner
) -> SkySide:
    """Detections in all strips of the sky."""
    tasks, omitted = _tasks(dump, heads, settings)
    outcomes = runner.run(find_sky_stars, tasks, folder="sky-stars") if tasks else []
    good = [n for n, one in enumerate(outcomes) if isinstance(one, StripStars)]
    return SkySide(
        tasks=tuple(tasks[n] for n in good),
        found=tuple(outcomes[n] for n in good),
        omissions=(*omitted, *(one for one in outcomes if isinstance(one, Entry))),
    )


def name_in_sky_strips(
    dump: Dump, side: SkySide, R_cs: Rotation, sigma_rad: Floats, *, known: bool
) -> tuple[NamedStars, ...]:
    """Named stars of each strip, by a mounting and its 1-sigma (3,), rad; see `name_sky_stars`."""
    if not side.tasks:
        return ()
    survey = survey_of(dump.star_catalogue)
    return tuple(
        name_sky_stars(task, found, survey, R_cs, sigma_rad, known=known, scatter_px=scatter_px(dump, task))
        for task, found in zip(side.tasks, side.found)
    )


def scatter_px(dump: Dump, task: SkyTask) -> float:
    """1-sigma of one star against another: distortion, vibration, and motion if not shown by 3 exposures."""
    motion = dump.errors.motion_arcsec if len(task.t_attitude_s) < FEWEST_SHOW else 0.0
    moved = np.hypot(dump.errors.vibration_arcsec, motion) * ARCSEC / dump.line_camera.pixel_rad
    return float(np.hypot(dump.errors.look_px, moved))


def _tasks(
    dump: Dump, heads: Sequence[HeadSightings], settings: Settings
) -> tuple[list[SkyTask], list[Entry]]:
    """A task for each strip of the sky that orbit and star exposures cover, an omission for each other."""
    tasks = []
    margin, camera = settings.run.exposure_margin_s, dump.line_camera
    covered, omitted = covered_strips(dump, dump.sky_strips, heads, margin)
    for strip, head, near in covered:
        times = np.array([head.stars[k].t_s for k in near])
        first, last = dump.span_s(strip)
        R_si, covariance_c = _attitudes(dump, heads, head, near)
        tasks.append(
            SkyTask(
                strip=strip,
                camera=camera,
                stages=camera.tdi_stages if isinstance(camera, LineCamera) else 1,
                bit_depth=dump.remote_bit_depth,
                orbit=dump.orbit.around(first - margin, last + margin),
                t_attitude_s=times,
                R_si=R_si,
                covariance_c=covariance_c,
                R_cs0=dump.R_cs0,
                settings=settings.sky_strips,
                carrier=head.head.name,
                interpolation=head.head.interpolation,
            )
        )
    return tasks, omitted


def _attitudes(
    dump: Dump, heads: Sequence[HeadSightings], head: HeadSightings, rows: Ints
) -> tuple[Rotation, Floats]:
    """Attitudes R_si (K,) of a head, and the covariance (K, 3, K, 3) of their errors, axes of c by the
    pre-launch matrices, rad²; smoothed where the calibration smooths them.
    """
    t_s, mountings = np.array([head.stars[k].t_s for k in rows]), stated_mountings(heads)
    R_si, to_c = attitudes_in_s(head, rows, heads[0], mountings), head.head.R_cs0.as_matrix()
    if head.head.is_smoothed:
        nominal = ConstantRate.fitted(t_s, R_si)
        track = before_calibration(dump, t_s, mountings, head.head.name, nominal)
        root_c = dump.R_cs0.as_matrix() @ track.errors_s(t_s)
        return track.R_si_nodes, np.einsum("kap,lbp->kalb", root_c, root_c)
    each = np.arange(len(rows))
    covariance = head.head.noise.coloured_covariance_s(t_s)
    covariance[each, :, each, :] += head.attitudes.covariance_s[rows]
    return R_si, np.asarray(np.einsum("ab,kblc,dc->kald", to_c, covariance, to_c))
