"""Places of stars in JPEG images whose steps are wider than the noise. Pillow compresses, and states the
steps."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree
from test_correlated_noise import NOISE_DN, SIZE, frame

from boresight.star_id.finding import rounded_blocks, star_list
from boresight.star_id.finding.rounded_blocks import places_in_rounded_blocks
from boresight.star_id.finding.star_list import list_stars
from boresight.star_id.settings import StarSettings


def compressed(image, quality):
    """The decoded image and the (8, 8) steps of its file."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=quality)
    opened = Image.open(file)
    return np.array(opened), np.array(opened.quantization[0], dtype=float).reshape(8, 8)


def errors_of(stars, xy):
    """Mean squared error, px^2, and chi2 of a coordinate."""
    distance, nearest = cKDTree(stars.xy_px).query(xy)
    seen = distance < 2.0
    error = stars.xy_px[nearest[seen]] - xy[seen]
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(stars.cov_px[nearest[seen]]), error)
    return float((error**2).mean()), float(square.mean()) / 2.0


def places(image, stars):
    level, _ = stars.background.at(stars.xy_px)
    return places_in_rounded_blocks(image, stars.xy_px, stars.flux_dn, level, stars.psf, stars.gain_e_per_dn)


@pytest.mark.parametrize(("quality", "ratio"), [(60, 1.02), (40, 0.95), (30, 0.95)])
def test_stars_of_rounded_blocks_have_smaller_errors_that_are_as_stated(quality, ratio, monkeypatch):
    image, xy = frame(np.random.default_rng([quality, 5]))
    image, _ = compressed(image, quality)
    square, chi2 = errors_of(list_stars(image, StarSettings()), xy)
    monkeypatch.setattr(star_list, "places_in_rounded_blocks", lambda *_: None)
    by_pixels, _ = errors_of(list_stars(image, StarSettings()), xy)
    assert square < ratio * by_pixels  # the same stars; of quality 60 pixels are still as good
    assert 0.7 < chi2 < 1.4  # 240 coordinates: 0.09 of it is chance, three times that


@pytest.mark.parametrize("quality", [70, 40])
def test_steps_are_those_of_the_file_and_noise_is_that_before_the_compression(quality):
    image, _ = frame(np.random.default_rng([quality, 6]))
    image, expected = compressed(image, quality)
    side = SIZE // 8 * 8
    cut = image[:side, :side]
    blocks = rounded_blocks._cosines_of(cut.astype(np.float32) - 128.0)
    steps = rounded_blocks.rounding_steps(blocks, rounded_blocks._are_cut(cut))
    known = np.isfinite(steps)
    assert known.sum() >= 8 and np.array_equal(steps[known], expected[known])
    stars = list_stars(image, StarSettings())
    noise = rounded_blocks._noise_before(blocks, steps, stars.xy_px)
    # pixels were whole numbers before: 0.3 DN; some 100 coefficients that are not zero tell the noise to 3 %
    assert noise == pytest.approx(np.hypot(NOISE_DN, 12.0**-0.5), rel=0.05)


def test_pixels_are_measured_where_blocks_are_rounded_by_less_than_the_noise():
    image, _ = frame(np.random.default_rng(7))
    for pixels in (image, compressed(image, 95)[0]):
        assert places(pixels, list_stars(pixels, StarSettings())) is None
