"""The deviation of the installation matrix against the paper's own matrix (28)."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from pytest import approx
from scipy.spatial.transform import Rotation

from boresight.geometry.installation import (
    deviation_from_theta,
    euler_zxy_from_theta,
    theta_between,
    theta_from_deviation,
)

PAPER_28 = np.array([[1.0, 0.001, -0.002], [-0.001, 1.0, 0.003], [0.002, -0.003, 1.0]])
angles = st.floats(-1.5, 1.5)


def test_paper_28_is_the_deviation_by_plus_3_2_1_milliradian():
    # The printed matrix is first order: second-order terms are up to 0.003**2 / 2 + 0.002**2 / 2 = 6.5e-6.
    M = deviation_from_theta(np.array([0.003, 0.002, 0.001])).as_matrix()
    assert approx(PAPER_28, abs=7e-6) == M


@given(st.tuples(angles, angles, angles))
def test_theta_and_deviation_are_inverse(theta):
    assert theta_from_deviation(deviation_from_theta(np.array(theta))) == approx(np.array(theta), abs=1e-12)


@given(st.tuples(angles, angles, angles))
def test_theta_between_takes_the_reference_to_the_matrix(theta):
    R_cs0 = Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True)
    R_cs = deviation_from_theta(np.array(theta)) * R_cs0
    assert theta_between(R_cs, R_cs0) == approx(np.array(theta), abs=1e-12)


def test_euler_angles_of_paper_28_are_its_three_deviations_to_second_order():
    # Products of two deviations reach 0.003 * 0.002 = 6e-6 rad.
    euler = euler_zxy_from_theta(np.array([0.003, 0.002, 0.001]))
    assert euler == approx([0.003, 0.002, 0.001], abs=6e-6)


def test_euler_angles_rebuild_the_deviation_as_turns_of_axes_about_z_then_x_then_y():
    theta = np.array([0.4, -0.7, 1.1])
    x, y, z = euler_zxy_from_theta(theta)

    def axes_turned(axis: str, angle: float) -> np.ndarray:
        return Rotation.from_euler(axis, angle).as_matrix().T

    M = axes_turned("y", y) @ axes_turned("x", x) @ axes_turned("z", z)
    assert approx(deviation_from_theta(theta).as_matrix(), abs=1e-12) == M
