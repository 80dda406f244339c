"""Images of stars by an empirical PSF, beside SciPy's interpolation of the same spline."""

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter

from boresight.star_id.finding.psf import FINE, psf_images, shape_images

RADIUS = 9


def test_images_and_slopes_are_those_of_the_spline():
    half = RADIUS * FINE + FINE // 2
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    shape = spline_filter(np.exp(-0.5 * ((x / 3.0) ** 2 + (y / 3.4) ** 2 + 0.02 * x * y)), order=3)
    offset = np.random.default_rng(1).uniform(-1.5, 1.5, (200, 2))
    found = shape_images(shape, offset, RADIUS)
    grid = np.arange(-RADIUS, RADIUS + 1.0)

    def by_scipy(move_x, move_y):
        images = []
        for x0, y0 in np.add(offset, (move_x, move_y)):
            at = np.broadcast_arrays((grid[:, None] - y0) * FINE + half, (grid - x0) * FINE + half)
            images.append(map_coordinates(shape, at, order=3, prefilter=False, mode="constant").ravel())
        return np.array(images)

    # peaks are 1: single precision
    assert np.abs(found.value - by_scipy(0.0, 0.0)).max() < 1e-6
    step = 1e-4  # px; the difference is wrong by its third derivative times step^2 / 6
    for slope, move in ((found.d_x, (step, 0.0)), (found.d_y, (0.0, step))):
        difference = (by_scipy(*move) - by_scipy(-move[0], -move[1])) / (2.0 * step)
        assert np.abs(slope - difference).max() < 2e-6


def test_no_star_gives_no_image():
    shape = np.zeros((2 * FINE * RADIUS + 3, 2 * FINE * RADIUS + 3))
    assert shape_images(shape, np.empty((0, 2)), RADIUS).columns.shape == (0, 4, (2 * RADIUS + 1) ** 2)


def test_nodes_of_a_smear_are_computed_once(monkeypatch):
    """They were a fifth of the time of a tracked frame with trails."""
    original, counts = np.polynomial.legendre.leggauss, []
    monkeypatch.setattr(np.polynomial.legendre, "leggauss", lambda n: counts.append(n) or original(n))
    offsets, sigma = np.zeros((3, 2)), np.full(3, 1.37)
    first, again = (psf_images(offsets, sigma, (11.3, 5.1), 12) for _ in range(2))
    assert len(counts) <= 1  # none, where another test has asked for as many
    assert np.array_equal(first.value, again.value)
