"""Whose a result folder is: marked by us, made from one dump with one set of settings, used by one run.

    boresight-result.json   marks the folder; states what dump and settings the result is made from
    .boresight-lock         process and host of the run that uses the folder

Only files that a run itself writes are ever removed. Nothing is written before the folder is accepted, and
no link in it is followed.
"""

from __future__ import annotations

import errno
import json
import os
import re
import socket
import stat
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

if sys.platform != "win32":
    import fcntl

from boresight.pipeline import __version__
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump_schema import DumpFile
from boresight.pipeline.files.object_store import dump_folder, is_address
from boresight.pipeline.files.text_files import read_json, read_toml
from boresight.pipeline.files.whole_file import write_text
from boresight.pipeline.results.folder import dumps_in
from boresight.pipeline.run.digests import digest
from boresight.pipeline.run.settings import Settings
from boresight.records.record import record, scalar

__all__ = ["Origin", "check_dump_of", "claimed", "dump_folder_of", "dump_identity", "origin_of"]

# Files in a result's folder: whose result it is, and that a run writes into it.
MARKER, LOCK = "boresight-result.json", ".boresight-lock"
# Files and folders of a result that may be replaced or removed; others are the user's.
OWN_FILES = (
    "installation.json run.json requirement.json about.json dumps.json".split()
    + "validation.json report.html report.pdf".split()
    + [f"interior/{n}" for n in "interior.json interior.png remote_camera.toml".split()]
    + [f"drift.{kind}" for kind in ("json", "csv", "png")]
    + [f"sightings/{n}.parquet" for n in "stars exposures targets strips passes ledger omissions".split()]
    + ["sightings/reliability.parquet"]
    + [f"evidence/{n}.parquet" for n in "inputs convergence angles matches exposure ground unmatched".split()]
    + [f"evidence/{n}.parquet" for n in "map allan attitude_noise".split()]
    + [f"evidence/{n}.json" for n in "context budget".split()]
)
# Regular expression of the files of finished work that the program writes, STAGE/NAME.DIGEST.parquet: only
# such files are removed.
OWN_WORK = re.compile(r"(exposures|matching-\d+|sky-stars)/.+\.[0-9a-f]{32}\.parquet")


@record(by_value=True)
class Origin:
    """What a result is made from, as digests that other places of the same files do not change."""

    dump: str = scalar("of dump.toml and the tables that it names; of several dumps, of all of these")
    settings: str = scalar("of the settings that were given")


def dump_identity(root: Path) -> str:
    """Digest of dump.toml and of the files of cameras, orbit, kernels and tables that it names."""
    head = read_toml(root / "dump.toml", DumpFile, "dump.toml")
    kernels = head.spice.kernels if head.spice else []
    cameras = [name for one in head.cameras for name in (one.file, one.installation) if name]
    names = (*head.files.single.values(), *cameras, *kernels)
    return digest([root / "dump.toml", *(root / name for name in names)])


def origin_of(result: Path) -> Origin | None:
    """What the marker of a result folder states; None where there is none; `RawDataError` if damaged."""
    path = result / MARKER
    if not path.is_file():
        return None
    content = read_json(path)
    values = [content.get(key) for key in ("dump", "settings")]
    if not all(isinstance(value, str) for value in values):
        raise RawDataError(str(path), "dump, settings", values, "two digests")
    return Origin(*map(str, values))


def check_dump_of(result: Path, dump: Path) -> None:
    """`RawDataError` where `dump` is not the one that a result is made from."""
    origin = origin_of(result)
    if origin is not None and origin.dump != dump_identity(dump):
        expected = f"the dump that {result} is made from (dump.toml and the tables that it names differ)"
        raise RawDataError(str(dump), "dump", "another dump", expected)


def dump_folder_of(result: Path) -> Path:
    """The folder of the dump that a run, finished or not, was started with: where it was, or where it now
    lies from the result, if both were moved. `RawDataError` where there is none, or it holds another dump.
    """
    path = result / MARKER
    content = read_json(path)
    folders, beside = content.get("folders"), content.get("from_result")
    places = [dump_folder(str(folders[0]))] if isinstance(folders, list) and len(folders) == 1 else []
    places += [(result / str(beside[0])).resolve()] if places and isinstance(beside, list) else []
    there = [place for place in places if place.is_dir()]
    if not there:
        expected = "the folder of the one dump that the result was made from; or give --dump"
        raise RawDataError(str(path), "folders", folders, expected)
    check_dump_of(result, there[0])
    return there[0]


@contextmanager
def claimed(
    result: Path, dumps: Sequence[Path], settings: Settings, *, overwrite: bool = False
) -> Iterator[None]:
    """Own a result folder while a run writes into it. The folder is made, marked and locked.

    `RawDataError` where the folder is a dump or lies in one, holds files that are not a result's or links,
    holds the result of another dump or of other settings (unless `overwrite`), is used by another run, or, at
    the end of the block, was moved or deleted.
    """
    _check_place(result, dumps)
    identities = sorted(dump_identity(dump) for dump in dumps)
    origin = Origin(identities[0] if len(dumps) == 1 else digest(identities), digest(settings))
    _accepted(result, origin, overwrite)
    result.mkdir(parents=True, exist_ok=True)
    with _locked(result) as check_is_there:
        before = _accepted(result, origin, overwrite)
        if before != origin:
            _take_over(result, origin, dumps)
        try:
            yield
        except OSError:
            check_is_there()
            raise
        check_is_there()


def _check_place(result: Path, dumps: Sequence[Path]) -> None:
    if is_address(result.as_posix().replace(":/", "://", 1)):
        raise RawDataError("--out", str(result), "an address", "a folder of this machine")
    try:
        str(result.resolve()).encode()
    except UnicodeEncodeError:
        found = "a name that is not text in UTF-8"
        raise RawDataError("--out", str(result), found, "a folder with a name in UTF-8") from None
    if result.exists() and not result.is_dir():
        raise RawDataError("--out", str(result), "a file", "a folder")
    for dump in dumps:
        if result.resolve().is_relative_to(dump.resolve()):
            raise RawDataError("--out", str(result), f"a folder of the dump {dump}", "a folder outside of it")


def _accepted(result: Path, origin: Origin, overwrite: bool) -> Origin | None:
    """What the folder holds a result of, if any; `RawDataError` where a run of `origin` must not write."""
    if not result.is_dir():
        return None
    if os.path.lexists(result / LOCK):
        _check_lock(result / LOCK, os.lstat(result / LOCK))  # not opened: a close would release its lock
    _check_no_links(result)
    before = origin_of(result)
    if before is None:
        ours = re.compile(rf"{re.escape(LOCK)}|\.{re.escape(MARKER)}\..*\.tmp")
        others = sorted(entry.name for entry in result.iterdir() if not ours.fullmatch(entry.name))
        if others:
            raise _not_ours(result, others)
    elif before != origin and not overwrite:
        another = "another dump" if before.dump != origin.dump else "other settings"
        expected = "another folder, or --overwrite to replace that result"
        raise RawDataError("--out", str(result), f"a result of {another}", expected)
    return before


def _check_no_links(result: Path) -> None:
    """`RawDataError` where the marker, or a folder that a run writes into, is a link."""
    own = {result / MARKER, *(result / Path(name).parts[0] for name in OWN_FILES), result / "work"}
    own |= {*(result / "work").glob("*")} if not (result / "work").is_symlink() else set()
    if links := sorted(path for path in own if path.is_symlink()):
        expected = "a folder without links; remove the link, or name another folder"
        raise RawDataError("--out", str(result), f"a link, {links[0].relative_to(result)}", expected)


def _take_over(result: Path, origin: Origin, dumps: Sequence[Path]) -> None:
    """Remove the result of something else and mark the folder. Finished units of the same dump, or of an
    edited one in the same place, stay: they are used again or replaced one by one.
    """
    folders = [str(dump) for dump in dumps]
    if (before := origin_of(result)) is not None:
        elsewhere = read_json(result / MARKER).get("folders") != folders
        _remove_own(result, work=before.dump != origin.dump and elsewhere)
    content: dict[str, Any] = {
        "program": f"boresight {__version__}",
        "dump": origin.dump,
        "settings": origin.settings,
    }
    content |= {"folders": folders, "from_result": [os.path.relpath(dump, result) for dump in dumps]}
    text = json.dumps(content, indent=2) + "\n"
    write_text(result / MARKER, text)


def _not_ours(result: Path, names: list[str]) -> RawDataError:
    """The error for a folder without marker, which may hold the result of a version that wrote none."""
    with suppress(RawDataError):
        version = read_json(result / "installation.json", "installation.json").get("version")
        if isinstance(version, str):
            found = f"a result of boresight {version} without {MARKER}, written before there was one"
            expected = "another folder (report, validate and export still read this one), or delete it first"
            return RawDataError("--out", str(result), found, expected)
    found = f"{', '.join(names[:3])}{' ...' if len(names) > 3 else ''}"
    return RawDataError("--out", str(result), found, "a new or empty folder, or one that boresight made")


def _remove_own(result: Path, *, work: bool) -> None:
    """Remove what runs wrote into a result folder and into those of its dumps; `work`: finished units too."""
    for name in dumps_in(result):
        if origin_of(result / name) is None:
            continue
        _remove_own(result / name, work=work)
        if work:
            (result / name / MARKER).unlink()
            (result / name / LOCK).unlink(missing_ok=True)
            _remove_empty(result / name)
    own = [result / name for name in OWN_FILES]
    if work:
        units = (result / "work").glob("*/*.parquet")
        own += [path for path in units if OWN_WORK.fullmatch("/".join(path.parts[-2:]))]
    for path in own:
        path.unlink(missing_ok=True)
    for folder in (*sorted({path.parent for path in own} - {result}), result / "work"):
        _remove_empty(folder)


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):  # not there, or not empty
        folder.rmdir()


@contextmanager
def _locked(result: Path) -> Iterator[Callable[[], None]]:
    """Lock the folder; the system releases the lock of a process that ends in whatever way. The block gets a
    function that raises `RawDataError` where the locked file is no longer in its place.
    """
    path = result / LOCK
    with open(_open_lock(path), "r+", encoding="utf-8") as stream:

        def check_is_there() -> None:
            with suppress(OSError):
                if os.path.samestat(path.stat(follow_symlinks=False), os.fstat(stream.fileno())):
                    return
            found = "a folder that was moved or deleted during the run"
            raise RawDataError("--out", str(result), found, "the folder of the run until it ends; run again")

        if not _lock(stream):
            stream.seek(0)
            owner = stream.read(200).strip() or "another run"
            raise RawDataError("--out", str(result), f"in use by {owner}", "a folder that no other run uses")
        stream.truncate(0)
        stream.write(f"process {os.getpid()} on {socket.gethostname()}")
        stream.flush()
        yield check_is_there
        stream.truncate(0)


def _open_lock(path: Path) -> int:
    """Descriptor of the lock, which is made if it is not there; `RawDataError` for a link or another kind."""
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        descriptor = os.open(path, flags, 0o666)
    except OSError:
        _check_lock(path, os.lstat(path))
        raise
    try:
        _check_lock(path, os.fstat(descriptor))
    except RawDataError:
        os.close(descriptor)
        raise
    return descriptor


def _check_lock(path: Path, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode) or status.st_nlink != 1:
        found = "a link or another file than a run's lock"
        raise RawDataError("--out", str(path), found, "the lock of a run; remove what is there")


def _lock(stream: Any) -> bool:
    """Lock an open file for this process; false where another process, also of another host, has it."""
    if sys.platform == "win32":
        return True
    try:
        fcntl.lockf(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN):
            return False
        warnings.warn(f"{stream.name}: this file system has no locks ({error.strerror})", stacklevel=2)
    return True
