"""Fisheye lenses, fields of view of 70 to 175 degrees: which part of an image is identified first, and the
lenses from which the fit starts.

Stars are identified in a tangent plane, which has no room for directions far from the axis. So the middle of
the image, some 40 degrees, is identified as an image of its own; there all lenses are alike but for their
focal length. From there the fit goes outwards, from each kind of lens in turn: the one that explains most
stars, and these best, is the lens's own.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from boresight.geometry.star_camera import StarCamera
from boresight.records.record import Floats, Ints, array, record, scalar
from boresight.star_id.identification.tangent_plane import FieldOfView
from boresight.star_id.identification.triangle_index import equivalent_fov
from boresight.star_id.lens_model import TANGENT_RAD

__all__ = [
    "FISHEYE_RAD",
    "MIDDLE_TOLERANCE",
    "WIDEST_RAD",
    "ImageMiddle",
    "is_fisheye",
    "is_wide_field",
    "middle_field",
    "middle_of",
    "wide_lenses",
]

# Field of view, rad, from which the middle of an image is identified first.
FISHEYE_RAD = math.radians(70.0)
# Angle from the axis to the corners, rad, from which the same is done with a known camera.
_CORNER_RAD = math.radians(55.0)
# Largest field of view, rad, along columns that can be stated: at 90 degrees from the axis a direction has no
# place in the camera's tangent plane. Wider lenses are fitted to there.
WIDEST_RAD = math.radians(175.0)
# Half of the width, rad, of the middle that is identified: bright stars are enough there, and an equidistant
# lens differs by less than 1 % from any other (set by hand).
_MIDDLE_RAD = math.radians(20.0)
# Relative error of the middle's field of view: of one width, equisolid and stereographic lenses of 175 deg
# have focal lengths of 1.11 and 0.79 times that of an equidistant one.
MIDDLE_TOLERANCE = 0.3


@record
class ImageMiddle:
    """The middle of an image, as an image of its own."""

    xy_px: Floats = array("N, 2", "detections in it, from its own first pixel")
    rows: Ints = array("N", "rows of these detections")
    size: tuple[int, int] = scalar("columns and rows, px")
    fov_rad: float = scalar("its nominal field of view along columns")


@lru_cache(maxsize=4)  # every image of a camera asks
def is_fisheye(camera: StarCamera) -> bool:
    """Whether the middle of images of a known camera is identified first."""
    return camera.field_radius_rad > _CORNER_RAD


def is_wide_field(field: FieldOfView) -> bool:
    """`is_fisheye` by the field of view of a camera; NaN where a corner has no direction."""
    return not math.hypot(field.half_x, field.half_y) < math.tan(_CORNER_RAD)


def middle_of(xy_px: Floats, size: tuple[int, int], fov_x_rad: float) -> ImageMiddle:
    """The middle of an image of `size` (width, height), px, of a field of view of `fov_x_rad` along columns,
    with those of the detections (N, 2), px, that lie in it."""
    half_px = size[0] * _MIDDLE_RAD / fov_x_rad
    corner = [max(0, math.ceil(0.5 * (length - 1) - half_px)) for length in size]
    width, height = (length - 2 * first for length, first in zip(size, corner))
    xy = xy_px - corner
    rows = np.flatnonzero(((xy >= -0.5) & (xy <= np.array([width, height]) - 0.5)).all(axis=1))
    return ImageMiddle(xy[rows], rows, (width, height), fov_x_rad * width / size[0])


def middle_field(field: FieldOfView, tangents: Floats, focal_px: float) -> tuple[FieldOfView, Ints]:
    """The middle of the field of view of a known camera, and the rows of the detections, tangent-plane
    coordinates (N, 2), that lie in it."""
    half = math.tan(_MIDDLE_RAD)
    half_x, half_y = (min(half, side) if side == side else half for side in (field.half_x, field.half_y))
    with np.errstate(invalid="ignore"):
        inside = (np.abs(tangents) < [half_x, half_y]).all(axis=1)
    width, height = (round(2.0 * side * focal_px) for side in (half_x, half_y))
    fov = equivalent_fov(width, height, focal_px)
    return replace(field, half_x=half_x, half_y=half_y, equivalent_fov_rad=fov), np.flatnonzero(inside)


def wide_lenses(nominal: StarCamera) -> tuple[StarCamera, ...]:
    """Lenses with the focal length, detector and principal point of `nominal`: equidistant, equisolid,
    stereographic and, of a field that such lenses have, tangent.

    The second is an equidistant one with q1, q2 and q3, those of the series of 2 sin(t/2).
    """
    f_mm = 1e3 * nominal.focal_m
    equidistant = replace(
        nominal, projection="equidistant", p1=0.0, p2=0.0, q1=0.0, q2=0.0, q3=0.0, smooth=None
    )
    equisolid = replace(
        equidistant, q1=-1.0 / 24.0 / f_mm**2, q2=1.0 / 1920.0 / f_mm**4, q3=-1.0 / 322560.0 / f_mm**6
    )
    stereographic, tangent = (replace(equidistant, projection=kind) for kind in ("stereographic", "tangent"))
    fisheyes = equidistant, equisolid, stereographic
    return (*fisheyes, tangent) if equidistant.fov_x_rad < 2.0 * TANGENT_RAD else fisheyes
