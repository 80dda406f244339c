"""Attitude of a frame from that of the frame before: predicted stars are measured where they must be.

The camera rotates at a rate that a random acceleration changes (Bar-Shalom, Li, Kirubarajan 2001, 6.3.2), and
its focal length drifts by a random walk. The true attitude is R_si = exp(psi) R_si(stated), psi about the
axes of s; the covariance is that of psi, of the rate and of the logarithm of the focal length. Nothing is
searched beyond four standard deviations of the prediction: what is not found there is for the caller to
search in the whole sky.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.spatial.transform import Rotation
from scipy.special import bdtrc

from boresight.geometry.star_camera import StarCamera
from boresight.records.record import Bools, Floats, Ints, array, record, scalar
from boresight.star_id.finding.background import Background
from boresight.star_id.finding.centroid import Counts, StarFits, fit_stars
from boresight.star_id.finding.psf import Psf
from boresight.star_id.finding.star_list import StarList
from boresight.star_id.finding.windows import windows_at
from boresight.star_id.given_camera import fit_known_camera, fit_scaled_camera
from boresight.star_id.identification.triangle_index import StarIndex
from boresight.star_id.observer import proper_motion_covariance
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import has_reliable_position, smear_of_rate

__all__ = ["CameraMotion", "StarFix", "motion_of_fix", "near_prediction", "predicted_motion", "with_fix"]

# Rate, rad/s, 1 sigma about each axis, of a camera of which one frame is known: 5 deg/s (set by hand).
_UNKNOWN_RATE = math.radians(5.0)
# Largest error of a prediction, px, that is searched in its windows: beyond it they overlap (set by hand).
_LARGEST_REACH_PX = 32.0
# Stars that are measured, the brightest, and those that give the common shift (set by hand).
_STARS, _STARS_FOR_SHIFT = 48, 16
# Brightest stars of which those are taken, should many be saturated (wide fields), and those that are tried
# first: two in three lie in the image, the others beside it (set by hand).
_MOST_IN_VIEW, _FIRST_IN_VIEW = 400, 100
# Rows and columns of a pixel and its eight neighbours, from it.
_AROUND = np.repeat([-1, 0, 1], 3), np.tile([-1, 0, 1], 3)
# Distance, px, from the shifted prediction within which a star is the predicted one.
_SAME_PX = 3
# Length of a trail over the width of the PSF below which there is none: it widens a star by 0.2 %.
_NO_TRAIL = 0.2
# Distance of all stars from the prediction, px, to which their images are linear in it: the error is its
# third power over the square of the PSF's width.
_LINEAR_PX = 0.15
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
# Squared innovation of the focal length, 1 degree of freedom, from which it is not as assumed: 1e-6 by
# chance.
_NOT_SAME = 23.9
# Components of the state that a frame measures: rotation and focal length.
_MEASURED = np.array([0, 1, 2, 6])
# Side of the sample of the sky, pixels along each side: the level to 1/30 of the noise.
_SAMPLES = 40


@record
class CameraMotion:
    """Attitude and rate of a camera at one instant."""

    t_s: float = scalar("instant, s")
    R_si: Rotation = scalar("rotation GCRS to star-camera frame s")
    rate_s: Floats = array("3", "rotation of the camera about the axes of s, rad/s")
    log_scale: float = scalar("logarithm of the focal length over that of the camera as given")
    covariance: Floats = array(
        "7, 7", "of a small rotation about the axes of s, rad, of the rate, rad/s, and of log_scale"
    )

    @property
    def rate_known(self) -> bool:
        """Whether two frames at least gave the rate."""
        return float(np.trace(self.covariance[3:6, 3:6])) < _UNKNOWN_RATE**2


@record
class StarFix:
    """Attitude of one frame by its stars alone."""

    R_si: Rotation = scalar("rotation GCRS to star-camera frame s")
    covariance: Floats = array(
        "P, P", "of a small rotation about the axes of s, rad, and of log_scale, if it was measured"
    )
    stars: int = scalar("stars that it rests on")
    log_scale: float = scalar("logarithm of the focal length over that of the camera as given", default=0.0)
    misfit_px: float = scalar("rms displacement of stars from the camera, an axis, px", default=0.0)


def motion_of_fix(fix: StarFix, t_s: float, focal_error: float = 0.0) -> CameraMotion:
    """The motion that one frame tells: its attitude; a rate of zero with a 1-sigma beyond any camera's.

    `focal_error` is that of the camera's focal length as given, relative, 1 sigma; 0: it is exact.
    """
    covariance = np.zeros((7, 7))
    covariance[:3, :3], covariance[3:6, 3:6] = fix.covariance[:3, :3], _UNKNOWN_RATE**2 * np.eye(3)
    covariance[6, 6] = focal_error**2
    return CameraMotion(t_s, fix.R_si, np.zeros(3), 0.0, covariance)


def predicted_motion(
    motion: CameraMotion, t_s: float, acceleration: float, focal_drift: float = 0.0
) -> CameraMotion:
    """The motion at a later instant, its acceleration unknown: `acceleration`, rad/s², 1 sigma an axis;
    `focal_drift` is the relative change of the focal length in one second, 1 sigma."""
    dt = t_s - motion.t_s
    turn = Rotation.from_rotvec(-dt * motion.rate_s)
    step = np.eye(7)
    step[:3, :3], step[[0, 1, 2], [3, 4, 5]] = turn.as_matrix(), -dt
    covariance = step @ motion.covariance @ step.T
    at, rate, push = np.arange(3), np.arange(3, 6), acceleration**2 * dt**2
    covariance[at, at] += 0.25 * dt**2 * push
    covariance[at, rate] -= 0.5 * dt * push
    covariance[rate, at] -= 0.5 * dt * push
    covariance[rate, rate] += push
    if covariance[6, 6] > 0.0:  # else the focal length is exact
        covariance[6, 6] += focal_drift**2 * dt
    return CameraMotion(t_s, turn * motion.R_si, motion.rate_s, motion.log_scale, covariance)


def with_fix(motion: CameraMotion, fix: StarFix) -> CameraMotion:
    """The predicted motion with a frame's stars. Where both contradict one another, the prediction's
    covariance is scaled by the innovation's square, of motion and of focal length each by its own.
    """
    measured = len(fix.covariance)
    rows = _MEASURED[:measured]
    innovation = np.append((fix.R_si * motion.R_si.inv()).as_rotvec(), fix.log_scale - motion.log_scale)
    innovation, prior = innovation[:measured], motion.covariance
    factor = np.ones(7)
    for part, known, limit in ((slice(0, 3), slice(0, 6), _NOT_AS_ASSUMED), (slice(3, 4), [6], _NOT_SAME)):
        off = innovation[part]
        if not off.size:
            continue
        total = prior[np.ix_(rows[part], rows[part])] + fix.covariance[part, part]
        square = float(off @ np.linalg.solve(total, off))
        if square > limit:
            factor[known] = math.sqrt(square / off.size)
    prior = prior * factor[:, None] * factor
    gain = np.linalg.solve(prior[np.ix_(rows, rows)] + fix.covariance, prior[rows]).T
    change = gain @ innovation
    kept = np.eye(7)
    kept[:, rows] -= gain
    covariance = kept @ prior @ kept.T + gain @ fix.covariance @ gain.T
    R_si = Rotation.from_rotvec(change[:3]) * motion.R_si
    rate, log_scale = motion.rate_s + change[3:6], motion.log_scale + float(change[6])
    return CameraMotion(motion.t_s, R_si, rate, log_scale, covariance)


def near_prediction(
    image: NDArray[Any],
    motion: CameraMotion,
    before: StarList,
    camera: StarCamera,
    index: StarIndex,
    settings: StarSettings,
    *,
    exposure_s: float | None = None,
) -> StarFix | None:
    """Attitude of a raw image (H, W) by the stars at their predicted places; None where they are not there.

    `motion` is predicted for the middle of the exposure. `before` are the stars of the last frame that was
    searched as a whole: its PSF, gain, noise and saturation hold. With an exposure time the rate gives the
    trails of the stars; without it they are as `before`.
    """
    lens = replace(camera, focal_m=camera.focal_m * math.exp(motion.log_scale))
    focal_px = camera.focal_m / camera.pixel_m
    reach = 4.0 * focal_px * math.sqrt(np.linalg.eigvalsh(motion.covariance[:3, :3])[-1]) + 1.0
    if not reach < _LARGEST_REACH_PX:
        return None
    rows, xy, u_i = _in_view(image, motion.R_si, before, camera, lens, index, settings, reach)
    if len(rows) < _FEWEST:
        return None
    sky, psf = _sky_now(image, before), _psf_now(before.psf, motion, camera, exposure_s)
    counts, found = Counts(before.gain_e_per_dn, before.saturation_dn), None
    if reach <= _SAME_PX:  # then the prediction itself is the nearest start
        found = _measured(image, xy, np.zeros(2), 1.0, sky, psf, counts, settings)
    if found is None:
        found = _measured(image, xy, *_shift_of(image, xy, psf, reach), sky, psf, counts, settings)
    if found is None:
        return None
    fits, good = found
    years = settings.epoch_error_years
    cov = fits.cov_px[good] + proper_motion_covariance(index, rows[good], camera, motion.R_si, years)
    measured = fits.xy_px[good], cov, u_i[good], motion.R_si
    if motion.covariance[6, 6] == 0.0:
        known = fit_known_camera(lens, *measured)
        return StarFix(known.R_si, known.cov_s, len(good), 0.0, known.misfit_px)
    fit = fit_scaled_camera(lens, *measured)
    log_scale = motion.log_scale + fit.log_scale
    return StarFix(fit.R_si, fit.covariance, len(good), log_scale, fit.misfit_px)


def _shift_of(image: NDArray[Any], xy_px: Floats, psf: Psf, reach: float) -> tuple[Floats, float]:
    """The shift (2,) of stars from their predicted places (N, 2), brightest first, by the brightest pixels
    within `reach`, and the number of different shifts; px."""
    width = max(3, round(2.0 * psf.sigma_px + 0.5 * math.hypot(*psf.smear_px)) | 1)
    first, shifts = xy_px[:_STARS_FOR_SHIFT], 1.0
    shift: Floats = np.zeros(2)
    if reach > _SAME_PX:
        shift = _common(_brightest_pixels(image, first, math.ceil(reach), width) - first)
        shifts = (2.0 * reach / _SAME_PX) ** 2
    return _common(_brightest_pixels(image, first + shift, _SAME_PX, width) - first), shifts


def _measured(
    image: NDArray[Any],
    xy_px: Floats,
    shift: Floats,
    shifts: float,
    sky: Background,
    psf: Psf,
    counts: Counts,
    settings: StarSettings,
) -> tuple[StarFits, Ints] | None:
    """Fits of stars at `shift` (2,) from predicted places (N, 2), and the rows of those that are there; None
    where they are so few that a wrong prediction may have them, with so many `shifts` tried."""
    one_step = shifts == 1.0 and not psf.is_flat
    pixels = np.rint(xy_px + shift).astype(np.int64)
    fits = fit_stars(image, pixels, xy_px + shift - pixels, sky, psf, counts, one_step=one_step)
    moved = np.sort(fits.xy_px - xy_px - shift, axis=0)
    more = moved[len(moved) // 2]
    if one_step and math.hypot(*more) > _LINEAR_PX:
        shift = shift + more
        pixels = np.rint(xy_px + shift).astype(np.int64)
        fits = fit_stars(image, pixels, xy_px + shift - pixels, sky, psf, counts, one_step=True)
    near = ((fits.xy_px - xy_px - shift) ** 2).sum(axis=1) < _SAME_PX**2
    good = np.flatnonzero(fits.converged & near & (fits.snr > _LEAST_SNR) & ~fits.saturated)
    n, seen = len(xy_px), len(good)
    by_chance = shifts * float(bdtrc(seen - 1, n, _BY_CHANCE)) if seen else 1.0
    if seen < max(_FEWEST, _LEAST_SHARE * n) or by_chance > settings.max_false_alarm_probability:
        return None
    return fits, good


def _in_view(
    image: NDArray[Any],
    R_si: Rotation,
    before: StarList,
    camera: StarCamera,
    lens: StarCamera,
    index: StarIndex,
    settings: StarSettings,
    reach: float,
) -> tuple[Ints, Floats, Floats]:
    """The brightest reliable stars of the index in view that are not saturated in the image (H, W), as rows,
    pixels (N, 2) and directions (N, 3); `lens` is the camera with its present focal length."""
    every = index.near(camera.middle_axes()[:, 2] @ R_si.as_matrix(), _radius_about_middle(camera))
    every = every[_reliable(index, camera, before.psf.sigma_px, settings).take(every)]
    for most in (_FIRST_IN_VIEW, len(every)):
        rows = every[:most]
        xy = lens.pixels_from_directions(R_si.apply(index.u_i.take(rows, axis=0)))
        with np.errstate(invalid="ignore"):
            inside = (xy > reach) & (xy < np.array([camera.width_px, camera.height_px]) - 1.0 - reach)
        chosen = np.flatnonzero(inside.all(axis=1))[:_MOST_IN_VIEW]
        column, row = np.rint(xy.take(chosen, axis=0)).astype(np.int64).T[:, :, None]
        around = image[row + _AROUND[0], column + _AROUND[1]]
        chosen = chosen[(around < before.saturation_dn).all(axis=1)][:_STARS]
        if len(chosen) == _STARS:  # those that follow are fainter
            break
    rows, xy = rows.take(chosen), xy.take(chosen, axis=0)
    return rows, xy, index.u_i[rows]


@lru_cache(maxsize=4)  # every frame of a camera asks
def _radius_about_middle(camera: StarCamera) -> float:
    """Angle, rad, from the direction of the image's middle that no part of the image exceeds."""
    off_axis = math.acos(min(1.0, float(camera.middle_axes()[2, 2])))
    return camera.field_radius_rad + off_axis


@lru_cache(maxsize=2)  # every frame of a sequence asks
def _reliable(index: StarIndex, camera: StarCamera, psf_sigma_px: float, settings: StarSettings) -> Bools:
    """(N,) `has_reliable_position` of all stars of the index."""
    return has_reliable_position(index, np.arange(len(index.u_i)), camera, psf_sigma_px, settings)


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
    sample = image[down // 2 :: down, across // 2 :: across].ravel()
    at = [round(share * (sample.size - 1)) for share in (0.159, 0.5, 0.841)]
    low, level, high = np.partition(sample, at)[at].astype(float).tolist()
    sky = before.background
    own_level, own_noise = _medians(sky)
    factor = max(0.5 * (high - low), own_noise) / own_noise
    return replace(sky, level_dn=sky.level_dn + (level - own_level), noise_dn=sky.noise_dn * factor)


@lru_cache(maxsize=4)  # every frame asks
def _medians(sky: Background) -> tuple[float, float]:
    """Median level and noise, DN."""
    return float(np.median(sky.level_dn)), float(np.median(sky.noise_dn))


def _brightest_pixels(image: NDArray[Any], xy_px: Floats, reach: int, width: int) -> Ints:
    """(N, 2) pixels with the most light in a square of `width`, at most `reach` from `xy_px` (N, 2)."""
    side = 2 * reach + 1
    corner = np.clip(np.rint(xy_px).astype(np.int64) - reach, 0, np.array(image.shape[::-1]) - side)
    windows = windows_at(image, corner, side).astype(np.float32)
    light = uniform_filter(windows, (0, width, width), mode="nearest")
    row, column = np.divmod(light.reshape(len(light), -1).argmax(axis=1), side)
    return np.asarray(corner + np.column_stack([column, row]))
