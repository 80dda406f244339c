"""Ground control points of one image as texts of other programs.

| format | image points count from | heights | rejected points |
| --- | --- | --- | --- |
| Ames Stereo Pipeline, .gcp | the centre of the first pixel, as ours | ellipsoidal | left out |
| ENVI, .pts | (1, 1) at the outer corner of the first pixel | orthometric, EGM96 | left out |
| QGIS, .points | (0, 0) at that corner, rows negative | none | `enable` 0 |
"""

from __future__ import annotations

import numpy as np
from pyproj import CRS

from boresight.features.exports.exported_points import GroundPoints
from boresight.features.exports.notes import Notes
from boresight.features.exports.one_line import one_line
from boresight.geometry.geoid import Geoid

__all__ = ["points_asp", "points_envi", "points_qgis"]

LEAST_SIGMA_M = 1e-3  # ASP divides by it
# Coordinates that a program gives the centre of the first pixel, px; here it is 0.
_CENTRE_ENVI, _CENTRE_QGIS = 1.5, 0.5


def points_asp(points: GroundPoints, notes: Notes) -> str:
    """Text for ASP: of each used target id, latitude, longitude, height, their 1-sigma (m: north, east, up),
    image, column, row and their 1-sigma (px).
    """
    lines = [f"# {line}" for line in notes.lines()]
    image = one_line(points.image).replace(" ", "_")
    for row, n in enumerate(np.flatnonzero(points.used)):
        sigma_m = np.maximum(points.sigma_m[n], LEAST_SIGMA_M)[[1, 0, 2]]  # north, east, up
        ground = f"{points.lat_deg[n]:.10f} {points.lon_deg[n]:.10f} {points.height_m[n]:.4f}"
        sigma = " ".join(f"{value:.4f}" for value in sigma_m)
        pixel = " ".join(f"{value:.4f}" for value in (*points.xy_px[n], *points.sigma_px[n]))
        lines.append(f"{row} {ground} {sigma} {image} {pixel}")
    return "\n".join(lines) + "\n"


def points_envi(points: GroundPoints, notes: Notes, geoid: Geoid) -> str:
    """Text for ENVI: longitude, latitude, orthometric height, image x and y of each used point."""
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
        x, y = points.xy_px[n] + _CENTRE_ENVI
        height = points.height_m[n] - undulation[n]
        lines.append(f"{points.lon_deg[n]:.10f}\t{points.lat_deg[n]:.10f}\t{height:.4f}\t{x:.4f}\t{y:.4f}")
    return "\n".join(lines) + "\n"


def points_qgis(points: GroundPoints, notes: Notes) -> str:
    """Text for QGIS, one line per target: longitude, latitude, image x and y, residuals (measured minus
    computed, axes of the file) in px. The format has no comments: the notes are the remark of the CRS.
    """
    remark = "; ".join(notes.lines()).replace('"', "'")
    crs = f'{CRS.from_epsg(4326).to_wkt()[:-1]},REMARK["{remark}"]]'
    lines = [f"#CRS: {crs}", "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual"]
    for n in range(len(points.target_id)):
        x = points.xy_px[n, 0] + _CENTRE_QGIS
        y = -(points.xy_px[n, 1] + _CENTRE_QGIS)
        point = f"{points.lon_deg[n]:.10f},{points.lat_deg[n]:.10f},{x:.4f},{y:.4f}"
        dx, dy = np.nan_to_num(points.residual_px[n]) * [1.0, -1.0]
        lines.append(f"{point},{int(points.used[n])},{dx:.4f},{dy:.4f},{np.hypot(dx, dy):.4f}")
    return "\n".join(lines) + "\n"
