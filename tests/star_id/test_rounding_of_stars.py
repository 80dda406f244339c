"""Rounding moves no star, attitude or lens, also where a decision by evidence is near its limit."""

from dataclasses import replace

import numpy as np
import pytest
from foreign_lenses import SIZE, ForeignLens
from frames import PLACES, SMALL_CAMERA, Sensor, directions_of, listed_stars, star_frame, stars_in_view
from rounding import MOST, assert_unmoved, largest_jump, nudged
from scipy.spatial.transform import Rotation
from test_given_camera import cubic, scaled, shutter

from boresight.star_id.camera_fit import IdentifiedStars
from boresight.star_id.field import nominal_camera, solve_list
from boresight.star_id.field_fit import fit_attitude_and_lens
from boresight.star_id.finding.star_list import list_stars
from boresight.star_id.given_camera import fit_known_camera
from boresight.star_id.identification.triangle_index import build_index
from boresight.star_id.lens_model import choose_lens
from boresight.star_id.settings import StarSettings


def spread(covariances):
    return np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))


def places(stars):
    return stars.xy_px, spread(stars.cov_px)


SINGLE = 6e-8  # rounding of single precision, in which images are worked on
SENSORS = {
    "8 bits": Sensor(),
    "hot pixels": Sensor(bits=16, read_noise_dn=4.0, hot_pixels=300),
    "a trail": Sensor(bits=16, read_noise_dn=4.0, smear_px=(7.0, 3.0)),
    "wide stars": Sensor(bits=16, read_noise_dn=4.0, sigma_px=2.6),
}


def test_no_star_of_an_image_is_moved():
    def image(sensor, seed):
        rng = np.random.default_rng(5)
        raw, _ = star_frame(SMALL_CAMERA, Rotation.random(random_state=rng), PLACES, sensor, rng)
        raw = 0.731 * (
            raw + rng.uniform(-0.5, 0.5, raw.shape)
        )  # counts are exact: of these nothing is rounded
        return nudged(raw, seed, SINGLE) if seed else raw

    cases = [lambda seed, sensor=sensor: image(sensor, seed) for sensor in SENSORS.values()]
    assert_unmoved("stars", lambda raw: places(list_stars(raw, StarSettings())), cases)


SIGHTS = {  # what displaces the stars, of a size that may be seen or not
    "clean": lambda size: scaled(0.0),
    "shutter": lambda size: shutter(0.4 * size, 1.0),
    "lens": lambda size: cubic(0.3 * size),
    "focal length": lambda size: scaled(2e-4 * size),
}


def sighted(name, size, sky=3):
    """Stars of `SMALL_CAMERA`, displaced: centroids (N, 2), covariances, directions (N, 3), attitude."""
    rng = np.random.default_rng([7, sky])
    R_si = Rotation.random(random_state=rng)
    rows, exact = stars_in_view(SMALL_CAMERA, R_si, PLACES)
    sigma = 10.0 ** rng.uniform(-2.0, -0.8, len(rows))
    xy = SIGHTS[name](size)(exact) + sigma[:, None] * rng.normal(size=exact.shape)
    return xy, sigma[:, None, None] ** 2 * np.eye(2), directions_of(PLACES)[rows], R_si


def lens_of(xy, cov, u_i, R_si):
    field = fit_attitude_and_lens(SMALL_CAMERA, R_si, xy, cov, u_i).field
    value = [*(field.R_si * R_si.inv()).as_rotvec(), field.camera.fov_x_rad - SMALL_CAMERA.fov_x_rad]
    return np.array(value), np.append(spread(field.cov_s), field.fov_x_sigma_rad)


def attitude_of(xy, cov, u_i, R_si):
    fit = fit_known_camera(SMALL_CAMERA, xy, cov, u_i, R_si)
    return (fit.R_si * R_si.inv()).as_rotvec(), spread(fit.cov_s)


@pytest.mark.parametrize("fitted", [lens_of, attitude_of])
def test_no_lens_or_attitude_of_an_image_is_moved(fitted):
    def case(name, sky, seed):
        xy, *others = sighted(name, 1.0, sky)
        return (xy if seed is None else nudged(xy, seed), *others)

    cases = [lambda seed, at=(name, sky): case(*at, seed) for name in SIGHTS for sky in (3, 4)]
    assert_unmoved(fitted.__name__, lambda stars: fitted(*stars), cases)


def test_no_field_of_a_list_is_moved():
    index = build_index(PLACES, PLACES.epoch_jyear, (np.radians(15.0), np.radians(25.0)))

    def listed(sky, seed):
        rng = np.random.default_rng(sky)
        lens = ForeignLens(20.0, lambda angle: np.tan(angle) * (1.0 - 0.02 * np.tan(angle) ** 2))
        stars = listed_stars(lens, Rotation.random(random_state=rng), PLACES, rng)
        return stars if seed is None else replace(stars, xy_px=nudged(stars.xy_px, seed))

    def field(stars):
        found = solve_list(stars, SIZE, index, StarSettings(), fov_x_rad=np.radians(20.0))
        value = [*found.R_si.as_rotvec(), found.fov_x_rad]
        return np.array(value), np.append(spread(found.cov_s), found.fov_x_sigma_rad)

    assert_unmoved("fields", field, [lambda seed, sky=sky: listed(sky, seed) for sky in range(3)])


LENSES = {  # field of view, deg, and what `ForeignLens` takes
    "Brown": (30.0, lambda t: np.tan(t) * (1.0 - 0.1 * np.tan(t) ** 2)),
    "equidistant": (40.0, lambda t: t),
    "a wavy detector": (20.0, np.tan, lambda x, y: (0.4 * np.sin(6 * x + 1), 0.3 * np.sin(6 * y))),
}


def test_no_lens_of_many_images_is_moved():
    def identified(lens, seed):
        rng, parts, turns, (fov_deg, *_), lens = np.random.default_rng(9), [], [], lens, ForeignLens(*lens)
        for frame in range(5):
            turns.append(Rotation.random(random_state=rng))
            rows, xy = stars_in_view(lens, turns[-1], PLACES)
            rows, xy = rows[:60], xy[:60]
            measured = xy + 0.03 * rng.normal(size=xy.shape)
            parts.append((measured, directions_of(PLACES)[rows], np.full(len(rows), frame)))
        xy, u_i, frame = (np.concatenate(part) for part in zip(*parts))
        cov = np.full((len(xy), 1, 1), 0.03**2) * np.eye(2)
        stars = IdentifiedStars(xy if seed is None else nudged(xy, seed), cov, u_i, frame, np.zeros(5))
        start = nominal_camera(SIZE, np.radians(fov_deg))
        return stars, replace(start, principal_px=(1030.8, 762.4)), Rotation.concatenate(turns)

    def fitted(case):
        lens = choose_lens(*case)
        value = [getattr(lens.camera, name) for name in ("focal_m", "p1", "p2", "q1", "q2")]
        smooth = lens.camera.smooth
        coefficients = [] if smooth is None else smooth.coefficients_px.ravel()
        sigma = np.sqrt(np.diag(lens.covariance))
        n = len(lens.parameters)
        return np.append(value, coefficients), np.concatenate([sigma[[0, 3, 4, 5, 6]], sigma[n:]])

    cases = [lambda seed, lens=lens: identified(lens, seed) for lens in LENSES.values()]
    assert_unmoved("lenses", fitted, cases, seeds=(1,))


@pytest.mark.parametrize("fitted", [lens_of, attitude_of])
@pytest.mark.parametrize("name", ["shutter", "lens", "focal length"])
def test_what_grows_until_it_is_seen_makes_no_result_jump(name, fitted):
    """Sizes from nothing to what is plainly seen: somewhere between, evidence decides."""
    assert largest_jump(lambda size: fitted(*sighted(name, size))) <= MOST
