"""Correlation of normalised pictures, its peaks, and how likely a peak is wrong."""

import numpy as np
import pytest
from numpy.typing import NDArray

from boresight.gct_match.imaging.views import normalised
from boresight.gct_match.search.correlation import (
    correlation_surface,
    mean_and_spread,
    peaks_of,
    positions_under,
    probability_wrong,
)


def noise(seed: int, side: int) -> NDArray:
    return np.random.default_rng(seed).standard_normal((side, side)).astype(np.float32)


def test_normalised_picture_forgets_light_and_contrast():
    image = noise(1, 200) * 10.0 + 100.0
    ramp = np.linspace(0.5, 2.0, 200, dtype=np.float32)
    every = np.ones(image.shape, dtype=bool)
    one, two = normalised(image, every), normalised(image * ramp + 300.0 * ramp, every)
    assert (
        np.corrcoef(one.ravel(), two.ravel())[0, 1] > 0.95
    )  # the ramp itself shows where it is steep against the noise


def test_masked_pixels_say_nothing():
    image, valid = noise(2, 100), np.ones((100, 100), dtype=bool)
    valid[30:60, 30:60] = False
    bright = image.copy()
    bright[~valid] = 1e4
    assert normalised(image, valid) == pytest.approx(normalised(bright, valid), abs=1e-3)
    assert not normalised(bright, valid)[~valid].any()


def test_correlation_is_one_where_the_template_was_cut_out():
    picture = normalised(noise(3, 120), np.ones((120, 120), dtype=bool))
    surface = correlation_surface(picture[40:72, 50:82], picture)
    peaks = peaks_of(surface, 3, 3)
    assert peaks.xy[0] == pytest.approx([50.0, 40.0], abs=0.05)  # px, a parabola's accuracy
    assert peaks.value[0] == pytest.approx(1.0, abs=0.02)
    assert peaks.value[1] < 0.5


def test_lone_peak_is_right_and_one_among_equals_is_not():
    surface = 0.05 * noise(6, 41)
    surface[20, 20] = 0.8
    assert probability_wrong(surface, np.array([20.0, 20.0])) < 1e-6
    surface[5, 33] = 0.8
    assert probability_wrong(surface, np.array([20.0, 20.0])) > 0.4


def test_highest_of_nothing_but_chance_is_not_believed():
    wrong = []
    for seed in range(200):
        surface = 0.05 * noise(seed, 33)
        row, column = np.unravel_index(np.argmax(surface), surface.shape)
        wrong.append(probability_wrong(surface, np.array([column, row], dtype=float)))
    assert min(wrong) > 0.01  # the limit at which matches are refused


def test_positions_are_spread_about_the_peak_the_wider_the_lower_it_is():
    y, x = np.mgrid[:33, :33].astype(np.float32)
    far = 0.05 * noise(8, 33) * (np.hypot(x - 16.0, y - 16.0) > 8.0)

    def positions(height: float) -> tuple[NDArray, NDArray]:
        seen = far + height * np.exp(-((x - 16.4) ** 2 + (y - 16.3) ** 2) / (2.0 * 2.0**2))
        return mean_and_spread(*positions_under(seen, np.array([16.0, 16.0]), 3, turned=False))

    (middle, high), (_, low) = positions(0.5), positions(0.2)
    assert np.linalg.eigvalsh(low).min() > np.linalg.eigvalsh(high).max()  # a lower peak tells less
    assert middle == pytest.approx([16.4, 16.3], abs=0.1)  # px, a twentieth of the peak's width
