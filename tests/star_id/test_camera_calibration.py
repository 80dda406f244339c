"""The sky as a calibration field: truth recovered from a wrong nominal camera, with an honest covariance."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.wcs import WCS
from frames import PAPER_CAMERA, as_seen, directions_of, listed_stars
from scipy.spatial.transform import Rotation

from boresight.features.sky_images.sip import tan_sip
from boresight.geometry.epoch import Epoch
from boresight.geometry.star_camera import StarCamera
from boresight.star_id.camera_calibration import SkyFrame, calibrate_camera, residual_map
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.observer import Observer
from boresight.star_id.settings import StarSettings

TRUTH = replace(PAPER_CAMERA, principal_px=(2571.3, 1911.2))
NOMINAL = StarCamera(
    focal_m=0.105, pixel_m=6.4e-6, width_px=5120, height_px=3840, principal_px=(2559.5, 1919.5)
)  # focal length 5 % wrong, no distortion
SETTINGS = StarSettings()
EPOCH = Epoch.from_utc("2026-01-01T00:00:00Z")
P_I, V_I = np.array([6.9e6, 0.0, 0.0]), np.array([0.0, 1.0e3, 7.5e3])  # m, m/s


def sky_frame(name, rng, camera=TRUTH, observer=None):
    R_si, sky = Rotation.random(random_state=rng), hipparcos_stars(8.0).places
    if observer is not None:  # stars of the field and those that aberration brings there
        near = directions_of(sky) @ R_si.as_matrix()[2] > np.cos(1.1 * camera.field_radius_rad)
        sky = as_seen(sky.take(np.flatnonzero(near)), observer)
    return SkyFrame(name, listed_stars(camera, R_si, sky, rng), observer)


def model_error(camera):
    """Error of the pixel map over the detector, the best rotation taken out, px (N, 2)."""
    x, y = np.meshgrid(np.linspace(0, 5119, 25), np.linspace(0, 3839, 19))
    xy = np.column_stack([x.ravel(), y.ravel()])
    true, got = TRUTH.directions_from_pixels(xy), camera.directions_from_pixels(xy)
    turn, _ = Rotation.align_vectors(true, got)
    return TRUTH.pixels_from_directions(turn.apply(got)) - xy


@pytest.fixture(scope="module")
def calibrations(index):
    results = []
    for seed in range(5):
        rng = np.random.default_rng([9, seed])
        frames = [sky_frame(str(k), rng) for k in range(10)]
        results.append(calibrate_camera(frames, NOMINAL, index, SETTINGS))
    return results


def test_ten_frames_give_the_camera_to_a_hundredth_of_a_pixel(calibrations):
    for result in calibrations:
        error = model_error(result.camera)
        assert np.sqrt((error**2).mean()) < 0.01  # px
        assert np.hypot(*error.T).max() < 0.03  # px


def test_the_stated_covariance_holds(calibrations):
    ratios = []
    for result in calibrations:
        camera = result.camera
        found = np.array([camera.focal_m, *camera.principal_px, camera.q1, camera.q2])
        truth = np.array([TRUTH.focal_m, *TRUTH.principal_px, TRUTH.q1, TRUTH.q2])
        sigma = np.sqrt(np.diag(result.covariance))[[0, 1, 2, 5, 6]]
        ratios.append((found - truth) / sigma)
        assert 0.7 < result.chi2 / result.dof < 1.2
    # 25 normalised errors, correlated within a run: mean square one within a factor
    assert 0.3 < np.mean(np.square(ratios)) < 2.2
    assert np.abs(ratios).max() < 4.0


def test_the_error_that_is_foretold_is_the_error_that_comes(calibrations):
    x, y = np.meshgrid(np.linspace(0, 5119, 25), np.linspace(0, 3839, 19))
    xy = np.column_stack([x.ravel(), y.ravel()])
    foretold = np.mean([(result.model_sigma_px(xy) ** 2).mean() for result in calibrations])
    come = np.mean([(model_error(result.camera) ** 2).mean() for result in calibrations])
    assert 0.3 < come / foretold < 3.0


def test_the_residual_map_shows_what_the_model_leaves(calibrations):
    cells = residual_map(calibrations[0])
    assert cells.count.sum() == len(calibrations[0].frame)
    good = cells.count > 0
    off = cells.mean_px[good] / cells.error_px[good][:, None]
    assert np.abs(off).max() < 4.5  # of some 96 numbers one in 1500 maps
    # less than one by what the fit takes up, 37 numbers of 3000: the cells' errors are those that come
    assert 0.7 < (off**2).mean() < 1.3


def months_of_frames(rng, drift_per_s):
    """Two frames a fortnight for half a year, the focal length changing; satellite and Earth move."""
    half_year_s, frames = 1.58e7, []
    for k, t_s in enumerate(np.repeat(np.linspace(0.0, half_year_s, 13), 2)):
        camera = replace(TRUTH, focal_m=TRUTH.focal_m * np.exp(drift_per_s * (t_s - 0.5 * half_year_s)))
        observer = Observer(EPOCH, float(t_s), P_I, V_I)
        frames.append(sky_frame(str(k), rng, camera, observer))
    return frames


def test_a_drift_of_the_focal_length_is_found_where_there_is_one(index):
    rng, deviations = np.random.default_rng(17), []
    for ppm_a_year in (0.0, 30.0, -60.0, 0.0, 30.0, -60.0):
        per_s = ppm_a_year * 1e-6 / 3.15576e7
        frames = months_of_frames(rng, per_s)
        result = calibrate_camera(frames, NOMINAL, index, SETTINGS, drift=True)
        sigma = result.focal_drift_sigma_per_s
        assert sigma * 3.15576e7 < 5e-6  # a year: what 26 frames can tell, a sixth of the drifts here
        assert (abs(result.focal_drift_per_s) > 4.0 * sigma) == (ppm_a_year != 0.0)
        deviations.append((result.focal_drift_per_s - per_s) / sigma)
        # the focal length is that of the middle of the half-year, within its own error
        assert abs(result.camera.focal_m - TRUTH.focal_m) < 4.0 * np.sqrt(result.covariance[0, 0])
    assert np.abs(deviations).max() < 3.5  # of six, one in 350 times
    assert 0.06 < np.mean(np.square(deviations)) < 3.7  # chi2 of 6 degrees: 0.1 % on either side


def test_too_few_stars_is_an_answer(index):
    rng = np.random.default_rng(1)
    frame = sky_frame("one", rng)
    few = SkyFrame("one", frame.stars.take(np.arange(3)))
    answer = calibrate_camera([few], NOMINAL, index, SETTINGS)
    assert isinstance(answer, NotIdentified) and "20 are needed" in answer.reason


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("beta", [[0.0, 0.0, 0.0], [1.6e-4, -0.9e-4, 0.7e-4]], ids=["still", "moving"])
def test_sip_header_means_to_astropy_what_the_camera_means_here(beta, mirrored):
    """And what the sky is without the aberration of a velocity, over that of light, of some 3 px."""

    def at_rest(u_i):
        return (u_i - beta) / np.linalg.norm(u_i - beta, axis=1)[:, None]

    R_si = Rotation.from_euler("xyz", [40, -65, 110], degrees=True)
    header = tan_sip(TRUTH, R_si, sky_of=at_rest, mirrored=mirrored)
    assert header.largest_misfit_px < 1e-3
    rng = np.random.default_rng(2)
    xy = rng.uniform([0, 0], [5119, 3839], (200, 2))
    own = [5119.0, 0.0] + xy * [-1.0, 1.0] if mirrored else xy  # of the image as it is
    sky = WCS(header.cards()).all_pix2world(own, 0)
    u_i = at_rest(R_si.inv().apply(TRUTH.directions_from_pixels(xy)))
    ra, dec = np.radians(sky.T)
    other = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    assert np.linalg.norm(u_i - other, axis=1).max() < 2e-3 * TRUTH.pixel_m / TRUTH.focal_m  # 2e-3 px
