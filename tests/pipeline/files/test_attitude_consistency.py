"""The usual mistakes of attitude files are recognised, and a sound attitude is left alone."""

import numpy as np
import pytest
import strips
from scipy.spatial.transform import Rotation

from boresight.pipeline.files.usual_mistakes import AttitudeFault, find_attitude_fault

T = np.arange(-0.9, 2.9, 0.1)
PATH = strips.orbit()
MOUNTINGS = Rotation.random(40, rng=np.random.default_rng(5))
NOISE = np.array([1.0, 1.0, 7.0]) * np.pi / 648_000.0  # rad, a real tracker's at 10 Hz


def attitudes(R_cs: Rotation, seed: int) -> Rotation:
    """Nadir pointing with a roll of 20 deg, and a tracker's noise."""
    rng = np.random.default_rng(seed)
    R_co = Rotation.from_euler("x", 20.0, degrees=True)
    return Rotation.from_rotvec(NOISE * rng.standard_normal((len(T), 3))) * R_cs.inv() * R_co * PATH.R_oi(T)


def scalar_first(R: Rotation) -> Rotation:
    return Rotation.from_quat(np.roll(R.as_quat(), 1, axis=1))


WRONG = {
    AttitudeFault.SCALAR_ORDER: lambda R: scalar_first(R.inv()).inv(),
    AttitudeFault.INVERTED: lambda R: R.inv(),
    AttitudeFault.EARTH_FIXED: lambda R: R * Rotation.from_matrix(strips.EARTH.matrices_ie(T)),
    AttitudeFault.ORBITAL: lambda R: R * PATH.R_oi(T).inv(),
}


@pytest.mark.parametrize("fault", WRONG)
def test_likely_cause_of_wrong_attitudes_is_named(fault: AttitudeFault) -> None:
    named = []
    for seed, R_cs in enumerate(MOUNTINGS):
        found = find_attitude_fault(T, WRONG[fault](attitudes(R_cs, seed)), R_cs, PATH)
        named.append(found.fault if found else None)
    assert named.count(fault) >= 0.95 * len(named), named
    assert not set(named) - {fault, None} or named.count(fault) == len(named) - 1


def test_sound_attitudes_are_left_alone() -> None:
    assert all(find_attitude_fault(T, attitudes(R, n), R, PATH) is None for n, R in enumerate(MOUNTINGS))


def test_manoeuvre_during_a_strip_is_no_fault() -> None:
    R_cs = MOUNTINGS[0]
    turn = Rotation.from_rotvec(np.outer(T, [0.0, 0.02, 0.0]))  # rad/s: 1.1 deg/s along the track
    R_si = R_cs.inv() * turn * PATH.R_oi(T)
    assert find_attitude_fault(T, R_si, R_cs, PATH) is None


def test_attitudes_of_nothing_known_are_refused_without_a_cause() -> None:
    R_cs = MOUNTINGS[1]
    away = R_cs.inv() * Rotation.from_euler("x", 170.0, degrees=True) * PATH.R_oi(T)
    found = find_attitude_fault(T, away, R_cs, PATH)
    assert found is not None and found.fault is AttitudeFault.UNRELATED
    assert "170.0 deg off nadir" in str(found)
