"""Directions of matched targets, and the target that misses a strip."""

from dataclasses import replace

import numpy as np
import pytest

from boresight.calib.hypotheses import HypothesisInputs, hypotheses
from boresight.calib.strips import prepare_strip
from boresight.features.targets.dump_check import _in_view
from boresight.geometry.constants import WGS84
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.calibration.calibrate import DumpCalibration
from boresight.pipeline.diagnosis.input_findings import nearest_miss
from boresight.pipeline.stages.observed_strips import sighted_strips
from boresight.pipeline.stages.strip import footprint_e, ground_sightings, pushbroom_of


def test_covariance_of_a_target_is_turned_from_east_north_up_to_the_inertial_axes(calibration):
    task, matched = calibration.tasks[0], calibration.matched[0]
    sigma_m = np.array([1.0, 2.0, 3.0])
    targets = tuple(replace(target, sigma_m=sigma_m) for target in task.targets)
    ground = ground_sightings(matched, replace(task, targets=targets))
    p_e = {target.target_id: target.p_e for target in targets}
    for name, t_s, cov_i in zip(ground.target_id.tolist(), ground.t_s, ground.cov_target_i):
        R_ie = task.orbit.earth.matrices_ie(np.array([t_s]))[0]
        up = p_e[name] / np.array([WGS84.semi_major_m, WGS84.semi_major_m, WGS84.semi_minor_m]) ** 2
        up /= np.linalg.norm(up)
        east = np.cross([0.0, 0.0, 1.0], up)
        east /= np.linalg.norm(east)
        for axis, sigma in zip((east, np.cross(up, east), up), sigma_m):
            assert (R_ie @ axis) @ cov_i @ (R_ie @ axis) == pytest.approx(sigma**2, rel=1e-9)


def test_covariance_of_a_look_vector_is_that_of_sample_and_line(calibration: DumpCalibration) -> None:
    # An error of the sample alone moves the look vector along its CCD, and not along the track.
    task, matched = calibration.tasks[0], calibration.matched[0]
    sigma_px, step_px = 0.2, 0.5
    along_ccd = np.zeros_like(matched.cov_px)
    along_ccd[:, 0, 0] = sigma_px**2
    ground = ground_sightings(replace(matched, cov_px=along_ccd), task)
    sides = [matched.xy_px + np.array([step, 0.0]) for step in (step_px, -step_px)]
    more, less = (ground_sightings(replace(matched, xy_px=xy_px), task).u_c for xy_px in sides)
    moved = (more - less) / (2.0 * step_px) * sigma_px
    expected = moved[:, :, None] * moved[:, None, :]
    size = np.trace(expected, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(ground.cov_c / size, expected / size, rtol=0, atol=1e-3)


@pytest.mark.parametrize("axis", ["across the track", "height"])  # along it: the clock's
def test_an_orbit_stated_too_far_to_the_right_or_too_high_is_an_error_above_zero(calibration, axis) -> None:
    orbit, off_m, heads = calibration.tasks[0].orbit, 10.0, (calibration.reference,)
    up, ahead = (v / np.linalg.norm(v, axis=1)[:, None] for v in (orbit.positions_m, orbit.velocities_m_s))
    ways = {"across the track": np.cross(ahead, up), "height": up}
    elsewhere = replace(orbit, positions_m=orbit.positions_m + off_m * ways[axis])
    stated, moved = (
        [
            prepare_strip(one, calibration.settings)
            for one in sighted_strips(tasks, calibration.matched, heads)
        ]
        for tasks in (calibration.tasks, [replace(task, orbit=elsewhere) for task in calibration.tasks])
    )
    inputs = HypothesisInputs(stated, calibration.estimate.R_cs, calibration.camera.pixel_rad)
    (error,) = (h for h in hypotheses(inputs) if h.cause == f"orbit or targets, {axis}")
    change_s = np.concatenate([two.v_s - one.v_s for one, two in zip(stated, moved)]) / off_m
    # Looks that move by so much the other way leave the same residuals. Axes of the orbit's frame in that of
    # the Earth: the Earth's rotation turns the velocity by 4 degrees.
    expected = -calibration.estimate.R_cs.apply(change_s)
    np.testing.assert_allclose(error.moves_c, expected[error.rows], atol=0.08 * np.abs(expected).max())


def test_nearest_miss_is_told_across_and_along_the_track(calibration: DumpCalibration) -> None:
    task = calibration.tasks[0]
    seen_e = footprint_e(task)
    first, last = seen_e[:, 0].mean(axis=0), seen_e[:, -1].mean(axis=0)
    duration_s = float(np.ptp(pushbroom_of(task).instants(np.array([0.0, task.strip.lines - 1.0]))))
    along = (last - first) / np.linalg.norm(last - first)
    across = np.cross(along, first / np.linalg.norm(first))
    far, near = task.targets[0], task.targets[1]
    half_m = np.ptp(seen_e.reshape(-1, 3) @ across) / 2
    near = replace(near, p_e=last + 7e3 * along + (half_m + 20e3) * across)
    far = replace(far, p_e=last + 900e3 * along)
    across_m, along_m, along_s, name, _ = nearest_miss([task], (far, near))
    assert name == near.target_id
    # 2 % of the distance: the footprint is a trapezoid on a curved Earth.
    assert (across_m, along_m) == pytest.approx((20e3, 7e3), abs=600.0)
    assert along_s == pytest.approx(along_m / np.linalg.norm(last - first) * duration_s, rel=1e-6)


def test_a_place_is_in_view_to_half_a_pixel_beyond_the_middles_of_the_outer_pixels(calibration) -> None:
    whole = calibration.tasks[0]
    for ccd, lines in whole.strip.ccd_lines.items():
        task = replace(whole, strip=replace(whole.strip, ccd_lines={ccd: lines}))
        last, out = np.array([task.camera.n_px(ccd), lines]) - 1.0, np.array([0.4, 0.6])
        at = np.tile(0.3 * last, (8, 1))
        at[:4, 0], at[4:, 1] = (np.concatenate([-out, end + out]) for end in last)  # beyond four edges
        p_e = pushbroom_of(task).ground_points(ccd, *at.T, ConstantHeight(900.0))
        assert _in_view(task, p_e).tolist() == [True, False] * 4
        assert _in_view(whole, p_e)[4::2].all()  # by this one of the CCDs
