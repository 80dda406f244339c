"""Noise of star cameras' attitudes from the record itself: spectrum, likelihood, scatter of means.

Signals are rotation vectors of attitudes against a reference. With several heads they are the differences of
each further head from the reference head, in which the motion of the satellite cancels; with one head, its
attitude against the nominal motion, of which only frequencies above those of the motion are used. Each axis
of each head has white noise and a first-order autoregressive process, AR(1); in a signal of step dt they have
the spectral density (per sample, two-sided)

    S(f) = w² + a² (1 - r²) / (1 - 2 r cos(2 pi f dt) + r²),    r = exp(-dt / τ).

Whittle's likelihood, the sum over frequencies of log det S + tr(S⁻¹ I) with the periodogram matrix I, is
maximised over w, a, τ of all axes at once: heads whose axes lie apart are separated by their axes (a tracker
is several times worse about its line of sight), and where that does not suffice, heads are taken to be alike.
What is constant over a piece of the record does not show in it; it is the scatter of means over disjoint
pieces that white and AR(1) do not explain. How alike neighbouring means are tells how long it lasts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import scipy
from scipy.optimize import minimize, nnls
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.records.record import Floats, Ints, array, record, scalar

__all__ = [
    "AxisSpectrum",
    "NoiseFit",
    "Signal",
    "allan_deviation",
    "difference_signal",
    "fit_noise",
    "pieces_of",
]

GAP = 1.5  # steps: a longer one ends a piece of the record
FEWEST_ROWS = 32  # of a piece whose spectrum is used
LONGEST_S = 1e5  # over which a constant is said to last: a day
FEWEST_FREQUENCIES = 8  # above those of the motion, of all pieces
ALIKE = 0.3  # scatter of log(w), log(a), log(τ) between heads, and between x and y
FAR = 1.5  # scatter of log(τ) about its start
TAPERED = 0.2  # of a piece, at its ends, where the motion of the satellite is in it
START_WHITE, START_STEPS = 0.7, 5.0  # part of the variance that is white, and τ in steps, at the start
LEAST_OF_HEAD = 0.02  # of the mean variance, that a head has at the start
H_LOG = 1e-3  # step of a parameter, by which the curvature is found


@record(kw_only=True)
class Signal:
    """Evenly spaced differences of heads, and how each head enters: signal = sum of R (3, 3) times errors."""

    values: Floats = array("K, D", "rotation vectors, rad, D = 3 for each difference")
    pieces: tuple[slice, ...] = scalar("parts of equal step without a gap")
    step_s: float = scalar("from row to row")
    enters: Floats = array("H, D, 3", "of each head's axes into the signal")
    lowest_hz: float = scalar("lower frequencies hold motion of the satellite; 0: none", default=0.0)

    def variance(self, of_axes: Floats) -> Floats:
        """Variance (..., D) of the components by that of the heads' axes (..., H, 3)."""
        return np.einsum("hda,...ha,hda->...d", self.enters, of_axes, self.enters)


@record(kw_only=True)
class AxisSpectrum:
    """Mean periodogram of one component of the signal, and the model's, rad² a sample."""

    frequency_hz: Floats = array("F", "frequencies")
    measured: Floats = array("F, D", "of each component")
    model: Floats = array("F, D", "by the fit")
    white: Floats = array("F, D", "by the fit of white noise alone")


@record(kw_only=True)
class NoiseFit:
    """Noise of each head, with errors, and how well it describes the record."""

    heads: tuple[AttitudeNoise, ...] = array("H", "fitted noise; constant part from means of pieces")
    sigma_log: Floats = array("H, 3, 3", "1-sigma of log(w), log(a), log(τ) of each head and axis")
    told_apart: Floats = array(
        "H, 3",
        "part, 0 to 1, of how the variances of axes that are taken to be alike differ that the record tells",
    )
    white_statistic: float = scalar("twice the log likelihood lost by white noise alone")
    white_dof: int = scalar("parameters that white noise alone does without")
    mean_s: float = scalar("length of the pieces whose means were compared")
    scatter: Floats = array("D", "rms of these means about their mean, rad; NaN with fewer than two")
    predicted: Floats = array("D", "the same by white and AR(1) noise")
    predicted_white: Floats = array("D", "the same by white noise of the same total variance")
    n_means: int = scalar("number of means")
    spectrum: AxisSpectrum = scalar("of the components of the signal")


def pieces_of(t_s: Floats) -> tuple[float, tuple[slice, ...]]:
    """The usual step of instants (K,), and the parts without a longer one."""
    step = float(np.median(np.diff(t_s)))
    breaks = np.flatnonzero(np.abs(np.diff(t_s) - step) > (GAP - 1.0) * step) + 1
    return step, tuple(slice(int(a), int(b)) for a, b in pairwise([0, *breaks.tolist(), len(t_s)]))


def fit_noise(signal: Signal, mean_s: float) -> NoiseFit:
    """Noise of H heads from their signal, the differences of heads or one against the nominal motion. A part
    of the errors counts as constant over pieces of `mean_s`, the length of a strip, say. `ValueError` for a
    record without a piece of 32 rows, or one too coarse to show more than the motion.
    """
    parts = [signal.values[piece] for piece in signal.pieces if piece.stop - piece.start >= FEWEST_ROWS]
    if not parts:
        longest = max((piece.stop - piece.start for piece in signal.pieces), default=0)
        raise ValueError(
            f"the longest part of the record without a gap has {longest} rows, {FEWEST_ROWS} are needed"
        )
    x, covariance, white_density, lost = _fitted(signal, parts)
    count = max(round(mean_s / signal.step_s), 1)
    of_parts = [_means(part, count) for part in parts]
    means = np.concatenate(of_parts)
    scatter2 = means.var(axis=0, ddof=1) if len(means) > 1 else np.full(means.shape[1], np.nan)
    by_axis = _variance_of_means(x, count, signal.step_s)
    predicted2 = signal.variance(by_axis)
    white2 = signal.variance(white_density / count)
    of_axes = np.exp(2.0 * x[..., 0]) + np.exp(2.0 * x[..., 1])
    level = signal.variance(of_axes)
    # The same part, as it is in the mean of all components, of the variance of every axis: a few means of
    # differences cannot tell more, and an axis without any would be trusted far too much.
    share = max(float(np.mean((scatter2 - predicted2) / level)), 0.0) if len(means) > 1 else 0.0
    r = np.exp(-signal.step_s / np.exp(x[..., 2]))
    by_ar1 = np.exp(2.0 * x[..., 1]) * r * ((1.0 - r**count) / (1.0 - r) / count) ** 2  # of neighbours
    near, far = (
        _between_means(of_parts, lag, level) - float(np.mean(signal.variance(by_axis) / level))
        for lag, by_axis in ((1, by_ar1), (2, by_ar1 * r**count))
    )
    share, one_sigma = max(share, near), float(np.mean(scatter2 / level)) / np.sqrt(means.size)
    kept = np.clip((far + one_sigma) / share, 0.0, 1.0 - 0.5 / len(means)) if share > 0.0 else 0.0
    lasts_s = min(count * signal.step_s / -np.log(kept), LONGEST_S) if kept else 0.0
    noise = tuple(
        AttitudeNoise(
            white_rad=np.exp(one[:, 0]),
            correlated_rad=np.exp(one[:, 1]),
            correlation_time_s=np.exp(one[:, 2]),
            constant_rad=np.sqrt(share * variance),
            constant_time_s=np.full(3, lasts_s),
        )
        for one, variance in zip(x, of_axes)
    )
    omega: Floats = np.pi * (np.arange(48, dtype=np.float64) + 0.5) / 48.0
    grid, _ = _axes_density(x, omega, signal.step_s)
    return NoiseFit(
        heads=noise,
        sigma_log=np.sqrt(np.diag(covariance)).reshape(x.shape),
        told_apart=_told_apart(x, covariance),
        white_statistic=lost,
        white_dof=2 * x.shape[0] * 3,
        mean_s=count * signal.step_s,
        scatter=np.sqrt(scatter2),
        predicted=np.sqrt(predicted2),
        predicted_white=np.sqrt(white2),
        n_means=len(means),
        spectrum=AxisSpectrum(
            frequency_hz=omega / (2.0 * np.pi * signal.step_s),
            measured=_binned(parts, signal, omega),
            model=signal.variance(grid),
            white=np.tile(signal.variance(white_density), (48, 1)),
        ),
    )


def allan_deviation(values: Floats, step_s: float) -> tuple[Floats, Floats]:
    """Averaging times (M,) and the Allan deviation (M, D) of means over them: of adjacent means, root of
    half the mean squared difference; overlapping.
    """
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    counts: Ints = np.unique(
        np.round(2.0 ** np.arange(0.0, np.log2(max(len(values) / 3.0, 1.0)), 0.5)).astype(np.int64)
    )
    deviations = []
    for m in counts.tolist():
        means = (sums[m:] - sums[:-m]) / m
        deviations.append(np.sqrt(0.5 * np.mean((means[m:] - means[:-m]) ** 2, axis=0)))
    times: Floats = counts.astype(np.float64) * step_s
    return times, np.reshape(deviations, (len(counts), values.shape[1]))


def _periodograms(parts: Sequence[Floats], signal: Signal) -> tuple[Floats, Floats]:
    """Angular frequencies (F,), rad a sample, and periodogram matrices (F, D, D), real part.

    Where slow motion is to be left out, a taper over a tenth at both ends keeps it from leaking upwards.
    """

    omega: list[Floats] = []
    matrices: list[Floats] = []
    for part in parts:
        K = len(part)
        taper = scipy.signal.windows.tukey(K, TAPERED if signal.lowest_hz > 0.0 else 0.0)[:, None]
        taper = taper / np.sqrt(np.mean(taper**2))
        X = np.fft.rfft(taper * (part - part.mean(axis=0)), axis=0)[1 : (K + 1) // 2]
        at: Floats = 2.0 * np.pi * np.arange(1, (K + 1) // 2, dtype=np.float64) / K
        used = at >= 2.0 * np.pi * signal.lowest_hz * signal.step_s
        omega.append(at[used])
        matrices.append((X[used, :, None] * X[used, None, :].conj()).real / K)
    return np.concatenate(omega).astype(np.float64), np.concatenate(matrices).astype(np.float64)


def _axes_density(x: Floats, omega: Floats, step_s: float) -> tuple[Floats, Floats]:
    """Spectral density (F, H, 3) of each axis for log parameters (H, 3, 3), and its change by these
    (F, H, 3, 3).
    """
    white, correlated, late = np.exp(2 * x[..., 0]), np.exp(2 * x[..., 1]), step_s / np.exp(x[..., 2])
    r, cosine = np.exp(-late), np.cos(omega)[:, None, None]
    below = 1.0 - 2.0 * r * cosine + r**2
    shape = (1.0 - r**2) / below
    by_r = -2.0 * (r + shape * (r - cosine)) / below
    by_x = np.stack(
        [np.broadcast_to(2.0 * white, shape.shape), 2.0 * correlated * shape, correlated * by_r * r * late],
        axis=-1,
    )
    return np.asarray(white + correlated * shape), by_x


def _whittle(axes: Floats, enters: Floats, periodogram: Floats) -> tuple[float, Floats]:
    """Minus twice the log likelihood of spectral densities (F, H, 3) of the axes, and its change by them."""
    H, D, _ = enters.shape
    pairs = np.einsum("hda,hea->deha", enters, enters).reshape(D * D, 3 * H)
    S = (axes.reshape(-1, 3 * H) @ pairs.T).reshape(-1, D, D)
    inverse = np.linalg.inv(S)
    by_S = inverse - inverse @ periodogram @ inverse
    value = np.sum(np.linalg.slogdet(S)[1]) + np.einsum("fde,fed->", inverse, periodogram)
    return float(value), (by_S.reshape(-1, D * D) @ pairs).reshape(axes.shape)


def _start_variances(signal: Signal, parts: Sequence[Floats]) -> Floats:
    """Variances (H, 3) of the heads' axes that explain the signal's covariance best, none negative."""
    values = np.concatenate([part - part.mean(axis=0) for part in parts])
    covariance = values.T @ values / len(values)
    H, D, _ = signal.enters.shape
    columns = np.einsum("hda,hea->deha", signal.enters, signal.enters).reshape(D * D, 3 * H)
    found, _ = nnls(columns, covariance.ravel())
    return np.maximum(found, LEAST_OF_HEAD * np.trace(covariance) / (D * H)).reshape(H, 3)


def _unlike(x: Floats, start: Floats) -> tuple[float, Floats]:
    """Minus the logarithm of the prior, and its change by x: heads of one satellite are of one make, so
    log(w), log(a), log(τ) of all x and y axes scatter by `ALIKE`, those of z likewise; τ is within a factor
    of some 5 of its start.
    """
    pull = np.zeros_like(x)
    for axes in (slice(0, 2), slice(2, 3)):
        pull[:, axes] = (x[:, axes] - x[:, axes].mean(axis=(0, 1))) / ALIKE
    later = (x[..., 2] - start[..., 2]) / FAR
    by_x = pull / ALIKE
    by_x[..., 2] += later / FAR
    return 0.5 * float(np.sum(pull**2) + np.sum(later**2)), by_x


def _errors(loss: Callable[[Floats], tuple[float, Floats]], x: Floats) -> Floats:
    """Covariance of the parameters by the curvature of minus the logarithm of their probability."""
    changes = [loss(x + step)[1] - loss(x - step)[1] for step in H_LOG * np.eye(len(x))]
    hessian = np.array(changes) / (2.0 * H_LOG)
    values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
    return np.asarray((vectors / np.maximum(values, 1.0)) @ vectors.T)  # the prior's curvature is above 1


def _told_apart(x: Floats, covariance: Floats) -> Floats:
    """Part (H, 3) of what `_unlike` allows the variance of each axis to differ from those that it takes to be
    alike that the `covariance` of the parameters (H, 3, 3) no longer leaves open; 1 where none is.
    """
    H, told = len(x), np.ones(x.shape[:2])
    of_white = 1.0 / (1.0 + np.exp(2.0 * (x[..., 1] - x[..., 0]))).ravel()
    shares = np.stack([of_white, 1.0 - of_white, 0.0 * of_white], axis=1)
    by_parameters = np.einsum("km,mp->kmp", np.eye(3 * H), shares).reshape(3 * H, 9 * H)
    for axes in ([0, 1], [2]):
        alike = np.arange(3 * H).reshape(H, 3)[:, axes].ravel()
        apart = (np.eye(len(alike)) - 1.0 / len(alike)) @ by_parameters[alike]
        if len(alike) > 1:
            left, allowed = np.diag(apart @ covariance @ apart.T), ALIKE**2 * np.sum(apart**2, axis=1)
            told[:, axes] = (1.0 - left / allowed).reshape(H, len(axes))
    return np.clip(told, 0.0, 1.0)


def _fitted(signal: Signal, parts: Sequence[Floats]) -> tuple[Floats, Floats, Floats, float]:
    """Log parameters (H, 3, 3) of the heads' axes with their covariance, the densities (H, 3) of white noise
    alone, and twice the log likelihood that this loses.
    """
    omega, periodogram = _periodograms(parts, signal)
    if len(omega) < FEWEST_FREQUENCIES:
        raise ValueError(
            f"rows every {signal.step_s:.3g} s show {len(omega)} frequencies above {signal.lowest_hz:g} Hz, "
            f"where the satellite's own motion ends, {FEWEST_FREQUENCIES} are needed: such rows show motion, "
            "not noise"
        )
    H = len(signal.enters)
    variance = _start_variances(signal, parts)
    shares = np.array([START_WHITE, 1.0 - START_WHITE, 1.0])
    start = 0.5 * np.log(variance[..., None] * shares)
    start[:, :, 2] = np.log(START_STEPS * signal.step_s)

    def loss(x: Floats) -> tuple[float, Floats]:
        p = x.reshape(H, 3, 3)
        density, by_parameters = _axes_density(p, omega, signal.step_s)
        fit, by_density = _whittle(density, signal.enters, periodogram)
        prior, by_prior = _unlike(p, start)
        return fit + prior, (np.einsum("fha,fhap->hap", by_density, by_parameters) + by_prior).ravel()

    found = minimize(loss, start.ravel(), jac=True)
    x = np.asarray(found.x, dtype=np.float64).reshape(H, 3, 3)

    def white_loss(y: Floats) -> tuple[float, Floats]:
        density = np.exp(y)
        level = np.tile(density.reshape(H, 3), (len(omega), 1, 1))
        fit, by_level = _whittle(level, signal.enters, periodogram)
        return fit, density * by_level.sum(axis=0).ravel()

    white = minimize(white_loss, np.log(variance).ravel(), jac=True)
    white_density = np.exp(np.asarray(white.x)).reshape(H, 3)
    covariance = _errors(loss, x.ravel())
    lost = 2.0 * (float(white.fun) - float(found.fun))
    return x, covariance, white_density, lost


def _means(part: Floats, count: int) -> Floats:
    whole = len(part) // count
    return part[: whole * count].reshape(whole, count, part.shape[1]).mean(axis=1)


def _variance_of_means(x: Floats, count: int, step_s: float) -> Floats:
    """Variance (H, 3) of a mean over `count` rows."""
    lag = np.arange(1, count)
    r = np.exp(-step_s / np.exp(x[..., 2]))
    series = 1.0 + 2.0 * np.sum((1.0 - lag / count) * r[..., None] ** lag, axis=-1)
    return np.asarray((np.exp(2.0 * x[..., 0]) + np.exp(2.0 * x[..., 1]) * series) / count)


def _between_means(parts: Sequence[Floats], lag: int, level: Floats) -> float:
    """Covariance of means (n, D) of parts of the record with the `lag`-th after them, in the mean of all
    components in units of `level` (D,).
    """
    middle = np.concatenate(parts).mean(axis=0)
    products = np.concatenate([(part[:-lag] - middle) * (part[lag:] - middle) for part in parts])
    return float(np.mean(products.mean(axis=0) / level)) if len(products) else 0.0


def _binned(parts: Sequence[Floats], signal: Signal, centres: Floats) -> Floats:
    """Mean periodogram (F, D) about each of the centres; NaN where there is none."""
    omega, periodogram = _periodograms(parts, signal)
    bins = np.floor(omega / np.pi * len(centres)).astype(np.int64).clip(0, len(centres) - 1)
    power = np.einsum("fdd->fd", periodogram)
    total = np.zeros((len(centres), power.shape[1]))
    np.add.at(total, bins, power)
    number = np.bincount(bins, minlength=len(centres))[:, None]
    return np.divide(total, number, out=np.full(total.shape, np.nan), where=number > 0)


def difference_signal(
    R_si: Rotation, others: Sequence[tuple[Rotation, Rotation]], step: tuple[float, tuple[slice, ...]]
) -> Signal:
    """Signal of several heads with attitudes at the same K instants: of each (R_hi, R_sh) after the
    reference head's `R_si`, the rotation from it, axes of s.
    """
    values = [(R_sh * R_hi * R_si.inv()).as_rotvec() for R_hi, R_sh in others]
    enters = np.zeros((1 + len(others), 3 * len(others), 3))
    enters[0] = np.tile(-np.eye(3), (len(others), 1))
    for n, (_, R_sh) in enumerate(others):
        enters[1 + n, 3 * n : 3 * n + 3] = R_sh.as_matrix()
    return Signal(values=np.concatenate(values, axis=1), pieces=step[1], step_s=step[0], enters=enters)
