"""The surface of the Earth in a dump: terrain models, or the heights of its targets."""

from __future__ import annotations

from dataclasses import field
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from boresight.geometry.geodesy import unit_vectors
from boresight.geometry.geoid import egm96
from boresight.geometry.terrain import ConstantHeight, Raster, Surface, TerrainGrid, TerrainTiles, joined
from boresight.pipeline.errors import refusing
from boresight.pipeline.files.content import Identity, identity_of
from boresight.pipeline.files.images.rasters import read_grid
from boresight.records.record import Floats, array, record

__all__ = ["NO_TERRAIN", "TargetHeights", "TerrainFiles", "mean_level", "surface_of"]

# Most pixels of a terrain model; of single precision they take 256 MiB.
MAX_TERRAIN_PIXELS = 8192 * 8192
MAX_TERRAIN_BYTES = 16 * MAX_TERRAIN_PIXELS  # of a file: of doubles, not packed, with a smaller copy


@record
class TargetHeights:
    """The surface of a dump without terrain model: a point has the height of the nearest target."""

    directions: Floats = array("N, 3", "unit vectors to the targets from the centre of a sphere")
    heights_m: Floats = array("N", "ellipsoidal heights of the targets, m")
    _tree: cKDTree = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tree", cKDTree(self.directions))

    def height_m(self, lat_rad: Floats, lon_rad: Floats) -> Floats:
        """Ellipsoidal heights (m) at points (...), latitude and longitude in radians; NaN for NaN."""
        lat, lon = np.broadcast_arrays(np.asarray(lat_rad, dtype=float), np.asarray(lon_rad, dtype=float))
        points = unit_vectors(lon.ravel(), lat.ravel())
        good = np.isfinite(points).all(axis=1)
        heights = np.full(len(points), np.nan)
        if good.any():
            heights[good] = self.heights_m[self._tree.query(points[good])[1]]
        return heights.reshape(lat.shape)

    def height_range_m(self) -> tuple[float, float]:
        """Heights (m) of the lowest and the highest target."""
        return float(self.heights_m.min()), float(self.heights_m.max())


NO_TERRAIN = TargetHeights(np.zeros((0, 3)), np.zeros(0))  # of a dump with strips of the sky alone


@record(by_value=True)
class TerrainFiles:
    """Terrain models that are read where they are needed. Equal files are read once (`surface_of`)."""

    files: tuple[str, ...]  # paths as dump.toml gives them
    paths: tuple[Path, ...]
    height_kind: str


def surface_of(terrain: TerrainFiles | TargetHeights, height_m: float | None = None) -> Surface:
    """The surface of the Earth, or one of a height that is given instead. A terrain file is read once in each
    process, as long as it stays the same.
    """
    if height_m is not None:
        return ConstantHeight(height_m)
    if isinstance(terrain, TargetHeights):
        return terrain
    return _read_terrain(terrain, tuple(map(identity_of, terrain.paths)))


def mean_level(terrain: TerrainFiles | TargetHeights) -> ConstantHeight:
    """Level ground midway between the lowest and the highest point of the surface."""
    return ConstantHeight(float(np.mean(surface_of(terrain).height_range_m())))


@lru_cache(maxsize=1)
def _read_terrain(terrain: TerrainFiles, identities: tuple[Identity, ...]) -> TerrainGrid | TerrainTiles:
    rasters, left = [], MAX_TERRAIN_PIXELS
    for file, path in zip(terrain.files, terrain.paths):
        grid = read_grid(path, file, max_pixels=left)
        rasters.append(Raster(grid.values, grid.transform, grid.crs))
        left -= grid.values.size
    geoid = egm96() if terrain.height_kind == "egm96" else None
    with refusing(", ".join(terrain.files), "heights", "a grid of heights"):
        grids = tuple(
            TerrainGrid.from_raster(raster.heights_m, raster.transform, raster.crs, geoid)
            for raster in joined(rasters, MAX_TERRAIN_PIXELS)
        )
    return grids[0] if len(grids) == 1 else TerrainTiles(grids)
