"""An ephemeris against itself: frequent mistakes are found and named, consistent files are not refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import EARTH_ROTATION_RATE, GM_EARTH
from boresight.pipeline.files.usual_mistakes import OrbitFault, find_orbit_fault

OMEGA = np.array([0.0, 0.0, EARTH_ROTATION_RATE])


def ephemeris(frame="ITRF", step_s=1.0, n=70, eccentricity=0.02, inclination_deg=97.5):
    """Kepler's ellipse by Newton's method; in ITRF the axes rotate about z."""
    a, t = 6.95e6, step_s * np.arange(n)
    mean = 1.0 + np.sqrt(GM_EARTH / a**3) * t
    E = mean.copy()
    for _ in range(20):
        E -= (E - eccentricity * np.sin(E) - mean) / (1.0 - eccentricity * np.cos(E))
    b = np.sqrt(1.0 - eccentricity**2)
    rate = np.sqrt(GM_EARTH / a**3) / (1.0 - eccentricity * np.cos(E))
    zero = 0.0 * t
    p = a * np.stack([np.cos(E) - eccentricity, b * np.sin(E), zero], axis=1)
    v = a * rate[:, None] * np.stack([-np.sin(E), b * np.cos(E), zero], axis=1)
    s, c = np.sin(np.radians(inclination_deg)), np.cos(np.radians(inclination_deg))
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    p, v = p @ tilt.T, v @ tilt.T
    if frame == "GCRF":
        return t, p, v
    angle = EARTH_ROTATION_RATE * t
    R_ei = Rotation.from_euler("z", -angle[:, None]).as_matrix()
    p, v = (np.einsum("nij,nj->ni", R_ei, x) for x in (p, v - np.cross(OMEGA, p)))
    return t, p, v


@pytest.mark.parametrize("frame", ["GCRF", "ITRF"])
@pytest.mark.parametrize(("step_s", "n"), [(0.1, 300), (1.0, 8), (1.0, 70), (60.0, 200), (180.0, 480)])
@pytest.mark.parametrize("inclination_deg", [0.0, 51.6, 97.5])
def test_consistent_ephemeris_has_no_fault(frame, step_s, n, inclination_deg):
    t, p, v = ephemeris(frame, step_s, n, inclination_deg=inclination_deg)
    assert find_orbit_fault(t, p, v, frame) is None


@pytest.mark.parametrize("seed", range(20))
def test_noise_of_a_receiver_is_no_fault(seed):
    rng = np.random.default_rng(seed)
    t, p, v = ephemeris()
    noisy = p + rng.normal(0.0, 10.0, p.shape), v + rng.normal(0.0, 0.1, v.shape)  # m, m/s
    assert find_orbit_fault(t, *noisy, "ITRF") is None


@pytest.mark.parametrize("step_s", [1.0, 60.0])
@pytest.mark.parametrize(
    ("fault", "frame", "wrong"),
    [
        (OrbitFault.ZERO, "ITRF", lambda p, v: 0.0 * v),
        (OrbitFault.REVERSED, "ITRF", lambda p, v: -v),
        (OrbitFault.SCALED, "ITRF", lambda p, v: 5.0 * v),
        (OrbitFault.SCALED, "GCRF", lambda p, v: 1e-3 * v),
        (OrbitFault.SCALED, "ITRF", lambda p, v: 1.002 * v),
        (OrbitFault.INERTIAL_IN_ROTATING_FRAME, "ITRF", lambda p, v: v + np.cross(OMEGA, p)),
        (OrbitFault.ROTATING_IN_INERTIAL_FRAME, "GCRF", lambda p, v: v - np.cross(OMEGA, p)),
        (OrbitFault.UNRELATED, "ITRF", lambda p, v: v[:, [1, 0, 2]]),
    ],
)
def test_wrong_velocities_are_found_and_the_cause_is_named(fault, frame, wrong, step_s):
    t, p, v = ephemeris(frame, step_s, 120)
    noisy = p + np.random.default_rng(1).normal(0.0, 2.0, p.shape)
    found = find_orbit_fault(t, noisy, wrong(p, v), frame)
    assert found is not None and found.fault is fault, found
    if fault is OrbitFault.SCALED:  # noise of the positions: 1e-5
        assert found.factor == pytest.approx(np.median(wrong(p, v) / v), rel=1e-3)


def test_a_factor_of_the_velocities_is_found_below_the_noise_of_each_since_many_tell_it():
    t, p, v = ephemeris("ITRF", 60.0, 800)
    noisy = 1.004 * v + np.random.default_rng(2).normal(0.0, 12.0, v.shape)  # m/s, where 30 are wrong
    found = find_orbit_fault(t, p, noisy, "ITRF")
    assert found is not None and found.fault is OrbitFault.SCALED, found
    assert found.factor == pytest.approx(1.004, abs=2e-4)  # 12 m/s by the root of 800 velocities: 3.5 sigma


@pytest.mark.parametrize("every", [(0.5, 60), (1.0, 70), (30.0, 200)], ids="{0[0]} s".format)
@pytest.mark.parametrize("tilt_deg", [28.5, 97.5])
@pytest.mark.parametrize(
    ("fault", "true", "stated", "axes"),
    [
        (OrbitFault.FRAME, "ITRF", "GCRF", [1.0, 1.0, 1.0]),
        (OrbitFault.INERTIAL, "GCRF", "ITRF", [1.0, 1.0, 1.0]),
        (OrbitFault.MIRRORED, "ITRF", "ITRF", [-1.0, 1.0, 1.0]),
        (OrbitFault.MIRRORED, "ITRF", "ITRF", [1.0, -1.0, 1.0]),
    ],
)
def test_states_of_other_axes_are_told_by_their_acceleration(fault, true, stated, axes, tilt_deg, every):
    t, p, v = ephemeris(true, *every, inclination_deg=tilt_deg)
    noise = np.random.default_rng(2).normal(0.0, 0.05, v.shape)  # m/s, of a receiver
    found = find_orbit_fault(t, p * axes, v * axes + noise, stated)
    assert found is not None and found.fault is fault, found
    # m/s²: twice the Earth's rate times the velocity, 1.1, seen twice if mirrored
    assert 0.3 < found.size < 3.0


@pytest.mark.parametrize(("jump_m", "found"), [(5.0, False), (10.0, True), (100.0, True), (3e5, True)])
@pytest.mark.parametrize("last", [31, 120])
def test_jump_of_the_positions_is_found_at_its_state(jump_m, found, last):
    t, p, v = ephemeris(n=120)
    p[30:last] += [0.0, jump_m, 0.0]
    fault = find_orbit_fault(t, p, v, "ITRF")
    assert (fault is not None) == found
    if jump_m == 100.0:
        assert fault.fault is OrbitFault.JUMP and fault.state == 30
        assert fault.size == pytest.approx(jump_m, rel=1e-3)  # quadrature over 1 s: 1e-5 m
        assert "jump at state 31" in str(fault)


def test_order_of_time_and_gaps():
    t, p, v = ephemeris()
    fault = find_orbit_fault(t[::-1], p[::-1], v[::-1], "ITRF")
    assert fault is not None and fault.fault is OrbitFault.NOT_ORDERED and fault.state == 1
    fault = find_orbit_fault(np.where(np.arange(70) == 30, t - 2.5, t), p, v, "ITRF")
    assert str(fault).endswith(f"at state 31: {2.5 - (t[1] - t[0]):g} s back")
    keep = np.r_[0:20, 45:70]
    assert find_orbit_fault(t[keep], p[keep], v[keep], "ITRF") is None


@pytest.mark.parametrize("step_s", [1.0, 10.0])
@pytest.mark.parametrize("late_s", [1.0, 0.002])
def test_times_that_jump_from_a_state_on_are_a_jump_of_the_positions(step_s, late_s):
    """By a step, too, which looks like a state that is missing."""
    t, p, v = ephemeris(step_s=step_s)
    fault = find_orbit_fault(t + late_s * step_s * (np.arange(70) >= 30), p, v, "ITRF")
    assert fault is not None and (fault.fault, fault.state) == (OrbitFault.JUMP, 30)
    speed_m_s = np.linalg.norm(v[30])
    assert fault.size == pytest.approx(late_s * step_s * speed_m_s, rel=0.02)  # it bends over 20 s


FACTORS = ("1.0004", "0.94", "1.07", "0.001 (units?)", "0.83 (units?)", "1.83 (units?)")


@pytest.mark.parametrize("factor", FACTORS)
def test_factor_of_the_velocities_is_told_with_the_digits_that_matter(factor):
    t, p, v = ephemeris(n=300)
    told = str(find_orbit_fault(t, p, float(factor.split()[0]) * v, "ITRF"))
    assert told.endswith(f"a factor: {factor}")
