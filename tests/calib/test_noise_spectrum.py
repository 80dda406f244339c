"""Noise of heads from their record, and the alignment between heads, against the noise that was drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.calib.alignment import HeadTrack, align_heads, carried_to, common_instants
from boresight.calib.noise_spectrum import Signal, allan_deviation, difference_signal, fit_noise, pieces_of
from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.simulator.head_attitudes import correlated_noise

ARCSEC = np.pi / 648_000.0
STEP, ROWS = 0.1, 930  # the record of Sentinel-2A's trackers
T = STEP * np.arange(ROWS)
R_SH = Rotation.from_euler("xyz", [50.0, 20.0, -70.0], degrees=True)
WHITE = np.array([[0.6, 0.9, 6.0], [0.9, 0.7, 6.8]])
CORRELATED = np.array([[0.4, 0.7, 4.7], [0.7, 0.35, 4.9]])
TIME = np.array([[0.5, 0.8, 1.2], [1.2, 0.4, 0.9]])
NOISE = [
    AttitudeNoise(
        white_rad=w * ARCSEC, correlated_rad=a * ARCSEC, correlation_time_s=tau, constant_rad=np.zeros(3)
    )
    for w, a, tau in zip(WHITE, CORRELATED, TIME)
]


def errors(rng: np.random.Generator, head: int) -> np.ndarray:
    slow = correlated_noise(CORRELATED[head], TIME[head], ROWS, STEP, rng)
    return ARCSEC * (WHITE[head] * rng.standard_normal((ROWS, 3)) + slow)


def tracks(
    rng: np.random.Generator, late_s: float = 0.0, slew_rad_s2: float = 0.0
) -> tuple[HeadTrack, HeadTrack]:
    """Two heads on a satellite that follows its orbit, or slews about a lopsided axis."""

    def motion(t: np.ndarray) -> Rotation:
        angle = np.outer(0.5 * slew_rad_s2 * t**2, [0.6, -0.5, 0.62])
        return Rotation.from_rotvec(angle) * Rotation.from_rotvec(np.outer(t, [0.0, 1.1e-3, 0.0]))

    nominal = Rotation.from_rotvec(np.outer(T, [0.0, 1.1e-3, 0.0]))
    a = Rotation.from_rotvec(errors(rng, 0)) * motion(T)
    b = Rotation.from_rotvec(errors(rng, 1)) * R_SH.inv() * motion(T - late_s)
    return HeadTrack(name="A", t_s=T, R_hi=a, R_oi=nominal), HeadTrack(name="B", t_s=T, R_hi=b, R_oi=nominal)


def test_noise_of_two_heads_is_recovered_from_their_differences() -> None:
    found, sigma = [], []
    for seed in range(5):
        a, b = tracks(np.random.default_rng(seed))
        fit = fit_noise(difference_signal(a.R_hi, [(b.R_hi, R_SH)], pieces_of(T)), 26.0)
        found.append([[one.white_rad / ARCSEC, one.correlated_rad / ARCSEC] for one in fit.heads])
        sigma.append(fit.sigma_log[:, 2])
        assert fit.white_statistic > chi2(fit.white_dof).ppf(1 - 1e-9)  # white noise alone is refuted
    mean = np.exp(np.log(found).mean(axis=0))  # (head, white or correlated, axis)
    # About the lines of sight, where the noise is large, the errors of the fit are honest.
    truth = np.stack([WHITE, CORRELATED], axis=1)[:, :, 2]
    assert np.allclose(mean[:, :, 2], truth, rtol=0.1)
    deviation = (np.log(found)[:, :, :, 2] - np.log(truth)) / np.array(sigma)[:, :, :2]
    assert 0.5 < np.sqrt(np.mean(deviation**2)) < 1.5
    # Across it the two heads are separated by the assumption alone that they are alike: 30 %.
    assert np.allclose(mean[:, 0, :2], WHITE[:, :2], rtol=0.35)


def test_one_head_tells_its_noise_above_the_frequencies_of_the_motion() -> None:
    wave = np.outer(np.sin(2 * np.pi * T / 5.0), [12.0, -9.0, 7.0]) * ARCSEC
    values = errors(np.random.default_rng(4), 0) + wave
    signal = Signal(values=values, pieces=pieces_of(T)[1], step_s=STEP, enters=np.eye(3)[None], lowest_hz=0.5)
    (noise,) = fit_noise(signal, 26.0).heads
    assert np.allclose(noise.white_rad / ARCSEC, WHITE[0], rtol=0.25)
    assert np.allclose(noise.correlated_rad / ARCSEC, CORRELATED[0], rtol=0.5)


def test_two_values_have_no_allan_deviation_but_its_columns() -> None:
    times, deviation = allan_deviation(np.array([[1.0, 2.0, 4.0], [3.0, 5.0, 9.0]]), 0.1)
    assert times.shape == (0,) and deviation.shape == (0, 3)


def test_allan_deviation_of_white_noise_falls_with_the_root_of_time() -> None:
    values = np.random.default_rng(0).standard_normal((20_000, 1))
    times, deviation = allan_deviation(values, 0.1)
    few = times < 20.0
    assert np.allclose(deviation[few, 0] * np.sqrt(times[few] / 0.1), 1.0, rtol=0.1)


def test_record_without_a_long_piece_is_refused() -> None:
    signal = Signal(
        values=np.zeros((100, 3)), pieces=(slice(0, 50), slice(50, 100)), step_s=0.1, enters=np.eye(3)[None]
    )
    with pytest.raises(ValueError, match="50 rows, 64 are needed"):
        fit_noise(signal, 26.0)


def test_alignment_and_its_covariance_hold() -> None:
    nees, runs = 0.0, 60
    for seed in range(runs):
        found = align_heads(
            *tracks(np.random.default_rng(100 + seed)), (NOISE[0], NOISE[1]), {"hour": T / 3600}, 10.0
        )
        error = (found.R_sh * R_SH.inv()).as_rotvec()
        nees += error @ np.linalg.solve(found.covariance_s, error)
        assert abs(found.angle_rad - np.arccos(R_SH.apply([0, 0, 1])[2])) < 6.0 * found.sigma_angle_rad
        drift = found.terms[0]
        assert np.all(np.abs(drift.value) < 5.0 * drift.sigma)
    low, high = chi2(3 * runs).ppf([0.0005, 0.9995])
    assert low < nees < high


def test_time_offset_shows_when_the_satellite_slews() -> None:
    late = 0.012  # s
    noise = (NOISE[0], NOISE[1])
    slewing = align_heads(*tracks(np.random.default_rng(7), late, slew_rad_s2=1e-4), noise, {}, 10.0)
    assert abs(slewing.time_offset_s - late) < 4.0 * slewing.sigma_time_offset_s < 0.004
    steady = align_heads(*tracks(np.random.default_rng(7), late), noise, {}, 10.0)
    assert steady.sigma_time_offset_s > 0.05


def test_attitudes_between_instants_are_carried_by_the_smoothed_motion() -> None:
    a, b = tracks(np.random.default_rng(1), slew_rad_s2=1e-4)
    shifted = replace(b, t_s=T + 0.04)
    first, rows = common_instants(a, shifted)
    assert len(rows) == ROWS
    here = carried_to(
        a, first, shifted.t_s[rows], Rotation.from_rotvec(np.outer(shifted.t_s, [0.0, 1.1e-3, 0.0]))
    )
    true = Rotation.from_rotvec(np.outer(0.5e-4 * shifted.t_s**2, [0.6, -0.5, 0.62])) * Rotation.from_rotvec(
        np.outer(shifted.t_s, [0.0, 1.1e-3, 0.0])
    )
    rms = np.sqrt(np.mean((here * true.inv()).as_rotvec() ** 2, axis=0)) / ARCSEC
    assert np.all(rms < 1.15 * np.hypot(WHITE[0], CORRELATED[0]))  # little more than the row's own noise
