"""Ground control points as GeoJSON (RFC 7946): WGS84 longitude, latitude, ellipsoidal height; the image point
is in the properties, where (0, 0) is the centre of the first pixel."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from boresight.features.exports.exported_points import GroundPoints
from boresight.features.exports.notes import Notes

__all__ = ["points_geojson"]


def points_geojson(parts: Sequence[GroundPoints], notes: Notes) -> str:
    """GeoJSON text: one feature collection of the targets of all `parts`."""
    features = [
        {
            "type": "Feature",
            "geometry": {
                "type": "Point",
                "coordinates": [float(part.lon_deg[n]), float(part.lat_deg[n]), float(part.height_m[n])],
            },
            "properties": {
                "target": part.target_id[n],
                "strip": part.strip_id,
                "ccd": int(part.ccd),
                "image": part.image,
                "sample": float(part.xy_px[n, 0]),
                "line": float(part.xy_px[n, 1]),
                "sigma_sample_px": float(part.sigma_px[n, 0]),
                "sigma_line_px": float(part.sigma_px[n, 1]),
                "residual_sample_px": _finite(part.residual_px[n, 0]),
                "residual_line_px": _finite(part.residual_px[n, 1]),
                "used": bool(part.used[n]),
            },
        }
        for part in parts
        for n in range(len(part.target_id))
    ]
    content = {"type": "FeatureCollection", "boresight": notes.items(), "features": features}
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
