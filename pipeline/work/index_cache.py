"""The index of catalogue triangles, kept between runs in the user's cache folder.

The key of a file is the digest of catalogue, epoch, field of view and program. The few files used last are
kept. If the folder cannot be written, the index is built in every run; a damaged file is replaced with a
warning.
"""

from __future__ import annotations

import warnings
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from boresight.geometry.starlight import StarPlaces
from boresight.pipeline.files.whole_file import write_whole
from boresight.pipeline.work.digests import digest, numerical_program
from boresight.star_id.identification.triangle_index import StarIndex, build_index

__all__ = ["cache_folder", "cached_index"]

_KEPT = 6  # files; the largest, for all fields of view, takes 60 MB


def cached_index(stars: StarPlaces, epoch_jyear: float, fov_rad: float | tuple[float, float]) -> StarIndex:
    """The index that `build_index` returns, read from the cache if it is there."""
    key = digest(stars, float(epoch_jyear), fov_rad, numerical_program("boresight.star_id"))
    path = cache_folder() / f"triangles-{key}.npz"
    try:
        with np.load(path, allow_pickle=False) as file:
            index = StarIndex.from_arrays(stars, epoch_jyear, dict(file))
        with suppress(OSError):
            path.touch()  # the time of the last use
        return index
    except OSError:
        pass  # missing or not readable
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        warnings.warn(f"{path}: damaged ({error}); the index is built again", stacklevel=2)
    index = build_index(stars, epoch_jyear, fov_rad)
    _keep(path, index)
    return index


def cache_folder() -> Path:
    """The folder in which this platform keeps a user's cached files of `boresight` (it need not exist)."""
    return platformdirs.user_cache_path("boresight", appauthor=False)


def _keep(path: Path, index: StarIndex) -> None:
    arrays: dict[str, Any] = index.arrays

    def write(target: Path) -> None:
        with target.open("wb") as stream:
            np.savez(stream, **arrays)

    with suppress(OSError):  # read-only or full: the next run builds the index again
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, write)
        files = sorted(path.parent.glob("triangles-*.npz"), key=lambda file: file.stat().st_mtime_ns)
        for old in files[:-_KEPT]:
            old.unlink(missing_ok=True)
