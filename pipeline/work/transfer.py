"""Objects sent from a process to another one of this machine, large arrays through memory that both share.

A pipe takes a picture of a strip in pieces of some ten kilobytes, and wakes both processes for each. Where
the system has files in memory, the arrays are written into one of these, and only the open file is sent.
"""

from __future__ import annotations

import os
import pickle
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import reduction
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

__all__ = ["Parcel", "receive", "send"]

SMALL_BYTES = 2**16  # a smaller array goes through the pipe
ALIGNED_BYTES = 64  # of the first byte of an array: what vector instructions may want


@dataclass(frozen=True, slots=True)
class Parcel:
    """What was received, still packed."""

    content: bytes  # pickled, without its large arrays
    arrays: tuple[memoryview, ...]

    def unpacked(self) -> Any:
        """The object that was sent."""
        return pickle.loads(self.content, buffers=self.arrays)


def send(pipe: Connection, sent: Any) -> None:
    """Send an object through the pipe, to be received by `receive`."""
    arrays: list[memoryview] = []

    def stays(buffer: pickle.PickleBuffer) -> bool:
        bytes_of = buffer.raw()
        if bytes_of.nbytes >= SMALL_BYTES:
            arrays.append(bytes_of)
        return bytes_of.nbytes < SMALL_BYTES

    content = pickle.dumps(sent, protocol=5, buffer_callback=stays)
    file = _in_memory(arrays) if arrays else None
    if arrays and file is None:
        content, arrays = pickle.dumps(sent, protocol=5), []
    pipe.send([array.nbytes for array in arrays])
    pipe.send_bytes(content)
    if file is not None:
        try:
            reduction.send_handle(pipe, file, 0)  # the process of the other end need not be known
        finally:
            os.close(file)


def receive(pipe: Connection) -> Parcel:
    """What the other end of the pipe sent by `send`; `EOFError` or `ConnectionError` where it has ended."""
    sizes = pipe.recv()
    content = pipe.recv_bytes()
    if not sizes:
        return Parcel(content, ())
    file = reduction.recv_handle(pipe)
    places, end = _places(sizes)
    arrays = np.empty(end, np.uint8).data
    try:  # copied: a mapping keeps the file open as long as an array lives, and few files may be open
        read = 0
        while read < end:
            read += os.preadv(file, [arrays[read:]], read)
    finally:
        os.close(file)
    return Parcel(content, tuple(arrays[first : first + size] for first, size in zip(places, sizes)))


def _places(sizes: list[int]) -> tuple[list[int], int]:
    """First bytes of arrays one after another, and the end of the last one."""
    places, end = [], 0
    for size in sizes:
        places.append(end)
        end += -(-size // ALIGNED_BYTES) * ALIGNED_BYTES
    return places, end


def _in_memory(arrays: list[memoryview]) -> int | None:
    """A file in memory that holds the arrays, open; None where the system has none."""
    if not hasattr(os, "memfd_create"):
        return None
    places, end = _places([array.nbytes for array in arrays])
    file = -1
    try:
        file = os.memfd_create("boresight")
        os.truncate(file, end)
        for first, array in zip(places, arrays):
            written = 0
            while written < array.nbytes:
                written += os.pwrite(file, array[written:], first + written)
    except OSError:
        with suppress(OSError):
            os.close(file)
        return None
    return file
