"""The stars named in single images, as one Parquet file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from boresight.pipeline.files.table_files import arrow_array, fixed_list
from boresight.pipeline.files.whole_file import write_whole
from boresight.star_id.field import FieldSolution

__all__ = ["write_named_stars"]


def write_named_stars(out: Path, named: Sequence[tuple[Path, FieldSolution]]) -> None:
    """One row a star of each image: file, hip, xy_px, residual_px, quaternion_si."""
    tables = [_table(path, found) for path, found in named]
    whole = pa.concat_tables(tables) if tables else _table_of_nothing()
    write_whole(out, lambda target: pq.write_table(whole, target, compression="zstd"))


def _table(path: Path, found: FieldSolution) -> pa.Table:
    n = found.matches
    return pa.table(
        {
            "file": arrow_array([str(path)] * n, pa.string()),
            "hip": arrow_array(found.hip),
            "xy_px": fixed_list(found.xy_px),
            "residual_px": fixed_list(found.residual_px),
            "quaternion_si": fixed_list(np.tile(found.R_si.as_quat(canonical=True), (n, 1))),
        }
    )


def _table_of_nothing() -> pa.Table:
    pairs = fixed_list(np.zeros((0, 2)))
    return pa.table(
        {
            "file": arrow_array([], pa.string()),
            "hip": arrow_array([], pa.int64()),
            "xy_px": pairs,
            "residual_px": pairs,
            "quaternion_si": fixed_list(np.zeros((0, 4))),
        }
    )
