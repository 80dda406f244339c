"""Attitudes with a gyro between them against full matrices of the same model; its path against the truth."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude_noise import NO_NOISE
from boresight.geometry.attitude_smoother import HeadRows, SmoothedAttitude
from boresight.geometry.constants import ARCSEC
from boresight.geometry.gyro import GyroNoise, GyroRows, longest_without_gap, summed_up, without_gap

NOISE = GyroNoise(
    random_walk_rad=0.2 * ARCSEC,
    bias_walk_rad_s=0.1 * ARCSEC,
    bias_rad_s=2.0 * ARCSEC,
    white_rad=0.05 * ARCSEC,
)
Q = 1e-9  # rad²/s³
ROWS, STEPS = np.array([0.0, 1.5, 3.0]), np.arange(-0.25, 3.3, 0.5)  # instants of the head and of the gyro
WANTED = np.array([0.1, 0.8, 1.0, 2.3])
SIGMA = 3.0 * ARCSEC


def walk(t, u):
    """Covariance of the integral of a random walk that begins at the first node."""
    a, b = t - STEPS[0] + 2.0, u - STEPS[0] + 2.0
    first, last = np.minimum.outer(a, b), np.maximum.outer(a, b)
    return first**2 * (3.0 * last - first) / 6.0, first, np.outer(a, b)


def test_a_gyro_between_attitudes_is_as_in_full_matrices() -> None:
    rng = np.random.default_rng(57)
    y, summed = rng.normal(0.0, SIGMA, (3, 3)), rng.normal(0.0, ARCSEC, (len(STEPS), 3))
    head = HeadRows(
        t_s=ROWS,
        R_so=Rotation.from_rotvec(y),
        covariance_s=np.tile(SIGMA**2 * np.eye(3), (3, 1, 1)),
        noise=NO_NOISE,
    )
    turned = Rotation.from_rotvec(summed)
    gyro = GyroRows(t_s=STEPS, R_sz=turned, R_oi=Rotation.identity(len(STEPS)), noise=NOISE)
    found = SmoothedAttitude.of([head], np.full(3, Q), gyro)
    free = (1e3 * SIGMA) ** 2

    def of_motion(t, u):
        twice, _, product = walk(t, u)
        return Q * twice + free * (1.0 + product)

    twice, first, product = walk(STEPS, STEPS)
    of_gyro = NOISE.random_walk_rad**2 * first + NOISE.bias_walk_rad_s**2 * twice + free
    of_gyro += NOISE.bias_rad_s**2 * product + NOISE.white_rad**2 * np.eye(len(STEPS))
    every = np.concatenate([ROWS, STEPS])
    C = of_motion(every, every)
    C[:3, :3] += SIGMA**2 * np.eye(3)
    C[3:, 3:] += of_gyro
    G = of_motion(WANTED, every)
    gain = np.linalg.solve(C, G.T).T
    mean, covariance = gain @ np.concatenate([y, summed]), of_motion(WANTED, WANTED) - gain @ G.T
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.R_so(WANTED).as_rotvec(), mean, atol=0.01 * sigma.min())
    np.testing.assert_allclose(
        np.sqrt(np.einsum("jaa->ja", found.covariance_s(WANTED))), np.tile(sigma[:, None], 3), rtol=0.01
    )
    root = found.root_s(WANTED)
    np.testing.assert_allclose(
        np.einsum("jp,kp->jk", root[:, 0], root[:, 0]) / np.outer(sigma, sigma),
        covariance / np.outer(sigma, sigma),
        atol=0.01,
    )
    alone = SmoothedAttitude.of([head], np.full(3, Q))
    assert np.all(np.trace(alone.covariance_s(WANTED), axis1=1, axis2=2) > 3.0 * sigma**2)


def test_the_path_is_that_of_the_attitude_while_the_nominal_frame_turns() -> None:
    t = np.linspace(0.0, 40.0, 201)
    start = Rotation.random(rng=np.random.default_rng(1))
    R_oi = Rotation.from_rotvec(np.outer(t, [2e-4, -1.1e-3, 3e-4])) * start
    middle = Rotation.from_euler("xyz", [30, -20, 60], degrees=True)
    turns = np.stack([1e-3 * np.sin(t / 7.0), 5e-4 * np.cos(t / 3.0), 1e-5 * t], axis=1)
    R_si = Rotation.from_rotvec(turns) * middle * R_oi
    own = np.zeros((len(t), 3))
    own[1:] = -(R_si[1:] * R_si[:-1].inv()).as_rotvec()  # right-handed, as a gyro gives it
    gyro = GyroRows(t_s=t, R_sz=summed_up(own), R_oi=R_oi, noise=NOISE)
    np.testing.assert_allclose(gyro.path(t, turns, middle), turns, atol=1e-10)


def test_a_gap_ends_a_stretch() -> None:
    t = np.concatenate([np.arange(0.0, 1.0, 0.1), np.arange(5.0, 7.0, 0.1)])
    assert longest_without_gap(t).tolist() == list(range(10, 30))
    assert longest_without_gap(t[:1]).tolist() == [0]
    assert np.concatenate(without_gap(t)).tolist() == list(range(len(t)))
    assert [len(part) for part in without_gap(t[:0])] == [0]


def test_a_noise_that_is_not_positive_is_refused() -> None:
    with pytest.raises(ValueError, match="white_rad must be positive"):
        GyroNoise(random_walk_rad=1e-7, bias_walk_rad_s=1e-9, bias_rad_s=1e-6, white_rad=0.0)
