"""An attitude and a lens that are believed in, the catalogue as it is seen with them, and a better belief
from stars that were found there.

The lens of a camera that is not calibrated is four numbers, log scale, k1, p1, p2: measured = (1 + s)(t +
distortion), t being where the tangent plane would show the star.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.star_id.attitude import wahba
from boresight.star_id.identification.tangent_plane import (
    PlaneImage,
    directions_of_plane,
    plane_of_directions,
)
from boresight.star_id.identification.triangle_index import StarIndex

__all__ = ["Guess", "guess_at", "refined", "seen_with"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_APART = 3.0  # pixels: a star nearer to a brighter one is not seen apart from it


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """An attitude and a lens, and catalogue stars as they are seen with them."""

    R: Array
    lens: Array
    rows: NDArray[np.int64]  # (M,) brightest first, all that may be in view
    predicted: Complex  # (M,)


def guess_at(image: PlaneImage, index: StarIndex, R: Array, lens: Array) -> Guess:
    """All stars of the index that may be in view."""
    field = image.field
    corner = math.hypot(field.half_x, field.half_y) * (1.03 + 0.5 * field.shape_error)
    rows = index.near(R[2], math.atan(corner * math.exp(-lens[0])))
    apart = index.to_brighter_rad.take(rows) > _APART * field.pixel
    return seen_with(index, rows.take(apart.nonzero()[0]), R, lens)


def seen_with(index: StarIndex, rows: NDArray[np.int64], R: Array, lens: Array) -> Guess:
    """The index's stars `rows` as they are seen with an attitude and a lens."""
    return Guess(R, lens, rows, _distorted(plane_of_directions(index.u_i.take(rows, axis=0) @ R.T), lens))


def refined(
    image: PlaneImage,
    index: StarIndex,
    guess: Guess,
    detections: NDArray[np.int64],
    stars: NDArray[np.int64],
) -> tuple[Rotation, Array, int]:
    """Attitude, and what detections (N,) that are stars (N,) of the index allow to be said of an unknown
    lens; also the number of parameters."""
    measured = image.plane.take(detections)
    u_i = index.u_i.take(stars, axis=0)
    if image.field.known:
        return wahba(directions_of_plane(measured), u_i, np.ones(len(u_i))), guess.lens, 3
    n = len(measured)
    free = 2 if n < 16 else 4
    if image.field.scale_error > 0 and n < 8:
        free = 1
    R, lens = guess.R, guess.lens.copy()
    for _ in range(3):
        ideal = plane_of_directions(u_i @ R.T)
        residual = measured - _distorted(ideal, lens)
        size = np.abs(residual) / math.sqrt(2.0)
        weight = 1.0 / np.hypot(1.0, size / (2.0 * np.median(size) + 0.05 * image.field.pixel))
        A = np.column_stack([*_turn_columns(ideal), *_lens_columns(ideal)[:free]]) * weight[:, None]
        b = residual * weight
        step = np.linalg.lstsq(np.vstack([A.real, A.imag]), np.append(b.real, b.imag), rcond=1e-10)[0]
        R = Rotation.from_rotvec(step[:3]).as_matrix() @ R
        lens[:free] += step[3:]
    return Rotation.from_matrix(R), lens, 3 + free


def _turn_columns(t: Complex) -> tuple[Complex, Complex, Complex]:
    """d(tangent coordinates) / d(right-handed turn about the axes of s), (N,) each."""
    return -1j - t.imag * t, 1.0 + t.real * t, 1j * t


def _lens_columns(t: Complex) -> tuple[Complex, Complex, Complex, Complex]:
    """d(distorted) / d(log scale, k1, p1, p2), (N,) each."""
    r2 = np.abs(t) ** 2
    return t, r2 * t, r2 + 2.0 * t.real * t, 1j * r2 + 2.0 * t.imag * t


def _distorted(t: Complex, lens: Array) -> Complex:
    if not lens.any():
        return t
    scale, k1, p1, p2 = lens
    _, radial, along, across = _lens_columns(t)
    return np.asarray((t + k1 * radial + p1 * along + p2 * across) * math.exp(scale))
