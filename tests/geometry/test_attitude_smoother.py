"""The smoother against the same model with full matrices, the scatter of its errors, and what it costs."""

from dataclasses import replace
from time import process_time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.geometry.attitude import ConstantRate
from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.attitude_smoother import (
    HeadRows,
    SmoothedAttitude,
    most_likely_motion,
    smoothed_track,
)
from boresight.geometry.constants import ARCSEC
from boresight.records.record import Floats

MIDDLE = Rotation.from_euler("xyz", [30, -20, 60], degrees=True)
Q = np.array([1e-9, 1e-10, 3e-9])  # rad²/s³ about the axes of o
AXES = (Rotation.from_rotvec([0.3, 0.2, 0.1]), Rotation.from_rotvec([1.3, 0.2, 0.1]))
NOISES = tuple(
    AttitudeNoise(
        white_rad=np.array([1.0, 1.2, 8.0]) * ARCSEC,
        correlated_rad=np.array(correlated) * ARCSEC,
        correlation_time_s=np.array([0.7, 1.0, 2.0]),
        constant_rad=np.zeros(3),
        R_sn=axes,
    )
    for correlated, axes in zip(([0.5, 0.0, 4.0], [0.5, 1.0, 4.0]), AXES)
)
TIMES = (np.arange(7) * 0.2, np.arange(6) * 0.25 + 0.04)
WANTED = np.array([0.05, 0.06, 0.11, 0.5, 0.93, 1.2, -0.1])  # s, two of them between the same rows


def head_rows(t: Floats, R_so: Rotation, noise: AttitudeNoise) -> HeadRows:
    covariance_s = np.tile(noise.white_covariance_s, (len(t), 1, 1))
    return HeadRows(t_s=t, R_so=R_so, covariance_s=covariance_s, noise=noise)


def heads(turns: list[Floats]) -> list[HeadRows]:
    turned = [Rotation.from_rotvec(y) * MIDDLE for y in turns]
    return [head_rows(t, R_so, noise) for t, R_so, noise in zip(TIMES, turned, NOISES)]


def motion_covariance(t: Floats, u: Floats) -> Floats:
    """(J, 3, K, 3), axes of s: a free start and rate at -0.2 s, and the integral of a random walk."""
    R, a, b = MIDDLE.as_matrix(), t + 0.2, u + 0.2
    first, last = np.minimum.outer(a, b), np.maximum.outer(a, b)
    walk = first**2 * (3.0 * last - first) / 6.0
    free = (1e-2) ** 2 * (1.0 + np.multiply.outer(a, b))  # rad, rad/s: far more than the rows leave open
    return np.einsum("xa,akl,ya->kxly", R, Q[:, None, None] * walk + free, R)


def full_matrices(turns: list[Floats]) -> tuple[Floats, Floats]:
    """Mean (J, 3) and covariance (3 J, 3 J) of the rotation at the wanted instants."""
    t, n = np.concatenate(TIMES), len(TIMES[0])
    C = motion_covariance(t, t)
    for rows, noise in ((slice(0, n), NOISES[0]), (slice(n, None), NOISES[1])):
        C[rows, :, rows] += noise.coloured_covariance_s(t[rows])
        for k in np.arange(len(t))[rows]:
            C[k, :, k] += noise.white_covariance_s
    C, G = C.reshape(3 * len(t), -1), motion_covariance(WANTED, t).reshape(3 * len(WANTED), -1)
    gain = np.linalg.solve(C, G.T).T
    own = motion_covariance(WANTED, WANTED).reshape(3 * len(WANTED), -1)
    return (gain @ np.concatenate(turns).ravel()).reshape(-1, 3), own - gain @ G.T


def noise_of(rng: np.random.Generator, noise: AttitudeNoise, t: Floats) -> Floats:
    """Errors (K, 3) about the axes of s."""
    C = noise.coloured_covariance_s(t)
    C[np.arange(len(t)), :, np.arange(len(t)), :] += noise.white_covariance_s
    root = np.linalg.cholesky(C.reshape(3 * len(t), -1))
    return (root @ rng.standard_normal(3 * len(t))).reshape(-1, 3)


def test_smoothed_attitudes_are_those_of_the_full_matrices() -> None:
    rng = np.random.default_rng(1)
    turns = [noise_of(rng, noise, t) for noise, t in zip(NOISES, TIMES)]
    found, (mean, covariance) = SmoothedAttitude.of(heads(turns), Q), full_matrices(turns)
    sigma = np.sqrt(np.diag(covariance))
    off = (found.R_so(WANTED) * MIDDLE.inv()).as_rotvec() - mean
    # rows of two heads 0.01 and 0.04 s apart share a node, where a correlated error has 0.7 s or more
    np.testing.assert_allclose(off.ravel() / sigma, 0.0, atol=0.02)
    root = found.root_s(WANTED).reshape(len(sigma), -1)
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(root @ root.T / scale, covariance / scale, atol=0.02)
    own = np.einsum("jaja->ja", covariance.reshape(len(WANTED), 3, len(WANTED), 3))
    np.testing.assert_allclose(np.einsum("jaa->ja", found.covariance_s(WANTED)), own, rtol=0.02)


def test_a_constant_of_a_head_moves_the_attitude_and_is_told_by_the_other_head() -> None:
    rng = np.random.default_rng(2)
    turns = [noise_of(rng, noise, t) for noise, t in zip(NOISES, TIMES)]
    b = np.array([3.0, -2.0, 5.0]) * ARCSEC
    before, after = (SmoothedAttitude.of(heads([turns[0], turns[1] + by]), Q) for by in (0.0 * b, b))
    moved = (after.R_so(WANTED) * before.R_so(WANTED).inv()).as_rotvec()
    np.testing.assert_allclose(before.by_constants(WANTED)[:, :, 3:] @ b, -moved, atol=1e-3 * ARCSEC)
    told = before.constants[:, 1:]
    np.testing.assert_allclose(np.abs(told), np.abs(after.constants[:, 1:]), rtol=1e-3)
    solved = [np.linalg.solve(one.constants[:, 4:], one.constants[:, 0]) for one in (before, after)]
    np.testing.assert_allclose(solved[1] - solved[0], b, atol=1e-2 * ARCSEC)
    common = told[:, :3] + told[:, 3:]  # a rotation of all heads alike
    assert np.abs(common).max() < 1e-3 * np.abs(told).max()


def test_stated_covariance_holds_for_a_motion_whose_size_the_rows_show() -> None:
    rng, nees, runs = np.random.default_rng(3), 0.0, 12
    t, middle = np.arange(0.0, 6.0, 0.1), np.array([3.0])
    noise = replace(NOISES[0], R_sn=Rotation.identity(), correlated_rad=0.3 * NOISES[0].correlated_rad)
    for _ in range(runs):
        size, period, phase = rng.uniform(3.0, 12.0, 3), rng.uniform(3.0, 7.0, 3), rng.uniform(0.0, 6.3, 3)
        true, true_middle = (
            size * ARCSEC * np.sin(2.0 * np.pi * at[:, None] / period + phase) for at in (t, middle)
        )
        rows = head_rows(t, Rotation.from_rotvec(true + noise_of(rng, noise, t)), noise)
        found = SmoothedAttitude.of([rows], most_likely_motion([[rows]]))
        off = (found.R_so(middle) * Rotation.from_rotvec(true_middle).inv()).as_rotvec()[0]
        nees += off @ np.linalg.solve(found.covariance_s(middle)[0], off)
    low, high = chi2(df=3 * runs).ppf([0.0005, 0.9995])
    assert low < nees < high


def test_time_grows_no_faster_than_the_rows() -> None:
    def seconds(count: int) -> float:
        t = 0.1 * np.arange(count)
        y = 5.0 * ARCSEC * np.sin(t)[:, None] + np.random.default_rng(4).normal(0.0, ARCSEC, (count, 3))
        rows = head_rows(t, Rotation.from_rotvec(y), NOISES[0])
        before = process_time()
        SmoothedAttitude.of([rows], Q).root_s(np.linspace(10.0, 0.1 * count - 10.0, 20))
        return process_time() - before

    few, many = (min(seconds(count) for _ in range(2)) for count in (500, 4000))
    assert many < 16.0 * few  # 8 times the rows; full matrices would take 512 times as long


@pytest.mark.parametrize("wrong_arcmin", [0.0, 10.0])
def test_track_of_two_heads_does_not_follow_a_wrong_alignment(wrong_arcmin: float) -> None:
    rng = np.random.default_rng(5)
    turns = [noise_of(rng, noise, t) for noise, t in zip(NOISES, TIMES)]
    turns[1] = turns[1] + np.radians(wrong_arcmin / 60.0) * np.array([1.0, 0.0, 0.0])
    still = ConstantRate(0.0, Rotation.identity(), np.zeros(3))
    track = smoothed_track(heads(turns), still, sigma_alignment_rad=0.1)
    off = (track.R_si(TIMES[0]) * MIDDLE.inv()).as_rotvec()
    assert track.cov_s is not None
    sigma = np.sqrt(np.einsum("kaa->ka", track.cov_s))
    assert np.all(np.abs(off) < 4.0 * sigma) and sigma.max() < 10.0 * ARCSEC
