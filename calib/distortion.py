"""What is left of the remote-sensing camera's distortion after its own calibration: a curve along the field.

The residual of a look vector along x and y of frame c is a random curve with variance one (times
`sigma_distortion_rad` squared) and Matérn's 3/2 correlation over `length_px`: of the angle across the field,
as the optics make it, over all CCDs; or, where the angle of a pixel is not given, of the sample number, one
for each CCD. The area under the correlation is that of exp(-d²/2) of a distance of d lengths: it decides how
much of the curve remains in the mean over a field. The curve is held by its values at knots half a length
apart, straight lines between them; what straight lines miss of the variance is noise of each target.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "correlation",
    "knot_weights",
    "knots_touched",
    "places_on_curves",
    "prior_information",
    "unknown_names",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Knot = tuple[int, int]  # curve: CCD, or 0 of the whole field; number of the knot along it


def places_on_curves(ccd: Index, sample: Array, u_c: Array, pixel_rad: float) -> tuple[Index, Array]:
    """Curve (J,) of each target and its place along it (J,), px: CCD and sample, or with a `pixel_rad` 0 and
    the angle of its look direction `u_c` (J, 3) across the field.
    """
    if not pixel_rad:
        return ccd, sample
    return np.zeros_like(ccd), np.arctan2(u_c[:, 1], u_c[:, 2]) / pixel_rad


def knots_touched(curve: Index, place: Array, length_px: float) -> tuple[Knot, ...]:
    """The knots between which targets at places (J,) on curves (J,) lie, in order."""
    left = np.floor(place / (0.5 * length_px)).astype(np.int64)
    both = {(int(c), int(k) + side) for c, k in zip(curve, left) for side in (0, 1)}
    return tuple(sorted(both))


def knot_weights(curve: Index, place: Array, knots: tuple[Knot, ...], length_px: float) -> Array:
    """Weights (J, K) of the knots in the curve's value at each target. Raises `KeyError` for a knot not
    in `knots`.
    """
    column = {knot: n for n, knot in enumerate(knots)}
    step = place / (0.5 * length_px)
    left = np.floor(step).astype(np.int64)
    weights = np.zeros((len(curve), len(knots)))
    for j, (c, k) in enumerate(zip(curve.tolist(), left.tolist())):
        share = step[j] - k
        weights[j, column[c, k]] = 1.0 - share
        weights[j, column[c, k + 1]] = share
    return weights


def correlation(knots: tuple[Knot, ...]) -> Array:
    """Prior correlation (K, K) of the values at knots: Matérn 3/2 within a curve, none between curves."""
    table = np.array(knots, dtype=float).reshape(-1, 2)
    lengths = 0.5 * np.abs(table[:, None, 1] - table[None, :, 1])
    distance = 4.0 / np.sqrt(2.0 * np.pi) * lengths  # area under (1 + d) exp(-d): 4 on both sides
    return (1.0 + distance) * np.exp(-distance) * (table[:, None, 0] == table[None, :, 0])


def unknown_names(knots: tuple[Knot, ...]) -> tuple[str, ...]:
    """Names of the camera's unknowns: the curve along x at every knot, then along y."""
    return tuple(f"distortion/{axis}/{ccd}/{k}" for axis in "xy" for ccd, k in knots)


def prior_information(names: tuple[str, ...]) -> Array:
    """Inverse prior covariance (n, n) of unknowns by their names, in units of the prior sigma."""
    parts = [name.split("/") for name in names]
    knots = tuple((int(ccd), int(k)) for _, _, ccd, k in parts)
    axis = np.array([a for _, a, _, _ in parts])
    return np.linalg.inv(correlation(knots) * (axis[:, None] == axis[None, :])) if names else np.zeros((0, 0))
