"""Pointings that calibrate a star camera best, chosen from candidates by G-optimal design.

The information of an image is known before it is taken: the catalogue states which stars will be on the
detector, and one earlier image how precisely this camera measures a star of a given brightness. The Fisher
information of each candidate about the seven camera parameters, its attitude unknown, adds to that of the
others, and the one that lowers the largest error of the camera model over the detector most is taken next
(greedy; Fedorov 1972, Theory of Optimal Experiments, ch. 3). Ten fields so chosen have the information of
sixty to ninety random ones, because bright stars are few and their positions on the detector matter.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.features.sky_images.score import cramer_rao_px
from boresight.geometry.star_camera import StarCamera
from boresight.records.record import Bools, Floats, array, record, scalar
from boresight.star_id.camera_fit import PARAMETERS, detector_grid, pixel_derivatives, visible_derivatives
from boresight.star_id.field import FieldSolution
from boresight.star_id.finding.psf import Psf
from boresight.star_id.identification.triangle_index import StarIndex
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import has_reliable_position

__all__ = ["Pointing", "SkyPlan", "StarImageModel", "plan_pointings"]


# Distance from the edge, px, within which a star is not measured (set by hand; about the radius of its
# window).
_MARGIN_PX = 4.0


@record(kw_only=True)
class StarImageModel:
    """Images of stars in a camera: PSF, noise and photometric zero point."""

    psf: Psf = scalar("point spread function")
    noise_dn: float = scalar("standard deviation of a background pixel, DN")
    gain_e_per_dn: float = scalar("electrons per DN; infinite: no photon noise")
    full_dn: float = scalar("saturation above the background, DN")
    flux_of_v0_dn: float = scalar("flux of a star of V = 0, DN")
    faintest_dn: float = scalar("flux of the faintest star detected, DN")

    @staticmethod
    def of(solution: FieldSolution, index: StarIndex) -> StarImageModel:
        """Model from an identified image; the zero point is the median of its unsaturated identified stars.

        Raises `ValueError` for a solution without star list, or if all identified stars are saturated.
        """
        stars = solution.stars
        if stars is None:
            raise ValueError("StarImageModel.of needs a field that was solved from an image")
        v_mag = index.stars.v_mag[solution.rows]
        flux = stars.flux_dn[solution.detections]
        unsaturated = ~stars.saturated[solution.detections]
        if not unsaturated.any():
            raise ValueError("all identified stars are saturated: the photometric zero point is unknown")
        noise = float(np.median(stars.background.noise_dn))
        zero = float(np.median(flux[unsaturated] * 10.0 ** (0.4 * v_mag[unsaturated])))
        # flux of SNR 1 in a matched filter: noise times the root of the PSF's effective area
        one = noise * np.sqrt(4.0 * np.pi) * stars.psf.sigma_px
        sky = float(np.median(stars.background.level_dn))
        return StarImageModel(
            psf=stars.psf,
            noise_dn=noise,
            gain_e_per_dn=stars.gain_e_per_dn,
            full_dn=stars.saturation_dn - sky,
            flux_of_v0_dn=zero,
            faintest_dn=one * stars.threshold,
        )


@record
class Pointing:
    """One image to take."""

    R_si: Rotation = scalar("rotation GCRS to star-camera frame s")
    stars: int = scalar("usable stars")
    sigma_px: float = scalar("largest 1-sigma error of the camera model after it, one axis, px")


@record
class SkyPlan:
    """Images to take, those that add most first, and the errors of the camera after them."""

    pointings: tuple[Pointing, ...] = array("F", "images in order")
    random_sigma_px: Floats = array("F", "largest error after as many random candidates, median of draws, px")


def plan_pointings(
    camera: StarCamera,
    images: StarImageModel,
    index: StarIndex,
    settings: StarSettings,
    candidates: Rotation,
    frames: int,
) -> SkyPlan:
    """The best pointings, so many `frames`, of the attitudes `candidates` (N,), GCRS to frame s, for the
    calibration of an approximately known camera. `ValueError` for fewer candidates than frames.
    """
    if not 1 <= frames <= len(candidates):
        raise ValueError(f"frames must be 1 to the number of candidates, {len(candidates)}, got {frames}")
    every = np.arange(len(index.u_i))
    reliable = has_reliable_position(index, every, camera, images.psf.sigma_px, settings)
    each = [_information(camera, images, index, reliable, R_si) for R_si in candidates]
    information, stars = np.array([one[0] for one in each]), np.array([one[1] for one in each])
    J = visible_derivatives(camera, detector_grid(camera))
    scale = _wide_prior(camera)
    information, J = information * scale[:, None] * scale, J * scale
    chosen = _exchange(information, J, _greedy(information, J, frames))
    order = [chosen[k] for k in _greedy(information[chosen], J, frames)]  # best first
    sums = np.eye(len(PARAMETERS)) + np.cumsum(information[order], axis=0)
    sigmas = _largest_sigma(sums, J)
    pointings = tuple(Pointing(candidates[k], int(stars[k]), float(sigma)) for k, sigma in zip(order, sigmas))
    return SkyPlan(pointings, _random_sigma(information, J, frames))


def _information(
    camera: StarCamera, images: StarImageModel, index: StarIndex, reliable: Bools, R_si: Rotation
) -> tuple[Floats, int]:
    """Fisher information (7, 7) of one image about the camera, its attitude unknown; number of usable
    stars."""
    rows = index.near(R_si.inv().apply([0.0, 0.0, 1.0]), camera.field_radius_rad)
    rows = rows[reliable[rows]]
    flux = images.flux_of_v0_dn * 10.0 ** (-0.4 * index.stars.v_mag[rows])
    u_s = R_si.apply(index.u_i[rows])
    xy = camera.pixels_from_directions(u_s)
    far = np.array([camera.width_px, camera.height_px]) - 1.0 - _MARGIN_PX
    with np.errstate(invalid="ignore"):
        found = (flux > images.faintest_dn) & ((xy > _MARGIN_PX) & (xy < far)).all(axis=1)
    if found.sum() < 3:  # no attitude
        return np.zeros((7, 7)), int(found.sum())
    u_s, xy, flux = u_s[found], xy[found], flux[found]
    noise = np.full(len(flux), images.noise_dn)
    sigma = cramer_rao_px(xy, flux, noise, images.psf, images.gain_e_per_dn, full_dn=images.full_dn)
    both = (derivatives / sigma[:, None, None] for derivatives in pixel_derivatives(camera, u_s))
    J, A = (derivatives.reshape(2 * len(sigma), -1) for derivatives in both)
    return J.T @ J - J.T @ A @ np.linalg.solve(A.T @ A, A.T @ J), len(flux)


def _wide_prior(camera: StarCamera) -> Floats:
    """(7,) 1-sigma prior errors of PARAMETERS: 5 % of the focal length, 5 % of the width, distortions of
    order one."""
    f_mm, off = 1e3 * camera.focal_m, 0.05 * camera.width_px
    distortion = [0.1 / f_mm, 0.1 / f_mm, 1.0 / f_mm**2, 10.0 / f_mm**4]
    return np.array([0.05 * camera.focal_m, off, off, *distortion])


def _largest_sigma(information: Floats, J: Floats) -> Floats:
    """(...,) largest 1-sigma error over the detector along one axis, of informations (..., 7, 7)."""
    covariance = np.linalg.inv(information)
    variance = 0.5 * np.einsum("nip,...pq,niq->...n", J, covariance, J, optimize=True)
    return np.asarray(np.sqrt(variance.max(axis=-1)))


def _greedy(information: Floats, J: Floats, frames: int) -> list[int]:
    """Candidates in the order in which they lower the largest error most."""
    total = np.eye(information.shape[1])
    chosen: list[int] = []
    for _ in range(frames):
        k = _best(information, J, total, chosen)
        chosen.append(k)
        total = total + information[k]
    return chosen


def _best(information: Floats, J: Floats, total: Floats, taken: list[int]) -> int:
    """The candidate that lowers the largest error most, of those not taken."""
    sigma = _largest_sigma(total + information, J)
    sigma[taken] = np.inf
    return int(sigma.argmin())


def _exchange(information: Floats, J: Floats, chosen: list[int]) -> list[int]:
    chosen = list(chosen)
    for _ in range(3):  # exchanging each pointing for a better one
        before = list(chosen)
        for n in range(len(chosen)):
            others = chosen[:n] + chosen[n + 1 :]
            rest = np.eye(information.shape[1]) + information[others].sum(axis=0)
            chosen[n] = _best(information, J, rest, others)
        if chosen == before:
            break
    return chosen


def _random_sigma(information: Floats, J: Floats, frames: int) -> Floats:
    rng = np.random.default_rng(0)
    sets = [rng.permutation(len(information))[:frames] for _ in range(100)]
    sums = np.eye(information.shape[1]) + np.cumsum(information[sets], axis=1)  # (draws, frames, 7, 7)
    return np.asarray(np.median(_largest_sigma(sums, J), axis=0))
