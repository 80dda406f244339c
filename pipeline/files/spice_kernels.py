"""Open the SPICE kernels that a dump names, with NAIF's toolkit (spiceypy, the extra `spice`).

The bytes of a kernel are read as those of every file of a dump, checked, and copied to a folder of their own
that the toolkit loads: it never follows a name that a kernel states. The kernels that a program has loaded
itself are set aside meanwhile and are loaded again afterwards.
"""

from __future__ import annotations

import struct
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from boresight.geometry.record import record, scalar
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.content import content_of, limited_content

__all__ = ["CK", "NO_KERNELS", "SPK", "Kernels", "is_kernel", "loaded", "toolkit"]

CK, SPK = "CK", "SPK"  # kinds of kernels: attitudes, orbit
# First bytes of binary kernels of either kind, and those of files older than 1993.
BINARY = {CK: b"DAF/CK  ", SPK: b"DAF/SPK "}
OF_OLD_FILES = b"NAIF/DAF"
RECORD = 1024  # bytes of a DAF record
BYTE_ORDERS = {b"LTL-IEEE": "<", b"BIG-IEEE": ">"}  # a DAF's LOCFMT, and the sign that `struct` uses for it
MAX_BYTES = 256 * 2**20  # of a kernel; a day of attitudes at 8 Hz takes 28 MB
OTHER_KERNELS = ("KERNELS_TO_LOAD", "PATH_SYMBOLS", "PATH_VALUES")  # keywords that name further files
# The toolkit has one pool of kernels for the whole process.
_ONE_AT_A_TIME = threading.Lock()


@record(kw_only=True)
class Kernels:
    """Kernels beside those of attitudes and orbit: LSK, SCLK, FK."""

    files: tuple[str, ...] = scalar("their names in errors")
    paths: tuple[Path, ...] = scalar("of the same files")
    spacecraft: int | None = scalar("NAIF id of the satellite in the SPK; None: the only object in it")


NO_KERNELS = Kernels(files=(), paths=(), spacecraft=None)  # of a dump without SPICE files


def toolkit(file: str) -> Any:
    """The module spiceypy; `RawDataError` about the kernel `file` where it is not installed."""
    try:
        import spiceypy
    except ImportError as error:
        remedy = "spiceypy: pip install 'boresight[spice]'"
        raise RawDataError(file, "SPICE kernel", str(error), remedy) from error
    return spiceypy


def is_kernel(path: Path, file: str, kind: str) -> bool:
    """Whether the file is a binary kernel of this kind, CK or SPK; False for one that cannot be read.

    `RawDataError` for one of the other kind.
    """
    try:
        start = content_of(path)[:8] if path.stat().st_size <= MAX_BYTES else b""
    except (OSError, ValueError):  # its reader reports it
        return False
    for other, name in BINARY.items():
        if start == name and other != kind:
            raise RawDataError(file, "byte 0", f"a SPICE {other}", f"a {kind}, or another form of this file")
    return start == BINARY[kind]


@contextmanager
def loaded(path: Path, file: str, kernels: Kernels) -> Iterator[str]:
    """The binary kernel `file` and the kernels beside it, loaded in the toolkit, by the name to use in it.

    Errors of the toolkit become `RawDataError` about `file`.
    """
    spice = toolkit(file)
    with tempfile.TemporaryDirectory(prefix="boresight-", ignore_cleanup_errors=True) as folder:
        copies = [
            _copy(*one, Path(folder) / f"{n}.kernel")
            for n, one in enumerate([*zip(kernels.paths, kernels.files), (path, file)])
        ]
        with _ONE_AT_A_TIME:
            try:
                with spice.KernelPool(copies):
                    yield copies[-1]
            except (spice.exceptions.SpiceyError, spice.exceptions.NotFoundError) as error:
                raise RawDataError(file, "SPICE", _reason(error), _remedy(error)) from error


def _copy(path: Path, file: str, copy: Path) -> str:
    """Write a checked kernel to `copy`."""
    raw = limited_content(path, file, "a SPICE kernel", MAX_BYTES)
    if raw.startswith((*BINARY.values(), b"DAF/", OF_OLD_FILES)):
        _check_daf(raw, file)
    elif not raw.startswith(b"KPL/"):
        raise RawDataError(file, "byte 0", raw[:8], "KPL/LSK, KPL/SCLK or KPL/FK, or a DAF")
    elif named := [word for word in OTHER_KERNELS if word.encode() in raw.upper()]:
        expected = "no such keyword; name the kernels themselves under [spice] in dump.toml"
        raise RawDataError(file, named[0], "a meta-kernel", expected)
    copy.write_bytes(raw)
    return str(copy)


def _check_daf(raw: bytes, file: str) -> None:
    """`RawDataError` where the list of segments of a DAF leaves the file, or leads in a circle."""
    order = BYTE_ORDERS.get(raw[88:96])
    if order is None or len(raw) < 2 * RECORD:
        found = f"{raw[88:96]!r}, {len(raw)} bytes"
        raise RawDataError(file, "byte 88", found, "a DAF with LTL-IEEE or BIG-IEEE numbers")
    nd, ni = struct.unpack_from(f"{order}2i", raw, 8)
    if (nd, ni) != (2, 6):
        raise RawDataError(file, "byte 8", f"{nd} and {ni} components", "2 and 6, as a CK and an SPK have")
    at, visited = struct.unpack_from(f"{order}i", raw, 76)[0], set()
    while at:
        if at in visited or not 2 <= at <= len(raw) // RECORD:
            found = f"record {at} of {len(raw) // RECORD}"
            raise RawDataError(file, "list of segments", found, "each record once, inside the file")
        visited.add(at)
        base = (at - 1) * RECORD
        following, _, count = struct.unpack_from(f"{order}3d", raw, base)
        if not (0.0 <= count <= 25.0 and 0.0 <= following < 2**31 and following == int(following)):
            found = f"{count:g} segments, then record {following:g}"
            raise RawDataError(file, f"record {at}", found, "at most 25 segments, and a whole number")
        for n in range(int(count)):
            begin, end = struct.unpack_from(f"{order}2i", raw, base + 24 + 40 * n + 32)
            if not 1 <= begin <= end <= len(raw) // 8:
                found = f"numbers {begin} to {end} of {len(raw) // 8}"
                raise RawDataError(file, f"segment {n + 1} of record {at}", found, "numbers inside the file")
        at = int(following)


def _reason(error: Exception) -> str:
    """What the toolkit says, in one line."""
    short, long = (str(getattr(error, name, "") or "") for name in ("short", "long"))
    return " ".join(f"{short} {long}".split()) or " ".join(str(error).split())


def _remedy(error: Exception) -> str:
    """What may help, by the toolkit's own short names of errors."""
    text = str(error)
    if "MISSINGTIMEINFO" in text or "DELTET" in text or "NOLEAPSECONDS" in text:
        return "a leap-second kernel (LSK) among the kernels under [spice] in dump.toml"
    if "SCLK" in text or "KERNELVARNOTFOUND" in text:
        return "the clock kernel (SCLK) of the satellite among the kernels under [spice] in dump.toml"
    return "whole kernels that belong together; the others are named under [spice] in dump.toml"
