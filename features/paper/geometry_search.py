"""Search for the geometry behind the paper's Fig. 7 and Table 4, whose Fig. 3 and numbers of stars are not
printed.

Stars and targets that fill their fields give theta in closed form: theta is the difference of two attitudes,
so

    cov = R_cs C_s R_csᵀ / (stars) + C_c / (targets),    C = sigma² (E[I - u uᵀ])⁻¹ over the camera's field,

with the numbers of stars and targets summed over all frames, about the axes of c. The search varies the
direction of the star camera's axis, its roll, both numbers and the spread of the targets. SI units, radians;
arcsec in tables.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from boresight.features.paper.paper_tables import FIGURE_7_CELLS, FIGURE_7_SIGMA_ARCSEC, TABLE_4
from boresight.geometry.constants import ARCSEC
from boresight.records.record import Floats, array, record
from boresight.simulator.campaign import CameraPair

__all__ = ["GeometrySearch", "covariance_shapes", "geometry_map", "predicted_sigma", "star_camera_rotation"]

# (2, 3) arcsec, about X, Y, Z: standard deviations of the paper's Fig. 7, and the rms of its Table 4.
PAPER = np.array(
    [FIGURE_7_SIGMA_ARCSEC, np.sqrt(np.mean([np.square(own) for _, own in TABLE_4.values()], axis=0))]
)
# Noise of star and target positions, px, of the campaigns in each row.
_CELLS = (FIGURE_7_CELLS, tuple(TABLE_4))


@record(kw_only=True)
class GeometrySearch:
    """Grid of the search. Numbers of stars and targets are sums over all frames."""

    from_zenith_deg: Floats = array(
        "A", "angle between the star camera's axis and -Z of c", default_factory=lambda: np.arange(0.0, 91.0)
    )
    azimuth_deg: Floats = array(
        "B", "of that axis from X (flight) to Y of c", default_factory=lambda: np.arange(0.0, 91.0, 5.0)
    )
    roll_deg: Floats = array(
        "C", "of the star camera about its axis", default_factory=lambda: np.array([0.0, 45.0, 90.0])
    )
    stars: Floats = array("D", "identified stars in all frames", default_factory=lambda: _steps(1e3, 1e5, 25))
    targets: Floats = array("E", "targets in all frames", default_factory=lambda: _steps(1e3, 1e6, 37))
    spread: Floats = array(
        "F", "width of the targets over that of the swath", default_factory=lambda: np.array([0.25, 0.5, 1.0])
    )


def star_camera_rotation(from_zenith_deg: float, azimuth_deg: float, roll_deg: float) -> Rotation:
    """`R_cs` of a star camera whose axis is `from_zenith_deg` off -Z of c towards `azimuth_deg` (0: X, 90:
    Y).
    """
    tilt = Rotation.from_euler("ZY", [azimuth_deg, -from_zenith_deg], degrees=True)
    return tilt * Rotation.from_euler("XZ", [180.0, roll_deg], degrees=True)


def covariance_shapes(cameras: CameraPair, spread: float = 1.0) -> tuple[Floats, Floats]:
    """Covariances (3, 3) of the attitude from one star (frame s) and from one target (frame c) of 1 px noise,
    rad².

    Targets fill a square of `spread` times the swath, as in `simulator.campaign.draw_frames`.
    """
    half_s = np.array([cameras.star_half_width_px, cameras.star_half_height_px]) * cameras.star_pixel_rad
    half_c = np.full(2, spread * cameras.half_field_rad)
    shapes = [_per_direction(half) for half in (half_s, half_c)]
    return cameras.star_pixel_rad**2 * shapes[0], cameras.pixel_rad**2 * shapes[1]


def predicted_sigma(
    R_cs: Rotation,
    shapes: tuple[Floats, Floats],
    cells: Sequence[tuple[float, float]],
    stars: Floats,
    targets: Floats,
) -> Floats:
    """1-sigma (..., 3) of theta about the axes of c, arcsec, rms over cells (sigma_s, sigma_c), px; `stars`
    and `targets` in all frames have shape (...).
    """
    C, (noise_s, noise_c) = R_cs.as_matrix(), np.mean(np.square(cells), axis=0)
    of_star, of_target = np.diag(C @ shapes[0] @ C.T) * noise_s, np.diag(shapes[1]) * noise_c
    return np.sqrt(of_star / stars[..., None] + of_target / targets[..., None]) / ARCSEC


def geometry_map(cameras: CameraPair, search: GeometrySearch) -> pd.DataFrame:
    """The best numbers for every direction of the star camera's axis, one row per direction and goal.

    The goals: `figure7` (three standard deviations), `table4` (three rms), `both` (all six), and
    `figure7-few` and `table4-few` with at most 400 frames of 60 stars and 20 targets. `misfit` is the largest
    ratio, either way, between prediction and the paper; `fit_*` columns hold the predictions in arcsec.
    """
    tables = [_best_numbers(cameras, search, *direction) for direction in _directions(search)]
    found = pd.concat(tables, ignore_index=True)
    keep = found.groupby(["goal", "from_zenith_deg", "azimuth_deg"])["misfit"].idxmin()
    return found.loc[keep].sort_index().reset_index(drop=True)


def _directions(search: GeometrySearch) -> Iterator[tuple[float, float, float]]:
    for from_zenith in search.from_zenith_deg:
        for azimuth in search.azimuth_deg:
            for roll in search.roll_deg:
                yield float(from_zenith), float(azimuth), float(roll)


def _best_numbers(
    cameras: CameraPair, search: GeometrySearch, from_zenith: float, azimuth: float, roll: float
) -> pd.DataFrame:
    R_cs = star_camera_rotation(from_zenith, azimuth, roll)
    spread, stars, targets = np.meshgrid(search.spread, search.stars, search.targets, indexing="ij")
    sigma = np.empty((2, *spread.shape, 3))  # of Fig. 7 and of Table 4
    for n, of_spread in enumerate(search.spread):
        shapes = covariance_shapes(cameras, float(of_spread))
        for k, cells in enumerate(_CELLS):
            sigma[k, n] = predicted_sigma(R_cs, shapes, cells, stars[n], targets[n])
    misfit = np.abs(np.log(sigma / PAPER[:, None, None, None, :])).max(axis=-1)
    few = (stars <= 400 * 60) & (targets <= 400 * 20)
    goals = {"figure7": misfit[0], "table4": misfit[1], "both": misfit.max(axis=0)}
    goals |= {f"{name}-few": np.where(few, goals[name], np.inf) for name in ("figure7", "table4")}
    rows = []
    for goal, value in goals.items():
        best = np.unravel_index(int(value.argmin()), value.shape)
        fits = {
            f"fit_{name}_{'xyz'[axis]}": sigma[k][best][axis]
            for k, name in enumerate(("figure7", "table4"))
            for axis in range(3)
        }
        head = {"goal": goal, "from_zenith_deg": from_zenith, "azimuth_deg": azimuth, "roll_deg": roll}
        numbers = {"stars": stars[best], "targets": targets[best], "spread": spread[best]}
        rows.append(head | numbers | {"misfit": float(np.exp(value[best]))} | fits)
    return pd.DataFrame(rows)


def _per_direction(half_rad: Floats) -> Floats:
    """(E[I - u uᵀ])⁻¹ over directions u = (x, y, 1) normalised, x and y uniform within `half_rad` (2,)."""
    axis = (np.arange(64) + 0.5) / 32.0 - 1.0
    x, y = np.meshgrid(half_rad[0] * axis, half_rad[1] * axis)
    u = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return np.asarray(np.linalg.inv(np.eye(3) - u.T @ u / len(u)))


def _steps(first: float, last: float, number: int) -> Floats:
    return np.asarray(np.geomspace(first, last, number), dtype=np.float64)
