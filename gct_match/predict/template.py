"""Predicted template: a chip in the geometry of the strip, with the blur of the camera.

Pixel of the strip -> point on the ground, through the rigorous model, every row at its own instant -> map
coordinates -> chip. The map is computed at nodes a few pixels apart and interpolated linearly, since
attitude, orbit and terrain models are smooth on that scale. Template and strip differ by a translation and a
small affine map.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import cv2
import numpy as np
from pyproj import CRS, Transformer

from boresight.gct_match.imaging.resample import sample
from boresight.gct_match.records import Chip, Image
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.attitude import interpolation_weights
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.line_camera import gaussian_sigma_px
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.terrain import Surface
from boresight.records.record import Bools, Floats, array, record, scalar

__all__ = ["Template", "chip_points", "chip_sides_px", "predict_template"]

_NODE_PX = 8  # between nodes of the map, in pixels of the template


@record
class Template:
    """A chip on the grid of a strip."""

    image: Image = array("H, W", "grey values of the strip's pixels, or of square blocks of them")
    valid: Bools = array("H, W", "false where the chip ends, is not valid, or the ground is not known")
    origin_px: tuple[int, int] = scalar("(sample, line) of the first pixel")


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
    """The chip as a CCD should show it.

    Parameters
    ----------
    chip : Chip
        Geo-referenced picture of the ground.
    pushbroom : Pushbroom
        Rigorous model of the strip.
    ccd : int
        CCD as numbered in the camera model.
    origin_px : (sample, line)
        First pixel of the CCD's image that the template covers.
    shape : (h, w)
        Pixels of the template, each a block of `stride`² pixels of the CCD's image.
    surface : Surface
        Ellipsoidal heights of the ground.
    settings : MatchSettings
        MTF of camera and chip.

    Returns
    -------
    Template
        Not valid where the chip ends or the model finds no ground.
    """
    h, w = shape
    rows, columns = _nodes(h), _nodes(w)
    by_row = interpolation_weights(rows, np.arange(h), points=2)
    by_column = interpolation_weights(columns, np.arange(w), points=2)
    first = np.array(origin_px) + 0.5 * (stride - 1)
    line, sample_px = np.meshgrid(first[1] + stride * rows, first[0] + stride * columns, indexing="ij")
    xy = chip_points(chip, pushbroom.ground_points(ccd, sample_px.ravel(), line.ravel(), surface))
    known = np.isfinite(xy).all(axis=1).reshape(line.shape)
    xy[~np.isfinite(xy)] = -1e6
    x, y = (np.ascontiguousarray(by_row @ part.reshape(line.shape) @ by_column.T) for part in xy.T)
    sigma = _blur_sigma_px(_pixels_per_template_pixel(x, y), stride, settings)
    # a Gaussian wider than the chip is its mean: bounds memory for chips of absurdly small pixels
    blurred = _blurred(chip, min(sigma, float(max(chip.image.shape))))
    x32, y32 = x.astype(np.float32), y.astype(np.float32)
    edge, (rows_chip, columns_chip) = 1.0 + 2.0 * sigma, chip.image.shape
    valid = (x > edge) & (x < columns_chip - 1 - edge) & (y > edge) & (y < rows_chip - 1 - edge)
    if not chip.valid.all():
        valid &= cv2.remap((~chip.valid).astype(np.float32), x32, y32, cv2.INTER_LINEAR) < 0.01
    if not known.all():
        valid &= (by_row @ known @ by_column.T) > 0.999
    return Template(sample(blurred, x32, y32), valid, origin_px)


def _blur_sigma_px(scale: float, stride: int, settings: MatchSettings) -> float:
    """Blur to add to a chip, in its pixels: what the camera adds to the chip's own, and the block's width.

    `scale` is the number of chip pixels to one of the template.
    """
    camera_px = gaussian_sigma_px(settings.mtf_at_nyquist) * scale / stride
    added_px2 = max(camera_px**2 - gaussian_sigma_px(settings.chip_mtf_at_nyquist) ** 2, 0.0)
    return float(np.sqrt(added_px2 + (stride**2 - 1.0) / 12.0 * (scale / stride) ** 2))


def chip_points(chip: Chip, p_e: Floats) -> Floats:
    """(N, 2) points (column, row) of the chip, (0, 0) at the centre of its first pixel, that show the ground
    points p_e (N, 3), ITRS in m.
    """
    lat, lon, _ = geodetic_from_ecef(p_e)
    east, north = _to_map(chip.crs).transform(np.degrees(lon), np.degrees(lat))
    a, b, c, d, e, f = chip.transform
    inverse = np.linalg.inv(np.array([[a, b], [d, e]]))
    return np.column_stack([np.asarray(east) - c, np.asarray(north) - f]) @ inverse.T - 0.5


def chip_sides_px(
    chips: Iterable[Chip], pushbroom: Pushbroom, ccd: int, xy_px: Floats, surface: Surface
) -> Floats:
    """Shorter side of each of N chips in pixels of the strip around `xy_px` (N, 2); 0 if unknown."""
    at = xy_px[:, None, :] + 16.0 * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    p_e = pushbroom.ground_points(ccd, at[:, :, 0].ravel(), at[:, :, 1].ravel(), surface)
    sides = []
    for chip, corner_e in zip(chips, p_e.reshape(-1, 3, 3)):
        xy = chip_points(chip, corner_e)
        scale = np.sqrt(abs(np.linalg.det((xy[1:] - xy[0]) / 16.0)))
        sides.append(min(chip.image.shape) / scale if np.isfinite(scale) and scale > 0.0 else 0.0)
    return np.array(sides)


def _pixels_per_template_pixel(x: Floats, y: Floats) -> float:
    """Pixels of the chip to one of the template, along a side, from the map x, y (h, w) in its middle."""
    h, w = x.shape
    by_column = [(part[h // 2, -1] - part[h // 2, 0]) / (w - 1) for part in (x, y)]
    by_row = [(part[-1, w // 2] - part[0, w // 2]) / (h - 1) for part in (x, y)]
    return float(np.sqrt(abs(np.linalg.det(np.array([by_column, by_row]).T))))


def _blurred(chip: Chip, sigma: float) -> Image:
    """The chip after a Gaussian of `sigma` px; pixels that are not valid take the values around them."""
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


def _nodes(n: int) -> Floats:
    return np.asarray(np.linspace(0.0, n - 1.0, max(2, -(-(n - 1) // _NODE_PX) + 1)), dtype=float)


@lru_cache(maxsize=64)
def _to_map(crs: str) -> Transformer:
    return Transformer.from_crs(CRS.from_epsg(4979).to_2d(), CRS.from_user_input(crs), always_xy=True)
