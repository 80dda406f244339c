"""Where an image of the sky points, whatever camera took it: field of view known, roughly known, or not at
all.

An unknown field of view is a row of roughly known ones: for each guess triangles are looked up in the table
made for it, the large fields first, because their tables are small. The first guess whose proposal passes the
test ends the search; all proposals of all guesses count in its false-alarm probability.

Where centroids come with covariances, attitude and lens are fitted once more, each star with its own weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC
from boresight.geometry.star_camera import StarCamera
from boresight.star_id.field_fit import fit_attitude, fit_attitude_and_lens
from boresight.star_id.finding.star_list import StarList, find_stars
from boresight.star_id.identification.identify import Identification, NotIdentified, identify
from boresight.star_id.identification.tangent_plane import FieldOfView
from boresight.star_id.identification.triangle_index import StarIndex, equivalent_fov
from boresight.star_id.observer import Observer, star_directions
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import field_of_camera, select_for_calibration, tangent_coordinates

__all__ = [
    "LARGEST_FOV_RAD",
    "SMALLEST_FOV_RAD",
    "FieldSolution",
    "nominal_camera",
    "ra_dec_roll",
    "solve_field",
    "solve_list",
    "solve_stars",
]

Array = NDArray[np.float64]

SMALLEST_FOV_RAD, LARGEST_FOV_RAD = np.radians(5.0), np.radians(60.0)  # of an unknown camera
_NOMINAL_PIXEL_M = 5e-6  # of cameras of which only angles are known: focal length and pixel scale together
_GUESS_ERROR = 0.10
_LEAST_SAFE = 4  # stars beyond doubt; of fewer an attitude is no better than of all
_BEND = 0.012  # what an error of the focal length may do to the shape of a triangle, as a ratio
# stages of identification: all fields of view quickly first
_PASSES = (((0, 0, 6), (0, 6, 9)), ((0, 9, 13), (0, 13, 18), (1, 0, 9)))


@dataclass(frozen=True, slots=True, eq=False)
class FieldSolution:
    """An image identified. Row n of `hip`, `xy_px` and `residual_px` speaks of the same star."""

    R_si: Rotation
    cov_s: Array | None  # (3, 3) rad^2, of a turn of the image's centre about axes s; None for bare places
    camera: StarCamera  # as given, or fitted to this image
    fov_x_sigma_rad: float  # of a fitted camera; 0 for one that was given, NaN for bare places
    hip: NDArray[np.int64]
    rows: NDArray[np.int64]  # (M,) of the index's stars
    detections: NDArray[np.int64]  # (M,) rows of the centroids handed over
    xy_px: Array  # (M, 2)
    u_i: Array  # (M, 3) where they stand, as the observer sees it if there is one
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
        """Right ascension of the image's centre, GCRS axes; light effects are removed if there was an
        observer."""
        return ra_dec_roll(self.camera, self.R_si)[0]

    @property
    def dec_rad(self) -> float:
        """Declination of the image's centre."""
        return ra_dec_roll(self.camera, self.R_si)[1]

    @property
    def roll_rad(self) -> float:
        """Position angle, east of north, of the image's up direction (towards row 0) at its centre."""
        return ra_dec_roll(self.camera, self.R_si)[2]

    @property
    def fov_x_rad(self) -> float:
        """Angle between the middles of the left and right edges."""
        return self.camera.fov_x_rad

    @property
    def pointing_sigma_rad(self) -> float:
        """1-sigma error of the direction to the image's centre along one axis; NaN for bare places."""
        return float(np.sqrt(0.5 * np.trace(self._middle_covariance()[:2, :2])))

    @property
    def roll_sigma_rad(self) -> float:
        """1-sigma error of the turn about the direction to the image's centre; NaN for bare places."""
        return float(np.sqrt(self._middle_covariance()[2, 2]))

    def _middle_covariance(self) -> Array:
        """(3, 3) rad^2, of a turn about right, down and the direction of the image's centre."""
        if self.cov_s is None:
            return np.full((3, 3), np.nan)
        axes = self.camera.middle_axes()
        return np.asarray(axes.T @ self.cov_s @ axes)

    @property
    def rms_arcsec(self) -> float:
        """Root mean square distance of the matched stars."""
        scale = self.camera.pixel_m / self.camera.focal_m / ARCSEC
        return float(np.sqrt((self.residual_px**2).sum(axis=1).mean()) * scale)


def ra_dec_roll(camera: StarCamera, R_si: Rotation) -> tuple[float, float, float]:
    """Right ascension and declination of an image's middle, and the position angle, east of north, of its up
    direction (towards row 0) there; rad."""
    _, down, middle = (R_si.inv().as_matrix() @ camera.middle_axes()).T
    east = np.cross([0.0, 0.0, 1.0], middle)
    north = np.cross(middle, east)
    ra, dec = np.arctan2(middle[1], middle[0]) % (2.0 * np.pi), np.arcsin(middle[2])
    return float(ra), float(dec), float(np.arctan2(-down @ east, -down @ north))


def solve_field(
    image: NDArray,
    index: StarIndex,
    settings: StarSettings,
    *,
    camera: StarCamera | None = None,
    fov_x_rad: float | None = None,
    dark: NDArray | None = None,
    observer: Observer | None = None,
) -> FieldSolution | NotIdentified:
    """Identifies a raw image (H, W). Give `camera` (calibrated), or `fov_x_rad` (good to
    settings.fov_tolerance), or neither; and the `observer`, if known, to have aberration removed."""
    stars = find_stars(image, settings, dark)
    size = (image.shape[1], image.shape[0])
    return solve_list(stars, size, index, settings, camera=camera, fov_x_rad=fov_x_rad, observer=observer)


def solve_list(
    stars: StarList,
    size: tuple[int, int],
    index: StarIndex,
    settings: StarSettings,
    *,
    camera: StarCamera | None = None,
    fov_x_rad: float | None = None,
    observer: Observer | None = None,
) -> FieldSolution | NotIdentified:
    """The same from the stars that were found in an image of `size` (width, height)."""
    named = _named(stars.xy_px, size, index, settings, camera, fov_x_rad)
    if isinstance(named, NotIdentified):
        return named
    found, guess = named
    rows = found.detections
    xy, cov, u_i = stars.xy_px[rows], stars.cov_px[rows], star_directions(index, found.stars, observer)
    safe = select_for_calibration(stars, rows, found.stars, guess, index, settings)
    if safe.sum() < _LEAST_SAFE:
        safe[:] = True
    if camera is not None:
        fit = fit_attitude(camera, xy[safe], cov[safe], u_i[safe])
    else:
        fit = fit_attitude_and_lens(guess, found.R_si, xy[safe], cov[safe], u_i[safe])
    bare = _solution(found, stars.xy_px, fit.camera, index)
    return replace(
        bare, R_si=fit.R_si, cov_s=fit.cov_s, fov_x_sigma_rad=fit.fov_x_sigma_rad, u_i=u_i, stars=stars
    )


def solve_stars(
    xy_px: Array,
    size: tuple[int, int],
    index: StarIndex,
    settings: StarSettings,
    *,
    camera: StarCamera | None = None,
    fov_x_rad: float | None = None,
) -> FieldSolution | NotIdentified:
    """The same from bare places (N, 2), brightest first; all stars weigh alike."""
    named = _named(xy_px, size, index, settings, camera, fov_x_rad)
    return named if isinstance(named, NotIdentified) else _solution(named[0], xy_px, named[1], index)


def _named(
    xy_px: Array,
    size: tuple[int, int],
    index: StarIndex,
    settings: StarSettings,
    camera: StarCamera | None,
    fov_x_rad: float | None,
) -> tuple[Identification, StarCamera] | NotIdentified:
    """The names, and the camera, given or guessed, that they were found with."""
    if camera is not None:
        found = identify(
            tangent_coordinates(camera, xy_px), field_of_camera(camera, settings), index, settings
        )
        return found if isinstance(found, NotIdentified) else (found, camera)
    tried, best, count = 0, -np.inf, 0
    guesses = _guesses(fov_x_rad, settings)
    for stages in _PASSES:
        for fov, error in guesses:
            guess = nominal_camera(size, fov)
            found = identify(
                tangent_coordinates(guess, xy_px),
                _loose_field(guess, error, fov, settings),
                index,
                settings,
                stages=stages,
                tried=tried,
            )
            if isinstance(found, Identification):
                return found, _fitted_camera(guess, found.lens)
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


def _solution(found: Identification, xy_px: Array, camera: StarCamera, index: StarIndex) -> FieldSolution:
    return FieldSolution(
        R_si=found.R_si,
        cov_s=None,
        camera=camera,
        fov_x_sigma_rad=np.nan,
        hip=index.stars.hip.take(found.stars),
        rows=found.stars,
        detections=found.detections,
        xy_px=xy_px.take(found.detections, axis=0),
        u_i=index.u_i.take(found.stars, axis=0),
        false_alarm_probability=found.false_alarm_probability,
        log_false_alarm_probability=found.log_false_alarm_probability,
        stars=None,
    )
