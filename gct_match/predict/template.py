"""What a strip should show of a chip: the chip in the strip's own geometry, blurred as the camera blurs.

Pixel of the strip -> point on the ground, through the rigorous model, every row at its own instant -> map
coordinates -> chip. The map is computed on nodes a few pixels apart and is linear in between: attitude,
orbit and terrain models are smooth on that scale. What is left between template and strip is a translation
and a small affine map.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer

from boresight.gct_match.imaging.resample import sample
from boresight.gct_match.imaging.spectra import gaussian_sigma_px
from boresight.gct_match.records import Chip
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.terrain import Surface

__all__ = ["Template", "chip_points", "chip_side_px", "predict_template"]

Array = NDArray[np.float64]
Image = NDArray[Any]  # single precision

_NODE_PX = 8  # between nodes of the map, in pixels of the template


@dataclass(frozen=True, slots=True, eq=False)
class Template:
    """A chip on the grid of a strip: pixel (0, 0) covers `stride`² pixels from `origin_px` (sample, line)
    on.
    """

    image: Image  # (h, w)
    valid: NDArray[np.bool_]  # (h, w)
    origin_px: tuple[int, int]
    stride: int


def predict_template(
    chip: Chip,
    pushbroom: Pushbroom,
    ccd: int,
    origin_px: tuple[int, int],
    shape: tuple[int, int],
    surface: Surface,
    settings: MatchSettings,
    *,
    stride: int = 1,
) -> Template:
    """The chip as (h, w) blocks of stride² pixels of a CCD's image, from pixel `origin_px` (sample, line) on.

    Where the chip ends, or the model knows no ground, the template is not valid.
    """
    h, w = shape
    rows, columns = _nodes(h), _nodes(w)
    middle = 0.5 * (stride - 1)
    line, at = np.meshgrid(
        origin_px[1] + middle + stride * rows, origin_px[0] + middle + stride * columns, indexing="ij"
    )
    p_e = pushbroom.ground_points(ccd, at.ravel(), line.ravel(), surface)
    xy = chip_points(chip, p_e)
    known = np.isfinite(xy).all(axis=1).reshape(line.shape)
    xy[~np.isfinite(xy)] = -1e6
    by_row, by_column = _weights(rows, h), _weights(columns, w)
    x, y = (np.ascontiguousarray(by_row @ part.reshape(line.shape) @ by_column.T) for part in xy.T)
    scale = _pixels_per_template_pixel(x, y)
    # what the camera adds to the chip's own blur, and the block's own width, in pixels of the chip
    sigma = np.sqrt(
        max(
            (gaussian_sigma_px(settings.mtf_at_nyquist) * scale / stride) ** 2
            - gaussian_sigma_px(settings.chip_mtf_at_nyquist) ** 2,
            0.0,
        )
        + (stride**2 - 1.0) / 12.0 * (scale / stride) ** 2
    )
    blurred = _blurred(chip, sigma)
    image = sample(blurred, x.astype(np.float32), y.astype(np.float32))
    edge = 1.0 + 2.0 * sigma
    rows_chip, columns_chip = chip.image.shape
    valid = (x > edge) & (x < columns_chip - 1 - edge) & (y > edge) & (y < rows_chip - 1 - edge)
    if not chip.valid.all():
        bad = cv2.remap(
            (~chip.valid).astype(np.float32), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR
        )
        valid &= bad < 0.01
    if not known.all():
        valid &= (by_row @ known @ by_column.T) > 0.999
    return Template(image, valid, origin_px, stride)


def chip_points(chip: Chip, p_e: Array) -> Array:
    """Points of the chip (N, 2), (column, row) with (0, 0) at the centre of its first pixel, of ground
    points (N, 3).
    """
    lat, lon, _ = geodetic_from_ecef(p_e, WGS84)
    east, north = _to_map(chip.crs).transform(np.degrees(lon), np.degrees(lat))
    a, b, c, d, e, f = chip.transform
    inverse = np.linalg.inv(np.array([[a, b], [d, e]]))
    return np.column_stack([np.asarray(east) - c, np.asarray(north) - f]) @ inverse.T - 0.5


def chip_side_px(chip: Chip, pushbroom: Pushbroom, ccd: int, xy_px: Array, surface: Surface) -> float:
    """Side of the chip in pixels of the strip around `xy_px`."""
    x, y = xy_px
    p_e = pushbroom.ground_points(ccd, np.array([x, x + 16.0, x]), np.array([y, y, y + 16.0]), surface)
    points = chip_points(chip, p_e)
    per_px = np.sqrt(abs(np.linalg.det((points[1:] - points[0]) / 16.0)))
    return float(min(chip.image.shape) / per_px) if np.isfinite(per_px) and per_px > 0.0 else 0.0


def _pixels_per_template_pixel(x: Array, y: Array) -> float:
    h, w = x.shape
    jacobian = np.array(
        [
            [(x[h // 2, -1] - x[h // 2, 0]) / (w - 1), (x[-1, w // 2] - x[0, w // 2]) / (h - 1)],
            [(y[h // 2, -1] - y[h // 2, 0]) / (w - 1), (y[-1, w // 2] - y[0, w // 2]) / (h - 1)],
        ]
    )
    return float(np.sqrt(abs(np.linalg.det(jacobian))))


def _blurred(chip: Chip, sigma: float) -> Image:
    """The chip through a Gaussian; what is not valid takes the value of what is around it."""
    image = chip.image.astype(np.float32)
    if not chip.valid.all():
        weight = chip.valid.astype(np.float32)
        wide = 4.0 + 2.0 * sigma
        level = np.float32(image[chip.valid].mean()) if chip.valid.any() else np.float32(0.0)
        around: Image = cv2.GaussianBlur((image - level) * weight, (0, 0), wide)
        around /= cv2.GaussianBlur(weight, (0, 0), wide) + np.float32(1e-3)
        image = np.where(chip.valid, image, level + around)
    if sigma < 0.2:
        return image
    return cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)


def _nodes(n: int) -> Array:
    return np.asarray(np.linspace(0.0, n - 1.0, max(2, -(-(n - 1) // _NODE_PX) + 1)), dtype=float)


def _weights(nodes: Array, n: int) -> Array:
    """(n, K) weights of linear interpolation between nodes at 0..n-1."""
    at = np.arange(n, dtype=float)
    k = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    fraction = (at - nodes[k]) / (nodes[k + 1] - nodes[k])
    weights = np.zeros((n, len(nodes)))
    weights[np.arange(n), k] = 1.0 - fraction
    weights[np.arange(n), k + 1] += fraction
    return weights


@lru_cache(maxsize=64)
def _to_map(crs: str) -> Transformer:
    return Transformer.from_crs(CRS.from_epsg(4979).to_2d(), CRS.from_user_input(crs), always_xy=True)
