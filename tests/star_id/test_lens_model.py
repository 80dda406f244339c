"""Lenses that are not of the paper's model, calibrated from lists of stars: the map's error is as stated, or
the lens is refused."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from foreign_lenses import HEIGHT, SIZE, WIDTH, ForeignLens
from frames import listed_stars
from scipy.spatial.transform import Rotation

from boresight.geometry.star_camera import StarCamera
from boresight.star_id.camera_calibration import CameraCalibration, SkyFrame, calibrate_camera
from boresight.star_id.camera_fit import IdentifiedStars
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.field import nominal_camera
from boresight.star_id.identification.triangle_index import build_index
from boresight.star_id.lens_model import choose_lens
from boresight.star_id.settings import StarSettings

FOREIGN = {
    "Kannala and Brandt": (40.0, lambda t: t * (1 - 0.05 * t**2 + 0.02 * t**4 - 0.01 * t**6)),
    "orthographic": (36.0, np.sin),
    "wavy detector": (
        20.0,
        lambda t: np.tan(t) * (1 - 0.1 * np.tan(t) ** 2),
        lambda x, y: (0.4 * np.sin(3 * x + 1) * np.cos(2 * y), 0.3 * np.sin(3 * y - 2 * x)),
    ),
}
STEPS = {  # px, of the detector right of a column or below a row
    "columns, 1 px": (20.0, np.tan, lambda x, y: (1.0 * (x > 0.1), 0.0 * y)),
    "columns, 0.5 px": (20.0, np.tan, lambda x, y: (0.5 * (x > 0.1), 0.0 * y)),
    "rows, 0.5 px": (20.0, np.tan, lambda x, y: (0.5 * (y > 0.05), 0.0 * y)),
}


@cache
def index_of(fov_deg):
    places = hipparcos_stars(8.0).places
    return build_index(places, places.epoch_jyear, tuple(np.radians([0.6 * fov_deg, 1.2 * fov_deg])))


def calibrated(fov_deg, radius, *shift):
    lens, rng = ForeignLens(fov_deg, radius, *shift), np.random.default_rng(16)
    places, index = hipparcos_stars(8.0).places, index_of(fov_deg)
    frames = []
    for k in range(8):
        stars = listed_stars(lens, Rotation.random(random_state=rng), places, rng)
        frames.append(SkyFrame(str(k), stars))
    nominal = nominal_camera(SIZE, np.radians(1.02 * fov_deg))
    found = calibrate_camera(frames, nominal, index, StarSettings())
    assert isinstance(found, CameraCalibration)
    return lens, found


@pytest.mark.parametrize("name", FOREIGN)
def test_a_foreign_lens_is_as_wrong_as_stated(name):
    lens, found = calibrated(*FOREIGN[name])
    x, y = np.meshgrid(np.linspace(0, WIDTH - 1, 25), np.linspace(0, HEIGHT - 1, 19))
    xy = np.column_stack([x.ravel(), y.ravel()])
    error = lens.error_px(found.camera, xy)
    ratio = np.sqrt(0.5 * (error**2).sum(axis=1)) / found.model_sigma_px(xy)
    # some seven independent errors over the detector: mean square 1 within a factor, none far beyond
    assert 0.1 < (ratio**2).mean() < 2.5
    assert ratio.max() < found.band_factor(0.99)
    assert 2.3 < found.band_factor() < 3.0  # 1.7 if the errors were all one, 3 if eight
    assert (np.sqrt(0.5 * (error**2).sum(axis=1)) < 1.5 * found.map_error_px(xy)).all()  # 4 sigma
    assert found.explained


@pytest.mark.parametrize("name", STEPS)
def test_a_detector_with_a_step_is_refused_with_the_size_of_the_misfit(name):
    _, found = calibrated(*STEPS[name])
    assert not found.explained
    assert 0.01 < found.unmodelled_px < 0.5  # px; half of the largest step is the most that can be left


@pytest.mark.parametrize("field_deg", [90.0, 120.0, 175.0])
def test_fisheye_of_the_widest_fields_is_fitted_from_whatever_start(field_deg):
    """Brown's model diverges there: its fit is left out, and the fisheye's residuals are the noise alone."""
    truth = StarCamera(
        focal_m=5e-6 * 1000.0 / np.radians(0.5 * field_deg),  # 1000 px from the axis to the edge
        pixel_m=5e-6,
        width_px=2000,
        height_px=1500,
        principal_px=(1003.0, 742.0),
        projection="equidistant",
    )
    rng, sigma_px = np.random.default_rng(int(field_deg)), 0.1
    rotations = Rotation.random(3, random_state=rng)
    xy, u_i, frame = [], [], []
    for k in range(len(rotations)):
        pixels = rng.uniform(0.0, [1999.0, 1499.0], (100, 2))
        u_s = truth.directions_from_pixels(pixels)
        seen = np.isfinite(u_s).all(axis=1)
        xy.append(pixels[seen] + rng.normal(0.0, sigma_px, (seen.sum(), 2)))
        u_i.append(rotations[k].inv().apply(u_s[seen]))
        frame.append(np.full(seen.sum(), k))
    n = sum(map(len, xy))
    cov = np.tile(sigma_px**2 * np.eye(2), (n, 1, 1))
    stars = IdentifiedStars(np.vstack(xy), cov, np.vstack(u_i), np.concatenate(frame), np.zeros(3))
    lens = choose_lens(stars, replace(truth, projection="tangent"), rotations)
    assert lens.camera.projection == "equidistant"
    assert lens.camera.focal_m == pytest.approx(truth.focal_m, abs=4.0 * np.sqrt(lens.covariance[0, 0]))
    assert 0.8 < lens.fit.chi2 / lens.fit.dof < 1.2  # 600 residuals: 1 sigma of the ratio is 0.06
    assert np.isfinite(lens.covariance).all()


def test_lens_that_no_projection_images_is_an_error_that_says_so():
    u_i = Rotation.random(60, random_state=1).apply([0.0, 0.0, 1.0])  # also behind the camera
    xy, cov = np.random.default_rng(1).uniform(0.0, 2000.0, (60, 2)), np.tile(0.01 * np.eye(2), (60, 1, 1))
    stars = IdentifiedStars(xy, cov, u_i, np.zeros(60, dtype=int), np.zeros(1))
    with pytest.raises(np.linalg.LinAlgError):
        choose_lens(stars, nominal_camera(SIZE, np.radians(90.0)), Rotation.identity(1))
