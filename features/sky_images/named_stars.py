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
    counts = [found.matches for _, found in named]
    none = np.zeros((0, 2))
    quaternions = np.array([found.R_si.as_quat(canonical=True) for _, found in named]).reshape(-1, 4)
    whole = pa.table(
        {
            "file": arrow_array([str(path) for path, found in named for _ in found.hip], pa.string()),
            "hip": arrow_array(np.concatenate([np.zeros(0, np.int64), *(f.hip for _, f in named)])),
            "xy_px": fixed_list(np.concatenate([none, *(found.xy_px for _, found in named)])),
            "residual_px": fixed_list(np.concatenate([none, *(found.residual_px for _, found in named)])),
            "quaternion_si": fixed_list(np.repeat(quaternions, counts, axis=0)),
        }
    )
    write_whole(out, lambda target: pq.write_table(whole, target, compression="zstd"))
