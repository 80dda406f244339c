"""Packed spectra beside NumPy's, for even and odd shapes."""

import numpy as np
import pytest

from boresight.gct_match.imaging.spectra import filtered, frequency, padded_shape, ring_means, rings

SHAPES = [(64, 64), (75, 54), (60, 81), (45, 75)]  # what OpenCV transforms without padding


@pytest.mark.parametrize("shape", SHAPES)
def test_packed_numbers_stand_at_their_frequency(shape: tuple[int, int]):
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])[None, :]
    by_numpy = np.sort(np.hypot(fy, fx), axis=None)
    assert np.sort(frequency(shape), axis=None) == pytest.approx(by_numpy, abs=1e-7)


@pytest.mark.parametrize("shape", [(64, 64), (61, 97)])
def test_filter_is_that_of_numpy(shape: tuple[int, int]):
    image = np.random.default_rng(1).standard_normal(shape).astype(np.float32)
    rows, columns = padded = padded_shape(shape)
    mirrored = np.pad(image, ((8, rows - shape[0] - 8), (8, columns - shape[1] - 8)), mode="symmetric")
    f2 = np.fft.fftfreq(rows)[:, None] ** 2 + np.fft.rfftfreq(columns)[None, :] ** 2
    theirs = np.fft.irfft2(np.fft.rfft2(mirrored) * np.exp(-30.0 * f2), s=padded)[8:-8, 8:-8]
    ours = filtered(image, np.exp(-30.0 * frequency(padded) ** 2).astype(np.float32))
    assert ours == pytest.approx(theirs[: shape[0], : shape[1]], abs=1e-5)  # single precision of unit noise


@pytest.mark.parametrize("shape", SHAPES)
def test_rings_hold_the_power_of_the_spectrum(shape: tuple[int, int]):
    rng = np.random.default_rng(2)
    a, b = (rng.standard_normal(shape).astype(np.float32) for _ in range(2))
    _, count = rings(shape)
    A, B = np.fft.fft2(a), np.fft.fft2(b)
    index = (np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])) * 32.0 + 1e-6).astype(int)
    theirs = [np.bincount(index.ravel(), (x * y.conj()).real.ravel()) for x, y in ((A, A), (B, B), (A, B))]
    assert np.array_equal(count, np.bincount(index.ravel()))
    for own, their in zip(ring_means(a, b), theirs, strict=True):
        # packed: the few coefficients that are their own conjugates count double, against a hundred in a ring
        assert 2.0 * own[2:-1] * count[2:-1] == pytest.approx(
            their[2:-1], rel=0.05, abs=0.05 * abs(theirs[0]).mean()
        )
