"""Planets in an identified image of known time: bright detections that no catalogue of stars holds.

Heliocentric positions are those of Simon et al. (1994), ERFA's `plan94`: good to 10" for the inner planets
and to 80" for Jupiter and Saturn. That tells a planet from a star; no attitude is computed from it.
"""

from __future__ import annotations

import erfa
import numpy as np

from boresight.geometry.constants import ARCSEC, DAY_S, SPEED_OF_LIGHT
from boresight.geometry.groundlight import aberrate
from boresight.geometry.star_camera import StarCamera
from boresight.geometry.starlight import refract_by_air
from boresight.records.record import Floats, record, scalar
from boresight.star_id.field import FieldSolution
from boresight.star_id.observer import Observer

__all__ = ["Planet", "planet_directions", "planets_in_view"]

# Planets that stars' images show, with their numbers in ERFA's `plan94`; Earth is 3, Neptune is too faint.
PLANETS = {1: "Mercury", 2: "Venus", 4: "Mars", 5: "Jupiter", 6: "Saturn", 7: "Uranus"}
# Astronomical unit, m (IAU 2012 B2).
_AU_M = erfa.DAU
# Error of a predicted planet, rad (`plan94` errs by up to 86″), and that of the lens, px: a detection
# within the larger one is the planet.
_ERROR_RAD, _ERROR_PX = 120.0 * ARCSEC, 3.0


@record(kw_only=True)
class Planet:
    """A planet in the field of view."""

    name: str = scalar("in English")
    x_px: float = scalar("predicted column")
    y_px: float = scalar("predicted row")
    detection: int = scalar("row of the brightest unidentified detection there; -1: none")


def planet_directions(observer: Observer) -> tuple[tuple[str, ...], Floats]:
    """Names (P,) and apparent directions (P, 3), GCRS axes, of the planets to Uranus: light time and
    aberration included, and refraction for an observer on the ground."""
    day, part = (float(jd) for jd in observer.epoch.tt_jd(observer.t_s))
    (earth, _), (_, barycentric) = (tuple(pv[key] for key in ("p", "v")) for pv in erfa.epv00(day, part))
    seen_from = earth + observer.p_i / _AU_M
    velocity = barycentric * (_AU_M / DAY_S) + observer.v_i
    directions = []
    for number in PLANETS:
        days = 0.0
        for _ in range(3):  # the second changes Jupiter's position by 0.01″
            away = erfa.plan94(day, part - days, number)["p"] - seen_from
            days = float(np.linalg.norm(away)) * _AU_M / SPEED_OF_LIGHT / DAY_S
        directions.append(away / np.linalg.norm(away))
    u_i = aberrate(np.array(directions), np.tile(velocity, (len(PLANETS), 1)))
    return tuple(PLANETS.values()), u_i if observer.air is None else refract_by_air(u_i, observer.air)


def planets_in_view(found: FieldSolution, observer: Observer) -> tuple[Planet, ...]:
    """Planets within the image of a solution, each with the detection that it may be.

    That is the brightest one within the error of the prediction that is no identified star.
    """
    assert found.stars is not None
    names, u_i = planet_directions(observer)
    xy = _pixels(found.camera, found.R_si.apply(u_i))
    reach = max(_ERROR_PX, _ERROR_RAD * found.camera.focal_m / found.camera.pixel_m)
    free = np.setdiff1d(np.arange(len(found.stars.snr)), found.detections)  # ascending: brightest first
    planets = []
    for name, at in zip(names, xy):
        if not found.camera.contains(at[None])[0]:
            continue
        near = free[np.hypot(*(found.stars.xy_px[free] - at).T) < reach]
        row = int(near[0]) if len(near) else -1
        planets.append(Planet(name=name, x_px=float(at[0]), y_px=float(at[1]), detection=row))
    return tuple(planets)


def _pixels(camera: StarCamera, u_s: Floats) -> Floats:
    """Pixels (P, 2) of directions in front of a camera; NaN for those behind it."""
    ahead = u_s[:, 2] > 0.1
    xy: Floats = np.full((len(u_s), 2), np.nan)
    xy[ahead] = camera.pixels_from_directions(u_s[ahead])
    return xy
