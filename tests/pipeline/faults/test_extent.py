"""No reader takes memory or time for what a file only states: rows, values, bytes, width and height."""

import contextlib
import gzip
import json
import os
import resource
import struct
import tarfile
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import rasterio
from astropy.io import fits
from readers import DOCUMENTED, READERS, Reader, write_sound_files

from boresight.features.operators import gipp_files
from boresight.features.operators.dimap_grid import dimap_grid_differences
from boresight.features.targets.ortho_files import read_heights
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.images.rasters import read_grid
from boresight.pipeline.files.images.star_images import read_star_image
from boresight.pipeline.files.images.tiff import check_strip_file
from boresight.pipeline.files.star_tables import read_star_table
from boresight.pipeline.files.table_files import read_parquet
from boresight.pipeline.files.text_files import csv_rows, read_json, read_message, read_text, toml_tables
from boresight.pipeline.files.xml_files import read_xml

LIMITED = r"found .*(, expected .*at most|expected END within|exceeds limit of) \d+"  # the latter of Pillow
MORE_BYTES, MOST_S = 2**30, 5.0  # beyond what the process has; of processor time


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """The block ends as `MemoryError` where it asks for a GiB more, and fails where it takes 5 s."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before, begin = resource.getrlimit(resource.RLIMIT_AS), time.process_time()
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MORE_BYTES, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    assert time.process_time() - begin < MOST_S


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sound_files(tmp_path_factory.mktemp("extent"))


QUICK = [reader for reader in READERS if reader.name != "plan, forecast"]


@pytest.mark.parametrize("reader", QUICK, ids=lambda reader: reader.name)
def test_file_with_a_hole_of_20_gigabytes_behind_it_is_read_or_refused(reader: Reader, root: Path) -> None:
    path = root / reader.file
    size = path.stat().st_size
    os.truncate(path, 20 * 10**9)
    try:
        with bounded():
            reader.read(root)
    except DOCUMENTED as error:
        assert 0 < len(str(error)) < 1000
    finally:
        os.truncate(path, size)


def test_exposure_longer_than_its_pixels_is_not_used_and_the_others_are(root: Path) -> None:
    os.truncate(path := root / "dump/exposures/0.png", 20 * 10**9)
    with bounded():
        dump = open_dump(root / "dump")
    (entry,) = [one for one in dump.omissions if one.file == "exposures/0.png"]
    assert f"found {path.stat().st_size} bytes, expected at most 1054720 bytes" in entry.text
    assert "0000" not in {exposure.exposure_id for exposure in dump.exposures} and dump.exposures


def tiff(path: Path, width: int, height: int, count: int = 1, kind: str = "uint8", **tags: Any) -> None:
    """A TIFF of which no pixel is stored."""
    form = {"driver": "GTiff", "width": width, "height": height, "count": count, "dtype": kind}
    form |= {"tiled": True, "compress": "deflate", "sparse_ok": True, "bigtiff": "yes"}
    place = {"crs": "EPSG:32633", "transform": rasterio.Affine(2.0, 0, 5e5, 0, -2.0, 5e6)}
    with rasterio.open(path, "w", **form, **({} if "blockxsize" in tags else place), **tags) as image:
        image.update_tags(ALTITUDE_B0="1")


def bmp(path: Path) -> None:
    head = struct.pack("<2sIHHI", b"BM", 1000, 0, 0, 54)
    path.write_bytes(head + struct.pack("<IiiHHIIiiII", 40, 60000, 60000, 1, 24, 0, 0, 0, 0, 0, 0))


def jpeg(path: Path) -> None:
    from PIL import Image

    Image.new("L", (8, 8)).save(path, "JPEG")
    raw = path.read_bytes()
    at = raw.index(b"\xff\xc0") + 5
    path.write_bytes(raw[:at] + struct.pack(">HH", 65000, 65000) + raw[at + 4 :])


def png(path: Path) -> None:
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBBI", 13, b"IHDR", 99999, 99999, 8, 0, 0, 0, 0, 0)
    )


def fits_of(axes: tuple[int, ...]) -> Callable[[Path], object]:
    cards = ["SIMPLE  =                    T", "BITPIX  =                   16", f"NAXIS   = {len(axes):20d}"]
    cards += [f"NAXIS{n}  = {size:20d}" for n, size in enumerate(axes, start=1)]
    text = "".join(card.ljust(80) for card in (*cards, "END"))
    return lambda path: path.write_bytes(text.ljust(2880).encode())


def star_table(path: Path) -> None:
    """3 million rows of 12 columns of a byte."""
    kinds = [(f"c{n}", np.uint8) for n in range(12)]
    fits.BinTableHDU(np.zeros(3_000_000, kinds)).writeto(path)


def npy(path: Path) -> None:
    np.lib.format.open_memmap(path, "w+", np.float64, (30000, 10000)).flush()


def numbers_of_parquet(path: Path) -> None:
    flags = pa.Array.from_buffers(pa.bool_(), 2**26 + 1, [None, pa.py_buffer(bytes(2**23 + 1))])
    pq.write_table(pa.table({"a": flags}), path)


def texts_of_parquet(path: Path) -> None:
    """One text of 1 MB, 10,000 times."""
    of = pa.DictionaryArray.from_arrays(pa.array(np.zeros(10_000, np.int32)), pa.array(["x" * 10**6]))
    pq.write_table(pa.table({"a": of}), path, store_schema=False)


def endless(path: Path) -> None:
    fits_of((96, 96))(path)
    path.write_bytes(path.read_bytes().replace(b"END", b"   "))
    os.truncate(path, 3 * 2**30)


def zipped(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.xml", bytes(gipp_files.MAX_BYTES + 1))


def tarred(path: Path) -> None:
    with tarfile.open(path, "w") as archive:
        for n in range(gipp_files.MAX_MEMBERS + 1):
            archive.addfile(tarfile.TarInfo(f"{n}.xml"))


def text(content: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(content)


def gipp(path: Path) -> object:
    return gipp_files.find_gipp_files(path, ".*")


def rows(path: Path) -> object:
    return sum(1 for _ in csv_rows(path, ["a"], [], "f"))


def gaia(path: Path) -> object:
    return read_star_table(path, "f")


# Form: file name, what writes it, what reads it.
FORMS: dict[str, tuple[str, Callable[[Path], Any], Callable[[Path], Any]]] = {
    "parquet, values": ("a.parquet", numbers_of_parquet, read_parquet),
    "parquet, repeated text": ("a.parquet", texts_of_parquet, read_parquet),
    "csv, a line": ("a.csv", text("a\n" + "x" * 2**21), rows),
    "csv, a line of wide characters": ("a.csv", text("a\n" + "\U0001f680" * 2**21), rows),
    "csv, rows": ("a.csv", text("a\n" + "1\n" * 500_001), rows),
    "json": ("a.json", text(json.dumps({"a": [{}] * 2**22})), read_json),
    "json, nested": ("a.json", text('{"a":' + "[" * 2**23), read_json),
    "xml, tags": ("a.xml", text("<a>" + "<b/>" * 2**22 + "</a>"), lambda p: read_xml(p, "f")),
    "xml, attributes": ("a.xml", text("<a>" + "<b c='' d='' e=''/>" * 2**20 + "</a>"),
        lambda p: read_xml(p, "f")),
    "toml, keys": ("a.toml", text("a" + ".a" * 10**5), lambda p: toml_tables(p, "f")),
    "text, gzip": ("a.gz", lambda path: path.write_bytes(gzip.compress(bytes(2**27 + 1), 1)),
        lambda p: read_message(p, "f")),
    "text, a hole": ("a.txt", lambda path: path.touch() or os.truncate(path, 2**33),
        lambda p: read_text(p, "f")),
    "stars, csv cells": ("a.csv", text("source_id" + ",a" * 99 + "\n" + (",1" * 99 + "\n") * 350_000), gaia),
    "stars, csv line": ("a.csv", text("source_id\n" + "x" * 10**6 + "\n1" * 10_000), gaia),
    "stars, fits": ("a.fits", star_table, gaia),
    "gipp, zip": ("a.zip", zipped, gipp),
    "gipp, tar": ("a.tar", tarred, gipp),
    "png": ("a.png", png, lambda p: read_star_image(p, "f")),
    "jpeg": ("a.jpg", jpeg, lambda p: read_star_image(p, "f")),
    "bmp": ("a.bmp", bmp, lambda p: read_star_image(p, "f")),
    "npy": ("a.npy", npy, lambda p: read_star_image(p, "f")),
    "pgm": ("a.pgm", text("P5 99999 99999 255\n"), lambda p: read_star_image(p, "f")),
    "fits": ("a.fits", fits_of((99999, 99999)), lambda p: read_star_image(p, "f")),
    "fits, planes": ("a.fits", fits_of((16384, 16384, 3)), lambda p: read_star_image(p, "f")),
    "fits, header": ("a.fits", endless, lambda p: read_star_image(p, "f")),
    "tiff": ("a.tif", lambda path: tiff(path, 10**5, 10**5), lambda p: read_star_image(p, "f")),
    "tiff, doubles": ("a.tif", lambda path: tiff(path, 16384, 8192, kind="float64"),
        lambda p: read_star_image(p, "f")),
    "strip, tiles": ("a.tif", lambda path: tiff(path, 65536, 10**7, blockxsize=16384, blockysize=16384),
        lambda p: check_strip_file(p, "f", lines=10**7, samples=65536, bit_depth=8)),
    "chip": ("a.tif", lambda path: tiff(path, 9000, 9000), lambda p: read_grid(p, "f", max_pixels=2**24)),
    "chip, a tile": ("a.tif", lambda path: tiff(path, 512, 512, blockxsize=65536, blockysize=65536),
        lambda p: read_grid(p, "f", max_pixels=2**24)),
    "height model": ("a.tif", lambda path: tiff(path, 20_001, 20_001),
        lambda p: read_heights([p], "ellipsoidal")),
    "location grid": ("a.tif", lambda path: tiff(path, 20_000, 20_000, 2),
        lambda p: dimap_grid_differences(SimpleNamespace(), p)),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_more_than_fits_in_memory_is_refused_with_its_size_and_the_limit(form: str, tmp_path: Path) -> None:
    name, write, read = FORMS[form]
    write(path := tmp_path / name)
    with bounded(), pytest.raises(RawDataError, match=LIMITED) as refused:
        read(path)
    assert "MemoryError" not in str(refused.value)
