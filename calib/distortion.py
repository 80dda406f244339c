"""What is left of the remote-sensing camera's distortion after its own calibration: a curve along the field,
and a shift, a slope and a bend of each CCD.

The residual of a look vector along x and y of frame c is a random curve with variance one (times
`sigma_distortion_rad` squared) and Matérn's 3/2 correlation over `length_px`: of the angle across the field,
as the optics make it, over all CCDs; or, where the angle of a pixel is not given, of the sample number, one
for each CCD. The area under the correlation is that of exp(-d²/2) of a distance of d lengths: it decides how
much of the curve remains in the mean over a field. The curve is held by its values at knots half a length
apart, straight lines between them; what straight lines miss of the variance is noise of each target.

The optics make a curve that passes from one CCD to the next; where a CCD sits and how flat it is, is its own.
Along x and along y a CCD has three unknowns more (`MODES`): Legendre polynomials of degree 0, 1 and 2 along
its samples, each with a mean square of one over the CCD. The slope is the CCD's rotation along x, its scale
along y.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boresight.calib.settings import CalibrationSettings
from boresight.geometry.sightings import GroundSightings

__all__ = [
    "MODES",
    "ccd_modes",
    "correlation",
    "knot_weights",
    "knots_touched",
    "missed_between_knots",
    "places_on_curves",
    "prior_information",
    "residual_distortion",
    "unit_numbers",
    "unknown_names",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
MODES = ("shift", "slope", "bend")  # of a CCD, along x and along y
Knot = tuple[int, int]  # curve: CCD, or 0 of the whole field; number of the knot along it
OF_CAMERA = 1000  # CCDs and curves of camera n are numbered from n times as many


def unit_numbers(ccd: Index, camera: Index) -> Index:
    """Numbers (J,) over all cameras of CCDs, or of curves, of cameras."""
    return OF_CAMERA * camera + ccd


def residual_distortion(
    ground: GroundSightings, camera: Index, models: Sequence[CalibrationSettings]
) -> tuple[Index, Array, Array, Array]:
    """Curve (J,) of each target, its place along it in correlation lengths, the curve's 1-sigma, rad, and the
    change (J, 3) by the `MODES` of its CCD, of 1-sigma each, rad; by the settings of each camera.
    """
    J, sample = len(camera), ground.xy_px[:, 0]
    curve, modes_rad = np.zeros(J, dtype=np.int64), np.zeros((J, 3))
    place, sigma_rad = np.zeros((2, J))
    for n in np.unique(camera).tolist():
        here, model = camera == n, models[n]
        ccd, x, u_c = ground.ccd[here], sample[here], ground.u_c[here]
        curves, places_px = places_on_curves(ccd, x, u_c, model.distortion_pixel_rad)
        curve[here] = unit_numbers(curves, camera[here])
        place[here] = places_px / model.distortion_length_px
        sigma_rad[here] = model.sigma_distortion_rad
        if model.ccd_px and any(model.sigma_ccd_rad):
            modes_rad[here] = ccd_modes(ccd, x, model.ccd_px) * model.sigma_ccd_rad
    return curve, place, sigma_rad, modes_rad


def places_on_curves(ccd: Index, sample: Array, u_c: Array, pixel_rad: float) -> tuple[Index, Array]:
    """Curve (J,) of each target and its place along it (J,), px: CCD and sample, or with a `pixel_rad` 0 and
    the angle of its look direction `u_c` (J, 3) across the field.
    """
    if not pixel_rad:
        return ccd, sample
    return np.zeros_like(ccd), np.arctan2(u_c[:, 1], u_c[:, 2]) / pixel_rad


def knots_touched(curve: Index, place: Array) -> tuple[Knot, ...]:
    """The knots between which targets at places (J,) on curves (J,) lie, in order."""
    left = np.floor(place / 0.5).astype(np.int64)
    both = {(int(c), int(k) + side) for c, k in zip(curve, left) for side in (0, 1)}
    return tuple(sorted(both))


def knot_weights(curve: Index, place: Array, knots: tuple[Knot, ...]) -> Array:
    """Weights (J, K) of the knots in the curve's value at each target: of the two that it lies between."""
    of_curve, number = np.array(knots, dtype=np.int64).reshape(-1, 2).T
    step = place[:, None] / 0.5
    share = step - np.floor(step)
    after = number - np.floor(step)
    return (of_curve == curve[:, None]) * ((after == 0.0) * (1.0 - share) + (after == 1.0) * share)


def missed_between_knots(weights: Array) -> Array:
    """Share (J,) of the curve's variance that straight lines between knots miss; `weights` (J, K) of these,
    which are those of two neighbours and add up to one.
    """
    squares = np.sum(weights**2, axis=1)
    return np.asarray((1.0 - squares) * (1.0 - correlation(((0, 0), (0, 1)))[0, 1]))


def correlation(knots: tuple[Knot, ...]) -> Array:
    """Prior correlation (K, K) of the values at knots: Matérn 3/2 within a curve, none between curves."""
    table = np.array(knots, dtype=float).reshape(-1, 2)
    lengths = 0.5 * np.abs(table[:, None, 1] - table[None, :, 1])
    distance = 4.0 / np.sqrt(2.0 * np.pi) * lengths  # area under (1 + d) exp(-d): 4 on both sides
    return (1.0 + distance) * np.exp(-distance) * (table[:, None, 0] == table[None, :, 0])


def ccd_modes(ccd: Index, sample: Array, ccd_px: tuple[int, ...]) -> Array:
    """Change (J, 3) of the distortion at each target by the `MODES` of its CCD, in units of their rms;
    `ccd_px` is the number of samples of every CCD of the camera.
    """
    t = 2.0 * sample / (np.array(ccd_px, dtype=float)[ccd] - 1.0) - 1.0
    return np.stack([np.ones_like(t), np.sqrt(3.0) * t, np.sqrt(5.0) * (1.5 * t * t - 0.5)], axis=1)


def unknown_names(knots: tuple[Knot, ...], ccds: tuple[int, ...] = ()) -> tuple[str, ...]:
    """Names of the camera's unknowns along x, then along y: the curve at every knot, modes of the CCDs."""
    of_knots = [f"{ccd}/{k}" for ccd, k in knots]
    of_ccds = [f"{ccd}/{mode}" for mode in MODES for ccd in ccds]
    return tuple(f"distortion/{axis}/{name}" for axis in "xy" for name in of_knots + of_ccds)


def prior_information(names: tuple[str, ...]) -> Array:
    """Inverse prior covariance (n, n) of unknowns by their names, in units of the prior sigma."""
    parts = [name.split("/") for name in names]
    rows_of: dict[tuple[str, int], list[int]] = {}
    for row, (_, axis, curve, k) in enumerate(parts):
        if k not in MODES:
            rows_of.setdefault((axis, int(curve)), []).append(row)
    information = np.eye(len(names))
    for (_, number), rows in rows_of.items():  # curves are independent
        knots = tuple((number, int(parts[row][3])) for row in rows)
        information[np.ix_(rows, rows)] = np.linalg.inv(correlation(knots))
    return information
