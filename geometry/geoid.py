"""Height of the geoid above the WGS84 ellipsoid, from a global or regional grid of latitude and longitude.

Ellipsoidal height = orthometric height (above mean sea level) + undulation. EGM96 on its 5' grid is part of
the package (source: `geometry/data/README.md`). Interpolation is bicubic convolution (Keys 1981).
"""

from __future__ import annotations

import importlib.resources
from functools import cache
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray

from boresight.records.record import Floats, Ints, array, record, scalar

__all__ = ["Geoid", "egm96"]


@record
class Geoid:
    """Undulations on a regular grid of latitude and longitude.

    `undulations[r, c]` is the value at latitude `lat_first_rad + r step_lat_rad` and longitude
    `lon_first_rad + c step_lon_rad`. A grid around the whole Earth is periodic in longitude, with or without
    a repeated last column. Raises `ValueError` for less than 2 x 2 points or missing values.
    """

    undulations: NDArray[Any] = array("R, C", "geoid above the ellipsoid, single precision or 16 bit")
    lat_first_rad: float = scalar("latitude of the first row")
    lon_first_rad: float = scalar("longitude of the first column")
    step_lat_rad: float = scalar("from row to row; negative in north-up rasters")
    step_lon_rad: float = scalar("from column to column")
    per_m: float = scalar("units of `undulations` in a metre: 100 for centimetres", default=1.0)

    def __post_init__(self) -> None:
        if min(self.undulations.shape) < 2:
            raise ValueError(f"a geoid grid needs at least 2 x 2 points, got {self.undulations.shape}")
        if self.undulations.dtype.kind == "f" and not np.all(np.isfinite(self.undulations)):
            raise ValueError("a geoid grid must not have missing values")

    @staticmethod
    def from_raster(undulations_m: ArrayLike, transform: ArrayLike) -> Geoid:
        """Geoid from a raster in degrees (GeoTIFF or GTX files of EGM2008 and national geoids).

        `undulations_m` (rows, columns) are values at pixel centres, m; `transform` is the six numbers (a, 0,
        c, 0, e, f) of rasterio's Affine, whose origin is the corner of the first pixel. Raises `ValueError`
        for a rotated raster.
        """
        a, b, c, d, e, f = (float(value) for value in np.ravel(np.asarray(transform, dtype=float))[:6])
        if b or d or not (a and e):
            raise ValueError(f"a geoid raster must have its rows along parallels, got {(a, b, c, d, e, f)}")
        first_lat, first_lon = np.radians(f + 0.5 * e), np.radians(c + 0.5 * a)
        grid = np.asarray(undulations_m, dtype=np.float32)
        return Geoid(grid, float(first_lat), float(first_lon), float(np.radians(e)), float(np.radians(a)))

    def undulation_m(self, lat_rad: ArrayLike, lon_rad: ArrayLike) -> Floats:
        """Height of the geoid above the ellipsoid, m, in the broadcast shape of the arguments.

        Longitude may exceed +-pi. Raises `ValueError` for a point outside the grid.
        """
        lat, lon = np.broadcast_arrays(np.asarray(lat_rad, float), np.asarray(lon_rad, float))
        row, column = self._row_and_column(lat, lon)
        near, row_weights = self._four_rows(row)
        result = np.zeros(row.shape)
        for i in range(4):
            result += row_weights[i] * self._along_rows(near[i], column)
        return result

    def undulation_on_grid_m(self, lat_rad: ArrayLike, lon_rad: ArrayLike) -> Floats:
        """Undulations (R, C), m, on a grid of latitudes (R,) and longitudes (C,).

        Equal to `undulation_m` bit for bit, and faster: each row of the geoid is interpolated once.
        """
        lat, lon = np.asarray(lat_rad, float)[:, None], np.asarray(lon_rad, float)[None, :]
        row, column = self._row_and_column(lat, lon)
        near, row_weights = self._four_rows(row[:, 0])
        needed, index = np.unique(np.stack(near), return_inverse=True)
        lines, index = self._along_rows(needed[:, None], column), index.reshape(4, -1)
        result = np.zeros((len(row), column.shape[1]))
        for weight, at in zip(row_weights, index):
            result += weight[:, None] * lines[at]
        return result

    @property
    def _period(self) -> int:
        """Columns of 360 degrees for a grid around the whole Earth, else 0."""
        period = round(2.0 * np.pi / abs(self.step_lon_rad))
        return period if self.undulations.shape[1] >= period else 0

    def _row_and_column(self, lat: Floats, lon: Floats) -> tuple[Floats, Floats]:
        """Fractional row and column of points; `ValueError` outside the grid."""
        rows, columns = self.undulations.shape
        row = (lat - self.lat_first_rad) / self.step_lat_rad
        column = (lon - self.lon_first_rad) / self.step_lon_rad
        column = np.mod(column, 2.0 * np.pi / abs(self.step_lon_rad))
        slack = 1e-6
        outside = (row < -slack) | (row > rows - 1 + slack)
        if not self._period:
            outside = outside | (column > columns - 1 + slack)
        if np.any(outside):
            lat, lon, outside = (np.ravel(each) for each in np.broadcast_arrays(lat, lon, outside))
            where = int(np.argmax(outside))
            raise ValueError(
                f"latitude {np.degrees(lat[where]):.6f}, "
                f"longitude {np.degrees(lon[where]):.6f} deg is outside the geoid grid"
            )
        return np.clip(row, 0.0, rows - 1.0), column

    def _four_rows(self, row: Floats) -> tuple[list[Ints], tuple[Floats, ...]]:
        """The four grid rows around fractional rows, and their weights."""
        rows = self.undulations.shape[0]
        r0 = np.clip(np.floor(row).astype(np.int64), 0, rows - 2)
        return [np.clip(r0 + i, 0, rows - 1) for i in (-1, 0, 1, 2)], _keys_weights(row - r0)

    def _along_rows(self, r: Ints, column: Floats) -> Floats:
        """Values at fractional columns of the grid rows `r`."""
        columns, period = self.undulations.shape[1], self._period
        c0 = np.floor(column).astype(np.int64)
        c0 = c0 if period else np.clip(c0, 0, columns - 2)
        column_weights = _keys_weights(column - c0)
        line = np.zeros(np.broadcast_shapes(r.shape, column.shape))
        for j in range(4):
            c = np.mod(c0 + (j - 1), period) if period else np.clip(c0 + (j - 1), 0, columns - 1)
            line += column_weights[j] * (self.undulations[r, c] / np.float32(self.per_m))
        return line


@cache
def egm96() -> Geoid:
    """EGM96 (NIMA/NASA 1998) on the 5' grid of the package, rounded to centimetres; read once per process."""
    path = importlib.resources.files("boresight.geometry") / "data" / "egm96-5.npy.zst"
    with path.open("rb") as file, pa.CompressedInputStream(file, "zstd") as stored:
        # Stored: second differences in centimetres along longitude and latitude; two cumulative sums invert.
        # All undulations have 16 bit: sums may wrap in between.
        centimetres = np.lib.format.read_array(stored)
    for row, before in zip(centimetres[1:], centimetres):  # ten times faster than np.cumsum along columns
        row += before
    np.cumsum(centimetres, axis=1, dtype=np.int16, out=centimetres)
    step = np.radians(1.0 / 12.0)
    return Geoid(centimetres, -0.5 * np.pi, -np.pi, step, step, per_m=100.0)


def _keys_weights(fraction: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Weights of points -1, 0, 1, 2 of cubic convolution with a = -1/2 (Keys 1981, eq. 15)."""
    f = fraction
    return (
        ((-0.5 * f + 1.0) * f - 0.5) * f,
        (1.5 * f - 2.5) * f * f + 1.0,
        ((-1.5 * f + 2.0) * f + 0.5) * f,
        (0.5 * f - 0.5) * f * f,
    )
