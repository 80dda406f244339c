"""The strip's linear model against the paper's frame and against differences of the physics."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_campaigns import BOLD, CAMERAS
from scipy.spatial.transform import Rotation

from boresight.calib import strips as strips_module
from boresight.calib.calibration import calibrate_strips
from boresight.calib.distortion import correlation, knots_touched
from boresight.calib.error_table import (
    SharedUnknowns,
    coordinate_covariance,
    earth_axes,
    find_shared,
    of_pass,
)
from boresight.calib.pass_attitude import _covered, _weights
from boresight.calib.settings import CalibrationSettings
from boresight.calib.strips import group_strips, linearise, prepare_strip, tangent_axes
from boresight.features.paper.frames import calibrate_frames
from boresight.geometry.attitude import interpolation_weights
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.geometry.sightings import StripSightings, VectorSets
from boresight.simulator.campaign import StripPlan, draw_strips

NONE = CalibrationSettings(
    sigma_position_m=0.0, sigma_clock_s=0.0, sigma_vibration_rad=0.0, sigma_distortion_rad=0.0
)
NOTHING = SharedUnknowns()


def strips_of(plan, seed=1):
    return draw_strips(plan, CAMERAS, np.random.default_rng(seed))[0]


def test_coordinates_are_known_in_axes_that_turn_with_the_earth_and_directions_across_themselves():
    """Once around in a stellar day of 86164.0989 s; of a star nothing else than across is changed."""
    rng, stellar_day_s = np.random.default_rng(3), 86_164.0989
    t_s = np.array([0.0, stellar_day_s / 4.0, stellar_day_s / 12.0])
    root = rng.normal(size=(3, 3, 3))
    cov = root @ np.swapaxes(root, 1, 2)
    u_i = Rotation.random(3, rng=rng).apply([0.0, 0.0, 1.0])
    ground = coordinate_covariance(cov, t_s, u_i, np.zeros(3, dtype=bool))
    z = Rotation.from_euler("z", [[0.0], [90.0], [30.0]], degrees=True).as_matrix()
    np.testing.assert_allclose(earth_axes(t_s), z, atol=2e-8)  # rad: a rate of seven digits
    for n in range(3):
        np.testing.assert_allclose(ground[n], z[n].T @ cov[n] @ z[n], atol=1e-6)
        across = np.eye(3) - np.outer(u_i[n], u_i[n])
        own = across @ cov[n] @ across  # as a catalogue's: nothing along the direction
        (star,) = coordinate_covariance(own[None], t_s[:1], u_i[n : n + 1], np.array([True]))
        np.testing.assert_allclose(across @ star @ across, own * 1e12, rtol=1e-9, atol=1e-3)  # microradian²
        assert u_i[n] @ star @ u_i[n] == pytest.approx(0.5e12 * np.trace(own))
        np.linalg.cholesky(star)


def one_instant(strip: StripSightings) -> StripSightings:
    """The strip with its first exposure only, and all targets at its instant, where they would be seen
    then.
    """
    exposure, ground = strip.exposures[0], strip.ground
    R_oi = strip.R_oi_exposures[:1]
    same = replace(ground, t_s=np.full(len(ground.t_s), exposure.t_s))
    return replace(
        strip,
        exposures=(exposure,),
        ground=same,
        R_oi_exposures=R_oi,
        R_oi_targets=Rotation.concatenate([R_oi[0]] * len(ground.t_s)),
    )


def doubled(strip: StripSightings) -> StripSightings:
    """The strip with every exposure a second time, a millisecond later: the same stars at the same places."""
    twice = [replace(e, t_s=e.t_s + late) for e in strip.exposures for late in (0.0, 1e-3)]
    turn = np.repeat(np.arange(len(strip.exposures)), 2)
    return replace(strip, exposures=tuple(twice), R_oi_exposures=strip.R_oi_exposures[turn])


def test_with_one_exposure_at_the_targets_instant_it_is_the_papers_frame():
    still = replace(StripPlan(), duration_s=0.0, exposures=1, strips=5, targets=15)
    strips = [one_instant(strip) for strip in strips_of(still)]
    grounds, exposures = [s.ground for s in strips], [s.exposures[0] for s in strips]
    frames = VectorSets(
        star_start=np.arange(6) * 40,
        u_s=np.concatenate([e.u_s for e in exposures]),
        v_stars=np.concatenate([e.u_i for e in exposures]),
        sigma_s=np.full(200, 0.06 * 6.4e-5),
        target_start=np.arange(6) * 15,
        w_c=np.concatenate([g.u_c for g in grounds]),
        v_targets=np.concatenate([g.u_i for g in grounds]),
        sigma_c=np.full(75, 0.3e-6),
    )
    by_frames = calibrate_frames(frames, BOLD)
    by_strips = calibrate_strips(strips, BOLD, replace(NONE, robust=False))
    # relative; 1e-5 rad of noise moves the vectors at which information is taken
    np.testing.assert_allclose(by_strips.cov_theta, by_frames.solution.covariance, rtol=1e-4, atol=0)
    apart = theta_between(by_strips.R_cs, by_frames.R_cs)
    assert np.linalg.norm(apart) < 2e-3 * ARCSEC  # second order in 5 arcsec of noise about Z


def test_exposures_doubled_a_millisecond_apart_tell_nothing_more_and_nothing_less():
    strips = strips_of(StripPlan(strips=3))
    by_each = calibrate_strips(strips, BOLD, NONE)
    by_double = calibrate_strips([doubled(strip) for strip in strips], BOLD, NONE)
    # relative: nodes lie 0.5 ms later, in steps of 200 ms; a polynomial through each makes it 40 times
    np.testing.assert_allclose(np.diag(by_double.cov_theta), np.diag(by_each.cov_theta), rtol=0.02, atol=0)
    apart = theta_between(by_double.R_cs, by_each.R_cs)
    assert apart @ np.linalg.solve(by_each.cov_theta, apart) < 0.1**2 * 3  # a tenth of 1 sigma


@pytest.mark.parametrize("unknown", [1, 3])  # position along y, clock of the rows
def test_errors_of_a_pass_move_the_targets_as_the_physics_says(unknown):
    strip = strips_of(StripPlan(strips=1, wave_rad=(0.0, 0.0)))[0]
    ground, late_s = strip.ground, 1e-3 if unknown == 3 else 0.0
    shift = ground.v_rel_i * late_s if unknown == 3 else np.array([0.0, 2.0, 0.0])
    seen_from_there = ground.range_m[:, None] * ground.u_i - shift
    seen_from_there /= np.linalg.norm(seen_from_there, axis=1, keepdims=True)
    span = strip.exposures[-1].t_s - strip.exposures[0].t_s
    rate_o = (strip.R_oi_exposures[-1] * strip.R_oi_exposures[0].inv()).as_rotvec() / span
    later = Rotation.from_rotvec(rate_o * late_s) * strip.R_oi_targets
    there = replace(strip, ground=replace(ground, u_i=seen_from_there), R_oi_targets=later)
    settings = replace(NONE, sigma_position_m=2.0, sigma_clock_s=1e-3)
    before, after = prepare_strip(strip, settings), prepare_strip(there, settings)
    column = of_pass(before, settings)[:, :, unknown]
    size = np.abs(column).max()
    assert size > 1e-6  # rad
    # second order, and the rate by stars
    np.testing.assert_allclose(after.v_s - before.v_s, column, rtol=0, atol=5e-4 * size)


@pytest.fixture
def all_unknowns(monkeypatch):
    """Strips of a single head keep all unknowns of their own (`own_unknowns`)."""

    def as_they_are(X, ties, n_phi):
        none = np.zeros((len(X), X.shape[2], ties.shape[2] - n_phi))
        return X, none, none[:, :0]

    monkeypatch.setattr(strips_module, "condensed", as_they_are)


@pytest.mark.usefixtures("all_unknowns")
def test_theta_and_attitude_columns_are_derivatives_of_the_residual():
    strip = strips_of(StripPlan(strips=1))[0]
    settings = replace(NONE, robust=False)
    theta = np.array([2e-6, -3e-6, 1e-6])
    group = group_strips([prepare_strip(strip, settings)], NOTHING, settings)[0]
    at = linearise(group, BOLD, settings)
    turned = linearise(group, deviation_from_theta(theta) * BOLD, settings)
    change = (turned.r - at.r)[0]
    np.testing.assert_allclose(
        change, -(at.along(np.eye(at.n_common, 3))[0] @ theta), rtol=0, atol=2e-4 * np.abs(change).max()
    )
    column = at.X_q[0][:, 3 * 4 : 3 * 5]  # the fifth exposure
    psi = np.array([3e-6, 1e-6, -2e-6])
    covariance = prepare_strip(strip, settings).attitudes.covariance_s[4]
    exposure = strip.exposures[4]
    wrong = replace(exposure, u_s=Rotation.from_rotvec(psi).apply(exposure.u_s))
    exposures = (*strip.exposures[:4], wrong, *strip.exposures[5:])
    moved = group_strips([prepare_strip(replace(strip, exposures=exposures), settings)], NOTHING, settings)[0]
    change = (linearise(moved, BOLD, settings).r - at.r)[0]
    expected = -(column @ np.linalg.solve(np.linalg.cholesky(covariance), psi))
    np.testing.assert_allclose(change, expected, rtol=0, atol=1e-3 * np.abs(change).max())


def test_a_prior_of_zero_switches_its_error_off():
    strip = strips_of(StripPlan(strips=1))[0]
    prepared = prepare_strip(strip, NONE)
    assert of_pass(prepared, NONE).shape[2] == 4 and not np.any(of_pass(prepared, NONE))
    group = group_strips([prepared], NOTHING, NONE)[0]
    assert not np.any(group.white_s) and not np.any(group.missed)


@pytest.mark.usefixtures("all_unknowns")
def test_a_target_seen_twice_is_one_point_on_the_ground():
    strip = strips_of(StripPlan(strips=1, sigma_target_m=3.0))[0]
    ids = strip.ground.target_id.copy()
    ids[3] = ids[7]
    prepared = prepare_strip(replace(strip, ground=replace(strip.ground, target_id=ids)), NONE)
    group = group_strips([prepared], NOTHING, NONE)[0]
    assert group.shared_s.shape[3] == prepared.attitude_s.shape[2] + 4 + 3
    own = group.shared_s[0, :, :, -3:]
    assert np.flatnonzero(np.any(own != 0, axis=(1, 2))).tolist() == [3, 7]
    assert np.flatnonzero(~np.any(group.white_s[0] != 0, axis=(1, 2))).tolist() == [3, 7]


def test_targets_outside_the_exposures_are_not_extrapolated():
    strip = strips_of(StripPlan(strips=1))[0]
    short = replace(strip, exposures=strip.exposures[:5], R_oi_exposures=strip.R_oi_exposures[:5])
    prepared = prepare_strip(short, NONE)
    assert prepared.inside.tolist() == (strip.ground.t_s <= 0.9).tolist()  # 0.8 s and half a step of 0.2 s


def test_vibration_seen_by_the_exposures_adds_to_the_covariance_of_their_attitudes():
    strip = strips_of(StripPlan(strips=1))[0]
    sigma = 2e-6  # rad; the attitudes' own are some 1e-6
    still, shaken = (
        prepare_strip(strip, replace(NONE, sigma_vibration_exposure_rad=size)) for size in (0.0, sigma)
    )
    weights = interpolation_weights(np.array([e.t_s for e in strip.exposures]), strip.ground.t_s, points=4)
    phi = slice(0, 3 * len(strip.exposures))
    parts = (p.attitude_s[:, :, phi] for p in (shaken, still))
    added = [np.einsum("jan,jbn->jab", part, part) for part in parts]
    across = np.eye(3) - still.v_s[:, :, None] * still.v_s[:, None, :]
    expected = sigma**2 * np.sum(weights**2, axis=1)[:, None, None] * across
    np.testing.assert_allclose(added[0] - added[1], expected, rtol=0, atol=1e-6 * sigma**2)


def test_coordinates_of_targets_are_in_axes_that_rotate_with_the_earth():
    quarter_s = 86164.0905 / 4  # of a sidereal day
    strip = strips_of(StripPlan(strips=1))[0]
    ground = replace(strip.ground, cov_target_i=np.tile(np.diag([1.0, 4.0, 9.0]), (12, 1, 1)))
    now = replace(strip, ground=replace(ground, t_s=ground.t_s - ground.t_s))
    exposures = [replace(e, t_s=e.t_s - ground.t_s.mean()) for e in strip.exposures]
    now = replace(now, exposures=tuple(exposures))
    later = replace(
        now,
        ground=replace(now.ground, t_s=now.ground.t_s + quarter_s),
        exposures=tuple(replace(e, t_s=e.t_s + quarter_s) for e in exposures),
    )
    first, second = prepare_strip(now, NONE), prepare_strip(later, NONE)
    # Six hours later the target's x axis points where y pointed, and its y axis against x.
    scale = np.abs(first.coordinates_s).max()
    np.testing.assert_allclose(
        second.coordinates_s, first.coordinates_s[:, :, [1, 0, 2]] * [1, -1, 1], rtol=0, atol=1e-6 * scale
    )
    np.testing.assert_allclose(first.cov_coordinates[0], np.diag([1.0, 4.0, 9.0]), atol=1e-6)
    np.testing.assert_allclose(second.cov_coordinates[0], np.diag([4.0, 1.0, 9.0]), atol=1e-6)
    for strips, (x, y) in (((first, second), (1.0, 4.0)), ((second, first), (4.0, 1.0))):  # that of the first
        prior = find_shared(strips, NONE).prior_targets[:3, :3]
        np.testing.assert_allclose(np.linalg.inv(prior), np.diag([x, y, 9.0]), atol=1e-6)


def test_distortion_has_the_stated_variance_between_knots_too():
    sigma = 3e-7  # rad
    settings = replace(NONE, sigma_distortion_rad=sigma, distortion_length_px=2000.0)
    prepared = prepare_strip(strips_of(StripPlan(strips=1))[0], settings)
    knots = knots_touched(prepared.curve, prepared.place)
    group = group_strips([prepared], find_shared([prepared], settings), settings)[0]
    weights = group.parts[0].in_c[0, :, 0, : len(knots)] @ np.linalg.cholesky(correlation(knots))
    from_knots = np.sum(weights**2, axis=1)
    np.testing.assert_allclose(from_knots + group.missed[0], sigma**2, rtol=1e-9)
    # Linear interpolation over half a correlation length leaves up to an eighth of the variance.
    assert 0.05 * sigma**2 < group.missed.max() < 0.3 * sigma**2


def test_measurements_of_slanted_covariance_are_whitened_to_unit_variance():
    strip = strips_of(StripPlan(strips=1))[0]
    u = strip.ground.u_c
    x = np.cross(u, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    axes = np.stack([x, np.cross(u, x)], axis=2)  # (J, 3, 2)
    slanted = 1e-13 * np.array([[9.0, 5.0], [5.0, 4.0]])  # rad2: correlation 0.83
    ground = replace(strip.ground, cov_c=axes @ slanted @ np.swapaxes(axes, 1, 2))
    prepared = prepare_strip(replace(strip, ground=ground), NONE)
    at = linearise(group_strips([prepared], NOTHING, NONE)[0], BOLD, NONE)
    to_rows = at.whitener[0] @ tangent_axes(BOLD.apply(prepared.v_s))
    measured = to_rows @ ground.cov_c @ np.swapaxes(to_rows, 1, 2)
    np.testing.assert_allclose(measured, np.tile(np.eye(2), (len(u), 1, 1)), atol=1e-3)
    # 1e-3: the predicted directions, about which it is whitened, differ from the measured by the noise


def test_one_exposure_covers_half_a_second_to_either_side_of_it_wherever_it_is():
    for at in (-813.25, 0.0, 5211.9):
        t = at + np.array([-0.51, -0.49, 0.0, 0.49, 0.51])
        inside = _covered(np.array([at]), t)
        weights = _weights(np.array([at]), t, inside, "lagrange")
        assert inside.tolist() == [False, True, True, True, False]
        np.testing.assert_array_equal(weights, inside[:, None])
