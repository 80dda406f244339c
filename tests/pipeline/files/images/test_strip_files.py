"""Windows and bands of a strip's image hold the pixels of its file; damaged tiles are errors."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.windows import Window

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.images.tiff import StripFiles

WINDOWS = [(0, 0, 90, 70), (0, 69, 90, 1), (17, 31, 2, 3), (32, 32, 32, 32), (89, 0, 1, 70)]
SHAPE = (70, 90)  # neither side is a multiple of the tiles' 16 or 32


def image_of(kind: str) -> NDArray[Any]:
    """A strip with smooth and rough parts, so that differences wrap around both ways."""
    rng = np.random.default_rng(5)
    top = np.iinfo(kind).max
    image = (top * (0.5 + 0.5 * np.sin(np.arange(90) / 7.0)) * np.ones(SHAPE)).astype(kind)
    image[20:50, 30:60] = rng.integers(0, top, (30, 30), endpoint=True)
    return image


def written(path: Path, *, kind: str = "uint8", **form: Any) -> Path:
    """That strip as a tiled TIFF."""
    profile = {"tiled": True, "blockxsize": 32, "blockysize": 16, "compress": "deflate"} | form
    with rasterio.open(
        path, "w", driver="GTiff", width=90, height=70, count=1, dtype=kind, **profile
    ) as file:
        file.write(image_of(kind), 1)
    return path


@pytest.mark.parametrize("predictor", [1, 2])
@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_every_window_holds_the_pixels_that_were_written(kind: str, predictor: int, tmp_path: Path) -> None:
    path = written(tmp_path / "s.tif", kind=kind, predictor=predictor)
    strip = StripFiles({0: path}, {0: "s.tif"}, {0: SHAPE})
    for column, row, width, height in WINDOWS:
        pixels = strip.read(0, row, row + height, column, column + width)
        assert pixels.dtype == kind
        assert np.array_equal(pixels, image_of(kind)[row : row + height, column : column + width])


@pytest.mark.parametrize("form", [{}, {"compress": "zstd"}], ids=str)
def test_bands_begin_with_rows_of_tiles(form: dict[str, Any], tmp_path: Path) -> None:
    path = written(tmp_path / "s.tif", predictor=2, **form)
    strip = StripFiles(paths={0: path}, names={0: "s.tif"}, shapes={0: SHAPE})
    found = strip.read_bands(0, 4, 40)
    assert found is not None
    whole = strip.read(0, 0, 70, 0, 90)
    assert found[1] == 32  # two rows of tiles
    assert np.array_equal(found[0], np.concatenate([whole[top : top + 4] for top in (0, 32, 64)]))
    assert strip.read_bands(0, 4, 15) is None  # tiles have 16 lines


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_damaged_tile_is_an_error_and_a_missing_one_black(tmp_path: Path) -> None:
    path = written(tmp_path / "s.tif", predictor=2)
    with rasterio.open(path) as image:
        offset = int(image.get_tag_item("BLOCK_OFFSET_1_2", "TIFF", 1))
    strip = StripFiles({0: path}, {0: "s.tif"}, {0: SHAPE})
    assert strip.read(0, 30, 50, 30, 60).any()
    raw = bytearray(path.read_bytes())
    raw[offset : offset + 12] = b"\xff" * 12
    path.write_bytes(raw)
    assert strip.read(0, 0, 30, 0, 90).any()  # other tiles are sound
    with pytest.raises(RawDataError, match=r"s.tif: rows 30..49: found .* expected pixels that decode"):
        strip.read(0, 30, 50, 30, 60)
    sparse = tmp_path / "sparse.tif"
    form = {"tiled": True, "blockxsize": 32, "blockysize": 16, "compress": "deflate", "sparse_ok": True}
    with rasterio.open(
        sparse, "w", driver="GTiff", width=90, height=70, count=1, dtype="uint8", **form
    ) as file:
        file.write(np.full((16, 32), 7, np.uint8), 1, window=Window(32, 16, 32, 16))
    pixels = StripFiles({0: sparse}, {0: "s"}, {0: SHAPE}).read(0, 0, 70, 0, 90)
    assert pixels.sum() == 7 * 16 * 32 and (pixels[16:32, 32:64] == 7).all()
