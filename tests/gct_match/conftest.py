"""Pictures and strips that several tests share, made once."""

from copy import deepcopy

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rendered_pairs import Pair, draw_view, load_picture, pair_of
from small_strip import Case, make_case, texture

THETA = np.array([0.003, 0.002, 0.001])  # the paper's matrix (28)


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    cv2.setNumThreads(1)


@pytest.fixture(scope="session")
def aerial() -> NDArray:
    """10 cm aerial picture of the real world."""
    try:
        return load_picture("neon_yell_b_10cm.png")
    except FileNotFoundError as missing:
        pytest.skip(f"real aerial picture is not here: {missing}")


@pytest.fixture(scope="session")
def invented() -> NDArray:
    return texture(np.random.default_rng(1), 1400)


@pytest.fixture(scope="session")
def aerial_pairs(aerial: NDArray) -> dict[tuple[str, int], list[Pair]]:
    return _pairs(aerial)


@pytest.fixture(scope="session")
def invented_pairs(invented: NDArray) -> dict[tuple[str, int], list[Pair]]:
    return _pairs(invented)


@pytest.fixture(scope="session")
def case() -> Case:
    """A strip that starts from the paper's deviation: hundreds of pixels at this scale."""
    return make_case(np.random.default_rng(3), THETA, 12)


def _pairs(picture: NDArray) -> dict[tuple[str, int], list[Pair]]:
    """24 pairs of each condition and size; a chip is rendered once and serves every condition."""
    pairs: dict[tuple[str, int], list[Pair]] = {
        (condition, size): [] for size in (128, 64) for condition in ("clean", "date", "affine")
    }
    for size in (128, 64):
        for k in range(24):
            rng = np.random.default_rng([size, k])
            view = draw_view(picture, rng, size_px=size, margin_px=16)
            for condition in ("clean", "date", "affine"):
                own = deepcopy(rng)
                pair = pair_of(view, picture, own, margin_px=16, condition=condition)
                pairs[condition, size].append(pair)
    return pairs
