"""Outline of a strip on the ground."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.record import Floats
from boresight.geometry.terrain import Surface

__all__ = ["outline_deg"]

ALONG = 9  # points of each long side


def outline_deg(model: Pushbroom, lines: Mapping[int, int], surface: Surface) -> Floats:
    """Outline (N, 2) of what the CCDs of a strip see of `surface`: longitude and latitude in degrees, in
    order around it; points without ground are left out. `lines` has the number of lines of each CCD.
    """
    camera = model.camera
    ends = [(ccd, sample) for ccd in sorted(lines) for sample in (0.0, camera.n_px(ccd) - 1.0)]
    across = [np.asarray(camera.directions_from_pixels(ccd, np.array([s])))[0, 1] for ccd, s in ends]
    (left, right) = (ends[int(np.argmin(across))], ends[int(np.argmax(across))])
    sides = [_points(model, ccd, sample, lines[ccd], surface) for ccd, sample in (left, right)]
    outline = np.concatenate([sides[0], sides[1][::-1]])
    return outline[np.isfinite(outline).all(axis=1)]


def _points(model: Pushbroom, ccd: int, sample: float, lines: int, surface: Surface) -> Floats:
    p_e = model.ground_points(ccd, sample, np.linspace(0.0, lines - 1.0, ALONG), surface)
    lat, lon, _ = geodetic_from_ecef(p_e, WGS84)
    lon = np.degrees(lon)
    middle = lon[np.isfinite(lon)][:1]
    lon = middle + (lon - middle + 180.0) % 360.0 - 180.0 if len(middle) else lon  # no step at the date line
    return np.column_stack([lon, np.degrees(lat)])
