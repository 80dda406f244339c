"""The index of catalogue triangles, kept between runs in the user's cache folder.

The key of a file is the digest of catalogue, epoch, field of view and program. The few files used last are
kept. If the folder cannot be written, the index is built in every run; a damaged file is replaced with a
warning. A file is mapped into memory: nothing is copied, and processes share its pages. It has

    4 bytes   CRC-32 of all that follows
    4 bytes   length of the text
    text      JSON: name -> [type, shape, first byte]
    arrays    each begins at a multiple of 64 bytes
"""

from __future__ import annotations

import json
import mmap
import struct
import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
import platformdirs
from isal import isal_zlib  # CRC at 10 GB/s
from numpy.typing import NDArray

from boresight.geometry.starlight import StarPlaces
from boresight.pipeline.files.whole_file import write_whole
from boresight.pipeline.run.digests import digest, numerical_program
from boresight.star_id.identification.triangle_index import StarIndex, build_index

__all__ = ["cache_folder", "cached_index", "write_arrays"]

# Start of the file: a number that marks the format and the length of the head in bytes, 32 bits each,
# little-endian.
_HEAD = struct.Struct("<II")
# Bytes to multiples of which arrays are aligned in the file: a line of the processor's cache.
_ALIGNED = 64


def write_arrays(path: Path, arrays: Mapping[str, NDArray]) -> None:
    """Write arrays of numbers, of any shapes (N, ...), for `mapped_arrays`; `OSError` if that fails."""
    places, parts, end = {}, [], 0
    for name, array in arrays.items():
        places[name] = (array.dtype.str, array.shape, end)
        parts.append(array.tobytes() + bytes(-array.nbytes % _ALIGNED))
        end += len(parts[-1])
    text = json.dumps(places).encode()
    text += b" " * (-(_HEAD.size + len(text)) % _ALIGNED)
    body = b"".join((struct.pack("<I", len(text)), text, *parts))
    path.write_bytes(struct.pack("<I", isal_zlib.crc32(body)) + body)


def mapped_arrays(path: Path) -> dict[str, NDArray]:
    """The arrays (N, ...) of a file that `write_arrays` made, read-only; `ValueError` if it is damaged."""
    with path.open("rb") as stream:
        content = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    if len(content) < _HEAD.size:
        raise ValueError(f"{len(content)} bytes, at least {_HEAD.size} are expected")
    stated, length = _HEAD.unpack_from(content)
    if (found := isal_zlib.crc32(memoryview(content)[4:])) != stated:
        raise ValueError(f"CRC-32 is {found:08x}, {stated:08x} is stated")
    first = _HEAD.size + length
    places = json.loads(content[_HEAD.size : first])
    return {
        name: np.frombuffer(content, kind, int(np.prod(shape)), first + offset).reshape(shape)
        for name, (kind, shape, offset) in places.items()
    }


_KEPT = 6  # files; the largest, for all fields of view, takes 60 MB


def cached_index(stars: StarPlaces, epoch_jyear: float, fov_rad: float | tuple[float, float]) -> StarIndex:
    """The index that `build_index` returns, read from the cache if it is there."""
    key = digest(stars, float(epoch_jyear), fov_rad, numerical_program(StarIndex.__module__))
    path = cache_folder() / f"triangles-{key}.arrays"
    try:
        index = StarIndex.from_arrays(stars, mapped_arrays(path))
        with suppress(OSError):
            path.touch()  # the time of the last use
        return index
    except OSError:
        pass  # missing or not readable
    except ValueError as error:
        warnings.warn(f"{path}: damaged ({error}); the index is built again", stacklevel=2)
    index = build_index(stars, epoch_jyear, fov_rad)
    with suppress(OSError):  # read-only or full: the next run builds the index again
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, lambda target: write_arrays(target, index.arrays))
        files = sorted(path.parent.glob("triangles-*"), key=lambda file: file.stat().st_mtime_ns)
        for old in files[:-_KEPT]:
            old.unlink(missing_ok=True)
    return index


def cache_folder() -> Path:
    """The folder in which this platform keeps a user's cached files of `boresight` (it need not exist)."""
    return platformdirs.user_cache_path("boresight", appauthor=False)
