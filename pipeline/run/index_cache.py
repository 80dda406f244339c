"""The index of catalogue triangles, kept between runs in the user's cache folder.

The key of a file is the digest of catalogue, epoch, field of view and program. The few files used last are
kept. If the folder cannot be written, the index is built in every run; a damaged file is replaced with a
warning.
"""

from __future__ import annotations

import warnings
from contextlib import suppress
from pathlib import Path

import platformdirs

from boresight.geometry.starlight import StarPlaces
from boresight.pipeline.files.array_file import mapped_arrays, write_arrays
from boresight.pipeline.files.whole_file import write_whole
from boresight.pipeline.run.digests import digest, numerical_program
from boresight.star_id.identification.triangle_index import StarIndex, build_index

__all__ = ["cache_folder", "cached_index"]

_KEPT = 6  # files; the largest, for all fields of view, takes 60 MB


def cached_index(stars: StarPlaces, epoch_jyear: float, fov_rad: float | tuple[float, float]) -> StarIndex:
    """The index that `build_index` returns, read from the cache if it is there."""
    key = digest(stars, float(epoch_jyear), fov_rad, numerical_program(StarIndex.__module__))
    path = cache_folder() / f"triangles-{key}.arrays"
    try:
        index = StarIndex.from_arrays(stars, epoch_jyear, mapped_arrays(path))
        with suppress(OSError):
            path.touch()  # the time of the last use
        return index
    except OSError:
        pass  # missing or not readable
    except ValueError as error:
        warnings.warn(f"{path}: damaged ({error}); the index is built again", stacklevel=2)
    index = build_index(stars, epoch_jyear, fov_rad)
    _keep(path, index)
    return index


def cache_folder() -> Path:
    """The folder in which this platform keeps a user's cached files of `boresight` (it need not exist)."""
    return platformdirs.user_cache_path("boresight", appauthor=False)


def _keep(path: Path, index: StarIndex) -> None:
    with suppress(OSError):  # read-only or full: the next run builds the index again
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, lambda target: write_arrays(target, index.arrays))
        files = sorted(path.parent.glob("triangles-*"), key=lambda file: file.stat().st_mtime_ns)
        for old in files[:-_KEPT]:
            old.unlink(missing_ok=True)
