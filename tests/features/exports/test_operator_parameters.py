"""The operator's parameters: each form of the file takes lines of sight to the same places."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.features.exports.operator_parameters import fit_correction, operator_parameters
from boresight.geometry.epoch import Epoch

EPOCH = Epoch.from_utc("2020-08-16T12:02:20")
R_CS0 = Rotation.from_euler("YXZ", [0.3, -0.2, 0.5])
T0 = 12.625


@pytest.fixture(scope="module")
def correction():
    """A correction of known size, looks and instants, and where the corrected looks are."""
    rng = np.random.default_rng(9)
    n = 60
    u_c = np.column_stack([rng.uniform(-0.02, 0.02, n), rng.uniform(-0.18, 0.18, n), np.ones(n)])
    u_c /= np.linalg.norm(u_c, axis=1, keepdims=True)
    t = T0 + rng.uniform(-12.0, 12.0, n)
    turn = Rotation.from_rotvec(np.outer(1.0 + 0.02 * (t - T0), [3e-4, -2e-4, 5e-4]))
    v_s = turn.apply(R_CS0.inv().apply(u_c) * [1.0, 1.0, 1.0003])
    v_s /= np.linalg.norm(v_s, axis=1, keepdims=True)
    found = fit_correction(v_s, u_c, t, R_CS0, T0)
    assert np.abs(found.residuals_rad).max() < 1e-7  # rad: products of small angles are not linear in time
    return found, u_c, t, v_s - found.residuals_rad


def elementary(axis, angle):
    turned = np.zeros((len(angle), 3))
    turned[:, "xyz".index(axis)] = angle
    return Rotation.from_rotvec(turned)


def test_the_transforms_for_rugged_give_the_corrected_lines_of_sight(correction):
    found, u_c, t, expected = correction
    content = json.loads(operator_parameters(found, R_CS0, EPOCH, {"mission": "test"}))
    assert EPOCH.seconds_from_utc([content["t0_utc"]])[0] == T0
    v = R_CS0.inv().apply(u_c)
    scale, *rotations = content["rugged"]
    v = v * [1.0, 1.0, scale["factor"]]
    for one in rotations:
        angle = np.polynomial.polynomial.polyval(t - T0, one["coefficients"])
        v = elementary(one["axis"], angle).apply(v)
    assert np.abs(v / np.linalg.norm(v, axis=1, keepdims=True) - expected).max() < 1e-14


def test_the_angles_in_mrad_and_the_quaternion_are_the_matrix_at_t0(correction):
    found, *_ = correction
    content = json.loads(operator_parameters(found, R_CS0, EPOCH, {}))
    Q = found.rotations(np.array([T0]))[0]
    x, y, z = (1e-3 * content["piloting_to_instrument_mrad"][key] for key in ("R1_X", "R2_Y", "R3_Z"))
    P = elementary("y", [y]) * elementary("x", [x]) * elementary("z", [z])
    assert (P * (R_CS0 * Q).inv()).magnitude()[0] < 1e-14
    w, *vector = content["quaternion"]
    assert (Rotation.from_quat([*vector, w]) * Q.inv()).magnitude() < 1e-14
    # an attitude q from s to e: corrected looks R_es Q^-1 v, the product of q and the conjugate of Q
    R_es = Rotation.from_euler("xyz", [1.0, 0.4, -2.0])
    corrected = R_es * Rotation.from_quat([*vector, w]).inv()
    v = np.array([0.1, -0.2, 0.97])
    assert np.abs(corrected.apply(v) - R_es.apply(Q.inv().apply(v))).max() < 1e-15
    sigma = [content["angles"][axis]["sigma"][0] for axis in "xyz"]
    assert sigma == pytest.approx(found.sigma[:3].tolist())
    assert content["homothety_z"]["h"] == found.scale
    lengths = [float(np.linalg.norm(one)) for one in found.residuals_rad]
    assert content["residual_rms_rad"] == pytest.approx(np.sqrt(np.mean(np.square(lengths))), rel=1e-12)
