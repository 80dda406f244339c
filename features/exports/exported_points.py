"""Matched targets in one raw image: the record that all formats of ground control points write."""

from __future__ import annotations

from boresight.geometry.record import Bools, Floats, array, record, scalar

__all__ = ["GroundPoints"]


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
