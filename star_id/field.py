"""Where an image of the sky points, whatever camera took it: field of view known, roughly known, or not at
all.

An unknown field of view is a row of roughly known ones: for each guess triangles are looked up in the table
made for it, the large fields first, because their tables are small. The first guess whose proposal passes the
test ends the search; all proposals of all guesses count in its false-alarm probability.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geometry.constants import ARCSEC
from geometry.star_camera import StarCamera
from star_id.finding.star_list import StarList, find_stars
from star_id.naming.identify import Identification, NotIdentified, identify
from star_id.naming.plane import FieldOfView
from star_id.naming.triangles import StarIndex, equivalent_fov
from star_id.settings import StarSettings
from star_id.sight import field_of_camera, plane_coordinates

__all__ = [
    "LARGEST_FOV_RAD",
    "SMALLEST_FOV_RAD",
    "FieldSolution",
    "nominal_camera",
    "solve_field",
    "solve_stars",
]

Array = NDArray[np.float64]

SMALLEST_FOV_RAD, LARGEST_FOV_RAD = np.radians(5.0), np.radians(60.0)  # of an unknown camera
_NOMINAL_PIXEL_M = 5e-6  # of cameras of which only angles are known: focal length and pixel scale together
_GUESS_ERROR = 0.10
_BEND = 0.012  # what an error of the focal length may do to the shape of a triangle, as a ratio
# stages of identification: all fields of view quickly first
_PASSES = (((0, 0, 6), (0, 6, 9)), ((0, 9, 13), (0, 13, 18), (1, 0, 9)))


@dataclass(frozen=True, slots=True, eq=False)
class FieldSolution:
    """An image identified. Row n of `hip`, `xy_px` and `residual_px` speaks of the same star."""

    R_si: Rotation
    camera: StarCamera  # as given, or fitted to this image
    hip: NDArray[np.int64]
    detections: NDArray[np.int64]  # (M,) rows of the centroids handed over
    xy_px: Array  # (M, 2)
    u_i: Array  # (M, 3) catalogue directions
    false_alarm_probability: float
    log_false_alarm_probability: float
    stars: StarList | None  # all detections, where the image itself was given

    @property
    def matches(self) -> int:
        return len(self.hip)

    @property
    def residual_px(self) -> Array:
        """(M, 2) measured minus predicted."""
        return self.xy_px - self.camera.pixels_from_directions(self.R_si.apply(self.u_i))

    @property
    def ra_rad(self) -> float:
        """Right ascension of the image's centre, GCRS axes, light effects not removed."""
        x, y, _ = self._outline_i()[0]
        return float(np.arctan2(y, x) % (2 * np.pi))

    @property
    def dec_rad(self) -> float:
        """Declination of the image's centre."""
        return float(np.arcsin(self._outline_i()[0, 2]))

    @property
    def roll_rad(self) -> float:
        """Position angle, east of north, of the image's up direction (towards row 0) at its centre."""
        centre, up = self._outline_i()[:2]
        east = np.cross([0.0, 0.0, 1.0], centre)
        north = np.cross(centre, east)
        return float(np.arctan2(up @ east, up @ north))

    @property
    def fov_x_rad(self) -> float:
        """Angle between the middles of the left and right edges."""
        left, right = self._outline_i()[2:]
        return float(2.0 * np.arcsin(0.5 * np.linalg.norm(right - left)))

    def _outline_i(self) -> Array:
        """Directions to the image's centre, the pixel above it, the middles of the left and right edges."""
        width, height = self.camera.width_px, self.camera.height_px
        middle = np.array([0.5 * (width - 1), 0.5 * (height - 1)])
        points = middle + np.array([[0.0, 0.0], [0.0, -1.0], [-0.5 * width, 0.0], [0.5 * width, 0.0]])
        return np.asarray(self.R_si.inv().apply(self.camera.directions_from_pixels(points)))

    @property
    def rms_arcsec(self) -> float:
        """Root mean square distance of the matched stars."""
        scale = self.camera.pixel_m / self.camera.focal_m / ARCSEC
        return float(np.sqrt((self.residual_px**2).sum(axis=1).mean()) * scale)


def solve_field(
    image: NDArray,
    index: StarIndex,
    settings: StarSettings,
    *,
    camera: StarCamera | None = None,
    fov_x_rad: float | None = None,
    dark: NDArray | None = None,
) -> FieldSolution | NotIdentified:
    """Identifies a raw image (H, W). Give `camera` (calibrated), or `fov_x_rad` (good to
    settings.fov_tolerance), or neither."""
    stars = find_stars(image, settings, dark)
    return solve_stars(
        stars.xy_px,
        (image.shape[1], image.shape[0]),
        index,
        settings,
        camera=camera,
        fov_x_rad=fov_x_rad,
        stars=stars,
    )


def solve_stars(
    xy_px: Array,
    size: tuple[int, int],
    index: StarIndex,
    settings: StarSettings,
    *,
    camera: StarCamera | None = None,
    fov_x_rad: float | None = None,
    stars: StarList | None = None,
) -> FieldSolution | NotIdentified:
    """The same from centroids (N, 2), brightest first, in an image of `size` (width, height)."""
    if camera is not None:
        found = identify(plane_coordinates(camera, xy_px), field_of_camera(camera, settings), index, settings)
        return found if isinstance(found, NotIdentified) else _solution(found, xy_px, camera, index, stars)
    tried, best, count = 0, -np.inf, 0
    guesses = _guesses(fov_x_rad, settings)
    for stages in _PASSES:
        for fov, error in guesses:
            guess = nominal_camera(size, fov)
            found = identify(
                plane_coordinates(guess, xy_px),
                _loose_field(guess, error, fov, settings),
                index,
                settings,
                stages=stages,
                tried=tried,
            )
            if isinstance(found, Identification):
                return _solution(found, xy_px, _fitted_camera(guess, found.lens), index, stars)
            tried = int(found.numbers.get("proposals", tried))
            best, count = max(best, found.numbers.get("best_log_odds", -np.inf)), count + 1
    low, high = np.degrees(guesses[-1][0]), np.degrees(guesses[0][0])
    return NotIdentified(
        f"{len(xy_px)} stars found; {tried} triangles agree with the catalogue for fields of view from"
        f" {low:.1f} to {high:.1f} deg, none explains the image",
        {"stars": float(len(xy_px)), "proposals": float(tried), "best_log_odds": float(best)},
    )


def nominal_camera(size: tuple[int, int], fov_x_rad: float) -> StarCamera:
    """A camera without distortion of a given field of view along the columns' direction."""
    width, height = size
    focal_px = 0.5 * width / np.tan(0.5 * fov_x_rad)
    middle = (0.5 * (width - 1), 0.5 * (height - 1))
    return StarCamera(float(focal_px * _NOMINAL_PIXEL_M), _NOMINAL_PIXEL_M, width, height, middle)


def _guesses(fov_x_rad: float | None, settings: StarSettings) -> list[tuple[float, float]]:
    """Fields of view to try, largest first, each with the relative error it stands for."""
    if fov_x_rad is None:
        low, high = SMALLEST_FOV_RAD, LARGEST_FOV_RAD
    else:
        low, high = fov_x_rad * (1 - settings.fov_tolerance), fov_x_rad * (1 + settings.fov_tolerance)
    guesses = []
    top = high * 1.001
    while top > low:
        error = min(_GUESS_ERROR, _BEND / (0.6 * top) ** 2)
        guess = max(top / (1 + error), np.sqrt(low * top))
        guesses.append((float(guess), float(error)))
        top = guess / (1 + error)
    return guesses


def _loose_field(guess: StarCamera, error: float, fov: float, settings: StarSettings) -> FieldOfView:
    focal_px = guess.focal_m / guess.pixel_m
    shape = settings.uncalibrated_error * min(1.0, 0.3 + fov / np.radians(40.0))
    return FieldOfView(
        0.5 * guess.width_px / focal_px,
        0.5 * guess.height_px / focal_px,
        equivalent_fov(guess.width_px, guess.height_px, focal_px),
        1.0 / focal_px,
        error + 0.02,
        shape,
    )


def _fitted_camera(guess: StarCamera, lens: Array) -> StarCamera:
    """The guess with the log scale, k1, p1 and p2 that identification fitted in the tangent plane."""
    focal_m = guess.focal_m * float(np.exp(lens[0]))
    f_mm = focal_m * 1e3
    return StarCamera(
        focal_m,
        guess.pixel_m,
        guess.width_px,
        guess.height_px,
        guess.principal_px,
        p1=float(-lens[2] / f_mm),
        p2=float(-lens[3] / f_mm),
        q1=float(lens[1] / f_mm**2),
    )


def _solution(
    found: Identification, xy_px: Array, camera: StarCamera, index: StarIndex, stars: StarList | None
) -> FieldSolution:
    return FieldSolution(
        R_si=found.R_si,
        camera=camera,
        hip=index.stars.hip.take(found.stars),
        detections=found.detections,
        xy_px=xy_px.take(found.detections, axis=0),
        u_i=index.u_i.take(found.stars, axis=0),
        false_alarm_probability=found.false_alarm_probability,
        log_false_alarm_probability=found.log_false_alarm_probability,
        stars=stars,
    )
