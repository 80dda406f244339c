"""Ground control points for the Ames Stereo Pipeline: the .gcp file of one image.

A line is: id, latitude, longitude, height above the WGS84 ellipsoid, their 1-sigma (m), then the image,
column, row and their 1-sigma (px). Image points count from the centre of the first pixel, as ours. Points
that the calibration rejected are not written.
"""

from __future__ import annotations

import numpy as np

from boresight.features.exports.exported_points import GroundPoints
from boresight.features.exports.notes import Notes
from boresight.features.exports.one_line import one_line

__all__ = ["points_asp"]

LEAST_SIGMA_M = 1e-3  # ASP divides by it


def points_asp(points: GroundPoints, notes: Notes) -> str:
    """Text of the .gcp file, one line per used target."""
    lines = [f"# {line}" for line in notes.lines()]
    image = one_line(points.image).replace(" ", "_")
    for row, n in enumerate(np.flatnonzero(points.used)):
        sigma_m = np.maximum(points.sigma_m[n], LEAST_SIGMA_M)[[1, 0, 2]]  # north, east, up
        ground = f"{points.lat_deg[n]:.10f} {points.lon_deg[n]:.10f} {points.height_m[n]:.4f}"
        sigma = " ".join(f"{value:.4f}" for value in sigma_m)
        pixel = " ".join(f"{value:.4f}" for value in (*points.xy_px[n], *points.sigma_px[n]))
        lines.append(f"{row} {ground} {sigma} {image} {pixel}")
    return "\n".join(lines) + "\n"
