"""Sound star images of every format that `identify` accepts, changed at random, beside what Pillow reads.

`benchmarks/fuzz_images.py` reads ten thousand of each format, a test some dozens.
"""

import io
import random
import re
import struct
import warnings
import zlib
from collections.abc import Callable

import cv2
import numpy as np
import tifffile
from astropy.io import fits
from PIL import Image

__all__ = ["FORMATS", "differs", "mutated", "with_checksums"]

WIDTH, HEIGHT = 44, 38
_RNG = np.random.default_rng(11)
GREY = np.clip(_RNG.normal(30.0, 4.0, (HEIGHT, WIDTH)), 0, 255).astype(np.uint8)
DEEP = _RNG.integers(0, 65536, (HEIGHT, WIDTH)).astype(np.uint16)
COLOURS = _RNG.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
_GREY_WEIGHTS = (0.299, 0.587, 0.114)


def _saved(image: Image.Image, kind: str, **options: object) -> bytes:
    stream = io.BytesIO()
    image.save(stream, kind, **options)
    return stream.getvalue()


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def _png_with(content: bytes, chunk: bytes) -> bytes:
    """A PNG file with a chunk between its header and what follows."""
    return content[:33] + chunk + content[33:]


def _png(rows: bytes, colour: int, depth: int, interlaced: int = 0) -> bytes:
    head = struct.pack(">IIBBBBB", WIDTH, HEIGHT, depth, colour, 0, 0, interlaced)
    stream = _chunk(b"IDAT", zlib.compress(rows))
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", head) + stream + _chunk(b"IEND", b"")


def _unfiltered(image: np.ndarray) -> bytes:
    rows = np.ascontiguousarray(image, image.dtype.newbyteorder(">")).reshape(HEIGHT, -1).view(np.uint8)
    return np.hstack([np.zeros((HEIGHT, 1), np.uint8), rows]).tobytes()


def _filtered(kind: int) -> bytes:
    """Rows of noise that a decoder takes as filtered by Average or Paeth."""
    rows = np.hstack([np.full((HEIGHT, 1), kind, np.uint8), GREY])
    return rows.tobytes()


def _apng() -> bytes:
    frames = [Image.fromarray(np.roll(GREY, k, 0)) for k in range(3)]
    return _saved(frames[0], "PNG", save_all=True, append_images=frames[1:])


def _tiff(image: np.ndarray, **options: object) -> bytes:
    stream = io.BytesIO()
    tifffile.imwrite(stream, image, **options)
    return stream.getvalue()


def _fits(*units: fits.PrimaryHDU | fits.ImageHDU | fits.CompImageHDU) -> bytes:
    stream = io.BytesIO()
    fits.HDUList(list(units)).writeto(stream)
    return stream.getvalue()


def _npy(image: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, image)
    return stream.getvalue()


def _cv2(suffix: str, image: np.ndarray) -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


def _digits(values: np.ndarray) -> bytes:
    return b"\n".join(b" ".join(b"%d" % value for value in row.ravel()) for row in values)


FORMATS: dict[str, Callable[[], list[bytes]]] = {
    "PNG": lambda: [
        _saved(Image.fromarray(GREY), "PNG"),
        _saved(Image.fromarray(DEEP), "PNG"),
        _saved(Image.fromarray(COLOURS), "PNG"),
        _saved(Image.fromarray(GREY).convert("P"), "PNG"),
        _png(_filtered(3), 0, 8),
        _png(_filtered(4), 0, 8),
        _png(_unfiltered(np.dstack([DEEP] * 3)), 2, 16),
        _png_with(_saved(Image.fromarray(GREY), "PNG"), _chunk(b"tRNS", b"\0\7")),
        _apng(),
    ],
    "JPEG": lambda: [
        _saved(Image.fromarray(GREY), "JPEG"),
        _saved(Image.fromarray(COLOURS), "JPEG", subsampling=2),
        _saved(Image.fromarray(COLOURS), "JPEG", progressive=True),
        _saved(Image.fromarray(COLOURS).convert("CMYK"), "JPEG"),
    ],
    "TIFF": lambda: [
        *(_tiff(image) for image in (GREY, DEEP)),
        *(_tiff(GREY, compression="deflate", **how) for how in ({"predictor": 2}, {"tile": (16, 16)})),
        _saved(Image.fromarray(GREY), "TIFF", compression="tiff_lzw"),
        _tiff(COLOURS, photometric="rgb"),
        _saved(Image.fromarray(GREY), "TIFF", compression="packbits"),
    ],
    "BMP": lambda: [
        *(_saved(Image.fromarray(image), "BMP") for image in (GREY, COLOURS)),
        _cv2(".bmp", COLOURS),
    ],
    "PGM, PPM": lambda: [
        _saved(Image.fromarray(GREY), "PPM"),
        _saved(Image.fromarray(COLOURS), "PPM"),
        _cv2(".pgm", DEEP),
        b"P2\n# by hand\n%d %d\n255\n" % (WIDTH, HEIGHT) + _digits(GREY),
        b"P3 %d %d 255\n" % (WIDTH, HEIGHT) + _digits(COLOURS),
        b"P5\n# 12 bits\n%d %d\n4095\n" % (WIDTH, HEIGHT) + (DEEP >> 4).astype(">u2").tobytes(),
    ],
    "WebP": lambda: [
        _saved(Image.fromarray(COLOURS), "WEBP", lossless=True),
        _saved(Image.fromarray(COLOURS), "WEBP", quality=60),
    ],
    "JPEG 2000": lambda: [
        _saved(Image.fromarray(GREY), "JPEG2000"),
        _saved(Image.fromarray(COLOURS), "JPEG2000", irreversible=True),
        _cv2(".jp2", DEEP),
    ],
    "FITS": lambda: [
        *(_fits(fits.PrimaryHDU(image)) for image in (GREY, DEEP, DEEP.astype(np.float32))),
        _fits(fits.PrimaryHDU(), fits.ImageHDU(np.moveaxis(COLOURS, 2, 0))),
        _fits(fits.PrimaryHDU(), fits.CompImageHDU(DEEP.astype(np.int32), compression_type="RICE_1")),
        *(
            _fits(fits.PrimaryHDU(), fits.CompImageHDU(GREY.astype(np.int32), compression_type=kind))
            for kind in ("GZIP_2", "PLIO_1", "HCOMPRESS_1")
        ),
    ],
    "npy": lambda: [_npy(GREY), _npy(DEEP.astype(np.float64)), _npy(COLOURS)],
}


def mutated(content: bytes, rng: random.Random) -> bytes:
    """`content` with bytes, bits or whole parts changed: of a PNG half of the time in its inflated rows, and
    mostly with checksums that are right again."""
    if content.startswith(b"\x89PNG") and rng.random() < 0.5:
        at = content.index(b"IDAT") - 4
        (length,) = struct.unpack_from(">I", content, at)
        rows = _changed(zlib.decompress(content[at + 8 : at + 8 + length]), rng)
        stream = _chunk(b"IDAT", zlib.compress(rows, rng.choice((0, 1, 6))))
        return content[:at] + stream + content[at + 12 + length :]
    raw = _changed(content, rng)
    mended = content.startswith(b"\x89PNG") and rng.random() < 0.8
    return with_checksums(raw) if mended else raw


def _changed(content: bytes, rng: random.Random) -> bytes:
    raw = bytearray(content)
    early = max(1, min(len(raw), 200))  # headers are short
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        at = rng.randrange(early if rng.random() < 0.6 else len(raw))
        match rng.randrange(7):
            case 0 | 1:
                raw[at] ^= 1 << rng.randrange(8)
            case 2 | 3:
                raw[at] = rng.choice((0, 1, 2, 0x7F, 0x80, 0xFF, rng.randrange(256)))
            case 4:
                value = rng.choice((0, 1, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, rng.randrange(2**32)))
                raw[at : at + 4] = struct.pack(rng.choice(("<I", ">I")), value)
            case 5:
                del raw[at : at + rng.choice((1, 2, 7, 100))]
            case 6:
                begin = rng.randrange(len(raw))
                raw[at:at] = raw[begin : begin + rng.choice((1, 2, 7, 100))]
        if not raw:
            return b""
    if rng.random() < 0.1:
        del raw[rng.randrange(len(raw)) :]
    return bytes(raw)


def with_checksums(raw: bytes) -> bytes:
    """A PNG whose chunks have the right checksums again, so that what is in them is looked at."""
    out, at = bytearray(raw), 8
    while at + 12 <= len(out):
        (length,) = struct.unpack_from(">I", out, at)
        end = at + 8 + length
        if end + 4 > len(out):
            break
        struct.pack_into(">I", out, end, zlib.crc32(out[at + 4 : end]))
        at = end + 4
    return bytes(out)


def _by_pillow(content: bytes) -> np.ndarray | None:
    """The image in grey levels (H, W) as Pillow reads it; None where it does not."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(content)) as image:
                if image.width * image.height > 10**7:
                    return None
                if image.format == "JPEG" and image.mode == "RGB":
                    image.draft("L", image.size)
                image.load()
                if image.mode == "P":
                    image = image.convert("RGB")
                if image.format == "TIFF" and (262 not in image.tag_v2 or image.tag_v2.get(274, 1) != 1):
                    return None  # Pillow then reverses grey values or rotates: raw images are read as stored
                if image.format == "FITS":  # Pillow turns it upside down, without BZERO, of a cube one plane,
                    others = (b"NAXIS3", b"ZIMAGE")  # and of packed tiles their table
                    plain = image.mode == "L" and not any(key in content for key in others)
                    return np.flipud(np.asarray(image)).astype(float) if plain else None
                values = np.asarray(image)
    except Exception:  # Pillow raises many kinds
        return None
    if values.ndim == 3 and values.shape[2] == 2:
        return values[..., 0].astype(float)
    if values.ndim == 3:
        return values[..., :3].astype(float) @ np.array(_GREY_WEIGHTS)
    return values.astype(float)


def differs(image: np.ndarray, content: bytes) -> bool | None:
    """Whether an image (H, W) that was read differs from what Pillow reads; None where Pillow reads none, or
    no such values (colours of 16 bits, floating point)."""
    other = _by_pillow(content)
    if other is None or image.dtype.kind != "u":
        return None
    if image.dtype == np.uint16 and other.max(initial=0) <= 255 < image.max():
        return None  # of 16 bits Pillow keeps the upper 8
    if content[:2] in (b"P2", b"P3", b"P5", b"P6"):
        largest = int(re.sub(rb"#[^\n]*\n", b" ", content).split(None, 4)[3])
        deep = largest > 255 and content[:2] in (b"P2", b"P5")  # Pillow reads colours with 8 bits
        image = image * ((65535 if deep else 255) / largest)
    return image.shape != other.shape or bool(np.abs(image - other).max() > 0.51)  # grey levels: rounded
