"""Named arrays in one file that is mapped into memory: nothing is copied, and processes share its pages.

4 bytes   CRC-32 of all that follows
4 bytes   length of the text
text      JSON: name -> [type, shape, first byte]
arrays    each begins at a multiple of 64 bytes
"""

from __future__ import annotations

import json
import mmap
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from isal import isal_zlib  # CRC at 10 GB/s
from numpy.typing import NDArray

__all__ = ["mapped_arrays", "write_arrays"]

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
