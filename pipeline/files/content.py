"""Content of files: its extent checked before, read once, for the digest and for the decoder.

Every reader compares what a head, a footer or the file system states (bytes, rows x columns, width x height)
with its limit by `check_extent` before it reads, so a small or sparse file cannot fill the memory.

The bytes of the last small file that was read as a whole stay in memory, and are its content as long as its
size, its place on the disk and its times are the same. So do the digests of files.
"""

from __future__ import annotations

import errno
import hashlib
import math
import os
import stat
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO, cast

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.object_store import StoredPath

__all__ = [
    "Identity",
    "check_bytes",
    "check_extent",
    "check_regular",
    "content_digest",
    "content_of",
    "identity_of",
    "limited_content",
    "open_regular",
    "remember_digest",
    "small_content",
    "with_identity",
]

KEPT_BYTES = 2**26  # three raw exposures of 20 million pixels; a strip is read by window
STREAMED_BYTES = 2**23  # read at once of a larger file, of a store in one request

MOST_DIGESTS = 100_000  # remembered
# Flags of `os.open` with which a pipe does not make the program wait.
_NO_WAIT = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)

Identity = tuple[int, ...]

_digests: dict[tuple[Path, Identity], str] = {}


def open_regular(path: Path, buffering: int = -1) -> BinaryIO:
    """A regular file, opened for reading; `OSError` for anything else, of which opening may block or act.

    Everything that a dump, a result or a user names is opened here, or by a library that is given the bytes
    or the name of a file that was checked here and may follow no name in it.
    """
    if isinstance(path, StoredPath):
        return cast(BinaryIO, path.open("rb", buffering))
    _identity(path)  # a device must not even be opened
    descriptor = os.open(path, os.O_RDONLY | _NO_WAIT)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):  # exchanged in between
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return cast(BinaryIO, os.fdopen(descriptor, "rb", buffering))


def _read(path: Path) -> bytes:
    if isinstance(path, StoredPath):
        return path.read_bytes()  # in one request
    with open_regular(path) as stream:
        return stream.read()


def content_of(path: Path) -> bytes:
    """All bytes of a regular file; `OSError` for anything else."""
    content = small_content(path)
    return _read(path) if content is None else content


def small_content(path: Path) -> bytes | None:
    """All bytes of a regular file of at most 64 MiB, None for a larger one; `OSError` for anything else."""
    identity = _identity(path)
    return _content(path, identity) if identity[0] <= KEPT_BYTES else None


def content_digest(path: Path) -> str:
    """SHA-256 of all bytes of a regular file as hexadecimal digits; `OSError` for anything else."""
    return with_identity(path)[1]


def with_identity(path: Path) -> tuple[Identity, str]:
    """What changes when the file's content does, and `content_digest`."""
    identity = _identity(path)
    if (path, identity) not in _digests:
        remember_digest(path, identity, _sha256(path, identity))
    return identity, _digests[path, identity]


def remember_digest(path: Path, identity: Identity, digest: str) -> None:
    """Take over what `with_identity` found, here or in another process."""
    if len(_digests) >= MOST_DIGESTS:
        del _digests[next(iter(_digests))]  # the oldest
    _digests[path, identity] = digest


def check_regular(path: Path, file: str, expected: str) -> int:
    """Size in bytes of a regular file; `RawDataError` for a FIFO, a device (opening it may block) or none."""
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        missing = isinstance(error, (FileNotFoundError, NotADirectoryError, ValueError))
        found = "no such file" if missing else f"{getattr(error, 'strerror', None) or error}"
        raise RawDataError(file, "file", found, expected) from error
    if not stat.S_ISREG(status.st_mode):
        found = "a folder" if stat.S_ISDIR(status.st_mode) else "a device, FIFO or socket"
        raise RawDataError(file, "file", found, expected)
    return status.st_size


def check_extent(file: str, field: str, extent: Sequence[int], most: int, unit: str) -> None:
    """`RawDataError` where the product of an extent (rows, columns) of `field` exceeds `most`, in `unit`."""
    if math.prod(extent) > most:
        raise RawDataError(file, field, f"{' x '.join(map(str, extent))} {unit}", f"at most {most} {unit}")


def check_bytes(path: Path, file: str, most: int) -> None:
    """`RawDataError` for a file of more than `most` bytes; of a missing one its reader reports that."""
    check_extent(file, "file", identity_of(path)[:1], most, "bytes")


def limited_content(path: Path, file: str, expected: str, max_bytes: int) -> bytes:
    """All bytes of a regular file; `RawDataError` for one that is missing, unreadable or too large."""
    check_extent(file, "file", (check_regular(path, file, expected),), max_bytes, "bytes")
    try:
        return content_of(path)
    except OSError as error:
        raise RawDataError(file, "file", error.strerror or str(error), "a readable file") from error


def identity_of(path: Path) -> Identity:
    """What changes when the content of a file does; empty where there is none, which its reader reports."""
    try:
        return _identity(path)
    except (OSError, ValueError):
        return ()


def _identity(path: Path) -> Identity:
    """What changes when the content does, the size first."""
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):  # opening a FIFO would block
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    times = status.st_mtime_ns, status.st_ctime_ns
    return status.st_size, status.st_dev, status.st_ino, *times


@lru_cache(maxsize=1)
def _content(path: Path, identity: Identity) -> bytes:
    return _read(path)


def _sha256(path: Path, identity: Identity) -> str:
    if identity[0] <= KEPT_BYTES:
        return hashlib.sha256(_content(path, identity)).hexdigest()
    state = hashlib.sha256()
    with open_regular(path, buffering=0) as stream:
        while piece := stream.read(STREAMED_BYTES):
            state.update(piece)
    return state.hexdigest()
