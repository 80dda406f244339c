"""Noise of compressed and processed images: few false stars, and places as accurate as stated. Pillow
compresses."""

import io

import cv2
import numpy as np
import pytest
from frames import Sensor, render
from PIL import Image
from scipy.spatial import cKDTree

from boresight.star_id.finding.background import estimate_background
from boresight.star_id.finding.correlated_noise import as_independent_noise
from boresight.star_id.finding.star_list import list_stars
from boresight.star_id.settings import StarSettings

SIZE = 900
NOISE_DN = 2.9
SENSOR = Sensor(bits=16, e_per_dn=4.0, background_dn=40.0, read_noise_dn=NOISE_DN)


def frame(rng, stars=120, background_dn=SENSOR.background_dn):
    """Image of 8 bits with stars of SNR 15 to 100 at least 28 px apart, and their places."""
    xy = rng.uniform(25, SIZE - 26, (4 * stars, 2))
    keep = np.ones(len(xy), dtype=bool)
    for a, b in cKDTree(xy).query_pairs(28.0):
        keep[max(a, b)] &= not keep[min(a, b)]
    xy = xy[keep][:stars]
    image = render(xy, rng.uniform(180.0, 1200.0, len(xy)), SIZE, SIZE, SENSOR, rng).astype(np.float64)
    return (image + background_dn - SENSOR.background_dn).clip(0, 255).round().astype(np.uint8), xy


def compressed(image, quality):
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=quality)
    return np.array(Image.open(file))


@pytest.mark.parametrize("quality", [90, 70, 40])
def test_jpeg_makes_no_stars_and_errors_are_as_stated(quality):
    image, xy = frame(np.random.default_rng(quality))
    stars = list_stars(compressed(image, quality), StarSettings())
    distance, nearest = cKDTree(stars.xy_px).query(xy)
    seen = distance < 2.0
    assert seen.mean() >= 0.95
    assert (cKDTree(xy).query(stars.xy_px)[0] > 3.0).sum() <= 5  # 20, 466 and 286 by the scatter of pixels
    error = stars.xy_px[nearest[seen]] - xy[seen]
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(stars.cov_px[nearest[seen]]), error) / 2.0
    assert 0.5 < chi2.mean() < 1.4  # 240 coordinates: 0.09; in six such frames 0.63 to 1.23


@pytest.mark.parametrize("cropped_px", [(0, 0), (3, 5), (7, 1)])
def test_rounding_of_blocks_with_stars_is_by_the_step_of_the_files_own_table(cropped_px):
    image, _ = frame(np.random.default_rng(4))
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=40)
    step = Image.open(file).quantization[0][0]  # of the mean of a block, times 8
    rows, columns = cropped_px
    found = list_stars(np.array(Image.open(file))[rows:, columns:], StarSettings()).background.rounding_dn
    # means of blocks of whole counts: to 0.04 DN of 2.5
    assert found == pytest.approx(step / np.sqrt(12.0), rel=0.02)
    assert list_stars(image, StarSettings()).background.rounding_dn == 0.0


def test_noise_of_a_smoothed_image_is_that_of_its_filtered_image():
    """White noise of s smoothed by a Gaussian of width a and filtered by one of width b has the standard
    deviation s / sqrt(4 pi (a^2 + b^2)), 1 / sqrt(4 pi b^2) of it for independent pixels."""
    rng = np.random.default_rng(1)
    a, b = 1.0, 1.2
    image = cv2.GaussianBlur(rng.normal(100.0, 10.0, (SIZE, SIZE)).astype(np.float32), (0, 0), a)
    found = as_independent_noise(image, estimate_background(image))
    expected = 10.0 * b / np.hypot(a, b)
    assert abs(np.median(found.noise_dn) / expected - 1.0) < 0.06  # quartile of 16 tiles: 0.03


def test_independent_noise_is_left_as_it_is():
    image, _ = frame(np.random.default_rng(2))
    background = estimate_background(image)
    assert as_independent_noise(image, background) is background


def test_a_sky_that_is_cut_off_is_left_as_it_is():
    image, _ = frame(np.random.default_rng(3), background_dn=1.0)
    image = compressed(image, 70)
    background = estimate_background(image)
    assert as_independent_noise(image, background) is background
