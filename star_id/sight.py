"""A raw image of a known camera becomes the sightings that calibration uses: named stars with covariances.

Only stars whose place is beyond doubt pass on: not displaced by a neighbour, a companion or, if saturated, a
skirt that is not the PSF's, not marked in the catalogue, not an outlier of the attitude fit.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.constants import ARCSEC
from boresight.geometry.epoch import Epoch
from boresight.geometry.sightings import StarSightings
from boresight.geometry.star_camera import StarCamera
from boresight.geometry.starlight import apparent_star_directions
from boresight.star_id.attitude import attitude_of_most
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.finding.star_list import StarList, find_stars
from boresight.star_id.identification.identify import AttitudePrior, NotIdentified, identify
from boresight.star_id.identification.tangent_plane import FieldOfView
from boresight.star_id.identification.triangle_index import StarIndex, equivalent_fov
from boresight.star_id.settings import StarSettings

__all__ = [
    "field_of_camera",
    "has_reliable_position",
    "select_for_calibration",
    "sight_stars",
    "smear_of_rate",
    "tangent_coordinates",
]

Array = NDArray[np.float64]

_NAMING_PX = 0.02  # a tenth of a faint star's centroid error
_REACH_SIGMA = 8.0  # no star displaces another from so far


def sight_stars(
    exposure_id: str,
    image: NDArray,
    camera: StarCamera,
    index: StarIndex,
    epoch: Epoch,
    t_s: float,
    p_i: Array,
    v_i: Array,
    settings: StarSettings,
    *,
    dark: NDArray | None = None,
    prior: AttitudePrior | None = None,
) -> StarSightings | NotIdentified:
    """Named stars of one exposure taken at `t_s` (its middle) from `p_i` (m) with velocity `v_i` (m/s), GCRS.

    A `prior` attitude (GCRS to s, aberration left in) saves time. A satellite's turning during the exposure
    goes in as `settings.smear_px` (`smear_of_rate`).
    """
    stars = find_stars(image, settings, dark)
    found = identify(
        tangent_coordinates(camera, stars.xy_px),
        field_of_camera(camera, settings),
        index,
        settings,
        prior=prior,
    )
    if isinstance(found, NotIdentified):
        return NotIdentified(f"exposure {exposure_id}: {found.reason}", found.numbers)
    safe = select_for_calibration(stars, found.detections, found.stars, camera, index, settings)
    rows, names = found.detections[safe], found.stars[safe]
    if len(rows) < 3:
        return NotIdentified(
            f"exposure {exposure_id}: {len(found.detections)} stars identified, only {len(rows)} fit for"
            " calibration, 3 are needed",
            {"identified": float(len(found.detections)), "usable": float(len(rows))},
        )
    xy = stars.xy_px[rows]
    u_s = camera.directions_from_pixels(xy)
    J = camera.pixel_jacobian(xy)
    cov_s = J @ stars.cov_px[rows] @ J.transpose(0, 2, 1)
    u_i = apparent_star_directions(index.stars.take(names), epoch, t_s, p_i, v_i)
    keep, _ = attitude_of_most(u_s, u_i, cov_s)
    return StarSightings(
        exposure_id=exposure_id,
        t_s=t_s,
        hip=index.stars.hip[names][keep],
        xy_px=xy[keep],
        u_s=u_s[keep],
        u_i=u_i[keep],
        cov_s=cov_s[keep],
    )


def tangent_coordinates(camera: StarCamera, xy_px: Array) -> Array:
    """Tangent-plane coordinates (u_x, u_y) / u_z of image points, distortion removed well enough for
    naming."""
    return camera.tangents_from_pixels(xy_px, error_px=_NAMING_PX)


def field_of_camera(camera: StarCamera, settings: StarSettings) -> FieldOfView:
    """What identification has to know of a calibrated camera."""
    focal_px = camera.focal_m / camera.pixel_m
    return FieldOfView(
        0.5 * camera.width_px / focal_px,
        0.5 * camera.height_px / focal_px,
        equivalent_fov(camera.width_px, camera.height_px, focal_px),
        1.0 / focal_px,
        0.0,
        settings.camera_error,
    )


def smear_of_rate(camera: StarCamera, rate_s: Array, exposure_s: float) -> tuple[float, float]:
    """How far (columns, rows) stars near the axis move while the camera turns at `rate_s` (3,) rad/s, in axes
    of s.

    Stars turn against the camera, du/dt = -rate x u; the image is the reverse of u.
    """
    scale = camera.focal_m / camera.pixel_m * exposure_s
    return float(scale * rate_s[1]), float(-scale * rate_s[0])


def select_for_calibration(
    stars: StarList,
    detections: NDArray[np.int64],
    rows: NDArray[np.int64],
    camera: StarCamera,
    index: StarIndex,
    settings: StarSettings,
) -> NDArray[np.bool_]:
    """The same for detections named by rows of the index."""
    safe = has_reliable_position(index, rows, camera, stars.psf.sigma_px, settings)
    return np.asarray(safe & ~stars.blended[detections])


def has_reliable_position(
    index: StarIndex,
    rows: NDArray[np.int64],
    camera: StarCamera,
    psf_sigma_px: float,
    settings: StarSettings,
) -> NDArray[np.bool_]:
    """(N,) which stars `rows` (N,) of the index the catalogue does not doubt and no other displaces in this
    camera."""
    arcsec_per_px = camera.pixel_m / camera.focal_m / ARCSEC
    limit_arcsec = settings.max_photocentre_shift_px * arcsec_per_px
    trusted = _is_in(index.stars.hip[rows], _trusted_hip(float(f"{limit_arcsec:.3g}")))
    displaced = _displaced(index, psf_sigma_px * arcsec_per_px * ARCSEC, limit_arcsec * ARCSEC)
    return np.asarray(trusted & ~displaced[rows])


@lru_cache(maxsize=4)
def _trusted_hip(limit_arcsec: float) -> NDArray[np.int64]:
    """Hipparcos numbers, ascending, of stars that the catalogue does not doubt and no companion displaces."""
    catalogue = hipparcos_stars(8.0)
    return catalogue.places.hip[catalogue.usable_for_calibration & catalogue.point_like(limit_arcsec)]


def _is_in(values: NDArray[np.int64], ascending: NDArray[np.int64]) -> NDArray[np.bool_]:
    place = np.minimum(np.searchsorted(ascending, values), len(ascending) - 1)
    return np.asarray(ascending[place] == values)


def _displaced(index: StarIndex, sigma_rad: float, limit_rad: float) -> NDArray[np.bool_]:
    """(N,) which stars of the index another one displaces by more than `limit_rad` (Gaussian images of
    `sigma_rad`)."""
    near = (index.close_rad < _REACH_SIGMA * sigma_rad).nonzero()[0]
    pair, d = index.close.take(near, axis=0), index.close_rad.take(near)
    v_mag = index.stars.v_mag.take(pair)
    overlap = d * np.exp(-((0.5 * d / sigma_rad) ** 2))
    displaced = np.zeros(len(index.u_i), dtype=bool)
    for star, other in ((0, 1), (1, 0)):
        flux_ratio = 10.0 ** (-0.4 * (v_mag[:, other] - v_mag[:, star]))
        displaced[pair[flux_ratio * overlap > limit_rad, star]] = True
    return displaced
