"""Attitude of a frame from that of the frame before: predicted stars are measured where they must be.

The camera rotates at a rate that a random acceleration changes (Bar-Shalom, Li, Kirubarajan 2001, 6.3.2).
The true attitude is R_si = exp(psi) R_si(stated), psi about the axes of s; the covariance is that of psi and
of the rate. Nothing is searched beyond four standard deviations of the prediction: what is not found there
is for the caller to search in the whole sky.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.spatial.transform import Rotation
from scipy.special import bdtrc

from boresight.geometry.record import Floats, Ints, array, record, scalar
from boresight.geometry.star_camera import StarCamera
from boresight.star_id.finding.background import Background
from boresight.star_id.finding.centroid import Counts, fit_stars
from boresight.star_id.finding.psf import Psf
from boresight.star_id.finding.star_list import StarList
from boresight.star_id.finding.windows import windows_at
from boresight.star_id.given_camera import fit_known_camera
from boresight.star_id.identification.triangle_index import StarIndex
from boresight.star_id.observer import Observer, proper_motion_covariance, star_directions
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import has_reliable_position, smear_of_rate

__all__ = ["CameraMotion", "StarFix", "motion_of_fix", "near_prediction", "predicted_motion", "with_fix"]

# Rate, rad/s, 1 sigma about each axis, of a camera of which one frame is known: 5 deg/s (set by hand).
_UNKNOWN_RATE = math.radians(5.0)
# Largest error of a prediction, px, that is searched in its windows: beyond it they overlap (set by hand).
_LARGEST_REACH_PX = 32.0
# Stars that are measured, the brightest, and those that give the common shift (set by hand).
_STARS, _STARS_FOR_SHIFT = 48, 16
# Distance, px, from the shifted prediction within which a star is the predicted one.
_SAME_PX = 3
# Length of a trail over the width of the PSF below which there is none: it widens a star by 0.2 %.
_NO_TRAIL = 0.2
# SNR of a star that counts: noise has it at one pixel of 3 million.
_LEAST_SNR = 5.0
# Probability that a window of a wrong prediction holds a star within `_SAME_PX`: 28 px² of a frame of 1024²
# with 1500 detections, the most that occur (set by hand).
_BY_CHANCE = 0.05
# Fewest stars that fix an attitude, and the share of those predicted that must be seen (set by hand).
_FEWEST, _LEAST_SHARE = 5, 0.5
# Squared innovation in its covariance, 3 degrees of freedom, from which the motion is not as assumed: 1e-6 by
# chance.
_NOT_AS_ASSUMED = 30.7
# Side of the sample of the sky, pixels along each side: the level to 1/50 of the noise.
_SAMPLES = 64


@record
class CameraMotion:
    """Attitude and rate of a camera at one instant."""

    t_s: float = scalar("instant, s")
    R_si: Rotation = scalar("rotation GCRS to star-camera frame s")
    rate_s: Floats = array("3", "rotation of the camera about the axes of s, rad/s")
    covariance: Floats = array("6, 6", "of a small rotation about the axes of s, rad, and of the rate, rad/s")

    @property
    def rate_known(self) -> bool:
        """Whether two frames at least gave the rate."""
        return float(np.trace(self.covariance[3:, 3:])) < _UNKNOWN_RATE**2


@record
class StarFix:
    """Attitude of one frame by its stars alone."""

    R_si: Rotation = scalar("rotation GCRS to star-camera frame s")
    cov_s: Floats = array("3, 3", "of a small rotation about the axes of s, rad²")
    stars: int = scalar("stars that it rests on")


def motion_of_fix(fix: StarFix, t_s: float) -> CameraMotion:
    """The motion that one frame tells: its attitude; a rate of zero with a 1-sigma beyond any camera's."""
    covariance = np.zeros((6, 6))
    covariance[:3, :3], covariance[3:, 3:] = fix.cov_s, _UNKNOWN_RATE**2 * np.eye(3)
    return CameraMotion(t_s, fix.R_si, np.zeros(3), covariance)


def predicted_motion(motion: CameraMotion, t_s: float, acceleration: float) -> CameraMotion:
    """The motion at a later instant, its acceleration unknown: `acceleration`, rad/s², 1 sigma an axis."""
    dt = t_s - motion.t_s
    turn = Rotation.from_rotvec(-dt * motion.rate_s)
    step = np.eye(6)
    step[:3, :3], step[:3, 3:] = turn.as_matrix(), -dt * np.eye(3)
    pushed = np.vstack([-0.5 * dt**2 * np.eye(3), dt * np.eye(3)])
    covariance = step @ motion.covariance @ step.T + acceleration**2 * pushed @ pushed.T
    return CameraMotion(t_s, turn * motion.R_si, motion.rate_s, covariance)


def with_fix(motion: CameraMotion, fix: StarFix) -> CameraMotion:
    """The predicted motion with a frame's stars; the prediction's covariance is scaled by the innovation's
    square where both contradict one another.
    """
    innovation = (fix.R_si * motion.R_si.inv()).as_rotvec()
    prior = motion.covariance
    total = prior[:3, :3] + fix.cov_s
    square = float(innovation @ np.linalg.solve(total, innovation))
    if square > _NOT_AS_ASSUMED:
        prior = prior * (square / 3.0)
        total = prior[:3, :3] + fix.cov_s
    gain = np.linalg.solve(total, prior[:3]).T
    change = gain @ innovation
    kept = np.eye(6) - gain @ np.eye(3, 6)
    covariance = kept @ prior @ kept.T + gain @ fix.cov_s @ gain.T
    R_si = Rotation.from_rotvec(change[:3]) * motion.R_si
    return CameraMotion(motion.t_s, R_si, motion.rate_s + change[3:], covariance)


def near_prediction(
    image: NDArray[Any],
    motion: CameraMotion,
    before: StarList,
    camera: StarCamera,
    index: StarIndex,
    settings: StarSettings,
    *,
    exposure_s: float | None = None,
    observer: Observer | None = None,
) -> StarFix | None:
    """Attitude of a frame by the stars at their predicted places; None where they are not there.

    Parameters
    ----------
    image : (H, W) array
        Raw image.
    motion : CameraMotion
        Predicted for the middle of the exposure.
    before : StarList
        Of the last frame that was searched as a whole: its PSF, gain, noise and saturation hold.
    camera : StarCamera
        Calibrated camera.
    index : StarIndex
        Star index for the camera.
    settings : StarSettings
        `max_false_alarm_probability`, `epoch_error_years` and `max_photocentre_shift_px` are used.
    exposure_s : float, optional
        Exposure time: the rate then gives the trails of the stars; without it they are as `before`.
    observer : Observer, optional
        Aberration and proper motion are removed.
    """
    focal_px = camera.focal_m / camera.pixel_m
    reach = 4.0 * focal_px * math.sqrt(np.linalg.eigvalsh(motion.covariance[:3, :3])[-1]) + 1.0
    if not reach < _LARGEST_REACH_PX:
        return None
    rows, xy, u_i = _in_view(motion.R_si, before, camera, index, settings, observer, reach)
    if len(rows) < _FEWEST:
        return None
    sky, psf = _sky_now(image, before), _psf_now(before.psf, motion, camera, exposure_s)
    width = max(3, round(2.0 * psf.sigma_px + 0.5 * math.hypot(*psf.smear_px)) | 1)
    shift: Floats = np.zeros(2)
    shifts = 1.0
    if reach > _SAME_PX:
        first = slice(_STARS_FOR_SHIFT)
        shift = _common(_brightest_pixels(image, xy[first], math.ceil(reach), width) - xy[first])
        shifts = (2.0 * reach / _SAME_PX) ** 2
    shift = _common(_brightest_pixels(image, xy + shift, _SAME_PX, width) - xy)
    pixels = np.rint(xy + shift).astype(np.int64)
    counts = Counts(before.gain_e_per_dn, before.saturation_dn)
    fits = fit_stars(image, pixels, xy + shift - pixels, sky, psf, counts)
    near = ((fits.xy_px - xy - shift) ** 2).sum(axis=1) < _SAME_PX**2
    good = np.flatnonzero(fits.converged & near & (fits.snr > _LEAST_SNR) & ~fits.saturated)
    n, seen = len(rows), len(good)
    by_chance = shifts * float(bdtrc(seen - 1, n, _BY_CHANCE)) if seen else 1.0
    if seen < max(_FEWEST, _LEAST_SHARE * n) or by_chance > settings.max_false_alarm_probability:
        return None
    years = settings.epoch_error_years if observer is None else 0.0
    cov = fits.cov_px[good] + proper_motion_covariance(index, rows[good], camera, motion.R_si, years)
    fit = fit_known_camera(camera, fits.xy_px[good], cov, u_i[good], motion.R_si)
    return StarFix(fit.R_si, fit.cov_s, seen)


def _in_view(
    R_si: Rotation,
    before: StarList,
    camera: StarCamera,
    index: StarIndex,
    settings: StarSettings,
    observer: Observer | None,
    reach: float,
) -> tuple[Ints, Floats, Floats]:
    """The brightest reliable stars of the index in view, as rows, pixels (N, 2) and directions (N, 3)."""
    axis = camera.middle_axes()[:, 2] @ R_si.as_matrix()
    rows = np.flatnonzero(index.u_i @ axis > math.cos(camera.field_radius_rad))
    rows = rows[np.argsort(index.stars.v_mag[rows], kind="stable")]
    xy = camera.pixels_from_directions(R_si.apply(index.u_i[rows]))
    with np.errstate(invalid="ignore"):
        inside = (xy > reach) & (xy < np.array([camera.width_px, camera.height_px]) - 1.0 - reach)
    chosen = np.flatnonzero(inside.all(axis=1))[: 2 * _STARS]
    sound = has_reliable_position(index, rows[chosen], camera, before.psf.sigma_px, settings)
    rows = rows[chosen[sound][:_STARS]]
    if observer is None:
        return rows, xy[chosen[sound][:_STARS]], index.u_i[rows]
    u_i = star_directions(index, rows, observer)
    return rows, camera.pixels_from_directions(R_si.apply(u_i)), u_i


def _psf_now(psf: Psf, motion: CameraMotion, camera: StarCamera, exposure_s: float | None) -> Psf:
    """The PSF with the trail of the predicted rate; without one where that is far shorter than a star."""
    if exposure_s is None:
        return psf
    smear = smear_of_rate(camera, motion.rate_s, exposure_s)
    return replace(psf, smear_px=smear if math.hypot(*smear) > _NO_TRAIL * psf.sigma_px else (0.0, 0.0))


def _common(offsets: Floats) -> Floats:
    """(2,) the mean of the offsets (N, 2) about that one which has most others within `_SAME_PX`."""
    near = ((offsets[:, None] - offsets) ** 2).sum(axis=2) < _SAME_PX**2
    return np.asarray(offsets[near[near.sum(axis=1).argmax()]].mean(axis=0))


def _sky_now(image: NDArray[Any], before: StarList) -> Background:
    """The background of the frame before at the level and noise that a sample of this one has."""
    down, across = (max(1, size // _SAMPLES) for size in image.shape)
    sample = image[down // 2 :: down, across // 2 :: across].astype(float)
    low, level, high = np.percentile(sample, (15.9, 50.0, 84.1))
    sky = before.background
    noise = max(0.5 * (high - low), float(np.median(sky.noise_dn)))
    return replace(
        sky,
        level_dn=sky.level_dn + (level - np.median(sky.level_dn)),
        noise_dn=sky.noise_dn * (noise / float(np.median(sky.noise_dn))),
    )


def _brightest_pixels(image: NDArray[Any], xy_px: Floats, reach: int, width: int) -> Ints:
    """(N, 2) pixels with the most light in a square of `width`, at most `reach` from `xy_px` (N, 2)."""
    side = 2 * reach + 1
    corner = np.clip(np.rint(xy_px).astype(np.int64) - reach, 0, np.array(image.shape[::-1]) - side)
    windows = windows_at(image, corner, side).astype(np.float32)
    light = uniform_filter(windows, (0, width, width), mode="nearest")
    row, column = np.divmod(light.reshape(len(light), -1).argmax(axis=1), side)
    return np.asarray(corner + np.column_stack([column, row]))
