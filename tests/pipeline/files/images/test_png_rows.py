"""Rows of PNG files beside what OpenCV reads; what is not understood is left to OpenCV."""

import io
import struct
import tracemalloc
import zlib
from contextlib import suppress

import cv2
import numpy as np
import pytest
from PIL import Image

from boresight.pipeline.files.images.png import NONE, SUB, UP, png_of_noise, png_rows

AVERAGE = 3


def chunk(kind: bytes, content: bytes) -> bytes:
    body = kind + content
    return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))


def png(
    filtered: bytes, width: int, height: int, depth: int = 8, between: bytes = b"", interlaced: int = 0
) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, depth, 0, 0, 0, interlaced)
    packed = zlib.compress(filtered, 1)
    parts = b"".join(chunk(b"IDAT", packed[at : at + 1000]) for at in range(0, len(packed), 1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + between + parts + chunk(b"IEND", b"")


def filtered_rows(image: np.ndarray, filters: np.ndarray) -> bytes:
    """Rows as the standard filters them, byte by byte modulo 256."""
    size = image.dtype.itemsize
    rows = np.ascontiguousarray(image, image.dtype.newbyteorder(">")).view(np.uint8)
    before = np.hstack([np.zeros((len(rows), size), np.uint8), rows[:, :-size]])
    above = np.vstack([np.zeros_like(rows[:1]), rows[:-1]])
    minus = np.choose(filters[:, None], [np.zeros_like(rows), before, above])
    return np.hstack([filters[:, None].astype(np.uint8), rows - minus]).tobytes()


def noise(shape: tuple[int, int], dtype: type, seed: int = 4) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


def by_opencv(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def by_pillow(image: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "png")
    return stream.getvalue()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (300, 1), (37, 61), (1100, 700)])
def test_any_mixture_of_the_three_filters_gives_the_image(dtype: type, shape: tuple[int, int]) -> None:
    image = noise(shape, dtype)
    for filters in (
        np.random.default_rng(5).choice([NONE, SUB, UP], shape[0]),
        *(np.full(shape[0], kind) for kind in (NONE, SUB, UP)),
    ):
        content = png(filtered_rows(image, filters), shape[1], shape[0], 8 * image.itemsize)
        read = png_rows(content)
        assert read is not None and read.dtype == image.dtype and np.array_equal(read, image)
        assert np.array_equal(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED), image)


@pytest.mark.parametrize("write", [by_opencv, by_pillow, png_of_noise])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_images_of_noise_are_read_whoever_wrote_them(write, dtype):
    image = np.clip(np.random.default_rng(6).normal(30.0, 4.0, (900, 1300)), 0, 255).astype(dtype)
    content = write(image)
    read = png_rows(content)
    assert np.array_equal(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED), image)
    assert read is not None and read.dtype == dtype and np.array_equal(read, image)


IMAGE = noise((40, 50), np.uint8)
ROWS = filtered_rows(IMAGE, np.full(40, SUB))
WHOLE = png(ROWS, 50, 40)
AVERAGED = bytes([AVERAGE]) + ROWS[1:]
STREAM = zlib.compress(ROWS, 1)
HEAD = struct.pack(">IIBBBBB", 50, 40, 8, 0, 0, 0, 0)


def of_chunks(*chunks: tuple[bytes, bytes]) -> bytes:
    return WHOLE[:8] + b"".join(chunk(*one) for one in chunks) + chunk(b"IEND", b"")


def with_head(*values: int, stream: bytes = STREAM) -> bytes:
    return of_chunks((b"IHDR", struct.pack(">IIBBBBB", *values)), (b"IDAT", stream))


FORBIDDEN = {
    "another compression": with_head(50, 40, 8, 0, 1, 0, 0),
    "another filter method": with_head(50, 40, 8, 0, 0, 1, 0),
    "no row": with_head(50, 0, 8, 0, 0, 0, 0, stream=zlib.compress(b"")),
    "no column": with_head(0, 40, 8, 0, 0, 0, 0, stream=zlib.compress(bytes(40))),
    "a long header": of_chunks((b"IHDR", HEAD + b"x"), (b"IDAT", STREAM)),
    "a second header": of_chunks((b"IHDR", HEAD), (b"IHDR", HEAD), (b"IDAT", STREAM)),
    "an unknown chunk that must be known": of_chunks((b"IHDR", HEAD), (b"ABCD", b"x"), (b"IDAT", STREAM)),
    "data in two runs": of_chunks(
        (b"IHDR", HEAD), (b"IDAT", STREAM[:500]), (b"tEXt", b"a\0b"), (b"IDAT", STREAM[500:])
    ),
}
LEFT_TO_OPENCV = {
    "another filter": png(AVERAGED, 50, 40),
    "another filter in the last row": png(ROWS[:-51] + bytes([4]) + ROWS[-50:], 50, 40),
    "no such filter": png(bytes([77]) + ROWS[1:], 50, 40),
    "a row too few": png(ROWS[:-51], 50, 40),
    "a byte too few": png(ROWS[:-1], 50, 40),
    "a byte too many": png(ROWS + b"\0", 50, 40),
    "a row too many": png(ROWS + ROWS[:51], 50, 40),
    "a megabyte too many": png(ROWS + bytes(2**20), 50, 40),
    "no pixels": WHOLE[:33] + chunk(b"IEND", b""),
    "a stream cut off": WHOLE[:33] + chunk(b"IDAT", zlib.compress(ROWS, 1)[:-4]) + chunk(b"IEND", b""),
    "a wrong checksum of the stream": WHOLE[:33]
    + chunk(b"IDAT", zlib.compress(ROWS, 1)[:-4] + b"abcd")
    + chunk(b"IEND", b""),
    "what is no stream": WHOLE[:33] + chunk(b"IDAT", bytes(100)) + chunk(b"IEND", b""),
    "a transparent grey value": png(ROWS, 50, 40, between=chunk(b"tRNS", b"\0\7")),
    "interlaced": png(ROWS, 50, 40, interlaced=1),
    "colours": by_opencv(np.dstack([IMAGE] * 3)),
    "4 bits": png(ROWS, 100, 40, 4),
}


@pytest.mark.parametrize("content", LEFT_TO_OPENCV.values(), ids=LEFT_TO_OPENCV)
def test_what_is_not_whole_or_not_understood_is_left_to_opencv(content: bytes) -> None:
    assert np.array_equal(png_rows(WHOLE), IMAGE)
    assert png_rows(content) is None


@pytest.mark.parametrize("content", FORBIDDEN.values(), ids=FORBIDDEN)
def test_what_the_standard_forbids_is_refused_as_by_opencv(content: bytes) -> None:
    decoded = None
    with suppress(cv2.error):
        decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded is None
    assert png_rows(content) is None


def test_a_text_beside_the_image_does_not_matter() -> None:
    content = of_chunks((b"IHDR", HEAD), (b"tEXt", b"a\0b"), (b"IDAT", STREAM), (b"tEXt", b"a\0b"))
    assert np.array_equal(png_rows(content), IMAGE)


def test_a_stream_of_too_many_zeros_is_not_inflated() -> None:
    """200 MB in 200 kB, as one piece and as many: memory stays that of the image."""
    for between in (1000, 10**7):
        packed = zlib.compress(bytes(2 * 10**8), 9)
        parts = (chunk(b"IDAT", packed[at : at + between]) for at in range(0, len(packed), between))
        content = WHOLE[:33] + b"".join(parts) + chunk(b"IEND", b"")
        tracemalloc.start()
        assert png_rows(content) is None
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 5 * 10**6  # bytes: the compressed pieces, joined, and one row
