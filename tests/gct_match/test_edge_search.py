"""Places of a chip in large pictures: the best ones are found whatever the step from coarse to fine."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from boresight.gct_match.search.edge_search import (
    Positions,
    _windows,
    best_positions,
    search_picture,
    search_template,
)
from boresight.gct_match.search.edges import edge_field, edge_similarity


@pytest.fixture(scope="module")
def ground() -> NDArray:
    """Fractal grey values, 8 bit, (700, 500)."""
    rng = np.random.default_rng(12)
    image = sum(s * cv2.GaussianBlur(rng.normal(size=(700, 500)), (0, 0), s) for s in (1.5, 4.0, 12.0))
    return np.clip(128.0 + 60.0 * image / image.std(), 0.0, 255.0).astype(np.uint8)


def test_the_best_place_is_that_of_the_full_search(ground: NDArray):
    # all ten, negatives with noise: their correlation is 0.5 to 0.9, far above the full search's next peak
    rng = np.random.default_rng(3)
    field = edge_field(ground)
    for _ in range(10):
        x, y = rng.integers(0, 460), rng.integers(0, 660)
        chip = 255.0 - ground[y : y + 36, x : x + 36] + rng.normal(0.0, 8.0, (36, 36))
        surface = edge_similarity(edge_field(chip.astype(np.float32)), field)
        row, column = np.unravel_index(surface.argmax(), surface.shape)
        box = (0, 0, surface.shape[1] - 1, surface.shape[0] - 1)
        found = best_positions(search_template(chip.astype(np.float32)), [search_picture(ground)], [box], 20)
        assert found.xy[0].tolist() == [column, row] == [x, y]
        assert (np.diff(found.value) <= 0.0).all() and len(found.xy) == 20


def test_of_two_pictures_the_right_one_is_named(ground: NDArray):
    left, right = (search_picture(np.ascontiguousarray(part)) for part in (ground[:, :240], ground[:, 240:]))
    chip = search_template(ground[300:332, 300:332].astype(np.float32))
    places = best_positions(chip, [left, right], [(0, 0, 208, 668)] * 2, 10)
    assert places.picture[0] == 1
    assert places.xy[0].tolist() == [60, 300]


def test_chip_that_reaches_beyond_the_picture_is_found_by_the_rest_of_it(ground: NDArray):
    chip = search_template(ground[100:132, 0:32].astype(np.float32))
    cut = search_picture(np.ascontiguousarray(ground[:, 12:]))
    places = best_positions(chip, [cut], [(-16, 0, 440, 668)], 10)
    assert places.xy[0].tolist() == [-12, 100]


def test_places_lie_within_the_box_and_what_it_is_rounded_to(ground: NDArray):
    chip = search_template(ground[300:332, 300:332].astype(np.float32))
    places = best_positions(chip, [search_picture(ground)], [(40, 60, 140, 220)], 50)
    low, high = places.xy.min(axis=0), places.xy.max(axis=0)
    assert (low >= [40 - 9, 60 - 9]).all() and (high <= [140 + 9, 220 + 9]).all()  # px: 3 + 4 + 2


def test_hidden_ground_is_no_place(ground: NDArray):
    image = ground.astype(np.float32)
    image[200:260, 100:180] = np.nan
    chip = search_template(ground[215:247, 120:152].astype(np.float32))
    places = best_positions(chip, [search_picture(image)], [(0, 0, 468, 668)], 10)
    assert np.isfinite(places.value).all()
    assert np.abs(places.xy - [120, 215]).max(axis=1).min() > 16


def test_sides_of_a_template_are_multiples_of_four():
    with pytest.raises(ValueError, match="multiples of 4"):
        search_template(np.zeros((30, 32), dtype=np.float32))


def test_a_picture_smaller_than_the_template_shows_its_edges():
    plane = np.arange(12, dtype=np.float32).reshape(1, 3, 4)
    positions = Positions(np.zeros(2, dtype=np.int64), np.array([[0, 0], [2, 1]]), np.zeros(2, np.float32))
    windows = _windows([plane], positions, (1, 8, 8), 1)
    reach = np.arange(windows.shape[2]) - (windows.shape[2] - 8) // 2
    for window, (x, y) in zip(windows[:, 0], positions.xy):
        rows, columns = np.clip(reach + y, 0, 2), np.clip(reach + x, 0, 3)
        assert np.array_equal(window, plane[0][np.ix_(rows, columns)])
