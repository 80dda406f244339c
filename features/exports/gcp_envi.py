"""Ground control points of one image for ENVI: its orthorectification .pts file.

ENVI counts image points from (1, 1) at the outer corner of the first pixel, so its centre is (1.5, 1.5), and
its heights are above the geoid (EGM96 here). Points that the calibration rejected are not written, since
the format cannot mark them.
"""

from __future__ import annotations

import numpy as np

from boresight.features.exports.exported_points import GroundPoints
from boresight.features.exports.notes import Notes
from boresight.features.exports.one_line import one_line
from boresight.geometry.geoid import Geoid

__all__ = ["points_envi"]

# Coordinate that ENVI gives the centre of the first pixel, px; here it is 0.
_CENTRE_OF_FIRST_PIXEL = 1.5


def points_envi(points: GroundPoints, geoid: Geoid, notes: Notes) -> str:
    """Text of the file: longitude, latitude, orthometric height, image x and y of each used point."""
    undulation = geoid.undulation_m(np.radians(points.lat_deg), np.radians(points.lon_deg))
    lines = [
        "; ENVI Orthorectification Ground Control Points File",
        f"; warp file: {one_line(points.image)}",
        "; projection info = {Geographic Lat/Lon, WGS-84, units=Degrees}",
        *(f"; {line}" for line in notes.lines()),
        "; Map (x,y,elev), Image (x,y)",
        ";",
    ]
    for n in np.flatnonzero(points.used):
        x, y = points.xy_px[n] + _CENTRE_OF_FIRST_PIXEL
        height = points.height_m[n] - undulation[n]
        lines.append(f"{points.lon_deg[n]:.10f}\t{points.lat_deg[n]:.10f}\t{height:.4f}\t{x:.4f}\t{y:.4f}")
    return "\n".join(lines) + "\n"
