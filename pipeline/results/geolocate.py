"""Image points to latitude, longitude and height, with what they may be wrong by along and across the track.

The 1-sigma takes in the installation matrix, the star exposures' attitudes and their interpolation, and what
the mission states of its own errors: position, clock, vibration, look distortion, terrain heights. To first
order each moves the foot of the line of sight over the ground:

    turn delta:  r (I - u nᵀ / uᵀn) (delta x u)      satellite moved by d:  (I - u nᵀ / uᵀn) d
    ground higher by h:  h (u / uᵀn - n)

with the line of sight u, its length r and the vertical n (a turn of the camera by delta turns u with it).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from boresight.geometry.attitude import lagrange_weights
from boresight.geometry.constants import ARCSEC, WGS84
from boresight.geometry.geodesy import ellipsoid_normals, geodetic_from_ecef
from boresight.geometry.terrain import Surface
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.text_files import read_table
from boresight.pipeline.results.strip_model import Calibrated, StripModel

__all__ = ["GroundPlaces", "Pixels", "geolocate", "places_csv", "read_pixels"]

Array = NDArray[np.float64]


class PixelRow(BaseModel):
    """One line of the file of pixels. (0, 0) is the centre of the first pixel."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)
    ccd: Annotated[int, Field(ge=0)]
    sample: float
    line: float


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """N image points of one strip."""

    ccd: NDArray[np.int64]
    sample: Array
    line: Array


@dataclass(frozen=True, slots=True, eq=False)
class GroundPlaces:
    """Where N pixels look; NaN where the line of sight meets no known ground or the row has no attitude."""

    lat_deg: Array
    lon_deg: Array
    height_m: Array  # above the WGS84 ellipsoid
    sigma_along_m: Array
    sigma_across_m: Array


def read_pixels(path: Path, calibrated: Calibrated) -> Pixels:
    """A CSV file with the columns ccd, sample, line. `RawDataError` names the line of what cannot be."""
    rows = read_table(path, PixelRow, str(path))
    n_ccds = calibrated.dump.line_camera.n_ccds
    for n, row in enumerate(rows):
        if row.ccd >= n_ccds:
            raise RawDataError(str(path), f"line {n + 2}, ccd", str(row.ccd), f"0 to {n_ccds - 1}")
    return Pixels(
        np.array([row.ccd for row in rows], dtype=np.int64),
        np.array([row.sample for row in rows], dtype=float),
        np.array([row.line for row in rows], dtype=float),
    )


def geolocate(calibrated: Calibrated, model: StripModel, pixels: Pixels, surface: Surface) -> GroundPlaces:
    """Places and their 1-sigma."""
    n = len(pixels.line)
    p_e, sigma = np.full((n, 3), np.nan), np.full((n, 2), np.nan)
    first, last = model.pushbroom.rows.line(model.track.t_s[[0, -1]])
    covered = (pixels.line >= first) & (pixels.line <= last)
    for ccd in np.unique(pixels.ccd[covered]).tolist():
        rows = np.flatnonzero(covered & (pixels.ccd == ccd))
        sample, line = pixels.sample[rows], pixels.line[rows]
        p_e[rows] = model.pushbroom.ground_points(ccd, sample, line, surface)
        sigma[rows] = _sigma(calibrated, model, line, p_e[rows])
    lat, lon, height = geodetic_from_ecef(p_e, WGS84)
    unknown = ~np.isfinite(p_e).all(axis=1)
    for values in (lat, lon, height):
        values[unknown] = np.nan
    return GroundPlaces(np.degrees(lat), np.degrees(lon), height, sigma[:, 0], sigma[:, 1])


def places_csv(pixels: Pixels, places: GroundPlaces) -> Iterator[str]:
    """Lines of a CSV file: the pixels and where they look; empty cells where nothing is known."""
    yield "ccd,sample,line,lat_deg,lon_deg,height_m,sigma_along_m,sigma_across_m\n"
    for n in range(len(pixels.line)):
        cells = [str(pixels.ccd[n]), repr(float(pixels.sample[n])), repr(float(pixels.line[n]))]
        values = (
            (places.lat_deg[n], ".10f"),
            (places.lon_deg[n], ".10f"),
            (places.height_m[n], ".3f"),
            (places.sigma_along_m[n], ".3f"),
            (places.sigma_across_m[n], ".3f"),
        )
        cells += [format(value, form) if np.isfinite(value) else "" for value, form in values]
        yield ",".join(cells) + "\n"


def _sigma(calibrated: Calibrated, model: StripModel, line: Array, p_e: Array) -> Array:
    """1-sigma (N, 2) along and across the track, m."""
    dump, push = calibrated.dump, model.pushbroom
    t_s = push.instants(line)
    satellite_e, motion_e = dump.orbit.positions_e(t_s), dump.orbit.velocities_e(t_s)
    lat, lon, _ = geodetic_from_ecef(p_e, WGS84)
    up = ellipsoid_normals(lat, lon)
    along = motion_e - up * np.einsum("na,na->n", motion_e, up)[:, None]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    to_track = np.stack([along, np.cross(along, up)], axis=1)  # (N, 2, 3)
    sight = p_e - satellite_e
    distance = np.linalg.norm(sight, axis=1)
    u = sight / distance[:, None]
    fall = u / np.einsum("na,na->n", u, up)[:, None]
    foot = np.eye(3) - fall[:, :, None] * up[:, None, :]
    R_ci = (push.R_cs * model.track.R_si(t_s)).as_matrix()
    R_ec = np.swapaxes(dump.orbit.earth.matrices_ie(t_s), 1, 2) @ np.swapaxes(R_ci, 1, 2)
    by_turn = distance[:, None, None] * to_track @ foot @ _turned_by(u) @ R_ec  # (N, 2, 3): m per rad about c
    by_shift = to_track @ foot
    turn = calibrated.result.cov_theta + _attitude_covariance(model, t_s) + _turn_variance(calibrated)
    variance = np.einsum("nia,nab,nib->ni", by_turn, turn, by_turn)
    variance += dump.errors.position_m**2 * np.einsum("nia,nia->ni", by_shift, by_shift)
    variance += (dump.errors.clock_s * np.einsum("nia,na->ni", by_shift, motion_e)) ** 2
    variance += (calibrated.sigma_terrain_m * np.einsum("nia,na->ni", to_track, fall - up)) ** 2
    return np.sqrt(variance)


def _turned_by(u: Array) -> Array:
    """(N, 3, 3): what takes a small turn delta to the change delta x u of a direction."""
    x, y, z = u.T
    o = np.zeros_like(x)
    return np.array([[o, z, -y], [-z, o, x], [y, -x, o]]).transpose(2, 0, 1)


def _attitude_covariance(model: StripModel, t_s: Array) -> Array:
    """Covariance (N, 3, 3) of the star camera's attitude, turned into frame c. Where too few exposures tell
    what the interpolation misses, the exposures' own errors stand alone.
    """
    track, C = model.track, model.pushbroom.R_cs.as_matrix()
    missed = np.nan_to_num(track.interpolation_sigma_rad(t_s))[:, :, None] ** 2 * np.eye(3)
    weights = lagrange_weights(track.t_s, t_s, track.points)
    assert track.cov_s is not None  # `strip_model` gives it
    own = np.einsum("jk,kab->jab", weights**2, track.cov_s)
    return np.asarray(C @ (own + missed) @ C.T)


def _turn_variance(calibrated: Calibrated) -> Array:
    """Vibration and look distortion as rotations about the axes of c, (3, 3) rad²."""
    errors, camera = calibrated.dump.errors, calibrated.dump.line_camera
    distortion = errors.look_distortion_px * camera.ccds[0].pixel_m / camera.focal_m
    return np.asarray(((errors.vibration_arcsec * ARCSEC) ** 2 + distortion**2) * np.eye(3))
