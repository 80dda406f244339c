"""Dumps in object stores and on web servers: `s3://bucket/path`, `https://host/path`, read through fsspec.

A file there is a `StoredPath`, a path of pathlib that can only be read. Of a large file only the ranges that
are asked for are fetched, as blocks that are kept; an answer on size and version holds for some seconds.
Credentials are those of the environment. Nothing is listed, so a web server needs no index. The wait for an
answer and the bytes that are taken of it are limited (`ANSWER_S`, `SLOWEST_BYTES_S`, `MOST_BYTES`).

A file that is missing or forbidden is an `OSError`, as on a disk. A store that does not answer is a
`WorkerError`, which stops a run instead of making its images missing ones.
"""

from __future__ import annotations

import errno
import io
import os
import queue
import re
import stat
import threading
import time
import zlib
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar, cast

from boresight.pipeline.errors import RawDataError, WorkerError

__all__ = ["StoredPath", "dump_folder", "gdal_name", "is_address"]

BLOCK_BYTES = 2**20  # of a large file; some four tiles of 512 x 512 px of 8 bits
# Blocks of `BLOCK_BYTES` that a process keeps of files in object stores, the last used: 64 MiB.
KEPT_BLOCKS = 64
CURRENT_S = 5.0  # how long an answer on size and version of a file is taken as current
ANSWER_S = 60.0  # longest wait for an answer, and a second more for each `SLOWEST_BYTES_S` that are asked for
# Slowest rate of a store, bytes per second, that is waited for; see `ANSWER_S`.
SLOWEST_BYTES_S = 100_000
MOST_BYTES = 2**31  # of a file that is fetched whole
FORBIDDEN, NOT_FOUND = (401, 403), 404  # status of HTTP
# What GDAL writes before a path, by the scheme of the address.
OF_GDAL = {"s3": "/vsis3/", "gs": "/vsigs/", "http": "/vsicurl/http://", "https": "/vsicurl/https://"}

Answer = TypeVar("Answer")


def is_address(text: str) -> bool:
    """Whether a text is the address of something in a store (`s3://...`), not a path of this machine."""
    return re.match(r"[a-z][a-z0-9+.-]+://", text) is not None


def dump_folder(folder: str | Path) -> Path:
    """The folder of a dump by its path or address. `RawDataError` for an address with a password or query."""
    text = str(folder)
    if not is_address(text):
        return Path(folder)
    if found := re.search(r"[?#]|//[^/]*@", text):
        expected = "an address alone; credentials come from the environment (docs/dump-format.md)"
        shown = text.split("?")[0].rpartition("@")[2]  # without the password
        raise RawDataError(shown, "address", f"{found[0][-1]} in it", expected)
    return StoredPath(text)


def gdal_name(path: Path) -> str:
    """The name by which GDAL finds a file; of a store, in its own virtual file system."""
    store, _, place = str(path).partition("://")
    return OF_GDAL[store] + place if place and store in OF_GDAL else str(path)


class StoredPath(type(Path())):  # type: ignore[misc]  # PosixPath or WindowsPath
    """A file or folder in a store, with the methods of `Path` that read."""

    def __str__(self) -> str:
        return self.as_posix()

    def as_posix(self) -> str:
        """The address, such as "s3://bucket/dump/strips.csv"."""
        return super().__str__().replace(os.sep, "/").replace(":/", "://", 1)

    __fspath__ = __str__

    def resolve(self, strict: bool = False) -> StoredPath:
        """The path itself: a store has no links, and `..` is an ordinary name in it."""
        return self

    def is_absolute(self) -> bool:
        """Always."""
        return True

    def exists(self, *, follow_symlinks: bool = True) -> bool:
        """Whether there is such a file."""
        try:
            self.stat()
        except FileNotFoundError:
            return False
        return True

    def is_dir(self, *, follow_symlinks: bool = True) -> bool:
        """Whether there is a dump below this address: a store has no folders."""
        return (self / "dump.toml").exists()

    def is_file(self, *, follow_symlinks: bool = True) -> bool:
        """Whether there is such a file."""
        return self.exists()

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """Size of a file, and as its inode a checksum of what the store says of its version."""
        size, version = _state(str(self), int(time.monotonic() / CURRENT_S))
        return os.stat_result((stat.S_IFREG | 0o444, version, 0, 1, 0, 0, size, 0, 0, 0))

    def read_bytes(self) -> bytes:
        """All bytes of a file in one request; `OSError` if the store does not give them, or too many."""
        if (size := self.stat().st_size) > MOST_BYTES:
            raise OSError(errno.EFBIG, f"{size} bytes, at most {MOST_BYTES} are fetched", str(self))
        return _range(str(self), 0, size)

    def open(self, mode: str = "r", buffering: int = -1, *args: Any, **named: Any) -> Any:
        """A stream of bytes (`rb`, else `OSError`); reads of less than `BLOCK_BYTES` fetch whole blocks."""
        if mode != "rb":
            raise OSError(errno.EROFS, "files in a store are only read", str(self))
        ranges = _Ranges(str(self), self.stat())
        return ranges if buffering == 0 else io.BufferedReader(ranges, max(buffering, io.DEFAULT_BUFFER_SIZE))


class _Ranges(io.RawIOBase):
    """The bytes of a file, fetched where they are read."""

    def __init__(self, address: str, state: os.stat_result) -> None:
        self.address, self.size, self.version = address, state.st_size, state.st_ino
        self.at = 0
        self.failure: WorkerError | None = None  # GDAL drops the exceptions of a stream

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self.at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self.at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self.at, io.SEEK_END: self.size}[whence]
        return self.at

    def readinto(self, buffer: Any) -> int:
        end = min(self.at + len(buffer), self.size)
        if (length := end - self.at) <= 0:
            return 0
        try:
            buffer[:length] = self._content(end)
        except WorkerError as error:
            self.failure = error
            raise
        self.at = end
        return length

    def _content(self, end: int) -> bytes:
        if end - self.at >= BLOCK_BYTES:
            return _range(self.address, self.at, end)
        first, last = self.at // BLOCK_BYTES, (end - 1) // BLOCK_BYTES
        ends = [min((n + 1) * BLOCK_BYTES, self.size) for n in range(first, last + 1)]
        blocks = [_block(self.address, self.version, first + k, stop) for k, stop in enumerate(ends)]
        return b"".join(blocks)[self.at - first * BLOCK_BYTES : end - first * BLOCK_BYTES]


@lru_cache(maxsize=KEPT_BLOCKS)
def _block(address: str, version: int, n: int, end: int) -> bytes:
    return _range(address, n * BLOCK_BYTES, end)


def _range(address: str, start: int, end: int) -> bytes:
    if end == start:
        return b""
    content = _asked(address, partial(_part, start=start, end=end), end - start)
    if len(content) != end - start:
        more = "more than " if len(content) > end - start else ""
        found = f"{more}{min(len(content), end - start)} bytes of a range of {end - start}"
        raise WorkerError(f"{address}: {found}: the server does not serve ranges, or the file changes")
    return content


def _part(store: Any, path: str, wait: Callable[..., Any], start: int, end: int) -> bytes:
    """Bytes of a file from `start` to before `end`; of a web server that sends more, some more.

    `wait` returns what a coroutine returns that the store's event loop runs.
    """
    if "http" not in store.protocol:
        return bytes(store.cat_file(path, start=start, end=end))

    async def read() -> bytes:
        session, content = await store.set_session(), bytearray()
        headers = {"Range": f"bytes={start}-{end - 1}"}
        async with session.get(store.encode_url(path), headers=headers) as answer:
            store._raise_not_found_for_status(answer, path)
            async for part in answer.content.iter_any():
                content += part
                if len(content) > end - start:
                    break
        return bytes(content)

    return bytes(wait(store.loop, read))


@lru_cache(maxsize=256)
def _state(address: str, period: int) -> tuple[int, int]:
    """Size and version of a file, asked for once in each period of time."""
    facts = _asked(address, lambda store, path, _: store.info(path))
    if facts["type"] != "file":
        raise FileNotFoundError(errno.ENOENT, "no such file", address)
    if facts["size"] is None:
        raise WorkerError(f"{address}: the server does not state its size")
    told = sorted((str(key), str(value)) for key, value in facts.items())
    return int(facts["size"]), zlib.crc32(repr(told).encode())


def _asked(address: str, question: Callable[..., Answer], size: int = 0) -> Answer:
    """The answer to a question to the store of an address: a function of the store, the path in it and
    fsspec's `sync`, of `size` bytes. `OSError` for a file that is missing or forbidden, `WorkerError` with
    the store's reason if there is no answer, or none in time.
    """
    try:
        import fsspec.asyn  # of the extra `cluster`

        limit_s = ANSWER_S + size / SLOWEST_BYTES_S
        return _in_time(lambda: question(*fsspec.core.url_to_fs(address), fsspec.asyn.sync), limit_s)
    except TimeoutError as error:
        remedy = "try again, or copy the dump to a disk of this machine"
        raise WorkerError(f"{address}: no answer within {limit_s:.3g} s; {remedy}") from error
    except ImportError as error:
        raise WorkerError(f"{address}: {error}: pip install 'boresight[cluster]'") from error
    except Exception as error:  # stores raise errors of their own, some as the cause of a FileNotFoundError
        missing = isinstance(error, FileNotFoundError)
        cause = error.__cause__ if missing and error.__cause__ else error
        status, reason = getattr(cause, "status", None), str(cause) or type(cause).__name__
        if status == NOT_FOUND or (missing and cause is error):
            raise FileNotFoundError(errno.ENOENT, "no such file", address) from error
        if status in FORBIDDEN or isinstance(cause, PermissionError):
            raise PermissionError(errno.EACCES, reason, address) from error
        raise WorkerError(f"{address}: {reason}") from error


def _in_time(question: Callable[[], Answer], limit_s: float) -> Answer:
    """What the question returns or raises; `TimeoutError` after `limit_s`, while it still waits."""
    answers: queue.SimpleQueue[tuple[Answer | None, Exception | None]] = queue.SimpleQueue()

    def ask() -> None:
        try:
            answers.put((question(), None))
        except Exception as error:
            answers.put((None, error))

    threading.Thread(target=ask, daemon=True).start()
    try:
        answer, error = answers.get(timeout=limit_s)
    except queue.Empty:
        raise TimeoutError(limit_s) from None
    if error is not None:
        raise error
    return cast(Answer, answer)
