"""Star sightings for calibration from a raw image of a calibrated camera: identified stars with covariances.

A star is used only if its measured and its catalogue position are reliable: not displaced by a neighbour or a
companion, not doubtful in the catalogue, its image consistent with the PSF (saturated stars: the wings).
Outliers are rejected later and once, by the attitude fit of the exposures (`geometry.attitude_estimate`).
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.constants import ARCSEC
from boresight.geometry.sightings import StarSightings
from boresight.geometry.star_camera import StarCamera
from boresight.records.record import Bools, Floats, Ints
from boresight.star_id.beyond_chance import LEAST_STARS
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.centroids import Centroids
from boresight.star_id.finding.star_list import list_stars
from boresight.star_id.identification.identify import NotIdentified, identify_stars
from boresight.star_id.identification.tangent_plane import FieldOfView
from boresight.star_id.identification.triangle_index import StarIndex, concatenated_ranges, equivalent_fov
from boresight.star_id.observer import Observer, star_directions
from boresight.star_id.settings import StarSettings

__all__ = [
    "explained",
    "field_of_camera",
    "has_reliable_position",
    "select_for_calibration",
    "sight_centroids",
    "sight_stars",
    "smear_of_rate",
    "tangent_coordinates",
]

# Error, px, that removing the distortion may have for identification: a tenth of a faint star's centroid
# error.
_IDENTIFICATION_ERROR_PX = 0.02
# Share of saturated pixels from which an image shows Sun, Moon or Earth, not the sky: a sky has far fewer
# (set by hand).
_MOSTLY = 0.3
# Distance in PSF widths beyond which no star displaces another: a Gaussian has fallen by 1e-14.
_REACH_SIGMA = 8.0


def sight_stars(
    exposure_id: str,
    image: NDArray[Any],
    camera: StarCamera,
    index: StarIndex,
    observer: Observer,
    settings: StarSettings,
) -> StarSightings | NotIdentified:
    """Identified stars of one exposure, fit for calibration.

    Parameters
    ----------
    exposure_id : str
        Name, used in the result and in messages.
    image : (H, W) array
        Raw image, 8 or 16 bits or floating.
    camera : StarCamera
        Calibrated camera that took it.
    index : StarIndex
        Star index for the camera's field of view (`build_index`).
    observer : Observer
        Middle of the exposure, position and velocity of the satellite.
    settings : StarSettings
        A rotation of the satellite during the exposure is stated by `settings.smear_px` (`smear_of_rate`).

    Returns
    -------
    StarSightings or NotIdentified
        Measured directions in frame s with covariances, and apparent catalogue directions, GCRS.

    Raises
    ------
    ValueError
        If the image is not (H, W) of at least 32 pixels.
    """
    stars = list_stars(image, settings)
    found = sight_centroids(exposure_id, stars.centroids, camera, index, observer, settings)
    return explained(found, image, stars.saturation_dn) if isinstance(found, NotIdentified) else found


def explained(found: NotIdentified, image: NDArray[Any], saturation_dn: float) -> NotIdentified:
    """`found` with what its raw image (H, W) shows instead of a sky: one value, or saturated pixels."""
    share, least = float(np.mean(image >= saturation_dn)), image.min()
    if share > _MOSTLY:
        seen = (
            f"{100.0 * share:.0f} % of the pixels are saturated: Sun, Moon or Earth in view, or overexposed"
        )
    elif least == image.max():
        seen = f"every pixel is {least:g}: a closed shutter, a dead detector or an empty file"
    else:
        return found
    return replace(found, reason=f"{found.reason}; {seen}")


def sight_centroids(
    exposure_id: str,
    stars: Centroids,
    camera: StarCamera,
    index: StarIndex,
    observer: Observer,
    settings: StarSettings,
) -> StarSightings | NotIdentified:
    """Identified stars of one exposure from its N centroids (N, 2); arguments as in `sight_stars`."""
    plane, field = tangent_coordinates(camera, stars.xy_px), field_of_camera(camera, settings)
    found = identify_stars(plane, field, index, settings)
    if isinstance(found, NotIdentified):
        reason = f"exposure {exposure_id}: {found.reason}"
        return NotIdentified(reason, found.n_stars, found.proposals, found.best_log_odds)
    usable = select_for_calibration(stars, found.detections, found.stars, camera, index, settings)
    rows, index_rows = found.detections[usable], found.stars[usable]
    if len(rows) < LEAST_STARS:
        reason = f"{len(usable)} stars identified, only {len(rows)} fit for calibration, 3 are needed"
        return NotIdentified(f"exposure {exposure_id}: {reason}", len(usable), found.proposals)
    xy = stars.xy_px[rows]
    u_s, J = camera.directions_and_jacobian(xy)
    cov_s = J @ stars.cov_px[rows] @ J.transpose(0, 2, 1)
    return StarSightings(
        exposure_id=exposure_id,
        t_s=observer.t_s,
        hip=index.stars.hip[index_rows],
        xy_px=xy,
        u_s=u_s,
        u_i=star_directions(index, index_rows, observer),
        cov_s=cov_s,
        snr=stars.snr[rows],
    )


def tangent_coordinates(camera: StarCamera, xy_px: Floats) -> Floats:
    """Tangent-plane coordinates (u_x, u_y) / u_z (N, 2), frame s, of pixels (N, 2), good to 0.02 px."""
    return camera.tangents_from_pixels(xy_px, error_px=_IDENTIFICATION_ERROR_PX)


def field_of_camera(camera: StarCamera, settings: StarSettings) -> FieldOfView:
    """Field of view of a calibrated camera, for `identify`."""
    focal_px = camera.focal_m / camera.pixel_m
    half_x, half_y = _half_sides(camera)
    return FieldOfView(
        half_x=half_x,
        half_y=half_y,
        equivalent_fov_rad=equivalent_fov(camera.width_px, camera.height_px, focal_px),
        pixel=1.0 / focal_px,
        scale_error=0.0,
        shape_error=settings.camera_error,
    )


@lru_cache(maxsize=4)  # every image of a camera asks
def _half_sides(camera: StarCamera) -> tuple[float, float]:
    """Largest tangent-plane coordinates of the corners: with distortion they lie farther out, or less."""
    right, low = camera.width_px - 0.5, camera.height_px - 0.5
    corners = np.array([[-0.5, -0.5], [right, -0.5], [-0.5, low], [right, low]])
    half_x, half_y = np.abs(camera.tangents_from_pixels(corners, error_px=0.1)).max(axis=0)
    return float(half_x), float(half_y)


def smear_of_rate(camera: StarCamera, rate_s: Floats, exposure_s: float) -> tuple[float, float]:
    """Motion (columns, rows), px, of star images near the axis while the camera rotates.

    The camera rotates at `rate_s` (3,) rad/s, axes of s, for `exposure_s`. Stars move in the opposite sense,
    du/dt = -rate x u, and pixel axes are opposite to those of s.
    """
    scale = camera.focal_m / camera.pixel_m * exposure_s
    return float(scale * rate_s[1]), float(-scale * rate_s[0])


def select_for_calibration(
    stars: Centroids,
    detections: Ints,
    rows: Ints,
    camera: StarCamera,
    index: StarIndex,
    settings: StarSettings,
) -> Bools:
    """(N,) whether identified stars may be used for calibration: reliable position, not blended.

    Row `detections[n]` of `stars` is identified as row `rows[n]` of the index.
    """
    reliable = has_reliable_position(index, rows, camera, stars.psf_sigma_px, settings)
    return np.asarray(reliable & ~stars.blended[detections])


def has_reliable_position(
    index: StarIndex, rows: Ints, camera: StarCamera, psf_sigma_px: float, settings: StarSettings
) -> Bools:
    """(N,) whether stars `rows` (N,) of the index have a sound catalogue position and no neighbour in the
    index displaces their images, of Gaussian width `psf_sigma_px`, in this camera."""
    arcsec_per_px = camera.pixel_m / camera.focal_m / ARCSEC
    limit_arcsec = settings.max_photocentre_shift_px * arcsec_per_px
    reliable = _sound(index, float(f"{limit_arcsec:.3g}")).take(rows)
    displaced = _displaced(index, rows, psf_sigma_px * arcsec_per_px * ARCSEC, limit_arcsec * ARCSEC)
    return np.asarray(reliable & ~displaced)


@lru_cache(maxsize=4)  # every image of a camera asks
def _sound(index: StarIndex, limit_arcsec: float) -> Bools:
    """(N,) stars of the index with a sound solution and no companion that displaces them so far."""
    catalogue = hipparcos_stars()
    sound = catalogue.places.hip[catalogue.usable_for_calibration & catalogue.point_like(limit_arcsec)]
    return np.asarray(np.isin(index.stars.hip, sound))


def _displaced(index: StarIndex, rows: Ints, sigma_rad: float, limit_rad: float) -> Bools:
    """(N,) which of the stars `rows` (N,) of the index a neighbour displaces by more than `limit_rad`, for
    Gaussian images of `sigma_rad`."""
    start, d, flux_ratio = _neighbours(index)
    first, end = start.take(rows), start.take(rows + 1)
    displaced = np.zeros(len(rows), dtype=bool)
    if np.array_equal(first, end):  # no star has a neighbour
        return displaced
    star, pair = concatenated_ranges(first, end)
    d, flux_ratio = d.take(pair), flux_ratio.take(pair)
    overlap = (d < _REACH_SIGMA * sigma_rad) * d * np.exp(-((0.5 * d / sigma_rad) ** 2))
    displaced[star[flux_ratio * overlap > limit_rad]] = True
    return displaced


@lru_cache(maxsize=2)  # every image of a camera asks
def _neighbours(index: StarIndex) -> tuple[Ints, Floats, Floats]:
    """Pairs of close stars by star: star n has the rows start[n]:start[n + 1] of the distances (P,), rad, and
    of the ratios of the neighbour's flux to its own (P,)."""
    star, other = np.concatenate([index.close, index.close[:, ::-1]]).T
    order = np.argsort(star, kind="stable")
    v_mag = index.stars.v_mag
    start = np.searchsorted(star[order], np.arange(len(index.u_i) + 1))
    flux_ratio = 10.0 ** (-0.4 * (v_mag[other] - v_mag[star]))
    return start, np.tile(index.close_rad, 2)[order], flux_ratio[order]
