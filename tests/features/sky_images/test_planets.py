"""Planets' directions against published conjunctions, and a planet told in an image."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.coordinates import get_body
from astropy.time import Time
from frames import PLACES, WIDE, listed_stars
from scipy.spatial.transform import Rotation

from boresight.features.sky_images.planets import planet_directions, planets_in_view
from boresight.geometry.epoch import Epoch
from boresight.star_id.field import FieldSolution, solve_list
from boresight.star_id.identification.triangle_index import build_index
from boresight.star_id.observer import Observer
from boresight.star_id.settings import StarSettings


def at(utc):
    """An observer at the middle of the Earth, at rest there."""
    return Observer(Epoch.from_utc(utc), 0.0, np.zeros(3), np.zeros(3))


def arcmin(u, v):
    return np.degrees(np.arccos(np.clip(u @ v, -1.0, 1.0))) * 60.0


def test_jupiter_and_saturn_met_on_the_day_and_as_closely_as_published():
    # great conjunction: 6.1' on 2020-12-21 at 18:20 UTC, in 20h 10m, -20.5 deg
    names, u_i = planet_directions(at("2020-12-21T18:20:00"))
    jupiter, saturn = (u_i[names.index(name)] for name in ("Jupiter", "Saturn"))
    assert arcmin(jupiter, saturn) == pytest.approx(6.1, abs=1.5)  # their errors of 80" each
    ra, dec = np.degrees(np.arctan2(jupiter[1], jupiter[0])) % 360.0, np.degrees(np.arcsin(jupiter[2]))
    assert ra == pytest.approx(302.5, abs=0.5) and dec == pytest.approx(-20.5, abs=0.2)
    for name, direction in zip(names, u_i):  # light time moves them by 5" to 40", aberration by up to 20"
        seen = get_body(name, Time("2020-12-21T18:20:00"), ephemeris="builtin").cartesian.xyz
        assert np.linalg.norm(direction - seen / np.linalg.norm(seen)) < 5e-7, name  # rad, 0.1"


def test_mars_passed_jupiter_as_closely_as_published():
    # conjunction of Mars and Jupiter: 0.3 deg on 2024-08-14 at 15 h UTC
    names, u_i = planet_directions(at("2024-08-14T15:00:00"))
    assert 17.0 < arcmin(u_i[names.index("Mars")], u_i[names.index("Jupiter")]) < 20.0


def test_a_planet_among_the_stars_is_told():
    observer = at("2020-12-21T18:20:00")
    names, u_i = planet_directions(observer)
    rng = np.random.default_rng(3)
    towards = Rotation.align_vectors([[0.05, 0.1, 1.0]], [u_i[names.index("Jupiter")]])[0]
    index = build_index(PLACES, PLACES.epoch_jyear, (np.radians(40.0), np.radians(60.0)))
    stars = listed_stars(WIDE, towards, PLACES, rng, brightest=2000.0).take(np.arange(150))
    xy = WIDE.pixels_from_directions(towards.apply(u_i[[names.index("Jupiter")]]))
    # px: something else beside it, as bright, and listed before
    bright = np.vstack([xy + np.array([40.0, -25.0]), xy])
    rows = np.concatenate([[0, 0], np.arange(len(stars.snr))])
    stars = replace(stars.take(rows), xy_px=np.vstack([bright, stars.xy_px]))
    found = solve_list(stars, (2048, 2048), index, StarSettings())
    assert isinstance(found, FieldSolution)
    seen = {planet.name: planet for planet in planets_in_view(found, observer)}
    assert {"Jupiter", "Saturn"} <= set(seen)
    assert seen["Jupiter"].detection == 1
    assert np.hypot(seen["Jupiter"].x_px - xy[0, 0], seen["Jupiter"].y_px - xy[0, 1]) < 2.0


@pytest.mark.parametrize(
    ("arcsec_px", "off_px", "detection"), [(5.0, 20.0, 0), (5.0, 28.0, -1), (80.0, 2.5, 0), (80.0, 4.0, -1)]
)
def test_a_detection_is_a_planet_within_two_minutes_of_arc_or_three_pixels(arcsec_px, off_px, detection):
    observer = at("2020-12-21T18:20:00")
    names, u_i = planet_directions(observer)
    camera = replace(WIDE, focal_m=WIDE.pixel_m * 206_264.8 / arcsec_px)
    R_si = Rotation.align_vectors([[0.0, 0.0, 1.0]], [u_i[names.index("Mars")]])[0]
    xy = camera.pixels_from_directions(np.array([[0.0, 0.0, 1.0]])) + off_px * np.array([0.6, -0.8])
    stars = SimpleNamespace(xy_px=xy, snr=np.array([50.0]))
    found = SimpleNamespace(camera=camera, R_si=R_si, stars=stars, detections=np.array([], dtype=int))
    planets = {one.name: one.detection for one in planets_in_view(found, observer)}  # type: ignore[arg-type]
    assert planets["Mars"] == detection
