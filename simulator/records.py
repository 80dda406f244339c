"""What a simulated mission hands over: what its ground segment would know, and the truth, kept apart.

`Mission` holds what goes into a dump; `Truth` goes to the dump's `truth/` folder alone. Images are made
when they are asked for, and each has random numbers of its own, so that the order of asking does not
matter. All instants are seconds since `Mission.epoch`, as the mission's own clocks say them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.epoch import Epoch
from boresight.geometry.line_camera import LineCamera
from boresight.geometry.star_camera import StarCamera
from boresight.simulator.scenario import Scenario

__all__ = [
    "ChipImage",
    "Exposure",
    "GroundTarget",
    "Installation",
    "Mission",
    "OrbitReport",
    "StatedErrors",
    "Strip",
    "TerrainReport",
    "TrueExposure",
    "TruePoint",
    "TrueStrip",
    "Truth",
]

Array = NDArray[np.float64]
Image = NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class OrbitReport:
    """What the satellite's receiver says: positions and velocities at even steps, its error included."""

    frame: str  # "ITRF", as a CCSDS OEM names it
    t_s: Array  # (K,)
    positions_m: Array  # (K, 3)
    velocities_m_s: Array  # (K, 3)
    sigma_position_m: float  # 1 sigma of each axis, common to a strip


@dataclass(frozen=True, slots=True, eq=False)
class Installation:
    """The installation matrix as measured on the ground, star camera -> remote-sensing camera."""

    R_cs: Rotation
    sigma_rad: Array  # (3,) about the axes of frame c


@dataclass(frozen=True, slots=True)
class StatedErrors:
    """1 sigma of what the mission knows to be wrong with its data."""

    position_m: float  # each axis, common to a strip
    clock_s: float  # row times against orbit and star camera, common to a strip
    vibration_arcsec: float  # each axis, too fast for the star exposures to follow
    look_distortion_px: float  # smooth along the detector
    terrain_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """One image of the star camera. `image()` renders it: (height, width), uint8 or uint16."""

    exposure_id: str
    t_s: float  # middle of the exposure
    exposure_s: float
    _render: Callable[[], Image]

    def image(self) -> Image:
        """The rendered image (height, width)."""
        return self._render()


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """What one CCD saw during one strip. The CCDs of a strip share its id."""

    strip_id: str
    ccd: int
    lines: int
    samples: int
    t_first_row_s: float  # middle of the first row
    row_period_s: float
    bits: int
    _render: Callable[[int], Iterator[Image]]

    def blocks(self, rows: int = 512) -> Iterator[Image]:
        """The strip in arrays (rows, samples), uint8 or uint16, first row first; the last may be shorter."""
        return self._render(rows)


@dataclass(frozen=True, slots=True, eq=False)
class ChipImage:
    """An ortho-rectified piece of reference image. `affine` as GDAL and rasterio write it: (a, b, c, d, e,
    f) takes (column, row) of a pixel's upper left corner to map coordinates.
    """

    target_id: str
    image: NDArray[np.uint8]  # (height, width)
    affine: tuple[float, float, float, float, float, float]
    epsg: int  # a UTM zone on WGS84


@dataclass(frozen=True, slots=True)
class GroundTarget:
    """A surveyed point, the middle of its chip; the survey's error included."""

    target_id: str
    lat_deg: float
    lon_deg: float
    height_m: float
    height_kind: str  # "egm96": above the geoid
    sigma_m: tuple[float, float, float]  # east, north, up


@dataclass(frozen=True, slots=True, eq=False)
class TerrainReport:
    """The grid of heights that the user gets. `affine` as in `ChipImage`, in degrees."""

    heights_m: NDArray[np.float32]  # (rows, columns)
    affine: tuple[float, float, float, float, float, float]
    epsg: int  # 4326: columns run along longitude
    height_kind: str  # "egm96"
    sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class TrueExposure:
    """True positions of an exposure's stars. Row n of every array refers to the same star."""

    exposure_id: str
    t_s: float
    R_si: Rotation  # at the middle of the exposure
    hip: NDArray[np.int64]  # (N,) 0 for an invented star
    xy_px: Array  # (N, 2) mean place over the exposure
    flux_e: Array  # (N,) electrons in the whole image of the star
    v_mag: Array  # (N,)


@dataclass(frozen=True, slots=True, eq=False)
class TrueStrip:
    """What was wrong with a strip's reported times and positions."""

    strip_id: str
    clock_offset_s: float  # reported row time minus true
    position_error_m: Array  # (3,) reported minus true, ITRS


@dataclass(frozen=True, slots=True)
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


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """True values of what a mission measures, for `validate` and tests only."""

    seed: int
    R_cs: Rotation
    theta_rad: Array  # (3,) R_cs = exp[[theta]] R_cs0
    line_camera: LineCamera  # with what the distortion table leaves
    orbit: OrbitReport  # without error (sigma 0)
    t_attitude_s: Array  # (K,) instants of the attitudes: 1 kHz over every strip
    R_ci: Rotation  # (K,) attitude of the remote-sensing camera
    strips: tuple[TrueStrip, ...]
    targets: tuple[TruePoint, ...]
    check_points: tuple[TruePoint, ...]
    _exposure: Callable[[str], TrueExposure]

    def exposure(self, exposure_id: str) -> TrueExposure:
        """The stars of one exposure; `KeyError` for an id that the mission does not have."""
        return self._exposure(exposure_id)


@dataclass(frozen=True, slots=True, eq=False)
class Mission:
    """One simulated mission. Everything but `truth` is what the mission itself would know."""

    scenario: Scenario
    epoch: Epoch
    orbit: OrbitReport
    star_camera: StarCamera
    line_camera: LineCamera
    installation: Installation
    errors: StatedErrors
    exposures: tuple[Exposure, ...]
    strips: tuple[Strip, ...]
    targets: tuple[GroundTarget, ...]
    chips: tuple[ChipImage, ...]
    terrain: TerrainReport
    truth: Truth
