"""Detection by an empirical PSF: worked through in bands of rows, as on the whole image."""

import tracemalloc

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, spline_filter

from boresight.star_id.finding.background import estimate_background
from boresight.star_id.finding.psf import FINE
from boresight.star_id.finding.shape import _blobs, detect_shape, estimate_shape, flat_image


def field(height: int, width: int) -> np.ndarray:
    """An image of defocused stars, one every 60 px, also where bands of rows meet."""
    rng = np.random.default_rng(11)
    y, x = np.mgrid[0:height, 0:width]
    ring = np.abs(np.hypot((x + 7) % 60 - 30.0, (y + 14) % 60 - 30.0) - 5.0) < 1.5
    return rng.normal(200.0, 5.0, (height, width)) + 60.0 * gaussian_filter(ring.astype(float), 1.0)


def test_every_star_is_detected_once_across_the_borders_of_bands() -> None:
    image = field(1200, 600)  # bands meet at rows 256, 512, 768, 1024, stars lie at rows 16 + 60 k
    background = estimate_background(image)
    flat = flat_image(image, background)
    estimate = estimate_shape(image, flat, background, np.inf)
    assert estimate.stars >= 40  # of the 60 brightest
    xy = detect_shape(flat, estimate.shape, 20.0)
    assert len(xy) == 20 * 10
    assert np.abs((xy + np.array([7, 14])) % 60 - 30).max() <= 1


def test_peaks_in_bands_are_those_of_the_whole_image() -> None:
    # a kernel of one pixel: the filtered image is the image itself
    point = np.zeros((21 * FINE, 21 * FINE))
    point[len(point) // 2, len(point) // 2] = 1.0
    flat = np.random.default_rng(4).normal(size=(700, 300)).astype(np.float32)
    xy = detect_shape(flat, spline_filter(gaussian_filter(point, 0.05 * FINE), order=3), 2.5)
    highest = maximum_filter(flat, 5, mode="reflect")
    rows = np.unique(xy[:, 1])
    assert {255, 256, 511, 512} & set(rows.tolist())  # the last and first rows of bands are no exception
    alone = (flat == highest) & (flat > 2.5)
    assert set(map(tuple, xy[:, ::-1].tolist())) <= set(map(tuple, np.argwhere(alone).tolist()))


def test_memory_is_some_pictures_in_single_precision() -> None:
    image = field(1536, 1536).astype(np.uint8)
    background = estimate_background(image)
    tracemalloc.start()
    flat = flat_image(image, background)
    estimate = estimate_shape(image, flat, background, 255.0)
    detect_shape(flat, estimate.shape, 20.0)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 3.6 * 4 * image.size  # three pictures at once, and bands of some more


def test_stars_with_a_saturated_pixel_at_most_two_from_their_middle_give_no_shape() -> None:
    # 7 x 7 stars, each with one saturated pixel, from three to the left and above to three right and below
    offset = np.stack(np.meshgrid(np.arange(-3, 4), np.arange(-3, 4)), axis=-1).reshape(-1, 2)
    middle = np.array([230, 160]) + [60, 40] * offset
    impulse = np.zeros((320, 460))
    impulse[middle[:, 1], middle[:, 0]] = 1.0
    flat = 2000.0 * gaussian_filter(impulse, 1.5).astype(np.float32)
    image = np.zeros(flat.shape)
    image[middle[:, 1] + offset[:, 1], middle[:, 0] + offset[:, 0]] = 255.0
    found, _ = _blobs(image, flat, 255.0)
    expected = middle[np.abs(offset).max(axis=1) == 3]
    assert set(map(tuple, found.tolist())) == set(map(tuple, expected.tolist()))
