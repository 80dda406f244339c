"""Matched targets in raw images as ground control points of other programs.

| format | image points count from | heights | rejected points |
| --- | --- | --- | --- |
| Ames Stereo Pipeline, .gcp | the centre of the first pixel, as ours | ellipsoidal | left out |
| ENVI, .pts | (1, 1) at the outer corner of the first pixel | orthometric, EGM96 | left out |
| QGIS, .points | (0, 0) at that corner, rows negative | none | `enable` 0 |
| GeoJSON (RFC 7946) | the centre of the first pixel, in the properties | ellipsoidal | `used` false |
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pyproj import CRS

from boresight.features.exports.notes import Notes, one_line
from boresight.geometry.geoid import Geoid
from boresight.pipeline.files.whole_file import json_text
from boresight.records.record import Bools, Floats, array, record, scalar

__all__ = ["GroundPoints", "points_asp", "points_envi", "points_geojson", "points_qgis"]


@record(kw_only=True)
class GroundPoints:
    """Targets in the raw image of one CCD of one strip. Row n of every array is the same target."""

    strip_id: str = scalar("id of the strip")
    ccd: int = scalar("index of the CCD")
    image: str = scalar("file name of the raw image")
    target_id: tuple[str, ...] = array("N", "ids of the targets")
    lat_deg: Floats = array("N", "WGS84 latitude, degrees")
    lon_deg: Floats = array("N", "longitude, degrees")
    height_m: Floats = array("N", "height above the WGS84 ellipsoid, m")
    xy_px: Floats = array("N, 2", "(sample, line); (0, 0) is the centre of the first pixel")
    sigma_px: Floats = array("N, 2", "1-sigma of xy_px")
    residual_px: Floats = array("N, 2", "measured minus computed with the result's matrix; NaN: not computed")
    sigma_m: Floats = array("N, 3", "1-sigma of the target's coordinates east, north, up")
    used: Bools = array("N", "False: rejected by the calibration")


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


def points_geojson(parts: Sequence[GroundPoints], notes: Notes) -> str:
    """GeoJSON text: one feature collection of the targets of all `parts`."""
    features = [
        {
            "type": "Feature",
            "geometry": {
                "type": "Point",
                "coordinates": [part.lon_deg[n], part.lat_deg[n], part.height_m[n]],
            },
            "properties": {
                "target": part.target_id[n],
                "strip": part.strip_id,
                "ccd": part.ccd,
                "image": part.image,
                "sample": part.xy_px[n, 0],
                "line": part.xy_px[n, 1],
                "sigma_sample_px": part.sigma_px[n, 0],
                "sigma_line_px": part.sigma_px[n, 1],
                "residual_sample_px": part.residual_px[n, 0],
                "residual_line_px": part.residual_px[n, 1],
                "used": part.used[n],
            },
        }
        for part in parts
        for n in range(len(part.target_id))
    ]
    content = {"type": "FeatureCollection", "boresight": notes.items(), "features": features}
    return json_text(content, indent=1) + "\n"
