"""Measured points whose coordinates cannot be those of what the strip shows, and the slip that would fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from boresight.gct_match.records import Target
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef, local_axes_e
from boresight.geometry.groundlight import apparent_ground_directions
from boresight.geometry.ledger import Entry, Kind, Reason, Subject
from boresight.geometry.record import Bools, Floats
from boresight.pipeline.stages.coordinate_slips import likeliest, slips
from boresight.pipeline.stages.strip import StripTask, pushbroom_of

__all__ = ["fitting_slip", "without_hidden_points"]

NEAR_PX = 50.0  # a slip is looked for where the place is farther off, and must come nearer


def without_hidden_points(task: StripTask) -> tuple[StripTask, list[Entry]]:
    """The task without measured points that lie beyond the satellite's horizon, or so near to it that their
    refraction is not defined, and an omission for each.
    """
    points = task.points
    if not len(points.ccd):
        return task, []
    p_e = np.array([target.p_e for target in points.targets])
    t_s = np.asarray(pushbroom_of(task).instants_of_lines(points.ccd, points.xy_px[:, 1]), dtype=float)
    lat, lon, _ = geodetic_from_ecef(p_e, WGS84)
    up_e = local_axes_e(lat, lon)[:, :, 2]
    beyond = np.sum(up_e * (task.orbit.positions_e(t_s) - p_e), axis=1) <= 0.0
    u_i, _ = apparent_ground_directions(p_e, t_s, task.orbit, task.orbit.earth, task.effects)
    hidden = beyond | ~np.isfinite(u_i).all(axis=1)
    if not hidden.any():
        return task, []
    found = []
    for n in np.flatnonzero(hidden).tolist():
        target = points.targets[n]
        slip = fitting_slip(task, target, int(points.ccd[n]), points.xy_px[n])
        where = (
            "beyond the horizon" if beyond[n] else "so low that its refraction is not known, near the horizon"
        )
        reason = f"{where} of the satellite{slip or '; correct points.csv'}"
        subject = Subject(Kind.TARGET, strip=task.strip.strip_id, id=target.target_id)
        found.append(Entry(subject, Reason.HIDDEN, reason, "points.csv"))
    return replace(task, points=points.take(~hidden)), found


def fitting_slip(task: StripTask, target: Target, ccd: int, xy_px: Floats) -> str:
    """What would have to be read in the table for a target to lie at `xy_px` (2,), sample and line, behind a
    semicolon; empty where no slip explains it, or the target is near already.
    """
    model = pushbroom_of(task)
    lat, lon, height = geodetic_from_ecef(target.p_e[None], WGS84)

    def off_px(p_e: Floats) -> Floats:
        sample, line = model.pixels_from_ground(ccd, p_e)
        return np.nan_to_num(np.hypot(sample - xy_px[0], line - xy_px[1]), nan=np.inf)

    uncertain_px = task.settings.sigmas * float(task.sigma_installation_rad.max()) / task.camera.pixel_rad
    limit_px, stated_px = NEAR_PX + uncertain_px, float(off_px(target.p_e[None])[0])

    def fits(places_deg: Floats) -> Bools:
        place_lat, place_lon = np.radians(places_deg).T
        p_e = ecef_from_geodetic(place_lat, place_lon, np.full(len(place_lat), height[0]), WGS84)
        return np.asarray(off_px(p_e) < min(limit_px, 0.1 * stated_px))

    if stated_px < limit_px:
        return ""
    slip = likeliest(slips(float(np.degrees(lat[0])), float(np.degrees(lon[0]))), fits)
    return f"; {slip.words} would fit: correct the table" if slip else ""
