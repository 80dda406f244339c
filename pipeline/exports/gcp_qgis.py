"""Ground control points of one image for QGIS: the Georeferencer's .points file.

QGIS counts image points from (0, 0) at the outer corner of the first pixel, columns positive and rows
negative. A point that the calibration rejected is listed with `enable` 0. The format has no
heights.
"""

from __future__ import annotations

from pyproj import CRS

from boresight.pipeline.exports.ground_points import GroundPoints

__all__ = ["points_qgis"]

_CENTRE_OF_FIRST_PIXEL = 0.5


def points_qgis(points: GroundPoints) -> str:
    """Text of the .points file, one line per target: longitude, latitude, image x and y."""
    lines = [f"#CRS: {CRS.from_epsg(4326).to_wkt()}", "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual"]
    for n in range(len(points.target_id)):
        x = points.xy_px[n, 0] + _CENTRE_OF_FIRST_PIXEL
        y = -(points.xy_px[n, 1] + _CENTRE_OF_FIRST_PIXEL)
        point = f"{points.lon_deg[n]:.10f},{points.lat_deg[n]:.10f},{x:.4f},{y:.4f}"
        lines.append(f"{point},{int(points.used[n])},0,0,0")
    return "\n".join(lines) + "\n"
