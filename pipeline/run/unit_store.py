"""Results of finished units on disk: one Parquet file each, found again by a key of everything it depends on.

A unit (one exposure, one strip) has as its key the digest of the records it is computed from, the content of
the files that they name, the settings, the source of the program and the versions of the libraries. A file is
written under another name, flushed and renamed, so that it is on disk as a whole or not at all.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.table_files import read_parquet
from boresight.pipeline.files.whole_file import make_own_folder, write_whole
from boresight.records.record import record, scalar

__all__ = ["UnitStore", "read_meta", "read_unit"]

# Keys of a Parquet file's metadata: remarks on the unit, and a digest of what the file's checksums do not
# cover.
META, SEAL = b"boresight", b"seal"


@record
class UnitStore:
    """A folder of units with one sub-folder for each stage. Many processes may use it at once."""

    root: Path = scalar("the folder")

    def path(self, stage: str, name: str, key: str) -> Path:
        """The file of a unit, which need not exist."""
        return self.root / stage / f"{name}.{key}.parquet"

    def read(self, stage: str, name: str, key: str) -> pa.Table | None:
        """The table of a finished unit; None if it is missing or damaged, so that it has to be computed."""
        return read_unit(self.path(stage, name, key))

    def write(self, stage: str, name: str, key: str, table: pa.Table, meta: Mapping[str, Any]) -> Path:
        """Write a finished unit, remove older results of the same unit, and return the file's path."""
        path = self.path(stage, name, key)
        for folder in (self.root, *reversed(path.relative_to(self.root).parents[:-1])):
            make_own_folder(self.root / folder)
        remarks = json.dumps(dict(meta), sort_keys=True).encode()
        stated = table.replace_schema_metadata({META: remarks, SEAL: _seal(table, remarks)})

        def write(target: Path) -> None:  # few values repeat: without dictionaries it is smaller and faster
            pq.write_table(stated, target, compression="zstd", use_dictionary=False, write_page_checksum=True)

        write_whole(path, write)
        for other in path.parent.glob(f"{name}.*.parquet"):
            if other != path and other.name.count(".") == path.name.count("."):
                other.unlink(missing_ok=True)
        return path


def read_unit(path: Path) -> pa.Table | None:
    """The table of a finished unit; None for a file that is missing or damaged."""
    try:
        table = read_parquet(path)
    except RawDataError:
        return None
    metadata = table.schema.metadata or {}
    return table if metadata.get(SEAL) == _seal(table, metadata.get(META, b"")) else None


def _seal(table: pa.Table, remarks: bytes) -> bytes:
    """Digest of what a Parquet file's own checksums do not cover: names, types, number of rows, metadata."""
    # Parquet calls the items of a list elements.
    columns = [(field.name, str(field.type).replace("<item:", "<element:")) for field in table.schema]
    facts = json.dumps([columns, len(table)]).encode()
    return hashlib.blake2b(facts + remarks, digest_size=16).hexdigest().encode()


def read_meta(table: pa.Table) -> dict[str, Any]:
    """The `meta` that `UnitStore.write` stored in a table."""
    content: dict[str, Any] = json.loads((table.schema.metadata or {})[META])
    return content
