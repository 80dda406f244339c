"""Units of finished work on disk: one Parquet file each, found again by what it was made from.

A unit (one exposure, one strip) is known by a digest of everything that its result depends on: the records it
was called with, the content of the files they name, the settings and the program itself. A file is
written under another name, flushed and renamed, so that a unit is either there as a whole or not at all,
whatever happens.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.resources
import json
from collections.abc import Mapping
from enum import Enum
from functools import cache
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from boresight.pipeline import __version__
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.table_files import read_parquet
from boresight.pipeline.files.whole_file import write_whole

__all__ = [
    "UnitStore",
    "digest",
    "program",
    "read_meta",
    "read_unit",
]

META, SEAL = b"boresight", b"seal"
WHOLE_FILE_BYTES = 64 * 2**20  # larger files are known by size, time of change and both ends
END_BYTES = 2**20


def digest(*values: Any) -> str:
    """32 hexadecimal digits that change when anything in `values` does; a `Path` stands for its file's
    content.
    """
    state = hashlib.blake2b(digest_size=16)
    for value in values:
        _feed(state, value)
    return state.hexdigest()


def _feed(state: Any, value: Any) -> None:
    if value is None or isinstance(value, (bool, int, float, str, bytes, np.number, np.bool_)):
        state.update(f"{type(value).__name__}:{value!r};".encode())
    elif isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value)
        state.update(f"array:{array.dtype.str}:{array.shape};".encode())
        state.update(array.astype(str).tobytes() if array.dtype == object else array.tobytes())
    elif isinstance(value, Rotation):
        _feed(state, value.as_quat())
    elif isinstance(value, Path):
        _feed_file(state, value)
    elif isinstance(value, Enum):
        _feed(state, value.name)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        state.update(f"{type(value).__name__}(".encode())
        for field in dataclasses.fields(value):
            if field.init:
                state.update(f"{field.name}=".encode())
                _feed(state, getattr(value, field.name))
        state.update(b")")
    elif isinstance(value, Mapping):
        state.update(f"map:{len(value)};".encode())
        for key in sorted(value):
            _feed(state, key)
            _feed(state, value[key])
    elif isinstance(value, (tuple, list)):
        state.update(f"list:{len(value)};".encode())
        for item in value:
            _feed(state, item)
    else:
        raise TypeError(f"no digest for a {type(value).__name__}")


def _feed_file(state: Any, path: Path) -> None:
    try:
        size = path.stat().st_size
        with path.open("rb") as stream:
            if size <= WHOLE_FILE_BYTES:
                state.update(f"file:{size};".encode())
                while block := stream.read(2**20):
                    state.update(block)
            else:
                state.update(f"large file:{size}:{path.stat().st_mtime_ns};".encode())
                state.update(stream.read(END_BYTES))
                stream.seek(size - END_BYTES)
                state.update(stream.read(END_BYTES))
    except OSError as error:
        state.update(f"no file:{error.errno};".encode())


@cache
def program(*packages: str) -> str:
    """The version of the program, and a digest of the source of those packages that a stage rests on.

    So a unit is made again when the code behind it has changed, also where nobody has raised a version
    number.
    """
    sources: dict[str, bytes] = {}
    for package in packages:
        sources |= _sources(importlib.resources.files(package), package)
    return f"{__version__} {digest(sources)}"


def _sources(folder: Traversable, name: str) -> dict[str, bytes]:
    """Python files of a folder and of those within it."""
    sources: dict[str, bytes] = {}
    for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
        if entry.is_dir():
            sources |= _sources(entry, f"{name}/{entry.name}")
        elif entry.name.endswith(".py"):
            sources[f"{name}/{entry.name}"] = entry.read_bytes()
    return sources


@dataclasses.dataclass(frozen=True, slots=True)
class UnitStore:
    """A folder of units, one sub-folder a stage. Safe to be used by many processes at once."""

    root: Path

    def path(self, stage: str, name: str, key: str) -> Path:
        return self.root / stage / f"{name}.{key}.parquet"

    def read(self, stage: str, name: str, key: str) -> pa.Table | None:
        """The finished unit, or None when it has to be made. A file that cannot be read counts as not
        made.
        """
        return read_unit(self.path(stage, name, key))

    def write(self, stage: str, name: str, key: str, table: pa.Table, meta: Mapping[str, Any]) -> Path:
        """Write a finished unit; results of the same unit that were made from something else are removed."""
        path = self.path(stage, name, key)
        path.parent.mkdir(parents=True, exist_ok=True)
        remarks = json.dumps(dict(meta), sort_keys=True).encode()
        stated = table.replace_schema_metadata({META: remarks, SEAL: _seal(table, remarks)})
        write_whole(
            path, lambda target: pq.write_table(stated, target, compression="zstd", write_page_checksum=True)
        )
        for other in path.parent.glob(f"{name}.*.parquet"):
            if other != path and other.name.count(".") == path.name.count("."):
                other.unlink(missing_ok=True)
        return path


def read_unit(path: Path) -> pa.Table | None:
    """A finished unit; None for a file that is not there or is not whole."""
    try:
        table = read_parquet(path)
    except RawDataError:
        return None
    metadata = table.schema.metadata or {}
    return table if metadata.get(SEAL) == _seal(table, metadata.get(META, b"")) else None


def _seal(table: pa.Table, remarks: bytes) -> bytes:
    """Digest of what a Parquet file's own checksums do not cover: names, types, rows, remarks."""
    # Parquet calls the items of a list elements.
    columns = [(field.name, str(field.type).replace("<item:", "<element:")) for field in table.schema]
    facts = json.dumps([columns, len(table)]).encode()
    return hashlib.blake2b(facts + remarks, digest_size=16).hexdigest().encode()


def read_meta(table: pa.Table) -> dict[str, Any]:
    """What `UnitStore.write` was given as `meta`."""
    content: dict[str, Any] = json.loads((table.schema.metadata or {})[META])
    return content
