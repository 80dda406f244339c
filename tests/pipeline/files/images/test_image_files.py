"""Images of every permitted kind come out as the same counts; damaged ones are complaints, never pictures."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import tifffile
from astropy.io import fits
from handmade import write_strip
from PIL import Image
from pyproj import Transformer
from rasters import write_raster

import boresight as bs
from boresight.features.sky_images.image_time import time_of_image, with_error_of_focus
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files import content
from boresight.pipeline.files.images import image_file
from boresight.pipeline.files.images.rasters import grid_place
from boresight.pipeline.files.images.star_images import read_exposure, read_star_image

WIDTH, HEIGHT = 48, 40


def counts(bits: int) -> np.ndarray:
    rng = np.random.default_rng(bits)
    return rng.integers(0, 2**bits, (HEIGHT, WIDTH)).astype(np.uint8 if bits <= 8 else np.uint16)


def write(path: Path, image: np.ndarray) -> None:
    """PNG, TIFF or FITS by the file's ending; FITS holds 16 bits with the usual BZERO."""
    if path.suffix == ".fits":
        fits.PrimaryHDU(image).writeto(path)
    elif path.suffix == ".tif":
        write_strip(path, image)
    else:
        assert cv2.imwrite(str(path), image)


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("suffix", [".png", ".tif", ".fits"])
def test_counts_are_those_that_were_written_whatever_the_format(suffix, bits, tmp_path):
    path, image = tmp_path / f"e{suffix}", counts(bits)
    write(path, image)
    read = read_exposure(path, "e", width=WIDTH, height=HEIGHT, bit_depth=bits)
    assert read.dtype == image.dtype
    assert np.array_equal(read, image)
    assert np.array_equal(read_star_image(path, "e"), image)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".fits"])
def test_an_exposure_is_read_from_the_disk_once(suffix, tmp_path, monkeypatch):
    path, opened = tmp_path / f"e{suffix}", []
    write(path, counts(8))
    for module in (content, image_file):
        monkeypatch.setattr(module, "open_regular", lambda path: opened.append(path) or path.open("rb"))
    read_exposure(path, "e", width=WIDTH, height=HEIGHT, bit_depth=8)
    assert opened == [path]


@pytest.mark.parametrize("suffix", [".png", ".tif", ".fits"])
def test_another_size_or_depth_is_told_from_the_header(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"e{suffix}"
    write(path, counts(8))
    with pytest.raises(RawDataError, match="image size: found 48 x 40 px, expected 47 x 40 px"):
        read_exposure(path, "e", width=47, height=HEIGHT, bit_depth=8)
    with pytest.raises(RawDataError, match="bit depth: found 8 bits, expected 16 bits a pixel"):
        read_exposure(path, "e", width=WIDTH, height=HEIGHT, bit_depth=12)


def test_more_bits_than_stated_are_told(tmp_path: Path) -> None:
    write(tmp_path / "e.png", counts(16))
    with pytest.raises(RawDataError, match=r"pixels: found a value of .*, expected values of 12 bits"):
        read_exposure(tmp_path / "e.png", "e", width=WIDTH, height=HEIGHT, bit_depth=12)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".fits"])
def test_file_cut_anywhere_is_a_complaint_and_never_a_picture(suffix: str, tmp_path: Path) -> None:
    whole, cut = tmp_path / f"e{suffix}", tmp_path / f"cut{suffix}"
    write(whole, counts(16))
    raw = whole.read_bytes()
    # FITS is padded to blocks of 2880 bytes: what is cut from the padding is no loss.
    needed = (
        raw.index(b"END" + b" " * 77) // 2880 * 2880 + 2880 + WIDTH * HEIGHT * 2
        if suffix == ".fits"
        else len(raw)
    )
    for length in np.linspace(0, needed - 1, 25).astype(int):
        cut.write_bytes(raw[:length])
        try:
            read = read_exposure(cut, "e", width=WIDTH, height=HEIGHT, bit_depth=16)
        except RawDataError as error:
            assert error.file == "e"
        else:  # TIFF may keep its directory in front and lose nothing but a trailing byte
            assert np.array_equal(read, counts(16)), length


def test_a_picture_of_the_sky_is_read_from_any_format_with_one_plane_or_colours(tmp_path: Path) -> None:
    grey = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    colours = np.stack([grey, 2 * grey, 3 * grey])  # red, green, blue
    expected = 0.299 * grey + 2 * 0.587 * grey + 3 * 0.114 * grey
    real = grey.astype(np.float32) / 7.0
    holes = real.copy()
    holes[3, 5] = np.nan
    tifffile.imwrite(tmp_path / "float.tif", real)
    tifffile.imwrite(tmp_path / "rgb.tif", np.moveaxis(colours, 0, 2), photometric="rgb")
    tifffile.imwrite(tmp_path / "planes.tif", colours, photometric="rgb", planarconfig="separate")
    fits.PrimaryHDU(real).writeto(tmp_path / "float.fits")
    fits.PrimaryHDU(colours).writeto(tmp_path / "cube.fits")
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(real)]).writeto(tmp_path / "second.fits")
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(grey)]).writeto(tmp_path / "packed.fits")
    np.save(tmp_path / "float.npy", real.astype(np.float64))
    np.save(tmp_path / "rgb.npy", np.moveaxis(colours, 0, 2))
    np.save(tmp_path / "holes.npy", holes)
    cv2.imwrite(str(tmp_path / "grey.pgm"), grey)
    cv2.imwrite(str(tmp_path / "grey.jp2"), grey)
    for path in sorted(tmp_path.iterdir()):
        read = read_star_image(path, path.name).astype(float)
        if path.stem in ("rgb", "planes", "cube"):
            assert np.abs(read - expected).max() <= 0.51, path.name  # DN: rounded
        elif path.stem in ("packed", "grey"):
            assert np.array_equal(read, grey), path.name
        elif path.stem == "holes":
            assert read[3, 5] == np.median(real[np.isfinite(holes)])
        else:
            assert np.array_equal(read, real.astype(float)), path.name


def test_arrays_that_are_no_picture_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((7, 48, 64)))
    with pytest.raises(RawDataError, match=r"shape \(64, 7, 48\)"):
        read_star_image(tmp_path / "a.npy", "a.npy")
    np.save(tmp_path / "b.npy", np.array([[{}]], dtype=object), allow_pickle=True)
    with pytest.raises(RawDataError, match="without objects"):
        read_star_image(tmp_path / "b.npy", "b.npy")
    np.save(tmp_path / "c.npy", np.full((48, 64), np.nan))
    with pytest.raises(RawDataError, match="at least one"):
        read_star_image(tmp_path / "c.npy", "c.npy")


def test_the_time_of_an_image_is_that_of_its_header(tmp_path: Path) -> None:
    def of(**cards: str | float) -> str | None:
        unit = fits.PrimaryHDU(np.zeros((4, 4), np.uint8))
        unit.header.update({key.replace("_", "-"): value for key, value in cards.items()})
        unit.writeto(tmp_path / "a.fits", overwrite=True)
        return time_of_image(tmp_path / "a.fits")

    assert of(DATE_OBS="2021-05-03T23:59:50", EXPTIME=40.0) == "2021-05-04T00:00:10.000000Z"
    assert of(DATE_OBS="2021-05-03T23:59:50", DATE_AVG="2021-05-04") == "2021-05-04T12:00:00.000000Z"
    assert of() is None and of(DATE_OBS="yesterday") is None and of(DATE_OBS="1970-01-01") is None
    assert of(DATE_OBS="2021-05-03T00:00:00", TIMESYS="TDB") is None
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x9003: "2020:07:04 01:30:00", 0x9011: "+02:00", 0x829A: 30.0})
    Image.new("L", (40, 40)).save(tmp_path / "a.jpg", exif=exif)
    assert time_of_image(tmp_path / "a.jpg") == "2020-07-03T23:30:15.000000Z"
    (tmp_path / "b.jpg").write_bytes((tmp_path / "a.jpg").read_bytes()[:60])
    assert time_of_image(tmp_path / "b.jpg") is None


def test_the_field_of_a_named_lens_has_the_error_of_its_focus(tmp_path: Path) -> None:
    found = bs.identify(bs.example("mini") / "exposures/e0001.png", fov_deg=20.0).field

    def relative(f_number: float, focal_mm: float) -> float:
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x829D: f_number, 0x920A: focal_mm})
        Image.new("L", (40, 40)).save(tmp_path / "a.jpg", exif=exif)
        wider = with_error_of_focus(found, tmp_path / "a.jpg")
        return np.sqrt(wider.fov_x_sigma_rad**2 - found.fov_x_sigma_rad**2) / found.fov_x_rad

    # Rayleigh's quarter of a wave of 0.55 um at f/2: 4.4 um to either side, evenly
    assert relative(2.0, 3.04) == pytest.approx(4.4e-3 / 3.04 / np.sqrt(3.0), rel=1e-6)
    assert relative(1.9, 35.0) == pytest.approx(65.5e-6, rel=1e-2)
    for nothing in ((0.0, 3.04), (2.0, 0.0)):  # as cameras write that they do not know
        assert relative(*nothing) == 0.0
    assert with_error_of_focus(found, tmp_path / "none.jpg") is found


def test_the_place_of_a_raster_is_that_of_its_corners_and_middle(tmp_path: Path) -> None:
    transform = rasterio.Affine(20.0, 3.0, 305_000.0, 2.0, -30.0, 5_200_000.0)  # turned and unequal
    write_raster(tmp_path / "a.tif", np.zeros((40, 70), np.uint8), crs="EPSG:32719", transform=transform)
    place = grid_place(tmp_path / "a.tif", "a.tif")
    east, north = 305_000.0 + 35 * 20.0 + 20 * 3.0, 5_200_000.0 + 35 * 2.0 - 20 * 30.0
    lon, lat = Transformer.from_crs(32719, 4326, always_xy=True).transform(east, north)
    assert place.middle_deg == pytest.approx((lat, lon), abs=1e-9)
    inside = [(1.0, 1.0), (69.0, 39.0), (35.0, 20.0)]
    outside = [(-1.0, 20.0), (71.0, 20.0), (35.0, -1.0), (35.0, 41.0)]
    there = [tuple(transform @ pixel) for pixel in (*inside, *outside)]
    lon, lat = Transformer.from_crs(32719, 4326, always_xy=True).transform(*np.transpose(there))
    assert place.contains(np.column_stack([lat, lon])).tolist() == [True] * 3 + [False] * 4
