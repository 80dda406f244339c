"""What a simulated mission hands over: what its ground segment would know, and the truth, kept apart.

`Mission` holds what goes into a dump; `Truth` goes to the dump's `truth/` folder alone. Images are made
when they are asked for, and each has random numbers of its own, so that the order of asking does not
matter. All instants are seconds since `Mission.epoch` on the mission's clocks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.epoch import Epoch
from boresight.geometry.line_camera import LineCamera
from boresight.geometry.star_camera import StarCamera
from boresight.records.record import array, record, scalar
from boresight.simulator.scenario import Scenario

__all__ = [
    "ChipImage",
    "GroundTarget",
    "Installation",
    "Mission",
    "OrbitReport",
    "RenderedExposure",
    "RenderedStrip",
    "StatedErrors",
    "TerrainReport",
    "TrueExposure",
    "TruePoint",
    "TrueStar",
    "TrueStrip",
    "Truth",
]

Array = NDArray[np.float64]
Image = NDArray[Any]


@record
class OrbitReport:
    """Reported positions and velocities at even steps, ITRF, with the receiver's error."""

    t_s: Array = array("K", "instants, s")
    positions_m: Array = array("K, 3", "in ITRF, m")
    velocities_m_s: Array = array("K, 3", "in ITRF, m/s")


@record
class Installation:
    """The pre-launch installation matrix."""

    R_cs: Rotation = scalar("star camera -> remote-sensing camera")
    sigma_rad: Array = array("3", "1 sigma about the axes of frame c, rad")


@record(by_value=True)
class StatedErrors:
    """Stated 1-sigma errors of the mission's data."""

    position_m: float  # each axis, common to a strip
    clock_s: float  # row times against orbit and star camera, common to a strip
    vibration_arcsec: float  # each axis, too fast for the star exposures to follow
    look_distortion_px: float  # each axis, smooth over the field
    look_ccd_px: tuple[float, float, float] = (0.0, 0.0, 0.0)  # shift, slope and bend of each CCD by itself


@record
class RenderedExposure:
    """One image of the star camera."""

    exposure_id: str
    t_s: float  # middle of the exposure
    exposure_s: float
    image: Callable[[], Image]  # renders it: (height, width), uint8 or uint16


@record
class RenderedStrip:
    """What one CCD saw during one strip. The CCDs of a strip share its id."""

    strip_id: str
    ccd: int
    lines: int
    samples: int
    t_first_row_s: float  # middle of the first row
    row_period_s: float
    bits: int
    # Renders it in arrays (rows, samples) of so many rows, uint8 or uint16, first row first; the last may be
    # shorter.
    blocks: Callable[[int], Iterator[Image]]
    kind: str = "ground"  # or "sky"


@record
class ChipImage:
    """An ortho-rectified piece of reference image. `affine` as GDAL and rasterio write it: (a, b, c, d, e,
    f) takes (column, row) of a pixel's upper left corner to map coordinates.
    """

    target_id: str = scalar("target in the middle of the chip")
    image: NDArray[np.uint8] = array("H, W", "grey values")
    affine: tuple[float, float, float, float, float, float] = array("6", "(a, b, c, d, e, f), m")
    epsg: int = scalar("a UTM zone on WGS84")


@record(by_value=True)
class GroundTarget:
    """A surveyed point, the middle of its chip; the survey's error included."""

    target_id: str
    lat_deg: float
    lon_deg: float
    height_m: float
    height_kind: str  # "egm96": above the geoid
    sigma_m: tuple[float, float, float]  # east, north, up


@record
class TerrainReport:
    """The grid of heights that the user gets, EPSG:4326: columns run along longitude."""

    heights_m: NDArray[np.float32] = array("H, W", "above the geoid EGM96, rows from north to south, m")
    affine: tuple[float, float, float, float, float, float] = array("6", "as in `ChipImage`, degrees")
    sigma_m: float = scalar("1 sigma of the heights, m")


@record(kw_only=True)
class TrueExposure:
    """True positions of an exposure's stars. Row n of every array refers to the same star."""

    exposure_id: str = scalar("id of the exposure")
    t_s: float = scalar("middle of the exposure, s")
    R_si: Rotation = scalar("at the middle of the exposure, GCRS -> star camera")
    hip: NDArray[np.int64] = array("N", "catalogue number; 0 for an invented star")
    xy_px: Array = array("N, 2", "mean position over the exposure, (column, row)")
    v_mag: Array = array("N", "magnitude")


@record
class TrueStrip:
    """Errors of a strip's reported times and positions."""

    strip_id: str = scalar("id of the strip")
    clock_offset_s: float = scalar("reported row time minus true, s")
    position_error_m: Array = array("3", "reported minus true, ITRS, m")


@record(by_value=True)
class TruePoint:
    """A target or check point: its true place and where each CCD sees it (one entry for each sighting)."""

    point_id: str
    strip_id: str
    ccd: int
    sample: float
    line: float
    t_s: float  # true instant of the row
    p_e: tuple[float, float, float]  # ITRS, m
    lat_deg: float
    lon_deg: float
    height_ellipsoidal_m: float


@record(by_value=True)
class TrueStar:
    """A star that crosses one CCD in a strip of the sky."""

    strip_id: str
    ccd: int
    hip: int  # 0 for an invented star
    sample: float  # where and when it crosses the middle of the detector's stages
    line: float
    charge_e: float  # electrons in its whole image
    v_mag: float


@record(kw_only=True)
class Truth:
    """True values of what a mission measures, for `validate` and tests only."""

    seed: int = scalar("seed of all random numbers")
    R_cs: Rotation = scalar("star camera -> remote-sensing camera")
    theta_rad: Array = array("3", "R_cs = exp[[theta]] R_cs0")
    line_camera: LineCamera = scalar("with the residual of the distortion table")
    orbit: OrbitReport = scalar("without error (sigma 0)")
    t_attitude_s: Array = array("K", "instants of the attitudes: 1 kHz over every strip, s")
    R_ci: Rotation = array("K", "attitude of the remote-sensing camera")
    strips: tuple[TrueStrip, ...] = scalar("clock and position errors of each strip")
    targets: tuple[TruePoint, ...] = scalar("sightings of the targets")
    check_points: tuple[TruePoint, ...] = scalar("sightings of the check points")
    sky_stars: tuple[TrueStar, ...] = scalar("stars in strips of the sky")
    exposure: Callable[[str], TrueExposure] = scalar(
        "computes the stars of an exposure; `KeyError` for an id that the mission does not have"
    )


@record
class Mission:
    """One simulated mission. Everything but `truth` is what the mission itself would know."""

    scenario: Scenario
    epoch: Epoch
    orbit: OrbitReport
    star_camera: StarCamera
    line_camera: LineCamera
    installation: Installation
    errors: StatedErrors
    exposures: tuple[RenderedExposure, ...]
    strips: tuple[RenderedStrip, ...]
    targets: tuple[GroundTarget, ...]
    chips: tuple[ChipImage, ...]
    terrain: TerrainReport | None  # None without strips of the ground
    truth: Truth
