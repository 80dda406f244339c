"""Ground control points of one image for QGIS: the Georeferencer's .points file.

QGIS counts image points from (0, 0) at the outer corner of the first pixel, columns positive and rows
negative. A point that the calibration rejected is listed with `enable` 0. The residual is measured minus
computed in the axes of the file. The format has no heights, and no comments: the notes are the CRS's remark.
"""

from __future__ import annotations

import numpy as np
from pyproj import CRS

from boresight.features.exports.exported_points import GroundPoints
from boresight.features.exports.notes import Notes

__all__ = ["points_qgis"]

# Coordinate that QGIS gives the centre of the first pixel, px; here it is 0.
_CENTRE_OF_FIRST_PIXEL = 0.5


def points_qgis(points: GroundPoints, notes: Notes) -> str:
    """Text of the .points file, one line per target: longitude, latitude, image x and y, residuals in px."""
    remark = "; ".join(notes.lines()).replace('"', "'")
    crs = f'{CRS.from_epsg(4326).to_wkt()[:-1]},REMARK["{remark}"]]'
    lines = [f"#CRS: {crs}", "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual"]
    for n in range(len(points.target_id)):
        x = points.xy_px[n, 0] + _CENTRE_OF_FIRST_PIXEL
        y = -(points.xy_px[n, 1] + _CENTRE_OF_FIRST_PIXEL)
        point = f"{points.lon_deg[n]:.10f},{points.lat_deg[n]:.10f},{x:.4f},{y:.4f}"
        dx, dy = np.nan_to_num(points.residual_px[n]) * [1.0, -1.0]
        lines.append(f"{point},{int(points.used[n])},{dx:.4f},{dy:.4f},{np.hypot(dx, dy):.4f}")
    return "\n".join(lines) + "\n"
