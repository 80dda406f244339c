"""Images of every permitted kind come out as the same counts; damaged ones are complaints, never pictures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from astropy.io import fits
from handmade import write_strip
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.image_files import read_grid
from boresight.pipeline.files.star_images import read_exposure, read_star_image

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
def test_counts_are_those_that_were_written_whatever_the_format(
    suffix: str, bits: int, tmp_path: Path
) -> None:
    path, image = tmp_path / f"e{suffix}", counts(bits)
    write(path, image)
    read = read_exposure(path, "e", width=WIDTH, height=HEIGHT, bit_depth=bits)
    assert read.dtype == image.dtype
    assert np.array_equal(read, image)
    assert np.array_equal(read_star_image(path, "e"), image)


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


def test_jpeg_and_bitmap_are_read_for_identify_only(tmp_path: Path) -> None:
    smooth = cv2.GaussianBlur(counts(8), (0, 0), 3)
    for suffix, tolerance in ((".jpg", 12), (".bmp", 0)):  # grey values; JPEG loses some
        path = tmp_path / f"e{suffix}"
        assert cv2.imwrite(str(path), cv2.cvtColor(smooth, cv2.COLOR_GRAY2BGR))
        assert np.abs(read_star_image(path, "e").astype(int) - smooth).max() <= tolerance
        with pytest.raises(RawDataError, match="expected a PNG, TIFF or FITS image"):
            read_exposure(path, "e", width=WIDTH, height=HEIGHT, bit_depth=8)


@seed(20261120)
@settings(
    max_examples=150,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    suffix=st.sampled_from([".png", ".tif", ".fits", ".jpg", ".bmp"]),
    places=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=12),
    keep=st.floats(0.2, 1.0),
)
def test_bytes_changed_at_random_give_a_picture_or_a_complaint(
    suffix: str, places: list[tuple[float, int]], keep: float, tmp_path: Path
) -> None:
    path, damaged = tmp_path / f"whole{suffix}", tmp_path / f"damaged{suffix}"
    if not path.exists():
        write(path, counts(8)) if suffix in (".png", ".tif", ".fits") else cv2.imwrite(str(path), counts(8))
    raw = bytearray(path.read_bytes())
    for place, value in places:
        raw[int(place * (len(raw) - 1))] = value
    damaged.write_bytes(bytes(raw[: int(keep * len(raw)) + 1]))
    for read in (
        lambda: read_exposure(damaged, "e", width=WIDTH, height=HEIGHT, bit_depth=8),
        lambda: read_star_image(damaged, "e"),
        lambda: read_grid(damaged, "e", max_pixels=10**6),
    ):
        try:
            read()
        except RawDataError as error:
            assert error.file == "e"
