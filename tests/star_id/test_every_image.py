"""No image makes the finding of stars raise, and its unit makes no difference."""

import numpy as np
import pytest
from frames import PLACES, SMALL_CAMERA, Sensor, star_frame
from scipy.spatial.transform import Rotation

from boresight.star_id.finding.star_list import list_stars
from boresight.star_id.settings import StarSettings

SIZES = [(32, 33), (47, 200), (1500, 32), (101, 99)]
LOOKS = {
    "noise": lambda y, x, noise: 40.0 + 3.0 * noise,
    "nothing": lambda y, x, noise: 0.0 * noise,
    "full": lambda y, x, noise: 255.0 + 0.0 * noise,
    "gradient": lambda y, x, noise: 200.0 * x / x.max() + 3.0 * noise,
    "mosaic": lambda y, x, noise: (30.0 + 20.0 * (y % 2) + 45.0 * (x % 2)) + 2.0 * noise,
    "steep mosaic": lambda y, x, noise: (
        (1.0 + y % 2 + 2.0 * (x % 2)) * (5.0 + 50.0 * (x / x.max()) ** 4) + noise
    ),
    "cut off": lambda y, x, noise: 4.0 * noise,
    "edge": lambda y, x, noise: 20.0 + 200.0 * (x > 0.4 * x.max()) + noise,
    "blocks": lambda y, x, noise: 13.0 + 3.0 * ((y // 8 * 7 + x // 8 * 3) % 11 == 0),
    "hot pixels": lambda y, x, noise: 20.0 + 2.0 * noise + 200.0 * (noise > 2.8),
}


@pytest.mark.parametrize("look", LOOKS)
def test_no_image_raises(look):
    rng = np.random.default_rng(len(look))
    for size in SIZES:
        y, x = np.mgrid[: size[0], : size[1]].astype(np.float64)
        image = LOOKS[look](y, x, rng.normal(size=size))
        whole = image.clip(0, 255).round()
        counts = whole.astype(np.uint8), (256.0 * whole).astype(np.uint16)
        for pixels in (*counts, image, image.astype(np.float32)):
            stars = list_stars(pixels, StarSettings())
            assert np.isfinite(stars.xy_px).all() and np.isfinite(stars.cov_px).all()
            assert not len(stars.xy_px) or np.ptp(image) > 0.0  # one value has no stars


def frame(sensor):
    rng = np.random.default_rng(6)
    return star_frame(SMALL_CAMERA, Rotation.random(random_state=rng), PLACES, sensor, rng)[0]


@pytest.mark.parametrize("unit", [1e-12, 1.0 / 65535.0, 7.3, 1e12])
@pytest.mark.parametrize("counted", [True, False])
def test_the_same_stars_are_found_in_whatever_unit_and_above_whatever_offset(unit, counted):
    image = frame(Sensor()).astype(np.float64)
    if not counted:
        image += np.random.default_rng(2).uniform(-0.5, 0.5, image.shape)
    here = list_stars(image, StarSettings())
    there = list_stars(unit * (image - 300.0), StarSettings())
    # single precision after the change of unit: a rounding, 1e-4 of a pixel's noise
    np.testing.assert_allclose(there.xy_px, here.xy_px, rtol=0.0, atol=1e-3 * np.sqrt(here.cov_px.max()))
    np.testing.assert_allclose(there.flux_dn, unit * here.flux_dn, rtol=1e-3, atol=0.0)
    np.testing.assert_allclose(
        there.background.level_dn,
        unit * (here.background.level_dn - 300.0),
        rtol=0.0,
        atol=1e-3 * 300.0 * unit,
    )


def test_counts_of_12_bits_in_16_are_found_as_counts():
    image = np.minimum(16 * frame(Sensor(bits=16)).clip(0, 4095).astype(np.uint32), 65535).astype(np.uint16)
    here, there = list_stars(image, StarSettings()), list_stars(image // 16, StarSettings())
    assert len(here.xy_px) == len(there.xy_px) > 20
    np.testing.assert_allclose(here.xy_px, there.xy_px, rtol=0.0, atol=1e-6)
