"""Noise of heads from their record against the noise that was drawn."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
from drawn_heads import correlated_noise
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from two_trackers import ARCSEC, CORRELATED, R_SH, ROWS, STEP, WHITE, T, errors, tracks

from boresight.pipeline.head_noise import spectrum
from boresight.pipeline.head_noise.of_dump import _single
from boresight.pipeline.head_noise.spectrum import (
    Signal,
    allan_deviation,
    difference_signal,
    fit_noise,
    pieces_of,
)
from boresight.pipeline.head_noise.tracks import SMOOTHING_S, HeadTrack, carried_to, common_instants


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
    assert np.all(fit.told_apart[:, 2] > 0.9)  # each line of sight is across that of the other head
    # Across it the two heads are separated by the assumption alone that they are alike: 30 %.
    assert np.allclose(mean[:, 0, :2], WHITE[:, :2], rtol=0.35)
    assert np.all(fit.told_apart[:, :2] < 0.6)


def test_what_lasts_longer_than_a_strip_makes_means_of_every_axis_uncertain() -> None:
    """Three means, as of 97 s in pieces of 26 s, leave many splits between six axes: none may be trusted."""
    variance = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        pair, total = tracks(rng), np.sqrt(WHITE**2 + CORRELATED**2) * ARCSEC
        piece = (np.arange(ROWS) * STEP // 26.0).astype(int)
        slow = 0.4 * total[:, None] * rng.standard_normal((2, piece[-1] + 1, 3))
        a, b = (Rotation.from_rotvec(c[piece]) * one.R_hi for one, c in zip(pair, slow))
        fit = fit_noise(difference_signal(a, [(b, R_SH)], pieces_of(T)), 26.0)
        log = [[n.white_rad, n.correlated_rad, n.correlation_time_s] for n in fit.heads]
        of_means = spectrum._variance_of_means(np.log(np.swapaxes(log, 1, 2)), 260, STEP)
        constant = np.array([n.constant_rad for n in fit.heads])
        variance.append((of_means + constant**2) / (0.4 * total) ** 2)
    assert np.all(np.abs(np.log(np.mean(variance, axis=0))) < np.log(2.0))


@pytest.mark.parametrize("time_s", [0.0, 60.0, 300.0])
def test_how_long_a_constant_lasts_is_told_by_neighbouring_means(time_s: float) -> None:
    # An hour and a half of means over 10 s, of white noise and what lasts.
    t, rows = 10.0 * np.arange(600), 25
    rng = np.random.default_rng(3)
    white = 0.5 * ARCSEC * rng.standard_normal((len(t) * rows, 3))
    lasting = correlated_noise(np.full(3, 0.5 * ARCSEC), np.full(3, max(time_s, 1e-3)), t, rng)
    values = white + np.repeat(lasting, rows, axis=0)
    pieces = (slice(0, len(values)),)
    signal = Signal(values=values, pieces=pieces, step_s=10.0 / rows, enters=np.eye(3)[None])
    (noise,) = fit_noise(signal, 10.0).heads
    total = np.sqrt(noise.constant_rad**2 + noise.correlated_rad**2 * (noise.correlation_time_s > 10.0))
    if time_s:
        assert np.allclose(total, 0.5 * ARCSEC, rtol=0.4)  # 10 to 50 independent errors
        lasts_s = np.where(noise.correlation_time_s > 10.0, noise.correlation_time_s, noise.constant_time_s)
        assert np.all(lasts_s > 0.5 * time_s) and np.all(lasts_s < 4.0 * time_s)
    else:
        assert np.all(noise.constant_time_s < 15.0)


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
    pieces = (slice(0, 25), slice(25, 50))
    signal = Signal(values=np.zeros((50, 3)), pieces=pieces, step_s=0.1, enters=np.eye(3)[None])
    with pytest.raises(ValueError, match="25 rows, 32 are needed"):
        fit_noise(signal, 26.0)


def test_a_short_record_of_two_heads_is_served_with_errors_that_hold() -> None:
    """35 rows, 30 records: the rms of 60 normal deviates is 0.77 to 1.25 in 99 of 100."""
    deviations = []
    for seed in range(30):
        a, b = tracks(np.random.default_rng(seed))
        fit = fit_noise(difference_signal(a.R_hi[:35], [(b.R_hi[:35], R_SH)], pieces_of(T[:35])), 2.0)
        white = np.array([noise.white_rad[2] for noise in fit.heads]) / ARCSEC
        deviations.append(np.log(white / WHITE[:, 2]) / fit.sigma_log[:, 2, 0])
    assert 0.6 < np.sqrt(np.mean(np.square(deviations))) < 1.4
    of_three = difference_signal(a.R_hi, [(b.R_hi, R_SH), (b.R_hi, R_SH.inv())], pieces_of(T))
    one, none, C = np.eye(3), np.zeros((3, 3)), R_SH.as_matrix()
    expected = [[-one, C, none], [-one, none, C.T]]
    assert np.hstack(list(of_three.enters)) == pytest.approx(np.block(expected))


@pytest.mark.parametrize("step_s", [1.0, 2.5, 10.0, 60.0])
def test_a_coarse_record_of_one_head_is_refused_since_all_that_it_shows_is_motion(step_s) -> None:
    """As kernels of attitudes every ten seconds are: no frequency lies above those of the motion."""
    t = step_s * np.arange(400)
    wave = np.radians(0.5) * np.outer(np.sin(t / 97.0), [1.0, -0.4, 0.7])
    of = {"step_s": step_s, "enters": np.eye(3)[None], "lowest_hz": 0.5}
    signal = Signal(values=wave, pieces=(slice(0, 400),), **of)
    with pytest.raises(ValueError, match=r"rows every .* s show 0 frequencies above 0\.5 Hz"):
        fit_noise(signal, 26.0)


def test_a_gap_that_leaves_a_piece_shorter_than_the_means_leaves_the_rest() -> None:
    # A record with a gap after 10 s, of which means over 26 s are asked: those of the long piece alone.
    a, b = tracks(np.random.default_rng(2))
    keep = np.r_[0:100, 140 : len(T)]
    signal = difference_signal(a.R_hi[keep], [(b.R_hi[keep], R_SH)], pieces_of(T[keep]))
    fit = fit_noise(signal, 26.0)
    assert fit.n_means == int((len(T) - 140) * STEP / 26.0) and np.isfinite(fit.scatter).all()
    assert np.allclose(fit.heads[0].white_rad[2] / ARCSEC, WHITE[0][2], rtol=0.3)


def test_attitudes_between_instants_are_carried_by_the_smoothed_motion() -> None:
    a, b = tracks(np.random.default_rng(1), slew_rad_s2=1e-4)
    shifted = replace(b, t_s=T + 0.04)
    first, rows = common_instants(a, shifted)
    assert len(rows) == ROWS
    nominal = Rotation.from_rotvec(np.outer(shifted.t_s, [0.0, 1.1e-3, 0.0]))
    here = carried_to(a, first, shifted.t_s[rows], nominal)
    true = Rotation.from_rotvec(np.outer(0.5e-4 * shifted.t_s**2, [0.6, -0.5, 0.62])) * nominal
    rms = np.sqrt(np.mean((here * true.inv()).as_rotvec() ** 2, axis=0)) / ARCSEC
    assert np.all(rms < 1.15 * np.hypot(WHITE[0], CORRELATED[0]))  # little more than the row's own noise


def test_pieces_begin_at_the_first_row_after_a_gap() -> None:
    step, pieces = pieces_of(np.r_[0.0:10.0, 11.0:17.0, 23.0:26.0] * 0.25)  # a row is missing, and six
    assert step == 0.25 and pieces == (slice(0, 10), slice(10, 16), slice(16, 19))


def test_the_motion_by_which_attitudes_are_carried_is_smoothed_whatever_their_step() -> None:
    rng = np.random.default_rng(4)
    for step in (0.25, 0.125):  # s; the window is odd and spans `SMOOTHING_S`, whatever the step
        t = step * np.arange(400)
        angle = 3e-4 * t + rng.normal(0.0, 1e-5, 400)
        turn = Rotation.from_rotvec(np.outer(angle, [0.6, 0.0, 0.8]))  # about one axis: angles add
        track = HeadTrack(name="a", t_s=t, R_hi=turn, R_oi=Rotation.identity(400))
        rows = np.arange(100, 300)
        found = carried_to(track, rows, t[rows] + 1.0, Rotation.identity(200))
        window = 2 * int(0.5 * SMOOTHING_S / step) + 1
        rate = scipy.signal.savgol_filter(angle, window, 2, deriv=1, delta=step)[rows]
        expected = Rotation.from_rotvec(np.outer(angle[rows] + rate, [0.6, 0.0, 0.8]))
        assert (found * expected.inv()).magnitude().max() < 1e-12


def test_a_single_head_is_told_from_the_nominal_motion() -> None:
    off = 1e-3 * np.random.default_rng(6).normal(size=(len(T), 3))
    R_oi = Rotation.random(len(T), random_state=7)
    track = HeadTrack(name="a", t_s=T, R_hi=Rotation.from_rotvec(off) * R_SH * R_oi, R_oi=R_oi)
    apart = Rotation.from_rotvec(off) * Rotation.from_rotvec(-off[len(T) // 2])
    signal = _single(track, 0.4)
    np.testing.assert_allclose(signal.values, apart.as_rotvec(), rtol=0.0, atol=1e-14)  # rad: rounding
    assert (signal.step_s, signal.lowest_hz, signal.pieces) == (pytest.approx(STEP), 0.4, (slice(0, ROWS),))


def test_covariance_of_means_is_that_of_all_pairs_of_a_part_in_units_of_the_level() -> None:
    rng, level = np.random.default_rng(8), np.array([4.0, 0.3, 9.0, 0.05])
    parts = [np.sqrt(level) * (rng.normal(size=(n, 4)) + 5.0) for n in (40, 2, 25)]
    for lag in (1, 2):
        off = [(part - np.vstack(parts).mean(axis=0)) / np.sqrt(level) for part in parts]
        pairs = [(one[n], one[n + lag]) for one in off for n in range(len(one) - lag)]
        expected = np.mean([first * later for first, later in pairs])
        assert spectrum._between_means(parts, lag, level) == pytest.approx(expected, rel=1e-12)


def test_gradient_of_the_prior_of_alike_heads_is_that_of_differences() -> None:
    rng = np.random.default_rng(5)
    x, start = rng.normal(size=(2, 2, 3, 3))
    _, gradient = spectrum._unlike(x, start)
    for place in np.ndindex(x.shape):
        step = np.zeros(x.shape)
        step[place] = 1e-5
        slope = (spectrum._unlike(x + step, start)[0] - spectrum._unlike(x - step, start)[0]) / 2e-5
        assert gradient[place] == pytest.approx(slope, abs=1e-6)  # of a quadratic form: rounding alone


def test_density_of_an_axis_is_that_of_white_and_first_order_noise_and_its_changes_are_differences() -> None:
    step_s, omega = 0.3, np.array([0.02, 0.7, 1.9, 3.1])  # s; rad a sample
    x = np.random.default_rng(6).normal(size=(2, 3, 3)) * [0.5, 0.5, 1.5]  # heads, axes; logarithms
    density_of = spectrum._axes_density
    density, by_x = density_of(x, omega, step_s)
    lags = np.arange(-2000, 2001)  # of the autocovariance: correlation times of 30 steps at most
    white, correlated, time_s = np.moveaxis(np.exp(x), -1, 0)[..., None]
    covariance = correlated**2 * np.exp(-step_s * np.abs(lags) / time_s) + white**2 * (lags == 0)
    np.testing.assert_allclose(density, np.einsum("fl,hal->fha", np.cos(np.outer(omega, lags)), covariance))
    for p, h in enumerate(1e-5 * np.eye(3)):
        slope = (density_of(x + h, omega, step_s)[0] - density_of(x - h, omega, step_s)[0]) / 2e-5
        np.testing.assert_allclose(by_x[..., p], slope, rtol=1e-6, atol=1e-8 * density.max())  # curvature
