"""CE90 and LE90 against closed forms and drawn errors; what more data would change."""

from dataclasses import replace

import numpy as np
import pytest
from pytest import approx
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from boresight.calib.settings import CalibrationSettings
from boresight.geometry.attitude_estimate import fit_exposures
from boresight.geometry.constants import ARCSEC
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.geometry.sightings import GroundReferences
from boresight.pipeline.forecast.campaigns import improvements
from boresight.pipeline.report.ground_accuracy import predicted_accuracy, radius_90
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips, installation_by_tilt


def test_radius_of_90_per_cent_has_its_closed_forms():
    # Rayleigh distribution for equal axes, the normal distribution's own interval for one axis.
    assert radius_90(np.eye(2)) == approx(np.sqrt(2.0 * np.log(10.0)), rel=1e-9)
    assert radius_90(np.diag([4.0, 0.0])) == approx(2.0 * norm.ppf(0.95), rel=1e-5)
    assert radius_90(np.zeros((2, 2))) == 0.0


def test_predicted_accuracy_is_the_scatter_of_rays_on_flat_ground():
    # A million draws: the quantile is known to 0.3 %, three times that holds.
    rng = np.random.default_rng(5)
    root = np.array([[2.0, 0.3, -0.5], [0.0, 1.5, 0.8], [0.0, 0.0, 12.0]]) * ARCSEC
    covariance, tangents = root @ root.T, np.array([[0.02, -0.3], [0.0, 0.1]])
    range_m, position_m, along_m = 5.3e5, 2.0, 0.7
    found = predicted_accuracy(covariance, range_m, tangents, position_m, along_m)
    look = np.array([*tangents[0], 1.0])
    turned = look + np.cross(rng.standard_normal((1_000_000, 3)) @ root.T, look)
    errors = range_m * (turned[:, :2] / turned[:, 2:] - look[:2] * look[2])
    # On flat ground a ray is cut where z is the range: the turn's component along the ray has no effect.
    exact = np.cross(np.eye(3), look)
    J = range_m * (exact[:, :2] - exact[:, 2:] * look[:2]).T
    assert np.cov(errors.T) == approx(J @ covariance @ J.T, rel=0.02, abs=0.02)
    errors += rng.standard_normal(errors.shape) * position_m
    errors[:, 0] += rng.standard_normal(len(errors)) * along_m
    assert found["ce90_m"] == approx(np.quantile(np.linalg.norm(errors, axis=1), 0.9), rel=0.01)
    assert found["le90_m"] == approx(np.quantile(np.abs(errors), 0.9, axis=0), rel=0.01)


def test_the_clock_moves_a_place_along_the_track_and_the_orbit_both_ways():
    # No error of rotation: 2 m of the orbit each way, 6 m of the clock along, sqrt(40) in all.
    found = predicted_accuracy(np.zeros((3, 3)), 5.3e5, np.array([[0.02, -0.3]]), 2.0, 6.0)
    assert found["sigma_m"] == approx([np.sqrt(40.0), 2.0], rel=1e-12)
    assert found["le90_m"] == approx([1.6448536 * np.sqrt(40.0), 1.6448536 * 2.0], rel=1e-6)


def test_changes_of_the_data_have_the_effect_that_statistics_gives_them():
    # Errors of strips only, no distortion shared between them: twice the strips give 1 / sqrt(2). Half the
    # error of position bounds X where nothing else does.
    plan = StripPlan(strips=3, targets=8, across=(-0.5, 0.5), sigma_position_m=5.0)
    cameras = CameraPair(installation_by_tilt(np.radians(40.0), 0.7))
    strips, truth = draw_strips(plan, cameras, np.random.default_rng(2))
    none = dict.fromkeys(("sigma_clock_s", "sigma_vibration_rad", "sigma_distortion_rad"), 0.0)
    settings = CalibrationSettings(sigma_position_m=5.0, **none)
    fitted = [replace(one, attitudes=fit_exposures(one.exposures, settings.attitudes)) for one in strips]
    told = improvements(fitted, truth.R_cs, settings, camera(cameras))
    found = {one.change: one.sigma_ratio for one in told}
    assert found["twice as many strips"] == approx(np.full(3, np.sqrt(0.5)), rel=1e-3)
    assert found["half the error of position"][:2] == approx([0.5, 0.5], abs=0.02)
    assert found["half the error of the clock"] == approx(np.ones(3), rel=1e-6)
    # The noise of the image points averages with their number, that of the attitudes between them does not.
    assert np.sqrt(0.5) < found["twice as many targets in each strip"][2] < 0.85
    # Z from targets over half the swath, even: their rms distance is 0.5 / sqrt(3) = 0.29 of the half width;
    # at the ends, 0.8 to 1 of it, 0.90: the ratio of the two, within the spread of eight drawn targets.
    assert found["the same number of targets, all near the ends of the swath"][2] == approx(0.32, abs=0.1)


def test_targets_of_one_reference_can_be_twice_as_many():
    # An offset of 1 mm that all have in common is nothing beside the 5 m of each position: 1e-6 is rounding.
    cameras = CameraPair(installation_by_tilt(np.radians(40.0), 0.7))
    strips, truth = draw_strips(StripPlan(strips=3), cameras, np.random.default_rng(2))
    n, settings = StripPlan().targets, CalibrationSettings(sigma_position_m=5.0)
    offset = {
        "axes_i": np.tile(np.eye(3), (n, 1, 1)),
        "sigma_m": np.full((n, 3), 1e-3),
        "place": np.zeros((n, 3)),
    }
    mosaic = GroundReferences(name=np.full(n, "mosaic"), **offset)
    strips = [replace(one, attitudes=fit_exposures(one.exposures, settings.attitudes)) for one in strips]
    of_mosaic = [replace(one, ground=replace(one.ground, references=mosaic)) for one in strips]
    without, found = (improvements(of, truth.R_cs, settings, camera(cameras)) for of in (strips, of_mosaic))
    for one, other in zip(without, found):
        assert other.sigma_ratio == approx(one.sigma_ratio, rel=1e-6)


def camera(cameras: CameraPair) -> LineCamera:
    pitch_m, focal_m = 1e-5, 1e-5 / cameras.pixel_rad
    width = cameras.ccd_px * pitch_m
    of_all = {"n_px": cameras.ccd_px, "x_offset_m": 0.0, "rotation_rad": 0.0, "pixel_m": pitch_m}
    firsts = (np.arange(cameras.n_ccds) - 0.5 * cameras.n_ccds) * width
    ccds = tuple(Ccd(y_first_m=float(first), principal_sample=0.0, **of_all) for first in firsts)
    return LineCamera(focal_m, ccds, 1, "middle")


@pytest.mark.parametrize("angle", [0.0, 0.4, 2.0])
def test_radius_does_not_depend_on_the_axes(angle):
    R = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()[:2, :2]
    assert radius_90(R @ np.diag([9.0, 1.0]) @ R.T) == approx(radius_90(np.diag([1.0, 9.0])), rel=1e-9)
