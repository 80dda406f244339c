"""Where in a picture a template may lie: correlation of band-passed, locally normalised pictures, and its
peaks.

Light, season and haze change a scene's grey values but leave most of its edges: both pictures lose their
local mean and are divided by their local contrast before they are compared. How likely a peak is chance
follows from the number of independent values in the template, measured where it surely does not lie.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

__all__ = [
    "Peaks",
    "correlation_surface",
    "independent_values",
    "normalised",
    "peaks_of",
    "probability_wrong",
]

Array = NDArray[np.float64]
Image = NDArray[Any]  # single precision

_FINE_PX, _LOCAL_PX, _CONTRAST_PX = 0.8, 4.0, 6.0  # pass band and the neighbourhood of the contrast
_FLOOR = 0.15  # of the usual contrast: flat ground is not blown up to texture


@dataclass(frozen=True, slots=True, eq=False)
class Peaks:
    """The highest maxima of a correlation surface, best first."""

    xy: Array  # (K, 2) column, row of the surface, to a fraction of a pixel
    value: Array  # (K,)


def normalised(image: Image, valid: NDArray[np.bool_]) -> Image:
    """Band-passed, divided by the local contrast, limited to ±3; zero where not valid."""
    weight = None if valid.all() else valid.astype(np.float32)
    if weight is not None:
        if not valid.any():
            return np.zeros_like(image)
        image = np.where(valid, image, image[valid].mean()).astype(np.float32)
    fine: Image = cv2.GaussianBlur(image, (0, 0), _FINE_PX)
    if weight is None:
        fine -= cv2.GaussianBlur(image, (0, 0), _LOCAL_PX)
        power = cv2.GaussianBlur(fine * fine, (0, 0), _CONTRAST_PX)
    else:
        part = cv2.GaussianBlur(weight, (0, 0), _LOCAL_PX) + np.float32(1e-6)
        fine = (fine - cv2.GaussianBlur(image * weight, (0, 0), _LOCAL_PX) / part) * weight
        part = cv2.GaussianBlur(weight, (0, 0), _CONTRAST_PX) + np.float32(1e-6)
        power = cv2.GaussianBlur(fine * fine, (0, 0), _CONTRAST_PX) / part
    usual = np.float32(
        np.median(
            np.array(power, dtype=np.float64)[
                :: max(1, power.shape[0] // 256), :: max(1, power.shape[1] // 256)
            ]
        )
    )
    fine = fine / np.sqrt(np.maximum(power, 0.0) + np.float32(_FLOOR**2) * usual + np.float32(1e-12))
    return np.clip(fine, -3.0, 3.0, out=fine)


def correlation_surface(template: Image, picture: Image) -> Image:
    """Normalised correlation of a normalised template at every place where it lies within a normalised
    picture.
    """
    out = cv2.matchTemplate(picture, template - template.mean(), cv2.TM_CCORR)
    energy = cv2.boxFilter(
        picture * picture,
        -1,
        template.shape[::-1],
        anchor=(0, 0),
        normalize=False,
        borderType=cv2.BORDER_CONSTANT,
    )[: out.shape[0], : out.shape[1]]
    total = float(np.sum((template - template.mean()) ** 2))
    floor = 0.05 * total  # a window that is mostly empty has no correlation
    return out / np.sqrt(total * np.maximum(energy, floor) + 1e-12)


def peaks_of(surface: Image, most: int, apart: int) -> Peaks:
    """The `most` highest maxima that lie at least `apart` from one another."""
    size = 2 * apart + 1
    highest = cv2.dilate(surface, np.ones((size, size), np.uint8))
    row, column = np.nonzero((surface == highest) & (surface > 0.0))
    value = surface[row, column]
    if len(value) > most:
        keep = np.argpartition(value, -most)[-most:]
        row, column, value = row[keep], column[keep], value[keep]
    order = np.argsort(value)[::-1]
    row, column, value = row[order], column[order], value[order]
    xy = np.column_stack([column + _vertex(surface, row, column, 1), row + _vertex(surface, row, column, 0)])
    return Peaks(xy.astype(float), value.astype(float))


def probability_wrong(surface: Image, peak_xy: Array, independent: float, absent: float) -> float:
    """That the true place is not under the peak, given the whole correlation surface.

    Each place of the surface has the likelihood (1 - r²)^(-n/2) of explaining the pair, against 1 for
    chance. n is the geometric mean of the template's number of independent values and of one over the
    variance of r away from the peak: the first overrates scenes of repeated pattern, the second takes the
    peak's own side lobes for chance. Under the peak is what is joined to it at more than half its height:
    from there least squares climbs to the same place. `absent` is the prior probability that the surface
    does not hold the target at all.
    """
    column, row = np.clip(np.round(peak_xy).astype(int), 0, np.array(surface.shape[::-1]) - 1)
    _, labels = cv2.connectedComponents((surface > 0.5 * surface[row, column]).astype(np.uint8))
    near = (labels == labels[row, column]).astype(np.uint8)
    near[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2] = 1
    under = cv2.dilate(near, np.ones((5, 5), np.uint8)).astype(bool)
    away = surface[~under].astype(float)
    if away.size < 30:
        return 1.0
    r = np.clip(surface.astype(float), 0.0, 0.99999)
    independent = float(np.sqrt(independent / max(float(np.mean(away**2)), 1e-6)))
    log_likelihood = -0.5 * independent * np.log1p(-(r**2))
    top = float(log_likelihood.max())
    weight = np.exp(log_likelihood - top)
    here, elsewhere = float(weight[under].sum()), float(weight[~under].sum())
    chance = absent / (1.0 - absent) * surface.size * np.exp(-top)
    return float((elsewhere + chance) / (here + elsewhere + chance))


def independent_values(template: Image) -> float:
    """How many independent values a normalised template holds, from the evenness of its spectrum."""
    power = np.abs(scipy.fft.rfft2(template - template.mean())).astype(float) ** 2
    return float(2.0 * power.sum() ** 2 / (power**2).sum()) if power.any() else 1.0


def _vertex(surface: Image, row: NDArray, column: NDArray, axis: int) -> Array:
    """Offset of the parabola through three values from the middle one; zero at the surface's edge."""
    n = surface.shape[axis]
    at = row if axis == 0 else column
    inner = (at > 0) & (at < n - 1)
    step = np.where(inner, 1, 0)
    before = surface[row - step, column] if axis == 0 else surface[row, column - step]
    after = surface[row + step, column] if axis == 0 else surface[row, column + step]
    bend = 2.0 * surface[row, column] - before - after
    offset = np.where(bend > 1e-9, 0.5 * (after - before) / np.maximum(bend, 1e-9), 0.0)
    return np.clip(np.where(inner, offset, 0.0), -0.5, 0.5)
