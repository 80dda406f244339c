"""GIPP files of Sentinel-2 as they are distributed: NAME.xml, NAME.DBL beside NAME.HDR, or NAME.tgz,
NAME.tar.gz and NAME.zip with these; in a folder, in folders of it, or in one archive of several.

Archives are read in memory: of their members only regular files with a wanted name are looked at, and nothing
is written. A DBL is the document itself, or the Data_Block of an Earth Explorer file.
"""

from __future__ import annotations

import io
import lzma
import re
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePosixPath
from xml.etree.ElementTree import Element

from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.content import check_extent, limited_content
from boresight.pipeline.files.text_files import unpacked
from boresight.pipeline.files.xml_files import xml_of_bytes
from boresight.records.record import record, scalar

__all__ = ["GippFile", "find_gipp_files", "gipp_root"]

# Endings of files and archives that hold GIPP documents.
DOCUMENTS = (".xml", ".eof", ".dbl")
ARCHIVES = (".tgz", ".tar.gz", ".tar", ".zip")
ZIP, TAR = b"PK\x03\x04", b"ustar"  # the first bytes of a ZIP archive, and bytes 257 to 261 of a tar archive
# Kinds of files of a ZIP archive that are read; 0: the archive does not state them (made on Windows).
REGULAR = (0, stat.S_IFREG)
DAMAGE = (
    tarfile.TarError,
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    OSError,
    EOFError,
    ValueError,
    OverflowError,
    RuntimeError,  # a password
    NotImplementedError,  # a compression of other programs
)
EXPECTED = "a folder, a GIPP file or an archive of them"  # what messages say was expected
MAX_BYTES = 128 * 2**20  # of a file, packed and unpacked; all GIPP files of a satellite take 40 MB
# Most members of an archive that are looked at: a package holds some hundred.
MAX_MEMBERS = 10_000
MAX_DEPTH = 2  # archives inside an archive


@record
class GippFile:
    """One GIPP file, not yet read."""

    file: str = scalar("its name for messages, of a member of an archive with the archive's")
    content: Callable[[], bytes] = scalar("reads it")


def find_gipp_files(place: Path, stem: str) -> dict[str, GippFile]:
    """Files by name without suffix, of which the whole name matches the regular expression `stem`.

    `place` is a folder or an archive. Of several packings of one file a document is taken before an archive.
    """
    if not place.is_dir():
        raw = limited_content(place, place.name, EXPECTED, MAX_BYTES)
        return _members(raw, place.name, stem)
    inside = [path for path in sorted(place.iterdir()) if path.is_dir() and re.fullmatch(stem, path.name)]
    paths = [path for folder in (place, *inside) for path in sorted(folder.iterdir()) if not path.is_dir()]
    files = {path.relative_to(place).as_posix(): path for path in paths}
    return {
        name: GippFile(file, partial(limited_content, files[file], file, EXPECTED, MAX_BYTES))
        for name, file in _wanted(list(files), stem).items()
    }


def gipp_root(gipp: GippFile, stem: str, depth: int = 0) -> Element:
    """The element with the data of a file of that name without suffix.

    `RawDataError` for a damaged file, for an archive without such a document, and for more than the limits.
    """
    raw = unpacked(gipp.content(), gipp.file, MAX_BYTES)
    if not _is_archive(raw):
        root = xml_of_bytes(raw, gipp.file)  # the document, or an Earth Explorer file with it
        return next((one for one in root.iterfind("Data_Block/*") if one.find("DATA") is not None), root)
    members = _members(raw, gipp.file, re.escape(stem))
    if stem not in members or depth == MAX_DEPTH:
        raise RawDataError(gipp.file, "members", "no such document", f"{stem}.DBL, .xml or .EOF")
    return gipp_root(members[stem], stem, depth + 1)


def _wanted(files: list[str], stem: str) -> dict[str, str]:
    """Of names of files those wanted, by their names without suffix."""
    found: dict[str, str] = {}
    for suffix in (*DOCUMENTS, *ARCHIVES):
        for file in files:
            name = PurePosixPath(file).name
            if name.lower().endswith(suffix) and re.fullmatch(stem, own := name[: -len(suffix)]):
                found.setdefault(own, file)
    return found


def _is_archive(raw: bytes) -> bool:
    return raw[257:262] == TAR or raw.startswith(ZIP)


def _members(raw: bytes, file: str, stem: str) -> dict[str, GippFile]:
    """Wanted files of an archive, ZIP or tar, plain or compressed with gzip; their bytes are copied here."""
    raw = unpacked(raw, file, MAX_BYTES)
    if not _is_archive(raw):
        expected = "a folder of GIPP files, or an archive of them: ZIP, or tar, plain or with gzip"
        raise RawDataError(file, "byte 257", "no tar archive", expected)
    with refusing(file, "archive", "a whole archive, without a password", DAMAGE):
        wanted = _of_zip(raw, file, stem) if raw.startswith(ZIP) else _of_tar(raw, file, stem)
    return {
        own: GippFile(f"{file}: {PurePosixPath(name).name}", partial(bytes, content))
        for own, (name, content) in wanted.items()
    }


def _of_tar(raw: bytes, file: str, stem: str) -> dict[str, tuple[str, bytes]]:
    """Names and bytes of the wanted files of a tar archive, by their names without suffix."""
    with tarfile.open(fileobj=io.BytesIO(raw), mode="r:") as archive:
        regular: dict[str, tarfile.TarInfo] = {}
        for count, member in enumerate(archive):
            check_extent(file, "archive", (count + 1,), MAX_MEMBERS, "members")
            if member.isreg() and not member.issparse() and member.size <= len(raw):
                regular[member.name] = member
        found = {}
        for own, name in _wanted(list(regular), stem).items():
            stream = archive.extractfile(regular[name])
            assert stream is not None  # of a regular file
            found[own] = name, stream.read()
    return found


def _of_zip(raw: bytes, file: str, stem: str) -> dict[str, tuple[str, bytes]]:
    """The same of a ZIP archive."""
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        members = archive.infolist()
        check_extent(file, "archive", (len(members),), MAX_MEMBERS, "members")
        regular = {one.filename: one for one in members if stat.S_IFMT(one.external_attr >> 16) in REGULAR}
        found, size = {}, 0
        for own, name in _wanted(list(regular), stem).items():
            with archive.open(regular[name]) as stream:
                content = stream.read(MAX_BYTES - size + 1)
            size += len(content)
            check_extent(file, "unpacked", (size,), MAX_BYTES, "bytes")
            found[own] = name, content
    return found
