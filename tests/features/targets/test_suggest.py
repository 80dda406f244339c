"""Good places for targets in an ortho-image."""

import numpy as np
import pytest
from numpy.typing import NDArray
from small_strip import texture

from boresight.features.targets.suggest import SuggestedTarget, suggest_targets

TRANSFORM = (0.5, 0.0, 4000.0, 0.0, -0.5, 9000.0)


@pytest.fixture(scope="module")
def invented() -> NDArray:
    return texture(np.random.default_rng(1), 1400)


def test_lakes_and_repeated_patterns_are_left_out(invented: NDArray):
    image = invented[:600, :900].copy()
    image[:, :300] = 20.0  # a lake
    rows, columns = np.mgrid[0:600, 0:300]
    # a plantation
    image[:, 600:] = 90.0 + 40.0 * np.sign(np.sin(rows * 0.4)) * np.sign(np.sin(columns * 0.4))
    image += np.random.default_rng(1).normal(0.0, 1.0, image.shape)
    found = suggest_targets(image, TRANSFORM, np.ones(image.shape, dtype=bool), size_px=64, most=6)
    assert len(found) >= 3
    for target in found:
        assert 300 - 32 < target.column < 600 + 32  # a chip may reach over the border by its half
        assert target.sigma_px < 0.02
    faint = 0.02 * invented[:600, :900] + np.random.default_rng(1).normal(0.0, 1.0, image.shape)
    assert not suggest_targets(faint, TRANSFORM, np.ones(image.shape, dtype=bool), size_px=64, most=6)


def test_best_comes_first_and_map_coordinates_are_those_of_the_pixel(invented: NDArray):
    found = suggest_targets(invented, TRANSFORM, np.ones(invented.shape, dtype=bool), size_px=96, most=10)
    assert len(found) == 10
    scores = [target.score for target in found]
    assert scores == sorted(scores, reverse=True)
    best = found[0]
    assert best.x == pytest.approx(4000.0 + 0.5 * (best.column + 0.5), abs=1e-9)
    assert best.y == pytest.approx(9000.0 - 0.5 * (best.row + 0.5), abs=1e-9)


def test_places_without_data_are_left_out(invented: NDArray):
    valid = np.ones(invented.shape, dtype=bool)
    valid[:, 700:] = False
    found = suggest_targets(invented, TRANSFORM, valid, size_px=96, most=10)
    assert max(target.column for target in found) <= 700 - 48  # a chip is [column - 48, column + 48)


def test_image_of_less_than_two_chips_is_refused(invented: NDArray):
    with pytest.raises(ValueError, match="smaller than two chips"):
        suggest_targets(invented[:100, :300], TRANSFORM, np.ones((100, 300), dtype=bool), size_px=64, most=3)


def test_map_coordinates_of_a_turned_image_are_those_of_its_transform(invented: NDArray):
    a, b, c, d, e, f = turned = (0.4, 0.3, 4000.0, 0.35, -0.45, 9000.0)
    found = suggest_targets(invented, turned, np.ones(invented.shape, dtype=bool), size_px=96, most=10)
    assert len(found) == 10
    for one in found:
        u, v = one.column + 0.5, one.row + 0.5
        assert (one.x, one.y) == pytest.approx((a * u + b * v + c, d * u + e * v + f), abs=1e-9)


def test_a_place_that_occurs_twice_is_worth_nothing_and_a_lone_one_its_weight():
    lone, half, twice = (
        SuggestedTarget(column=0.0, row=0.0, x=0.0, y=0.0, sigma_px=0.02, rival=rival)
        for rival in (0.0, 0.5**0.5, 1.0)
    )
    assert (lone.score, half.score, twice.score) == pytest.approx((50.0, 25.0, 0.0))
