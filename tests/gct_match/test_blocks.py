"""What blocks of a template say of its displacement, beside a fit to its pixels."""

import numpy as np
import pytest
from numpy.typing import NDArray

from boresight.gct_match.refine.template_blocks import Blocks, blocks_of

SIDE = 128
MIDDLE = np.array([63.5, 63.5])
Y, X = np.mgrid[0:SIDE, 0:SIDE] - 63.5


def texture(seed: int) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Gradients, unit noise and weights of a template."""
    rng = np.random.default_rng(seed)
    gx, gy, noise = rng.standard_normal((3, SIDE, SIDE)).astype(np.float32)
    return gx, gy, noise, rng.uniform(0.2, 1.0, (SIDE, SIDE)).astype(np.float32)


def seen(P: NDArray, seed: int, noise_level: float) -> Blocks:
    gx, gy, noise, weight = texture(seed)
    dx, dy = (P[k, 0] * X + P[k, 1] * Y + P[k, 2] for k in (0, 1))
    shifted = (gx * dx + gy * dy + noise_level * noise).astype(np.float32)
    return blocks_of(gx, gy, shifted, weight, MIDDLE, 1.0)


def test_translation_is_that_of_all_pixels():
    P = np.array([[0.0, 0.0, 0.3], [0.0, 0.0, -0.2]])
    assert seen(P, 1, 0.0).displacement(affine=False) == pytest.approx(P, abs=1e-5)  # px, single precision


def test_affine_map_is_found_but_for_what_turns_within_a_block():
    P = np.array([[0.004, -0.003, 0.3], [0.002, 0.005, -0.2]])
    found = seen(P, 2, 0.0).displacement(affine=True)
    # a block of 16 px sees the mean lever arm: 16² / 128² of the information on the map is lost, and as much
    # of what it says of the rest is noise of the texture
    assert found[:, :2] == pytest.approx(P[:, :2], abs=4e-4)
    assert found[:, 2] == pytest.approx(P[:, 2], abs=2e-3)


def test_map_is_asked_for_only_where_there_is_one():
    still = np.zeros((2, 3))
    turned = np.array([[0.0, -2e-3, 0.0], [2e-3, 0.0, 0.0]])  # ten standard errors: noise 1, gradients 1
    assert all(seen(turned, seed, 1.0).show_affine(1.0) for seed in range(10))
    assert (
        sum(seen(still, seed, 1.0).show_affine(1.0) for seed in range(200)) <= 3
    )  # 0.1 % of 200; P(> 3) = 4e-5
    assert not seen(50.0 * turned, 0, 1.0).show_affine(1.0)  # no small map any more


def test_covariance_of_a_slanted_texture_is_slanted():
    # Edges along one diagonal: displacements along it are less certain than across, by 3 : 1.
    normalised, product, stated = [], [], []
    for seed in range(300):
        a, b, noise, weight = texture(seed)
        gx, gy = (a + 0.5 * b).astype(np.float32), (a - 0.5 * b).astype(np.float32)
        blocks = blocks_of(gx, gy, noise, weight, MIDDLE, 1.0)
        d, cov = blocks.displacement(affine=False)[:, 2], blocks.covariance(affine=False)
        normalised.append(d @ np.linalg.solve(cov, d) / 2.0)
        product.append(d[0] * d[1])
        stated.append(cov)
    mean = np.mean(stated, axis=0)
    # gradients (1, 1) and (0.5, -0.5): variances 1/2 and 2 along (1, 1) and (1, -1), correlation -0.6
    assert mean[0, 1] / np.sqrt(mean[0, 0] * mean[1, 1]) == pytest.approx(-0.6, abs=0.05)
    assert np.mean(product) == pytest.approx(mean[0, 1], rel=0.35)  # of 300 products: 11 % standard error
    assert np.mean(normalised) == pytest.approx(1.0, abs=0.25)  # 600 degrees of freedom: 6 % standard error
