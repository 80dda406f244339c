"""Strips of the ground as tasks: each with the exposures around it, their attitudes, and the targets that it
may show.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.gct_match.records import Target
from boresight.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef, local_axes_e
from boresight.geometry.groundlight import apparent_ground_directions
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.files.coordinate_slips import likeliest, slips
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.ground_points import NO_POINTS
from boresight.pipeline.files.repeats import targets_once
from boresight.pipeline.run.cached import StageRunner
from boresight.pipeline.run.executor import Executor, InOrder
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.coverage import attitudes_in_s, covered_strips, stated_mountings
from boresight.pipeline.stages.head import HeadSightings, before_calibration, sight_head
from boresight.pipeline.stages.strip import StripTask, footprint_e, pushbroom_of, targets_near
from boresight.records.ledger import Entry, Kind, Reason, Subject
from boresight.records.record import Bools, Floats

__all__ = ["before_launch", "fitting_slip", "strip_tasks", "strips_to_match"]

NEAR_PX = 50.0  # a slip is looked for where the place is farther off, and must come nearer
CLOSER = 0.1  # of the stated distance, within which a slip must bring it


def strip_tasks(
    dump: Dump,
    heads: Sequence[HeadSightings],
    R_cs: Rotation,
    sigma_rad: Floats,
    mountings: Mapping[str, Rotation],
    settings: Settings,
    *,
    with_slips: bool = True,
) -> tuple[list[StripTask], list[Entry]]:
    """A task for each strip that orbit and star exposures cover, and an omission for each other one, and for
    each hidden point, `with_slips` that would explain where it lies.

    `R_cs` with 1-sigma (3,) predicts where targets lie. Where another head carries the strip, its attitudes
    are turned to frame s by `mountings`.
    """
    tasks = []
    points = {one.strip_id: one for one in dump.points}
    margin = settings.run.exposure_margin_s
    covered, omitted = covered_strips(dump, dump.strips, heads, margin)
    for strip, head, near in covered:
        times = np.array([head.stars[k].t_s for k in near])
        first, last = dump.span_s(strip)
        R_si, cov_s = attitudes_in_s(head, near, heads[0], mountings), None
        if dump.heads[0].gyro is not None and dump.heads[0].gyro_around(times, dump.orbit) is None:
            reason = f"its gyro has no rows, or a gap, between the attitudes around strip {strip.strip_id}"
            omitted.append(Entry(dump.heads[0].subject, Reason.NOT_COVERED, f"{reason}: not used there"))
        if head.head.is_smoothed:
            track = before_calibration(dump, times, mountings, head.head.name, dump.orbit)
            R_si, cov_s = track.R_si_nodes, track.cov_s
        task = StripTask(
            strip=strip,
            camera=dump.line_camera,
            orbit=dump.orbit.around(first - margin, last + margin),
            t_attitude_s=times,
            R_si=R_si,
            cov_s=cov_s,
            R_cs=R_cs,
            sigma_installation_rad=np.asarray(sigma_rad, dtype=float),
            effects=dump.light,
            targets=(),
            chips=(),
            terrain=dump.terrain,
            settings=settings.match,
            points=points.get(strip.strip_id, NO_POINTS),
            interpolation=head.head.interpolation,
            carrier=head.head.name,
        )
        if not _sees_the_ground(task):
            reason = "by its attitudes the camera looks past the Earth: check quaternions and utc_first_row"
            omitted.append(Entry(strip.subject, Reason.NOT_OF_THE_GROUND, reason))
            continue
        task, hidden = _without_hidden_points(task, with_slips)
        omitted += hidden
        targets, chips = targets_near(task, dump.targets, dump.chips)
        tasks.append(replace(task, targets=targets, chips=chips))
    return tasks, omitted


def strips_to_match(
    dump: Dump, settings: Settings, executor: Executor | None = None
) -> tuple[list[StripTask], list[Entry]]:
    """Tasks of a dump's strips with the pre-launch installation matrix, and what cannot be used."""
    dump = targets_once(dump, settings.match)
    heads, tasks, uncovered = before_launch(dump, settings, executor)
    return tasks, [*dump.omissions, *(one for head in heads for one in head.omissions), *uncovered]


def before_launch(
    dump: Dump, settings: Settings, executor: Executor | None = None
) -> tuple[list[HeadSightings], list[StripTask], list[Entry]]:
    """The heads of a dump with their attitudes, nothing of them kept; a task for each strip that they cover,
    with the pre-launch matrices, and an omission for each other one.
    """
    runner = StageRunner(None, executor or InOrder())
    heads = [sight_head(dump, head, settings, runner) for head in dump.heads]
    sigma_rad, mountings = dump.sigma_installation_rad, stated_mountings(heads)
    return heads, *strip_tasks(dump, heads, dump.R_cs0, sigma_rad, mountings, settings)


def _sees_the_ground(task: StripTask) -> bool:
    """Whether any corner of a strip shows the Earth, and every measured point lies on an image of it."""
    seen_e, points, model = footprint_e(task), task.points, pushbroom_of(task)
    at_points = [
        model.ground_points(ccd, sample, line, ConstantHeight(0.0))
        for ccd in np.unique(points.ccd).tolist()
        for sample, line in [points.xy_px[points.ccd == ccd].T]
    ]
    return bool(np.isfinite(seen_e).any() and all(np.isfinite(p_e).all() for p_e in at_points))


def _without_hidden_points(task: StripTask, with_slips: bool) -> tuple[StripTask, list[Entry]]:
    """The task without measured points that lie beyond the satellite's horizon, or so near to it that their
    refraction is not defined, and an omission for each.
    """
    points = task.points
    if not len(points.ccd):
        return task, []
    p_e = np.array([target.p_e for target in points.targets])
    t_s = np.asarray(pushbroom_of(task).instants_of_lines(points.ccd, points.xy_px[:, 1]), dtype=float)
    lat, lon, _ = geodetic_from_ecef(p_e)
    up_e = local_axes_e(lat, lon)[:, :, 2]
    beyond = np.sum(up_e * (task.orbit.positions_e(t_s) - p_e), axis=1) <= 0.0
    u_i, _ = apparent_ground_directions(p_e, t_s, task.orbit, task.orbit.earth, task.effects)
    hidden = beyond | ~np.isfinite(u_i).all(axis=1)
    if not hidden.any():
        return task, []
    found = []
    for n in np.flatnonzero(hidden).tolist():
        target = points.targets[n]
        slip = fitting_slip(task, target, int(points.ccd[n]), points.xy_px[n]) if with_slips else ""
        low = "so low that its refraction is not known, near the horizon"
        where = "beyond the horizon" if beyond[n] else low
        reason = f"{where} of the satellite{slip or '; correct points.csv'}"
        subject = Subject(Kind.TARGET, strip=task.strip.strip_id, id=target.target_id)
        found.append(Entry(subject, Reason.HIDDEN, reason, "points.csv"))
    return replace(task, points=points.take(~hidden)), found


def fitting_slip(task: StripTask, target: Target, ccd: int, xy_px: Floats) -> str:
    """What would have to be read in the table for a target to lie at `xy_px` (2,), sample and line, behind a
    semicolon; empty where no slip explains it, or the target is near already.
    """
    model = pushbroom_of(task)
    lat, lon, height = geodetic_from_ecef(target.p_e[None])

    def off_px(p_e: Floats, ccd: int = ccd) -> Floats:
        sample, line = model.pixels_from_ground(ccd, p_e)
        return np.nan_to_num(np.hypot(sample - xy_px[0], line - xy_px[1]), nan=np.inf)

    uncertain_px = task.settings.sigmas * float(task.sigma_installation_rad.max()) / task.camera.pixel_rad
    limit_px, stated_px = NEAR_PX + uncertain_px, float(off_px(target.p_e[None])[0])

    def fits(places_deg: Floats) -> Bools:
        place_lat, place_lon = np.radians(places_deg).T
        p_e = ecef_from_geodetic(place_lat, place_lon, np.full(len(place_lat), height[0]))
        return np.asarray(off_px(p_e) < min(limit_px, CLOSER * stated_px))

    if stated_px < limit_px:
        return ""
    for other in range(task.camera.n_ccds):
        if float(off_px(target.p_e[None], other)[0]) < min(limit_px, CLOSER * stated_px):
            return f"; it fits in CCD {other}: correct its CCD"
    slip = likeliest(slips(float(np.degrees(lat[0])), float(np.degrees(lon[0]))), fits)
    return f"; {slip.words} would fit: correct the table" if slip else ""
