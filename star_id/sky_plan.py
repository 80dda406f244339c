"""Where to look to calibrate a star camera: of many pointings those whose stars, between them, tell most
about the lens where least is known of it.

What an image will tell is known before it is taken: the catalogue says which stars will be on the detector,
and one earlier image how well this camera places a star of a given brightness. Each candidate's Fisher
information about the camera's seven numbers, its own rotation unknown, adds to that of the others, and the
one that lowers the largest error of the model over the detector most is taken next (greedy G-optimal design;
Fedorov 1972, Theory of Optimal Experiments, ch. 3). Ten fields so chosen tell as much as sixty or ninety at
random: bright stars are few, and it matters where on the detector they fall.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.star_camera import StarCamera
from boresight.star_id.camera_fit import (
    PARAMETERS,
    detector_grid,
    pixel_derivatives,
    rotation_derivatives,
    visible_derivatives,
)
from boresight.star_id.field import FieldSolution
from boresight.star_id.finding.psf import Psf
from boresight.star_id.identification.triangle_index import StarIndex
from boresight.star_id.score import cramer_rao_px
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import has_reliable_position

__all__ = ["Pointing", "SkyPlan", "StarImageModel", "plan_pointings"]

Array = NDArray[np.float64]

_MARGIN_PX = 4.0  # a star nearer to the edge is not placed
_EXCHANGES = 3  # rounds in which each pointing may be exchanged for a better one


@dataclass(frozen=True, slots=True)
class StarImageModel:
    """What the image of a star is like in a camera, as one image of the sky shows it."""

    psf: Psf
    noise_dn: float
    gain_e_per_dn: float
    full_dn: float  # above the sky
    flux_of_v0_dn: float
    faintest_dn: float  # that is found

    @staticmethod
    def of(seen: FieldSolution, index: StarIndex) -> StarImageModel:
        """From an identified image: brightness by the median of its named stars that are not saturated."""
        stars = seen.stars
        if stars is None:
            raise ValueError("StarImageModel.of needs a field that was solved from an image")
        v_mag = index.stars.v_mag[seen.rows]
        flux = stars.flux_dn[seen.detections]
        whole = ~stars.saturated[seen.detections]
        if not whole.any():
            raise ValueError("all named stars are saturated: their brightness is not known")
        noise = float(np.median(stars.background.noise_dn))
        zero = float(np.median(flux[whole] * 10.0 ** (0.4 * v_mag[whole])))
        # flux of SNR 1 in a matched filter: noise times the root of the PSF's effective area
        one = noise * np.sqrt(4.0 * np.pi) * stars.psf.sigma_px
        sky = float(np.median(stars.background.level_dn))
        return StarImageModel(
            stars.psf, noise, stars.gain_e_per_dn, stars.saturation_dn - sky, zero, one * stars.threshold
        )


@dataclass(frozen=True, slots=True, eq=False)
class Pointing:
    """One image to take."""

    R_si: Rotation
    stars: int  # that will serve
    sigma_px: float  # largest 1-sigma error of the model over the detector after it, along one axis


@dataclass(frozen=True, slots=True, eq=False)
class SkyPlan:
    """Images to take, in the order of what they add, and what the camera will be known to after them."""

    pointings: tuple[Pointing, ...]
    covariance: Array  # (7, 7) of PARAMETERS
    random_sigma_px: Array  # (F,) the same largest error after as many candidates at random, median of draws


def plan_pointings(
    camera: StarCamera,
    images: StarImageModel,
    index: StarIndex,
    settings: StarSettings,
    candidates: Rotation,
    frames: int,
) -> SkyPlan:
    """The best `frames` of the attitudes `candidates` (R_si) for a camera that is roughly known.

    Raises `ValueError` for fewer candidates than frames.
    """
    if not 1 <= frames <= len(candidates):
        raise ValueError(f"frames must be 1 to the number of candidates, {len(candidates)}, got {frames}")
    every = np.arange(len(index.u_i))
    safe = has_reliable_position(index, every, camera, images.psf.sigma_px, settings)
    told = [_told(camera, images, index, safe, R_si) for R_si in candidates]
    information, stars = np.array([one[0] for one in told]), np.array([one[1] for one in told])
    seen = visible_derivatives(camera, detector_grid(camera))
    scale = _loosely_known(camera)
    information, seen = information * scale[:, None] * scale, seen * scale
    chosen = _exchanged(information, seen, _greedy(information, seen, frames))
    order = _in_order(information, seen, chosen)
    sums = np.eye(len(PARAMETERS)) + np.cumsum(information[order], axis=0)
    sigmas = _largest_sigma(sums, seen)
    pointings = tuple(Pointing(candidates[k], int(stars[k]), float(sigma)) for k, sigma in zip(order, sigmas))
    covariance = np.linalg.inv(sums[-1]) * scale[:, None] * scale
    return SkyPlan(pointings, covariance, _at_random(information, seen, frames))


def _told(
    camera: StarCamera, images: StarImageModel, index: StarIndex, safe: NDArray[np.bool_], R_si: Rotation
) -> tuple[Array, int]:
    """(7, 7) Fisher information of one image about the camera, its rotation unknown; and its stars."""
    rows = index.near(R_si.inv().apply([0.0, 0.0, 1.0]), camera.field_radius_rad)
    rows = rows[safe[rows]]
    flux = images.flux_of_v0_dn * 10.0 ** (-0.4 * index.stars.v_mag[rows])
    u_s = R_si.apply(index.u_i[rows])
    xy = camera.pixels_from_directions(u_s)
    far = np.array([camera.width_px, camera.height_px]) - 1.0 - _MARGIN_PX
    with np.errstate(invalid="ignore"):
        found = (flux > images.faintest_dn) & ((xy > _MARGIN_PX) & (xy < far)).all(axis=1)
    if found.sum() < 3:  # no rotation
        return np.zeros((7, 7)), int(found.sum())
    u_s, xy, flux = u_s[found], xy[found], flux[found]
    noise = np.full(len(flux), images.noise_dn)
    sigma = cramer_rao_px(xy, flux, noise, images.psf, images.gain_e_per_dn, full_dn=images.full_dn)
    J = (pixel_derivatives(camera, u_s) / sigma[:, None, None]).reshape(-1, len(PARAMETERS))
    A = (rotation_derivatives(camera, u_s) / sigma[:, None, None]).reshape(-1, 3)
    return J.T @ J - J.T @ A @ np.linalg.solve(A.T @ A, A.T @ J), len(flux)


def _loosely_known(camera: StarCamera) -> Array:
    """(7,) 1-sigma beliefs of before any image: 5 % of the focal length, 5 % of the width, distortions of
    order one."""
    f_mm, off = 1e3 * camera.focal_m, 0.05 * camera.width_px
    distortion = [0.1 / f_mm, 0.1 / f_mm, 1.0 / f_mm**2, 10.0 / f_mm**4]
    return np.array([0.05 * camera.focal_m, off, off, *distortion])


def _largest_sigma(information: Array, seen: Array) -> Array:
    """(...,) largest 1-sigma error over the detector along one axis, of informations (..., 7, 7)."""
    covariance = np.linalg.inv(information)
    variance = 0.5 * np.einsum("nip,...pq,niq->...n", seen, covariance, seen, optimize=True)
    return np.asarray(np.sqrt(variance.max(axis=-1)))


def _greedy(information: Array, seen: Array, frames: int) -> list[int]:
    whole = np.eye(information.shape[1])
    chosen: list[int] = []
    for _ in range(frames):
        k = _best(information, seen, whole, chosen)
        chosen.append(k)
        whole = whole + information[k]
    return chosen


def _best(information: Array, seen: Array, whole: Array, taken: list[int]) -> int:
    """The candidate that lowers the largest error most, of those not taken."""
    sigma = _largest_sigma(whole + information, seen)
    sigma[taken] = np.inf
    return int(sigma.argmin())


def _exchanged(information: Array, seen: Array, chosen: list[int]) -> list[int]:
    chosen = list(chosen)
    for _ in range(_EXCHANGES):
        before = list(chosen)
        for n in range(len(chosen)):
            others = chosen[:n] + chosen[n + 1 :]
            rest = np.eye(information.shape[1]) + information[others].sum(axis=0)
            chosen[n] = _best(information, seen, rest, others)
        if chosen == before:
            break
    return chosen


def _in_order(information: Array, seen: Array, chosen: list[int]) -> list[int]:
    """The same pointings, each time the one that adds most: a campaign that is cut short has the best."""
    left, order, whole = list(chosen), [], np.eye(information.shape[1])
    while left:
        k = left[int(_largest_sigma(whole + information[left], seen).argmin())]
        left.remove(k)
        order.append(k)
        whole = whole + information[k]
    return order


def _at_random(information: Array, seen: Array, frames: int, draws: int = 100) -> Array:
    rng = np.random.default_rng(0)
    sets = [rng.permutation(len(information))[:frames] for _ in range(draws)]
    sums = np.eye(information.shape[1]) + np.cumsum(information[sets], axis=1)  # (draws, frames, 7, 7)
    return np.asarray(np.median(_largest_sigma(sums, seen), axis=0))
