"""PNG files written here, as OpenCV and rasterio (libpng) read them."""

import cv2
import numpy as np
import pytest
import rasterio

from boresight.pipeline.files.images.png import png_of_noise


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize(
    ("dtype", "shape"), [(np.uint8, (37, 61)), (np.uint16, (1, 300)), (np.uint8, (4000, 3000))]
)
def test_every_pixel_is_read_back(dtype, shape, tmp_path):
    image = np.random.default_rng(3).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
    (tmp_path / "x.png").write_bytes(png_of_noise(image))
    for read in (
        cv2.imread(str(tmp_path / "x.png"), cv2.IMREAD_UNCHANGED),
        rasterio.open(tmp_path / "x.png").read(1),
    ):
        assert read.dtype == dtype and np.array_equal(read, image)
