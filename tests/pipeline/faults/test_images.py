"""Images that are missing, damaged, of another kind, or claim to be huge: exposure, strip, chip, terrain."""

import resource
import struct
from pathlib import Path

import numpy as np
import pytest
import rasterio
from astropy.io import fits
from handmade import write_chip, write_strip

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.images.rasters import read_grid
from boresight.pipeline.files.images.star_images import read_exposure, read_star_image
from boresight.pipeline.files.images.tiff import check_strip_file
from boresight.pipeline.files.terrain_files import TerrainFiles, surface_of


def exposure(path: Path) -> object:
    return read_exposure(path, "image", width=64, height=48, bit_depth=8)


def strip(path: Path) -> object:
    return check_strip_file(path, "image", lines=200, samples=64, bit_depth=8)


def chip(path: Path) -> object:
    return read_grid(path, "image", max_pixels=4096 * 4096)


def terrain(path: Path) -> object:
    return surface_of(TerrainFiles(("image",), (path,), "ellipsoidal"))


READ = {one.__name__: one for one in (exposure, strip, chip, terrain)}


def sound(kind: str, path: Path) -> None:
    """A TIFF that is read without complaint."""
    rng = np.random.default_rng(2)
    if kind in ("exposure", "strip"):
        write_strip(path, rng.integers(0, 255, (48 if kind == "exposure" else 200, 64)).astype(np.uint8))
    else:
        write_chip(path, rng.integers(0, 255, (32, 32)).astype(np.uint8))


def claiming(path: Path, width: int, height: int, *, tile: int = 0, rows: int = 1) -> None:
    """A TIFF of some hundred bytes with a header that claims so many pixels, packed by deflate."""
    tags = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (259, 3, 1, 8), (262, 3, 1, 1)]
    if tile:
        tags += [(277, 3, 1, 1), (322, 4, 1, tile), (323, 4, 1, tile), (324, 4, 1, 8), (325, 4, 1, 100)]
    else:
        tags += [(273, 4, 1, 8), (277, 3, 1, 1), (278, 4, 1, rows), (279, 4, 1, 100)]
    head = struct.pack("<2sHI", b"II", 42, 8) + struct.pack("<H", len(tags))
    head += b"".join(struct.pack("<HHII", *tag) for tag in tags) + struct.pack("<I", 0)
    path.write_bytes(head + bytes(200))


@pytest.mark.parametrize("kind", READ)
@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda path: path.unlink(), "image: file: found no such file, expected an image"),
        (lambda path: path.write_bytes(b""), "image: byte 0: found an empty file, expected a .*TIFF"),
        (lambda path: path.write_bytes(path.read_bytes()[:6]),
            "image: TIFF header: found .* expected a TIFF"),
        (lambda path: path.write_bytes(path.read_bytes()[:-300]), "image: .*found .*, expected"),
        (lambda path: path.write_bytes(b"GIF89a" + bytes(99)), "image: byte 0: found 47 49 46"),
    ],
    ids=["missing", "zero length", "header cut", "pixels cut", "no TIFF"],
)  # fmt: skip
def test_image_that_cannot_be_read_is_named(kind: str, damage, says: str, tmp_path: Path) -> None:
    path = tmp_path / "image.tif"
    sound(kind, path)
    READ[kind](path)
    damage(path)
    with pytest.raises(RawDataError, match=says):
        READ[kind](path)


@pytest.mark.parametrize(
    ("kind", "shape", "dtype", "says"),
    [
        ("exposure", (47, 64), "uint8", "image size: found 64 x 47 px, expected 64 x 48 px"),
        ("exposure", (48, 64), "uint16", "bit depth: found 16 bits, expected 8 bits"),
        ("exposure", (48, 64), "float32", "bit depth: found float32, expected uint8 or uint16"),
        ("strip", (200, 65), "uint8", "image size: found 65 x 200 px, expected 64 x 200 px"),
        ("strip", (200, 64), "uint16", "bit depth: found 16 bits, expected 8 bits"),
        ("chip", (5000, 4000), "uint8", "image size: found 4000 x 5000 px, expected at most 16777216 px"),
        ("chip", (32, 32), "complex64", "bit depth: found complex64, expected 8 or 16 bits or floating"),
        ("terrain", (32, 32), "int32", "bit depth: found int32, expected 8 or 16 bits or floating point"),
        ("terrain", (1, 32), "int16", "heights: found terrain needs at least 2 x 2 heights"),
    ],
)
def test_image_of_another_size_or_depth_is_refused_with_both(kind, shape, dtype, says, tmp_path):
    path = tmp_path / "image.tif"
    (write_strip if kind in ("exposure", "strip") else write_chip)(path, np.ones(shape, dtype))
    with pytest.raises(RawDataError, match=says):
        READ[kind](path)


@pytest.mark.parametrize("kind", READ)
@pytest.mark.parametrize("layout", [{"tile": 256}, {"tile": 999_984}, {"rows": 1}, {"rows": 10**6}])
def test_tiff_that_claims_a_million_by_a_million_pixels_costs_nothing(kind, layout, tmp_path):
    path = tmp_path / "image.tif"
    claiming(path, 10**6, 10**6, **layout)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    says = r"image: (image size|tiles or strips): found 1000000 x 1000000|999984"
    with pytest.raises(RawDataError, match=says):
        READ[kind](path)
    # The reader's own libraries may be loaded here for the first time; an image would be a terabyte.
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 * 1024  # KiB


def test_huge_strip_is_read_by_window(tmp_path: Path) -> None:
    """65536 x 40000 px, 2.6 GB, of which nothing is stored: what is not looked at is not decoded."""
    path, before = tmp_path / "image.tif", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    profile = {"driver": "GTiff", "width": 65536, "height": 40_000, "count": 1, "dtype": "uint8"}
    with rasterio.open(path, "w", **profile, tiled=True, compress="deflate", sparse_ok=True):
        pass
    check_strip_file(path, "image", lines=40_000, samples=65536, bit_depth=8)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 * 1024  # KiB


def test_archive_in_the_place_of_an_image_is_not_unpacked(tmp_path: Path) -> None:
    import gzip
    import zipfile

    whole, packed, archive = (tmp_path / name for name in ("sky.fits", "sky.fits.gz", "sky.zip"))
    fits.PrimaryHDU(np.ones((48, 64), np.uint8)).writeto(whole)
    packed.write_bytes(gzip.compress(whole.read_bytes()))
    with zipfile.ZipFile(archive, "w") as file:
        file.write(whole, "sky.fits")
    exposure(whole)
    for path in (packed, archive):
        for read in (exposure, lambda path: read_star_image(path, "image"), strip, chip):
            with pytest.raises(RawDataError, match=r"byte 0: found (1f 8b|50 4b)"):
                read(path)


def test_map_of_a_grid_must_have_places_on_the_earth(tmp_path: Path) -> None:
    path = tmp_path / "image.tif"
    sound("chip", path)
    local = 'LOCAL_CS["site",UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]'
    with rasterio.open(path, "r+") as file:
        file.crs = rasterio.CRS.from_wkt(local)
    with pytest.raises(RawDataError, match=r"image: coordinate reference system: found .*, expected"):
        chip(path)


@pytest.mark.parametrize("kind", ["million", "missing", "zero"])
def test_terrain_that_cannot_be_used_stops_before_the_work_begins(kind: str, handmade: Path) -> None:
    head = (handmade / "dump.toml").read_text().replace('"targets.csv"', '"targets.csv"\nterrain = "dem.tif"')
    (handmade / "dump.toml").write_text(head + '\n[terrain]\nheight_kind = "egm96"\nsigma_m = 5\n')
    if kind == "million":
        claiming(handmade / "dem.tif", 10**6, 10**6, tile=256)
    elif kind == "zero":
        (handmade / "dem.tif").write_bytes(b"")
    with pytest.raises(RawDataError) as caught:
        open_dump(handmade)
    assert caught.value.file == "dem.tif"
