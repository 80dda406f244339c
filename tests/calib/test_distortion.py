"""The curve that stands for the distortion's residual."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from boresight.calib.distortion import (
    MODES,
    ccd_modes,
    correlation,
    knot_weights,
    knots_touched,
    places_on_curves,
    prior_information,
    unknown_names,
)
from boresight.calib.error_table import _distortion
from boresight.simulator.cameras import calibrated_line_camera, distorted_line_camera
from boresight.simulator.campaign import CameraPair, DistortionCurve, StripPlan, installation_by_tilt
from boresight.simulator.scenario import ErrorSettings, LineCameraSettings

CAMERAS = CameraPair(installation_by_tilt(np.radians(15.0)))


def test_knots_hold_straight_lines_exactly_and_only_within_a_ccd():
    ccd = np.array([0, 0, 1, 1])
    sample = np.array([10.0, 900.0, 10.0, 6000.0])
    knots = knots_touched(ccd, sample / 1000.0)
    weights = knot_weights(ccd, sample / 1000.0, knots)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    value = np.array([500.0 * k for _, k in knots])
    np.testing.assert_allclose(weights @ value, sample)
    assert not np.any(weights[:2][:, [c == 1 for c, _ in knots]])


def test_drawn_curves_have_the_correlation_that_the_prior_states():
    rng = np.random.default_rng(3)
    plan = StripPlan(sigma_distortion_rad=1.0, distortion_length_px=1000.0)
    knots = tuple((1, k) for k in range(5))  # every 500 px
    ccd, at = np.ones(5, dtype=np.int64), 500.0 * np.arange(5)
    drawn = np.array([DistortionCurve.draw(plan, CAMERAS, rng).at(ccd, at)[:, 0] for _ in range(4000)])
    # 4 / sqrt(4000) and waves' own
    np.testing.assert_allclose(drawn.T @ drawn / 4000, correlation(knots), atol=0.09)


def test_simulated_curve_of_the_field_runs_on_from_ccd_to_ccd():
    length = 1500.0
    plan = StripPlan(sigma_distortion_rad=1.0, distortion_length_px=length, distortion_pixel_rad=1e-6)
    of_each, rng = replace(plan, distortion_pixel_rad=0.0), np.random.default_rng(3)
    ccd, sample = np.array([0, 1]), np.array([CAMERAS.ccd_px - 1.0, 0.0])  # neighbours across the seam
    jumps = [
        [np.diff(DistortionCurve.draw(one, CAMERAS, rng).at(ccd, sample), axis=0) for _ in range(400)]
        for one in (plan, of_each)
    ]
    field, each = np.sqrt(np.mean(np.square(jumps), axis=(1, 2, 3)))
    assert field < 0.01  # of the curve's sigma: sqrt(3) / length of a pixel, 0.001
    np.testing.assert_allclose(each, np.sqrt(2.0), rtol=0.1)  # two of their own; 3 standard errors


def test_prior_is_found_again_by_the_unknowns_names_in_any_order():
    names = unknown_names(((0, 1), (0, 2), (2, 1)), (0, 3))
    order = np.random.default_rng(5).permutation(len(names))
    prior = prior_information(names)
    of_modes = np.array([name.endswith(MODES) for name in names])
    assert of_modes.sum() == 12  # three of two CCDs along two axes, each of its own
    np.testing.assert_array_equal(prior[of_modes], np.eye(len(names))[of_modes])
    shuffled = prior_information(tuple(names[k] for k in order))
    np.testing.assert_allclose(shuffled, prior[np.ix_(order, order)], atol=1e-12)
    assert prior_information(()).shape == (0, 0)


def test_one_curve_over_all_ccds_shifts_the_whole_field_as_much_as_a_lens_does():
    settings, length = LineCameraSettings(), 1500.0
    camera = calibrated_line_camera(settings)
    ccd = np.repeat(np.arange(camera.n_ccds), 25)
    sample = np.tile(np.linspace(0.0, settings.samples - 1.0, 25), camera.n_ccds)
    u_c = np.concatenate([camera.directions_from_pixels(c, sample[ccd == c]) for c in range(camera.n_ccds)])

    def sigma_of_mean(pixel_rad):
        curve, place = places_on_curves(ccd, sample, u_c, pixel_rad)
        knots = knots_touched(curve, place / length)
        mean = knot_weights(curve, place / length, knots).mean(axis=0)
        return np.sqrt(mean @ correlation(knots) @ mean)

    no_own = {"ccd_shift_px": 0.0, "ccd_slope_px": 0.0, "ccd_bend_px": 0.0}
    errors = ErrorSettings(distortion_px=1.0, distortion_length_px=length, **no_own)
    rng, residuals = np.random.default_rng(8), []
    for _ in range(400):
        true = distorted_line_camera(camera, errors, rng)
        along = [t.distortion_offsets_m - c.distortion_offsets_m for t, c in zip(true.ccds, camera.ccds)]
        across = [t.across_offsets_m for t in true.ccds]
        residuals.append([np.concatenate(along), np.concatenate(across)])
    residual_px = np.array(residuals) / (settings.pixel_um * 1e-6)  # (400, along and across, samples)
    # 4 standard errors of 400 curves of some 9 independent lengths each: rms 1 px along as across.
    np.testing.assert_allclose(np.sqrt(np.mean(residual_px**2, axis=(0, 2))), 1.0, atol=0.05)
    shift_px = np.sqrt(np.mean(residual_px.mean(axis=2) ** 2, axis=0))
    # 3 standard errors of 400 draws, 0.106, beside 1.005: the areas under both correlations are the same.
    over = shift_px / sigma_of_mean(camera.pixel_rad)
    assert ((0.90 < over) & (over < 1.11)).all(), over  # along as across
    assert sigma_of_mean(camera.pixel_rad) > 1.1 * sigma_of_mean(0.0)  # curves of each CCD average away


def test_two_ccds_that_see_the_same_direction_share_the_curve_there():
    camera = calibrated_line_camera(LineCameraSettings())
    sample = np.array([6100.0])
    u_c = camera.directions_from_pixels(0, sample)
    other, _ = camera.samples_from_directions(1, u_c)
    pair = np.concatenate([u_c, camera.directions_from_pixels(1, other)])
    curve, place = places_on_curves(np.array([0, 1]), np.array([6100.0, other[0]]), pair, camera.pixel_rad)
    assert curve.tolist() == [0, 0]
    np.testing.assert_allclose(place[0], place[1], atol=0.5)  # px: the CCDs are rotated by some 20 µrad
    knots = knots_touched(curve, place / 1500.0)
    weights = knot_weights(curve, place / 1500.0, knots)
    np.testing.assert_allclose(weights[0], weights[1], atol=1e-3)
    assert len(knots) == 2


def test_modes_of_a_ccd_are_orthonormal_over_it_and_zero_on_others():
    ccd_px, ccds = (300, 512), (0, 1)
    sample = np.linspace(0.0, 511.0, 2001)
    of_one = np.ones(2001, dtype=np.int64)
    strip = SimpleNamespace(
        v_s=np.zeros((2001, 3)),
        distortion_rad=np.zeros(2001),
        curve=of_one,
        place=sample,
        unit=of_one,
        modes_rad=ccd_modes(of_one, sample, ccd_px),
    )
    change_c = _distortion((), ccds).columns_c(strip)
    modes = change_c[:, 0, :6]
    assert np.array_equal(change_c[:, 1, 6:], modes) and not change_c[:, 1, :6].any()
    own, other = modes[:, 1::2], modes[:, 0::2]
    np.testing.assert_allclose(own.T @ own / 2001, np.eye(3), atol=3e-3)  # the sum's ends: 2 / 2001
    assert not other.any()


def test_simulated_ccds_have_the_stated_shift_slope_and_bend():
    settings = LineCameraSettings()
    camera = calibrated_line_camera(settings)
    rms = (0.5, 0.2, 0.1)
    errors = ErrorSettings(distortion_px=0.0, ccd_shift_px=rms[0], ccd_slope_px=rms[1], ccd_bend_px=rms[2])
    rng, found = np.random.default_rng(2), []
    table = camera.ccds[0].distortion_samples
    modes = ccd_modes(np.zeros(len(table), dtype=np.int64), table, (settings.samples,))
    for _ in range(100):
        true = distorted_line_camera(camera, errors, rng)
        for t, c in zip(true.ccds, camera.ccds):
            residual = np.stack([t.distortion_offsets_m - c.distortion_offsets_m, t.across_offsets_m])
            found.append(np.linalg.lstsq(modes, residual.T / c.pixel_m, rcond=None)[0].T)
    drawn = np.concatenate(found)  # two axes, four CCDs, 100 cameras
    scatter = drawn.T @ drawn / len(drawn)
    np.testing.assert_allclose(np.sqrt(np.diag(scatter)), rms, rtol=0.09)  # 3.5 standard errors of 800 draws
    neighbours = np.mean(drawn[:-2:2, 0] * drawn[2::2, 0])  # along: of one CCD and the next
    assert abs(neighbours) < 3.5 * rms[0] ** 2 / np.sqrt(399)
