"""Orbits between their nodes, against a two-body orbit known in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import EARTH_ROTATION_RATE, GM_EARTH
from boresight.geometry.epoch import Epoch
from boresight.geometry.orbit import Orbit, OrbitGapError, argument_of_latitude, orbital_frame

EPOCH = Epoch.from_utc("2024-03-05T10:20:30Z")
RADIUS = 6_908e3  # m
RATE = np.sqrt(GM_EARTH / RADIUS**3)  # rad/s
TILT = Rotation.from_euler("xz", [1.7, 0.4])


class TurningEarth:
    """An Earth that only rotates, about z: the frames differ, in closed form."""

    omega_e = np.array([0.0, 0.0, EARTH_ROTATION_RATE])

    def matrices_ie(self, t_s):
        return Rotation.from_rotvec(np.outer(t_s, self.omega_e)).as_matrix()


def state(t_s):
    angle = RATE * np.asarray(t_s)
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    p = TILT.apply(RADIUS * np.stack([c, s, zero], axis=-1))
    return p, TILT.apply(RADIUS * RATE * np.stack([-s, c, zero], axis=-1))


def in_axes_e(t_s):
    p, v = state(t_s)
    R_ei = np.swapaxes(TurningEarth().matrices_ie(t_s), 1, 2)
    p_e = np.einsum("nij,nj->ni", R_ei, p)
    return p_e, np.einsum("nij,nj->ni", R_ei, v) - np.cross(TurningEarth.omega_e, p_e)


def orbit(t_s, degree=7, frame="GCRF", method="lagrange", states=None, **more):
    p, v = states or (state(t_s) if frame == "GCRF" else in_axes_e(t_s))
    given = {"t_s": t_s, "positions_m": p, "velocities_m_s": v, "frame": frame, "degree": degree}
    return Orbit(epoch=EPOCH, earth=TurningEarth(), method=method, **given | more)


SECONDS = np.arange(0.0, 61.0)
BETWEEN = np.random.default_rng(5).uniform(0.0, 60.0, 2000)


@pytest.mark.parametrize("frame", ["GCRF", "ITRF"])
@pytest.mark.parametrize("method, degree", [("lagrange", 7), ("lagrange", 8), ("hermite", 7), ("hermite", 3)])
def test_states_at_1_hz_are_those_of_the_true_orbit(frame, method, degree):
    # 1e-7 m: rounding is 1e-9 m a term; Hermite of degree 3 misses r n^4 / 384 = 3e-8 m. Velocity: 8 r n^5 /
    # ...
    ephemeris = orbit(SECONDS, degree, frame, method)
    p, v = state(BETWEEN)
    p_e, v_e = in_axes_e(BETWEEN)
    assert np.abs(ephemeris.positions_i(BETWEEN) - p).max() < 1e-7  # m
    assert np.abs(ephemeris.states_i(BETWEEN)[1] - v).max() < 2e-7  # m/s
    assert np.abs(ephemeris.positions_e(BETWEEN) - p_e).max() < 1e-7
    assert np.abs(ephemeris.velocities_e(BETWEEN) - v_e).max() < 2e-7


def test_velocity_without_velocities_is_the_slope_of_the_positions():
    ephemeris = orbit(SECONDS, velocities_m_s=None)
    assert np.abs(ephemeris.states_i(BETWEEN)[1] - state(BETWEEN)[1]).max() < 1e-6  # m/s


@pytest.mark.parametrize(("method", "step_s", "degree"), [("lagrange", 60.0, 5), ("hermite", 120.0, 5)])
def test_the_degree_asked_for_is_the_degree_used(method, step_s, degree):
    # A polynomial of that degree is met exactly, one of the next degree is not.
    t = np.arange(12) * step_s
    x = lambda t: (t - 300.0) / 300.0  # noqa: E731
    at = np.linspace(200.0, 600.0, 50)
    for power, exact in ((degree, True), (degree + 1, False)):
        p = np.outer(1e6 * x(t) ** power, [1.0, -2.0, 0.5])
        v = np.outer(1e6 * power * x(t) ** (power - 1) / 300.0, [1.0, -2.0, 0.5])
        ephemeris = orbit(t, degree, method=method, states=(p, v))
        error = np.abs(ephemeris.positions_i(at) - np.outer(1e6 * x(at) ** power, [1.0, -2.0, 0.5])).max()
        assert (error < 1e-6) == exact


def test_instants_outside_the_nodes_are_refused():
    ephemeris = orbit(SECONDS)
    assert np.isfinite(
        ephemeris.positions_i(np.array([0.0, 60.0, 60.0 + 1e-7]))
    ).all()  # rounding is forgiven
    for t in (-0.01, 60.01, np.nan):
        with pytest.raises(OrbitGapError, match="outside the ephemeris"):
            ephemeris.positions_i(np.array([30.0, t]))


@pytest.mark.parametrize("method", ["lagrange", "hermite"])
def test_a_gap_is_refused_and_never_reached_across(method):
    kept = SECONDS[(SECONDS <= 25.0) | (SECONDS >= 29.0)]
    ephemeris = orbit(kept, method=method)
    for t in (25.5, 27.0, 28.99):
        with pytest.raises(OrbitGapError, match="gap"):
            ephemeris.positions_i(np.array([10.0, t]))
    at = np.array([24.9, 25.0, 29.0, 29.1])  # beside the gap the stencil keeps to its side
    assert np.abs(ephemeris.positions_i(at) - state(at)[0]).max() < 1e-6
    poisoned = state(kept)[0]
    poisoned[kept > 26.0] += 1e6  # what stands beyond the gap must not matter here
    beyond = orbit(kept, method=method, states=(poisoned, state(kept)[1]))
    assert np.abs(beyond.positions_i(at[:2]) - state(at[:2])[0]).max() < 1e-6


def test_too_few_nodes_between_gaps_are_refused():
    kept = SECONDS[(SECONDS <= 20.0) | ((SECONDS >= 30.0) & (SECONDS <= 33.0)) | (SECONDS >= 40.0)]
    with pytest.raises(OrbitGapError, match="needs 8 nodes"):
        orbit(kept).positions_i(np.array([31.5]))
    with pytest.raises(ValueError, match="8 nodes needed"):
        orbit(SECONDS[:5])


def test_uneven_nodes_are_served_when_the_longest_step_is_stated():
    uneven = np.cumsum(np.tile([1.0, 2.0, 1.5], 10))
    at = np.linspace(5.0, 40.0, 200)
    ephemeris = orbit(uneven, max_step_s=2.5)
    assert np.abs(ephemeris.positions_i(at) - state(at)[0]).max() < 1e-6


def test_nonsense_is_refused():
    with pytest.raises(ValueError, match="increase"):
        orbit(SECONDS[::-1])
    with pytest.raises(ValueError, match="frame"):
        replace(orbit(SECONDS), frame="TEME")
    with pytest.raises(ValueError, match="velocities"):
        orbit(SECONDS, method="hermite", velocities_m_s=None)
    with pytest.raises(ValueError, match="shape"):
        orbit(SECONDS, positions_m=state(SECONDS)[0][:5])


def test_the_orbital_frame_has_z_down_y_against_the_normal_and_x_along():
    p, v = state(BETWEEN)
    R_oi = orbital_frame(p, v)
    assert R_oi.apply(-p / RADIUS) == pytest.approx(np.tile([0.0, 0.0, 1.0], (len(p), 1)), abs=1e-12)
    assert R_oi.apply(v / (RADIUS * RATE)) == pytest.approx(np.tile([1.0, 0.0, 0.0], (len(p), 1)), abs=1e-12)
    normal = np.cross(p, v)
    assert np.all(R_oi.apply(normal)[:, 1] < 0.0)


def test_the_argument_of_latitude_counts_from_the_ascending_node():
    # The two-body orbit crosses the equator northwards at angle 0.
    angle = np.array([0.0, 0.5, 2.0, 4.0, 6.2])
    found = argument_of_latitude(*state(angle / RATE))
    away = (found - angle + np.pi) % (2 * np.pi) - np.pi  # a rounding below 0 is one below 2 pi
    np.testing.assert_allclose(away, 0.0, atol=1e-9)


def test_an_orbit_in_the_equator_counts_from_the_x_axis():
    p, v = np.array([[0.0, 7e6, 0.0]]), np.array([[-7.5e3, 0.0, 0.0]])
    np.testing.assert_allclose(argument_of_latitude(p, v), [np.pi / 2], atol=1e-12)
