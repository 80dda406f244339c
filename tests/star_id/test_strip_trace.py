"""Traces and their centroids against images made by brute force, and against the Cramér-Rao bound."""

import numpy as np
import pytest
from strip_frames import trace

from boresight.star_id.finding.windows import StarWindows
from boresight.star_id.strip_stars.fit import fit_traces, gain_from_windows, width_of
from boresight.star_id.strip_stars.trace import Motion, trace_curvatures, trace_images, trace_radius

SIGMA, NOISE, GAIN = 0.55, 0.85, 60.0
MOTIONS = [(1.0, 0.0, 1), (0.8, 0.0, 16), (1.2, 0.05, 16), (-1.0, 0.0, 4)]


def many(rate, drift, stages, n):
    return Motion(np.full(n, rate), np.full(n, drift), stages)


def windows_of(images, noise2):
    n, side, _ = images.shape
    return StarWindows(
        corner=np.zeros((n, 2), dtype=np.int64),
        radius=side // 2,
        data=images.reshape(n, -1).astype(np.float32),
        good=np.ones((n, side * side), np.float32),
        noise2=np.full(n, noise2),
        saturated=np.zeros(n, dtype=bool),
    )


def drawn(rate, drift, stages, snr, n, rng):
    """Windows of n stars of one SNR with noise and rounding, and where they cross."""
    radius = trace_radius(many(rate, drift, stages, 1), SIGMA)
    peak = trace(0.0, 0.0, rate, drift, stages, SIGMA, radius)
    flux = snr * NOISE / np.sqrt((peak**2).sum())
    offset = rng.uniform(-0.5, 0.5, (n, 2))
    images = np.array([trace(*place, rate, drift, stages, SIGMA, radius, flux) for place in offset])
    noisy = np.rint(images + 12.0 + rng.standard_normal(images.shape) * np.sqrt(NOISE**2 + images / GAIN))
    return windows_of(noisy - 12.0, NOISE**2 + 1.0 / 12.0), offset, flux


@pytest.mark.parametrize("motion", MOTIONS)
def test_images_and_derivatives_are_those_of_brute_force(motion):
    place, step = np.array([0.21, -0.34]), 1e-4
    radius = trace_radius(many(*motion, 1), SIGMA)
    images = trace_images(place[None], many(*motion, 1), SIGMA, radius)
    side = 2 * radius + 1
    exact = trace(*place, *motion, SIGMA, radius)
    # five nodes a row and half a width between stages: 5e-4 of the peak, an SNR of 2000
    assert np.abs(images.value.reshape(side, side) - exact).max() < 6e-4 * exact.max()
    for axis, got in ((0, images.d_x), (1, images.d_y)):
        shift = step * np.eye(2)[axis]
        low, high = (trace(*(place + s * shift), *motion, SIGMA, radius) for s in (-1.0, 1.0))
        slope = (high - low) / (2.0 * step)
        assert np.abs(got.reshape(side, side) - slope).max() < 3e-3 * np.abs(slope).max()


@pytest.mark.parametrize("motion", MOTIONS)
def test_curvatures_are_the_slopes_of_the_derivatives(motion):
    place, step = np.array([[0.21, -0.34]]), 1e-2
    radius = trace_radius(many(*motion, 1), SIGMA)
    got = trace_curvatures(place, many(*motion, 1), SIGMA, radius)[0]
    slopes = []
    for axis in (0, 1):
        shift = step * np.eye(2)[axis]
        low, high = (
            trace_images(place + s * shift, many(*motion, 1), SIGMA, radius).columns[0, :2] for s in (-1, 1)
        )
        slopes.append((high.astype(float) - low) / (2.0 * step))
    exact = np.stack([slopes[0][0], slopes[0][1], slopes[1][1]])
    assert np.abs(slopes[0][1] - slopes[1][0]).max() < 1e-4 * np.abs(exact).max()
    # a step of 0.01 px leaves (0.01 / 0.55)^2 / 6 times a few, float32 5e-5
    assert np.abs(got - exact).max() < 1e-3 * np.abs(exact).max()


def test_places_of_faint_stars_have_no_bias_of_second_order():
    n, place, motion = 4000, np.array([0.3, -0.2]), (1.2, 0.1, 1)
    radius = trace_radius(many(*motion, 1), SIGMA)
    image = trace(*place, *motion, SIGMA, radius)
    flux = 12.0 * NOISE / np.sqrt((image**2).sum())  # SNR 12
    noise = np.random.default_rng(13).standard_normal((n // 2, *image.shape))
    noise *= np.sqrt(NOISE**2 + flux * image / GAIN)
    twins = windows_of(flux * image + np.concatenate([noise, -noise]), NOISE**2)
    fits = fit_traces(twins, np.tile(place, (n, 1)), many(*motion, n), SIGMA, GAIN)
    mean = (fits.offset - place).reshape(2, n // 2, 2).mean(axis=0)  # what is linear in the noise cancels
    sigma = mean.std(axis=0) / np.sqrt(n / 2)
    # the bias is 0.002 and 0.003 px, 8 sigma; left of it are higher orders, (0.07 px)^2 of it or less
    assert (np.abs(mean.mean(axis=0)) < 3.0 * sigma + 2e-4).all(), (mean.mean(axis=0), sigma)


@pytest.mark.parametrize("motion", MOTIONS[:3])
@pytest.mark.parametrize("snr", [7.0, 300.0])
def test_centroids_reach_their_bound_without_bias_and_state_it(motion, snr):
    n, rng = 400, np.random.default_rng(11)
    windows, offset, flux = drawn(*motion, snr, n, rng)
    fits = fit_traces(windows, np.zeros((n, 2)), many(*motion, n), SIGMA, GAIN)
    error = fits.offset - offset
    images = trace_images(offset, many(*motion, n), SIGMA, windows.radius)
    variance = windows.noise2[:, None] + images.value * flux / GAIN
    slopes = images.columns * np.array([flux, flux, 1.0, 1.0])[None, :, None]
    bound = np.linalg.inv(np.einsum("npm,nqm->npq", slopes / variance[:, None], slopes))[:, :2, :2]
    ratio = np.sqrt((error**2).mean(axis=0) / np.diagonal(bound, axis1=1, axis2=2).mean(axis=0))
    # 1.1 of the bound is what is asked for; 400 stars determine the ratio to 0.035
    assert ratio.max() < 1.1 + 0.06, ratio
    nees = np.einsum("na,nab,nb->n", error, np.linalg.inv(fits.cov_px), error).mean()
    assert 1.6 < nees < 2.4, nees  # 2 for an honest covariance, to 0.1, and rather below near the threshold
    if snr > 50.0:
        for axis in (0, 1):
            phase = np.floor((offset[:, axis] + 0.5) * 4.0).astype(int)
            bias = [error[phase == part, axis].mean() for part in range(4)]
            # 0.005 px is what is asked for; the mean of 100 stars is known to 0.0005 px
            assert np.abs(bias).max() < 0.005, (axis, bias)


def test_width_and_gain_come_from_the_stars_themselves():
    rng, n = np.random.default_rng(5), 40
    windows, _, _ = drawn(1.0, 0.0, 1, 300.0, n, rng)
    motion, start = many(1.0, 0.0, 1, n), np.zeros((n, 2))
    sigma = width_of(windows, start, motion)
    assert abs(sigma - SIGMA) < 0.01  # px: 40 stars of SNR 300 know it to 0.002
    gain = gain_from_windows(windows, start, motion, sigma)
    assert abs(np.log(gain / GAIN)) < 0.45, gain  # some 2.5 pixels of a star are photon-limited: 3 x 0.15
    windows.data[:5, 40] += 60.0  # a particle in five of the windows
    hit = gain_from_windows(windows, start, motion, sigma)
    assert abs(np.log(hit / gain)) < 0.3, (gain, hit)
