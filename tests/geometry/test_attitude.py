"""Attitude between star exposures: what the interpolation restores, and the error it states."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import AttitudeTrack, ConstantRate, EarthFixedAttitude, interpolation_weights
from boresight.geometry.constants import ARCSEC

MOUNTING = Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True)


class Nominal:
    """Orbital motion: one revolution in 95 minutes about an axis that is not one of the frames'."""

    def R_oi(self, t_s):
        axis = np.array([0.3, -0.8, 0.52])
        turn = np.outer(np.asarray(t_s), axis / np.linalg.norm(axis) * 2.0 * np.pi / 5700.0)
        return Rotation.from_rotvec(turn) * Rotation.from_euler("zyx", [1.0, 0.5, -2.0])


def wave(t_s, arcsec=12.0):
    t = np.asarray(t_s)
    period = np.array([3.1, 4.7, 6.3])
    return arcsec * ARCSEC * np.sin(2.0 * np.pi * t[:, None] / period + [0.1, 1.3, 2.9])


def true_attitude(t_s, arcsec=12.0):
    return MOUNTING * Rotation.from_rotvec(wave(t_s, arcsec)) * Nominal().R_oi(t_s)


def error_s(track, t_s, arcsec=12.0):
    return (track.R_si(t_s) * true_attitude(t_s, arcsec).inv()).as_rotvec()


def noisy_track(t_s, sigma_rad=2e-6):
    """Attitudes with errors of that size; equal errors at instants of the same tenth of a second."""
    draws = np.random.default_rng(5).normal(0.0, sigma_rad, (1000, 3))[np.round(10.0 * t_s).astype(int)]
    noise = Rotation.from_rotvec(draws)
    covariance = np.tile(sigma_rad**2 * np.eye(3), (len(t_s), 1, 1))
    return AttitudeTrack(t_s, noise * true_attitude(t_s), Nominal(), covariance)


EXPOSURES = 10.0 + 0.2 * np.arange(14)
INSIDE = np.random.default_rng(3).uniform(10.0, 12.6, 3000)


@settings(deadline=None)
@given(
    steps=st.lists(st.floats(0.1, 3.0), min_size=1, max_size=12),
    where=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=5),
    points=st.integers(2, 6),
)
def test_weights_sum_to_one_and_hold_a_line_and_a_cubic(steps, where, points):
    nodes = np.concatenate([[0.0], np.cumsum(steps)])
    t = np.array(where) * nodes[-1]
    weights = interpolation_weights(nodes, t, points=points)
    assert weights.shape == (len(t), len(nodes))
    assert np.abs(weights.sum(axis=1) - 1.0).max() < 1e-9
    assert (np.count_nonzero(weights, axis=1) <= points).all()
    if len(nodes) >= 2:
        assert np.abs(weights @ nodes - t).max() < 1e-7
    if points >= 4 and len(nodes) >= 4:
        scale = max(nodes[-1], 1.0)
        assert np.abs(weights @ (nodes / scale) ** 3 - (t / scale) ** 3).max() < 1e-7


def test_weights_pick_the_node_itself_and_the_nearest_four():
    weights = interpolation_weights(EXPOSURES, [10.6, 11.1], points=4)
    assert weights[0] == pytest.approx(np.eye(14)[3], abs=1e-12)
    assert np.flatnonzero(weights[1]).tolist() == [4, 5, 6, 7]
    assert weights[1][4:8] == pytest.approx([-1 / 16, 9 / 16, 9 / 16, -1 / 16], abs=1e-9)


@pytest.mark.parametrize("copies", [2, 3, 9])
def test_exposures_of_nearly_one_instant_are_one_node(copies):
    repeated = (EXPOSURES[:, None] + 1e-3 * np.arange(copies)).ravel()
    once, again = noisy_track(EXPOSURES), noisy_track(repeated)
    inside = INSIDE[INSIDE < EXPOSURES[-1]]
    # The mean of copies lies up to 4 ms later, in which the waves move by 0.1 arcsec.
    apart = (again.R_si(inside) * once.R_si(inside).inv()).magnitude()
    assert apart.max() < 0.1 * ARCSEC
    assert np.sqrt(np.mean(error_s(again, inside) ** 2)) < 2e-6  # rad, of one exposure
    stated = [track.covariance_s(inside).mean(axis=0) for track in (again, once)]
    # relative: nodes 4 ms later among steps of 200 ms change a weight by some 2 %
    np.testing.assert_allclose(*stated, rtol=0.02, atol=1e-20)


def test_exposures_a_quarter_of_a_step_apart_stay_nodes_of_their_own():
    uneven = np.sort(np.concatenate([EXPOSURES, EXPOSURES[:3] + 0.05]))
    assert len(noisy_track(uneven).t_s) == len(uneven)


def test_instants_are_taken_up_to_half_a_step_outside():
    assert np.isfinite(interpolation_weights(EXPOSURES, [9.91, 12.69])).all()
    for t in (9.89, 12.71, np.nan):
        with pytest.raises(ValueError, match="outside the exposures"):
            interpolation_weights(EXPOSURES, [11.0, t])


def test_orbital_motion_alone_is_restored_exactly():
    track = AttitudeTrack(EXPOSURES, true_attitude(EXPOSURES, 0.0), Nominal())
    assert np.abs(error_s(track, INSIDE, 0.0)).max() < 1e-14  # rad


def test_the_waves_of_figure_4_are_restored_to_milliarcseconds():
    # Cubic through steps of 0.2 s, 12" at 3.1 s: 12" (2 pi 0.2 / 3.1)^4 * 9/384 = 7.6 mas at worst inside.
    track = AttitudeTrack(EXPOSURES, true_attitude(EXPOSURES), Nominal())
    inner = INSIDE[(INSIDE > 10.2) & (INSIDE < 12.4)]
    assert np.abs(error_s(track, inner)).max() < 9e-3 * ARCSEC
    # against the attitude itself, interpolated without the nominal motion taken out first: far worse
    vectors = (track.R_si_nodes * track.R_si_nodes[7].inv()).as_rotvec()
    moved = Rotation.from_rotvec(interpolation_weights(EXPOSURES, inner, points=2) @ vectors)
    plain = moved * track.R_si_nodes[7]
    assert np.abs((plain * true_attitude(inner).inv()).as_rotvec()).max() > 0.1 * ARCSEC


def test_the_stated_interpolation_error_is_that_of_the_interpolation():
    track = AttitudeTrack(EXPOSURES, true_attitude(EXPOSURES), Nominal())
    stated = np.sqrt((track.interpolation_sigma_rad(INSIDE) ** 2).mean(axis=0))
    actual = np.sqrt((error_s(track, INSIDE) ** 2).mean(axis=0))
    # frame s against the waves' own axes: the mounting mixes them, both are compared in s
    assert np.all(stated < 2.0 * actual) and np.all(actual < 2.0 * stated)
    assert np.abs(track.interpolation_sigma_rad(EXPOSURES)).max() < 1e-12  # none at the exposures


def test_exposures_without_motion_are_not_said_to_move():
    # What the exposures' own noise puts into the differences is taken off: 0.5" of noise, no waves.
    rng = np.random.default_rng(4)
    sigma = 0.5 * ARCSEC
    noisy = Rotation.from_rotvec(rng.normal(0.0, sigma, (14, 3))) * true_attitude(EXPOSURES, 0.0)
    covariance = np.tile(sigma**2 * np.eye(3), (14, 1, 1))
    track = AttitudeTrack(EXPOSURES, noisy, Nominal(), covariance)
    blind = AttitudeTrack(EXPOSURES, noisy, Nominal())
    assert track.interpolation_sigma_rad(INSIDE).max() < blind.interpolation_sigma_rad(INSIDE).max()
    assert np.sqrt((track.interpolation_sigma_rad(INSIDE) ** 2).mean()) < 0.1 * ARCSEC


def test_the_stated_covariance_holds():
    # 400 draws of noise that differs from axis to axis; chi-squared of 3 x 400 within 4 sigma.
    rng = np.random.default_rng(6)
    L = np.array([[2.0, 0.0, 0.0], [0.7, 1.0, 0.0], [-0.4, 0.3, 5.0]]) * ARCSEC
    covariance = np.tile(L @ L.T, (14, 1, 1))
    t, total = np.array([11.13]), 0.0
    for _ in range(400):
        turn = rng.normal(size=(14, 3)) @ L.T
        track = AttitudeTrack(
            EXPOSURES, Rotation.from_rotvec(turn) * true_attitude(EXPOSURES), Nominal(), covariance
        )
        error = error_s(track, t)[0]
        total += error @ np.linalg.solve(track.covariance_s(t)[0], error)
    assert abs(total - 1200.0) < 4.0 * np.sqrt(2.0 * 1200.0) + 100.0  # the stated remainder adds up to 8 %


def test_three_exposures_are_interpolated_but_say_nothing_of_their_error():
    track = AttitudeTrack(EXPOSURES[:3], true_attitude(EXPOSURES[:3]), Nominal())
    assert np.abs(error_s(track, np.array([10.1, 10.3]))).max() < 0.2 * ARCSEC
    assert np.isnan(track.interpolation_sigma_rad(np.array([10.1]))).all()


def test_nonsense_is_refused():
    with pytest.raises(ValueError, match="increasing"):
        AttitudeTrack(EXPOSURES[::-1], true_attitude(EXPOSURES), Nominal())
    with pytest.raises(ValueError, match=r"R_si_nodes must have shape \(14,\), got \(5,\)"):
        AttitudeTrack(EXPOSURES, true_attitude(EXPOSURES[:5]), Nominal())
    with pytest.raises(ValueError, match="shape"):
        AttitudeTrack(EXPOSURES, true_attitude(EXPOSURES), Nominal(), np.zeros((3, 3)))
    with pytest.raises(ValueError, match="two points"):
        interpolation_weights(EXPOSURES, [11.0], points=1)


def test_polynomial_quaternions_are_normalised_and_referred_to_the_turning_earth():
    class Earth:
        def rotations_ie(self, t_s):
            return Rotation.from_rotvec(np.outer(t_s, [0.0, 0.0, 7.29e-5]))

    q0, q1 = MOUNTING.as_quat(), np.array([0.1, -0.2, 0.05, 0.02])
    attitude = EarthFixedAttitude(np.column_stack([2.0 * q0, 2.0 * q1]), 100.0, 4.0, Earth(), (90.0, 110.0))
    R_es = Rotation.from_quat(q0 + q1 * 0.5)  # t = 102 s, x = 0.5
    expected = (Rotation.from_rotvec([0.0, 0.0, 7.29e-5 * 102.0]) * R_es).inv()
    assert (attitude.R_si(np.array([102.0]))[0] * expected.inv()).magnitude() < 1e-14


def test_expansion_about_the_nearest_node_has_the_polynomials_derivatives():
    # From values of a polynomial of degree 7 comes its Taylor polynomial: numpy's derivatives.
    rng = np.random.default_rng(8)
    nodes = 5.0 + 0.1 * np.arange(20) + rng.uniform(-0.01, 0.01, 20)
    wave = np.polynomial.Polynomial(rng.normal(size=8), domain=[5.0, 7.0])
    t = np.array([4.98, 5.32, 5.449, 5.951, 6.2, 6.93])
    near = nodes[np.abs(t[:, None] - nodes).argmin(axis=1)]
    expected = wave(near) + wave.deriv()(near) * (t - near) + 0.5 * wave.deriv(2)(near) * (t - near) ** 2
    weights = interpolation_weights(nodes, t, "taylor")
    assert np.abs(weights @ wave(nodes) - expected).max() < 1e-9
    assert np.abs(weights.sum(axis=1) - 1.0).max() < 1e-10
    inner = interpolation_weights(nodes, nodes[8:9] + 0.01, "taylor")
    assert np.flatnonzero(inner[0]).tolist() == [*range(4, 12)]  # k - 4 ... k + 3


def test_expansion_follows_the_attitude_and_needs_eight_exposures():
    track = AttitudeTrack(EXPOSURES, true_attitude(EXPOSURES), Nominal(), interpolation="taylor")
    # 12" waves with periods of 3 s and more: the third-order term over 0.1 s is 0.018", of degree 7 less
    assert np.abs(error_s(track, INSIDE)).max() < 0.03 * ARCSEC
    assert track.breaks_s == pytest.approx(EXPOSURES[:-1] + 0.1)
    few = interpolation_weights(EXPOSURES[:7], [10.5], "taylor")
    assert np.array_equal(few, interpolation_weights(EXPOSURES[:7], [10.5]))


def test_constant_rate_is_recovered_from_attitudes_and_rotates_the_frame_the_right_way() -> None:
    omega_o, t = np.array([2e-3, 14e-3, -1e-3]), np.linspace(4.0, 6.2, 12)
    motion = ConstantRate(5.0, Rotation.from_euler("xyz", [40, -65, 110], degrees=True), omega_o)
    found = ConstantRate.fitted(t, motion.R_oi(t))
    assert np.abs(found.omega_o - omega_o).max() < 1e-12  # rad/s
    assert (found.R_oi(t) * motion.R_oi(t).inv()).magnitude().max() < 1e-12  # rad
    u_i = motion.R_oi([5.0]).inv().apply([[0.0, 0.0, 1.0]])
    later_o = motion.R_oi([5.0 + 1e-4]).apply(u_i)[0]
    # d u_o / dt = -omega x u_o: rotated about +y, a camera sees the stars of its axis move towards -x
    expected = np.array([0.0, 0.0, 1.0]) - 1e-4 * np.cross(omega_o, [0.0, 0.0, 1.0])
    assert np.abs(later_o - expected).max() < 2e-12  # second order: (omega t)^2 / 2 = 1e-12


def test_attitudes_relative_to_a_constant_rate_are_interpolated_as_those_relative_to_the_orbit() -> None:
    motion = ConstantRate(0.0, Rotation.identity(), np.array([0.0, 14.4e-3, 0.0]))
    t, at = np.arange(-0.2, 2.2, 0.2), np.linspace(0.0, 1.8, 50)

    def moving(s):
        return Rotation.from_rotvec(wave(s)) * motion.R_oi(s)

    track = AttitudeTrack(t, moving(t), motion)
    miss = (track.R_si(at) * moving(at).inv()).magnitude()
    assert miss.max() < 16e-3 * ARCSEC  # three axes of 7.6 mas at worst, see above
