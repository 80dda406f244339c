"""Ground points of pixels of a Pleiades strip (DIMAP V1), compared with the operator's location grid."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rasterio

from boresight.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.content import check_extent
from boresight.pipeline.files.dimap_metadata import DimapStrip
from boresight.pipeline.files.dump_schema import PixelRow
from boresight.pipeline.files.images.image_file import open_image
from boresight.pipeline.files.images.tiff import open_tiff
from boresight.pipeline.files.text_files import read_table

__all__ = ["dimap_grid_differences", "places_of_pixels"]

MAX_VALUES = 2**26  # of a location grid; one has some thousands


def places_of_pixels(strip: DimapStrip, pixels: Path, height_m: float) -> Iterator[str]:
    """Lines of a CSV file: the pixels of the file `pixels` with their places at an ellipsoidal height.

    Raises `RawDataError` for a pixel outside the image, a CCD other than 0, or a damaged file.
    """
    rows = read_table(pixels, PixelRow, str(pixels))
    for n, row in enumerate(rows):
        inside = -0.5 <= row.sample <= strip.width_px - 0.5 and -0.5 <= row.line <= strip.height_px - 0.5
        if row.ccd != 0 or not inside:
            found = f"CCD {row.ccd}, sample {row.sample:g}, line {row.line:g}"
            expected = f"CCD 0 of an image of {strip.width_px} x {strip.height_px} px"
            raise RawDataError(str(pixels), f"line {n + 2}", found, expected)
    sample, line = (np.array([getattr(row, name) for row in rows]) for name in ("sample", "line"))
    lat, lon, height = geodetic_from_ecef(
        strip.pushbroom.ground_points(0, sample, line, ConstantHeight(height_m))
    )
    yield "ccd,sample,line,lat_deg,lon_deg,height_m\n"
    for n in range(len(rows)):
        place = f"{np.degrees(lat[n]):.10f},{np.degrees(lon[n]):.10f},{height[n]:.3f}"
        yield f"0,{float(sample[n])!r},{float(line[n])!r},{place}\n"


def dimap_grid_differences(strip: DimapStrip, grid: Path) -> list[tuple[float, float, float]]:
    """(altitude, rms and largest difference) in metres for each altitude of the operator's location grid.

    The grid is the GeoTIFF `GRID_*.tif` of the product: bands of longitude and latitude in pairs, tags
    ALTITUDE_B0, ALTITUDE_B2, ... Raises `RawDataError` for another file.
    """
    with open_tiff(open_image(grid, grid.name, whole=False)) as raster:
        tags, t, count = raster.tags(), raster.transform, raster.count
        names = [f"ALTITUDE_B{2 * k}" for k in range(count // 2)]
        if not names or any(name not in tags for name in names):
            raise RawDataError(grid.name, "tags", f"{count} bands", "a location grid with ALTITUDE_B0, ...")
        check_extent(grid.name, "bands", (raster.width, raster.height, count), MAX_VALUES, "values")
        with refusing(grid.name, "bands", "pixels that decode", rasterio.errors.RasterioError):
            bands = raster.read()
    row, column = (axis.ravel() for axis in np.indices(bands.shape[1:]))
    sample, line = t.a * column + t.c - 0.5, t.e * row + t.f - 0.5  # (0.5, 0.5) is the first pixel's centre
    for axis, at, size in (("columns", sample, strip.width_px), ("lines", line, strip.height_px)):
        if at.min() < -1.0 or at.max() > size or np.ptp(at) < 0.5 * size:
            wrong = f"nodes at {axis} {at.min():.1f} to {at.max():.1f}, counted from the first pixel's centre"
            raise RawDataError(grid.name, "geotransform", wrong, f"nodes over the image of {size} {axis}")
    found = []
    for k, name in enumerate(names):
        altitude = float(tags[name])
        lon, lat = np.radians(bands[2 * k].ravel()), np.radians(bands[2 * k + 1].ravel())
        ours = strip.pushbroom.ground_points(0, sample, line, ConstantHeight(altitude))
        off = np.linalg.norm(ours - ecef_from_geodetic(lat, lon, altitude), axis=1)
        found.append((altitude, float(np.sqrt(np.mean(off**2))), float(off.max())))
    return found
