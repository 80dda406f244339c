"""Images made to harm: exposures without a sky, animated and damaged files, packed FITS."""

import gzip
import io
import random
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from astropy.io import fits
from command_line import ran
from image_mutants import FORMATS, differs, mutated
from PIL import Image
from rasters import write_raster

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.images.png import png_rows
from boresight.pipeline.files.images.star_images import read_exposure, read_star_image
from boresight.pipeline.files.images.tiff import MOST_PIXELS_A_BYTE
from boresight.star_id.finding import star_shape
from boresight.star_id.finding.star_list import list_stars
from boresight.star_id.settings import StarSettings

SHAPE = (96, 128)
TOP = {np.uint8: 255, np.uint16: 65535, np.float32: 1.0}


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def saved(image: np.ndarray, kind: str = "PNG", **options: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, kind, **options)
    return stream.getvalue()


def skyless(dtype: type, top: float) -> dict[str, np.ndarray]:
    """Images in which no star can be found."""
    sky = np.clip(np.random.default_rng(3).normal(0.1, 0.02, SHAPE), 0, 1)
    checks = np.indices(SHAPE).sum(axis=0) % 2
    columns, half = (sky * top).astype(dtype), (sky * top).astype(dtype)
    columns[:, ::2], half[:, : SHAPE[1] // 2] = top, top
    flat = {"saturated": top, "all zero": 0.0, "one value": 0.4 * top}
    images = {name: np.full(SHAPE, value, dtype) for name, value in flat.items()}
    images["checkerboard"] = (checks * top).astype(dtype)
    images["two highest values"] = (top - checks * top / 255).astype(dtype)
    return images | {"saturated columns": columns, "half saturated": half}


@pytest.mark.parametrize("dtype", TOP)
def test_image_without_a_sky_has_no_star_and_ends_nothing(dtype: type) -> None:
    for name, image in skyless(dtype, TOP[dtype]).items():
        for saturation in (None, float(TOP[dtype])):
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                stars = list_stars(image, StarSettings(saturation_dn=saturation))
            assert len(stars.xy_px) == 0, name


def test_exposures_without_a_sky_are_left_out_by_name_with_what_they_show(tmp_path: Path) -> None:
    images = skyless(np.uint8, 255)
    for name, image in images.items():
        (tmp_path / f"{name}.png").write_bytes(saved(image))
    bright = np.full(SHAPE, 1e30, np.float32)
    bright[5, 5] = np.inf
    fits.PrimaryHDU(bright).writeto(tmp_path / "bright.fits")
    fits.PrimaryHDU(np.full(SHAPE, np.nan, np.float32)).writeto(tmp_path / "nan.fits")
    paths = sorted(tmp_path.iterdir())
    told = ran("identify", "--fov", 20, *paths, status=1)
    assert isinstance(told.exception, SystemExit), told.output
    lines = told.output.splitlines()
    reasons = {path.stem: line for path in paths for line in lines if line.startswith(f"{path} ")}
    assert "100 % of the pixels are saturated: Sun" in reasons["saturated"]
    assert "50 % of the pixels are saturated" in reasons["checkerboard"]
    assert "every pixel is 0: a closed shutter" in reasons["all zero"]
    assert "every pixel is 102" in reasons["one value"]
    assert "a value of 1e+30" in reasons["bright"]
    assert "none that is a number" in reasons["nan"]
    assert all("not identified" in line or "not read" in line for line in reasons.values())
    assert len(reasons) == len(paths) and "identified 0 of 9 images" in told.output


def test_animated_png_is_refused_by_name_before_it_is_decoded(tmp_path: Path) -> None:
    path, sound = tmp_path / "e.png", saved(skyless(np.uint8, 255)["half saturated"])
    animation = chunk(b"acTL", struct.pack(">II", 1, 0))
    control = chunk(b"fcTL", struct.pack(">IIIIIHHBB", 0, SHAPE[1], SHAPE[0], 0, 0, 1, 1, 0, 0))
    broken = chunk(b"fdAT", struct.pack(">I", 1) + b"no stream")
    end = sound.index(b"IDAT") - 4
    for content in (
        sound[:end] + animation + control + sound[end:],
        sound[:end] + animation + sound[end:-12] + control + broken + sound[-12:],
    ):
        path.write_bytes(content)
        for read in (
            lambda: read_star_image(path, "e.png"),
            lambda: read_exposure(path, "e.png", width=SHAPE[1], height=SHAPE[0], bit_depth=8),
        ):
            with pytest.raises(RawDataError, match=r"e.png: byte \d+: found an animated PNG \(acTL\)"):
                read()


def test_chunk_whose_name_is_none_is_refused(tmp_path: Path) -> None:
    path, sound = tmp_path / "e.png", saved(skyless(np.uint8, 255)["half saturated"])
    for name in (b"a\0cd", b"ab1d", b"\xe4bcd"):
        path.write_bytes(sound[:33] + chunk(name, b"x") + sound[33:])
        with pytest.raises(RawDataError, match=r"byte 37: found .*, expected the name of a chunk"):
            read_star_image(path, "e.png")


def test_window_that_is_too_small_for_its_stream_is_left_to_pillow() -> None:
    """A stream states how far back it refers. ISA-L takes every window for the largest."""
    image = np.tile(np.random.default_rng(5).integers(0, 255, (1, 127), np.uint8), (90, 1))
    rows = np.hstack([np.zeros((90, 1), np.uint8), image]).tobytes()
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 127, 90, 8, 0, 0, 0, 0))
    for bits, read in ((15, True), (14, True), (13, False), (9, False)):  # 11520 bytes; 2^14 = 16384
        stream = bytearray(zlib.compress(rows, 9))
        stream[0] = ((bits - 8) << 4) | 8
        stream[1] = 31 - (stream[0] << 8) % 31
        content = b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", bytes(stream)) + chunk(b"IEND", b"")
        assert (png_rows(content) is not None) == read, bits


@pytest.mark.parametrize("column", ["COMPRESSED_DATA", "GZIP_COMPRESSED_DATA"])
def test_fits_tiles_that_may_unpack_to_any_size_are_refused(column: str, tmp_path: Path) -> None:
    bomb = np.frombuffer(gzip.compress(bytes(2**20)), np.uint8)
    cells = [fits.Column(column, "1PB()", array=np.array([bomb], dtype=object))]
    table = fits.BinTableHDU.from_columns(cells)
    kind = "GZIP_1" if column == "COMPRESSED_DATA" else "RICE_1"
    cards = {"ZIMAGE": True, "ZCMPTYPE": kind, "ZBITPIX": 32, "ZNAXIS": 2, "ZNAXIS1": 64, "ZNAXIS2": 64}
    table.header.update(cards)
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(tmp_path / "e.fits")
    with pytest.raises(RawDataError, match=r"e.fits: (ZCMPTYPE|TTYPE): found (GZIP_1|GZIP_COMPRESSED_DATA)"):
        read_star_image(tmp_path / "e.fits", "e.fits")


def test_tiff_with_white_as_zero_is_refused(tmp_path: Path) -> None:
    import tifffile

    tifffile.imwrite(tmp_path / "e.tif", np.eye(40, dtype=np.uint8), photometric="miniswhite")
    with pytest.raises(RawDataError, match=r"PhotometricInterpretation: found 0, white is zero"):
        read_star_image(tmp_path / "e.tif", "e.tif")


def test_counts_of_a_pgm_are_not_scaled_and_stay_below_the_largest_value(tmp_path: Path) -> None:
    path, image = tmp_path / "e.pgm", np.random.default_rng(7).integers(0, 4096, (40, 50)).astype(">u2")
    path.write_bytes(b"P5\n# by hand\n50 40\n4095\n" + image.tobytes())
    assert np.array_equal(read_star_image(path, "e"), image)
    path.write_bytes(b"P5 50 40 100 " + bytes(1999) + b"\xff")
    with pytest.raises(RawDataError, match="found a value of 255, expected at most 100"):
        read_star_image(path, "e")
    path.write_bytes(b"P5 50 40 255 " + bytes(1999))
    with pytest.raises(RawDataError, match="found 1999 bytes, expected 2000 bytes"):
        read_star_image(path, "e")


@pytest.mark.parametrize("kind", FORMATS)
def test_damaged_image_is_refused_or_read_as_pillow_reads_it(kind: str, tmp_path: Path) -> None:
    rng, sound, path, read = random.Random(f"9 {kind}"), FORMATS[kind](), tmp_path / "image", 0
    for _ in range(40):
        content = mutated(rng.choice(sound), rng)
        path.write_bytes(content)
        try:
            image = read_star_image(path, "image")
        except RawDataError:
            continue
        read += 1
        assert not differs(image, content)
    assert read > 2


def test_tiff_of_thousands_of_bands_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "bands.tif"
    form = {"driver": "GTiff", "width": 2, "height": 2, "dtype": "uint8", "interleave": "pixel"}
    with rasterio.open(path, "w", count=5000, **form) as image:
        assert image.count == 5000
    with pytest.raises(RawDataError, match=r"SamplesPerPixel.*5000"):
        read_star_image(path, path.name)


@pytest.mark.parametrize(("side", "refused"), [(16_384, True), (8192, False)])
def test_tiff_of_some_kb_that_states_a_huge_image_is_refused_before_it_is_unpacked(side, refused, tmp_path):
    path = tmp_path / "sparse.tif"
    form = {"tiled": True, "blockxsize": 4096, "blockysize": 4096, "compress": "deflate", "sparse_ok": True}
    with rasterio.open(path, "w", driver="GTiff", width=side, height=side, count=1, dtype="uint8", **form):
        pass
    assert path.stat().st_size * MOST_PIXELS_A_BYTE < side**2
    if refused:
        with pytest.raises(RawDataError, match=f"file: found {path.stat().st_size} bytes"):
            read_star_image(path, path.name)
    else:  # a small one is read: a quarter of a second
        assert not read_star_image(path, path.name).any()


@pytest.mark.parametrize("form", [{}, {"tiled": True, "blockxsize": 16, "blockysize": 16}, {"predictor": 2}])
@pytest.mark.parametrize("fault", ["checksum", "end"])
def test_deflated_block_of_a_tiff_whose_end_is_damaged_is_refused(fault, form, tmp_path):
    """The last pixels of such a block are other ones by GDAL than by Pillow, without a word of either."""
    path, pixels = tmp_path / "sky.tif", np.random.default_rng(3).integers(0, 200, (40, 50), dtype=np.uint8)
    write_raster(path, pixels, compress="deflate", **form)
    exposure = {"width": 50, "height": 40, "bit_depth": 8}
    assert np.array_equal(read_star_image(path, "sky.tif"), pixels)
    assert np.array_equal(read_exposure(path, "sky.tif", **exposure), pixels)
    with rasterio.open(path) as image:
        start, size = (int(image.get_tag_item(f"BLOCK_{key}_0_0", "TIFF", 1)) for key in ("OFFSET", "SIZE"))
    content = bytearray(path.read_bytes())
    content[start + size - (1 if fault == "checksum" else 6)] ^= 0x55
    path.write_bytes(content)
    for read in (read_star_image, lambda *given: read_exposure(*given, **exposure)):
        with pytest.raises(RawDataError, match=r"sky.tif: (block 0_0|pixels)"):
            read(path, "sky.tif")


def test_text_pgm_and_ppm_are_read_and_bounded(tmp_path: Path) -> None:
    path, rng = tmp_path / "e.ppm", np.random.default_rng(8)
    grey, colours = rng.integers(0, 4096, (30, 40)), rng.integers(0, 256, (30, 40, 3))
    path.write_text("P2 # a comment\n40 30\n4095\n" + "\n".join(" ".join(map(str, row)) for row in grey))
    read = read_star_image(path, "e")
    assert read.dtype == np.uint16 and np.array_equal(read, grey)
    rows = [" ".join(map(str, row.ravel())) + "\n" for row in colours]
    path.write_text("P3\n40 30 255\n" + "# rows\n".join(rows))
    expected = colours @ np.array([0.299, 0.587, 0.114])  # ITU-R BT.601
    assert np.abs(read_star_image(path, "e") - expected).max() <= 0.51
    for text, said in (
        ("P2 3 2 255 1 2 3 4 5", "5 numbers, expected 6 numbers"),
        ("P2 3 2 255 1 2 3 4 5 x", "expected 6 numbers"),
        ("P2 3 2 255 1 2 3 4 5 -6", "a value of -6"),
        ("P2 3 2 255 1 2 3 4 5 256", "a value of 256, expected at most 255"),
        ("P2 3 2 255 1 2 3 4 5 99999999999999999999", "expected"),
        ("P2 3 2 255 " + "0 " * 600_000, "bytes, expected at most"),
    ):
        path.write_text(text)
        with pytest.raises(RawDataError, match=said):
            read_star_image(path, "e")


@pytest.mark.parametrize(("colour", "interlaced"), [(0, 1), (2, 0), (3, 0), (4, 0), (6, 1)])
def test_png_whose_stream_ends_before_its_last_row_is_refused(colour, interlaced, tmp_path):
    """Pillow fills what is missing with black, so that a file of 1 kB may state 50 million pixels."""
    modes = {0: "L", 2: "RGB", 3: "P", 4: "LA", 6: "RGBA"}
    width, height, samples = 13, 11, {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour]
    adam7 = "00 88 40 88 04 48 20 44 02 24 10 22 01 12".split()  # x, y and their steps (ISO/IEC 15948, 8.2)
    passes = [tuple(map(int, first + step)) for first, step in zip(adam7[::2], adam7[1::2])]
    rng, rows = np.random.default_rng(3), b""
    for x, y, dx, dy in passes if interlaced else [(0, 0, 1, 1)]:
        columns, lines = len(range(x, width, dx)), len(range(y, height, dy))
        for _ in range(lines if columns else 0):
            rows += b"\0" + rng.integers(0, 255, columns * samples, dtype=np.uint8).tobytes()
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, colour, 0, 0, interlaced))
    palette = chunk(b"PLTE", bytes(range(256)) * 3) if colour == 3 else b""
    path = tmp_path / "e.png"
    for missing in (0, 1, len(rows) // 2):
        stream = zlib.compress(rows[: len(rows) - missing])
        content = b"\x89PNG\r\n\x1a\n" + head + palette + chunk(b"IDAT", stream) + chunk(b"IEND", b"")
        path.write_bytes(content)
        if missing:
            found = f"found {len(rows) - missing} bytes, expected {len(rows)} bytes of rows"
            with pytest.raises(RawDataError, match=found):
                read_star_image(path, "e")
        else:
            with Image.open(path) as image:
                assert image.mode == modes[colour]
            assert not differs(read_star_image(path, "e"), content)


def test_tiff_that_states_black_or_white_not_once_is_refused(tmp_path: Path) -> None:
    import tifffile

    path = tmp_path / "e.tif"
    for big in (False, True):
        for order in "<>":
            form = {"photometric": "minisblack", "bigtiff": big, "byteorder": order}
            tifffile.imwrite(path, np.eye(40, dtype=np.uint8), **form)
            assert read_star_image(path, "e").sum() == 40
            raw, (number, count) = bytearray(path.read_bytes()), ((8, "Q") if big else (4, "I"))
            at = raw.index(struct.pack(order + "HH" + count, 262, 3, 1))
            raw[at + 4 : at + 4 + number] = struct.pack(order + count, 33)
            path.write_bytes(raw)
            with pytest.raises(RawDataError, match="PhotometricInterpretation: found 33 values"):
                read_star_image(path, "e")
            raw[at + 4 : at + 4 + number] = struct.pack(order + count, 1)
            after = at + (20 if big else 12)  # in the place of the next tag once more
            raw[after : after + 4 + number] = raw[at : at + 4 + number]
            path.write_bytes(raw)
            with pytest.raises(RawDataError, match="PhotometricInterpretation: found 2 values"):
                read_star_image(path, "e")


@pytest.mark.filterwarnings("error")
def test_window_that_shows_no_width_is_no_good_star_and_no_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between saturated columns the normal matrix of a star's width is singular: its variance is negative."""
    real = star_shape.newton_step

    def singular(*given: Any) -> Any:
        step, normal, residual, weight = real(*given)
        normal[0] = np.diag([1.0, 1.0, 1.0, 1.0, -1.0])
        return step, normal, residual, weight

    rng, image = np.random.default_rng(4), np.zeros((200, 240))
    y, x = np.mgrid[:200, :240]
    for x0, y0 in rng.uniform(20, 180, (12, 2)):
        image += 3000.0 * np.exp(-0.5 * ((x - x0) ** 2 + (y - y0) ** 2) / 1.2**2)
    monkeypatch.setattr(star_shape, "newton_step", singular)
    stars = list_stars(rng.poisson(image + 500.0).astype(np.uint16), StarSettings())
    assert len(stars.xy_px) > 6 and np.isfinite(stars.cov_px).all()
