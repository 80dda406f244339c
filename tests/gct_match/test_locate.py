"""One template in one window: what looks alike is not taken for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from rendered_pairs import Pair, make_pair
from scipy import ndimage

from boresight.gct_match.locate import Located, NotLocated, locate
from boresight.gct_match.search.correlation import likeness_to_itself, normalised
from boresight.gct_match.settings import MatchSettings

MARGIN = 16
SETTINGS = MatchSettings()
TRUSTING = replace(SETTINGS, sigma_alike_px=SETTINGS.sigma_px)


def estate(rng: np.random.Generator, side: int) -> NDArray:
    """Roofs of two slopes, of various tones, sizes and places in plots of 140 picture pixels."""
    out = np.full((side, side), 80.0, np.float32)
    for top in range(20, side - 100, 140):
        for left in range(20, side - 100, 140):
            tone = rng.normal(150.0, 25.0)
            high, wide = rng.integers(75, 110, 2)
            y, x = np.array([top, left]) + rng.integers(0, 15, 2)
            out[y : y + high // 2, x : x + wide] = tone
            out[y + high // 2 : y + high, x : x + wide] = 0.6 * tone
    grain = ndimage.gaussian_filter(rng.standard_normal(out.shape).astype(np.float32), 3.0)
    return np.clip(out + 5.0 / grain.std() * grain, 0.0, 255.0).astype(np.float32)


def looked_for(template: NDArray, window: NDArray, settings: MatchSettings) -> Located | NotLocated:
    middle = (np.array(template.shape[::-1]) - 1.0) / 2.0
    here = MARGIN, MARGIN
    return locate(template, template > 0.0, window, window > 0.0, here, MARGIN, middle, settings)


def pair_of(half: NDArray, seed: int) -> Pair:
    return make_pair(half, np.random.default_rng(seed), size_px=64, margin_px=MARGIN, condition="clean")


def test_look_alikes_of_an_estate_are_told_apart_by_how_well_they_can_be_placed():
    one, two = np.array_split(estate(np.random.default_rng(3), 1200), 2)
    for here, there in ((7, 20), (14, 14), (20, 6)):
        template, window = pair_of(one, here).template, pair_of(two, there).window
        assert isinstance(looked_for(template, window, TRUSTING), Located)  # all else speaks for it
        outcome = looked_for(template, window, SETTINGS)
        assert isinstance(outcome, NotLocated)
        assert "things alike" in outcome.reason
        right = looked_for(template, pair_of(one, here).window, SETTINGS)
        assert isinstance(right, Located)
        # 0.05 px is asked for where things are alike; the very same houses leave noise alone, 0.01 px
        assert np.sqrt(right.placement.cov_px.max()) < 0.02


def test_picture_is_like_itself_where_it_holds_things_of_one_kind(invented: NDArray):
    every = np.ones((128, 128), dtype=bool)
    houses = estate(np.random.default_rng(5), 700)[::4, ::4][:128, :128]
    ground = np.ascontiguousarray(invented[:512:4, :512:4])
    assert likeness_to_itself(normalised(np.ascontiguousarray(houses), every)) > 0.5
    assert likeness_to_itself(normalised(ground, every)) < 0.4
    tile = ground[:32, :32]
    assert likeness_to_itself(normalised(np.tile(tile, (4, 4)), every)) > 0.95  # a copy, but for its frame
