"""The ground as the cameras see it: an endless map of reflectance, made piece by piece.

A map is sampled at texels: texel (column, row) is the square whose centre lies at easting `(column + 0.5)
texel_m` and northing `-(row + 0.5) texel_m` of a UTM zone, so that arrays are north-up. `ProceduralGround`
invents fields, woods, water, settlements and roads; `ImageGround` lays out an ortho-image that the user
gave. Both are deterministic, and the same wherever a patch begins. What the optics blur is for
`BlurredGround`, between the ground and the camera.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer

from boresight.geometry.attitude import interpolation_weights
from boresight.records.record import array, record, scalar
from boresight.simulator.landscape import STRENGTH_UNIT, Landscape
from boresight.simulator.lattice_noise import BAND, fractal, smooth_noise
from boresight.simulator.scenario import GroundSettings

__all__ = ["CHIP_TILE", "TILE", "BlurredGround", "Ground", "GroundImage", "ImageGround", "ProceduralGround"]

Patch = NDArray[np.float32]
Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

# Painted tiles that are kept in memory, the last used.
KEPT_TILES = 48
TILE = 1024  # texels: a tile of reflectance takes 4 MB, those under a row of one CCD's panels some 120 MB
CHIP_TILE = 256  # texels of a tile where only chips are read, here and there
_BLUR_REACH = 2.35  # sigmas of the blur: cutting off what lies beyond changes the modulation by 0.014 at most


class Ground(Protocol):
    """A map of reflectance, 0 to 1."""

    @property
    def texel_m(self) -> float:
        """Side of a texel, m."""

    def patch(self, column: int, row: int, width: int, height: int) -> Patch:
        """Reflectance of the texels of a window, (height, width)."""


@record
class GroundImage:
    """An ortho-image: grey values, affine (a, b, c, d, e, f) of pixel corners as in rasterio, and its CRS."""

    image: NDArray[Any] = array("H, W", "grey values")
    affine: tuple[float, float, float, float, float, float] = array("6", "of pixel corners, as in rasterio")
    crs: str = scalar("coordinate reference system")


class BlurredGround:
    """A ground seen through optics, kept in tiles of `side` texels.

    `sigma_texel` is the width of the whole system; what linear interpolation between the texels blurs by
    itself (a variance of 1/6 texel^2 on average) is taken off. The last tiles used are kept.
    """

    def __init__(self, ground: Ground, sigma_texel: float, side: int = TILE) -> None:
        self.texel_m = ground.texel_m
        self._ground = ground
        self._side = side
        self._sigma = float(np.sqrt(max(sigma_texel**2 - 1.0 / 6.0, 0.0)))
        self._tiles: OrderedDict[tuple[int, int], Patch] = OrderedDict()

    def window(self, column: int, row: int, width: int, height: int) -> Patch:
        """Blurred reflectance, (height, width), not to be overwritten."""
        side = self._side
        i, j = column // side, row // side
        if column + width <= (i + 1) * side and row + height <= (j + 1) * side:  # in one tile
            left, top = column - i * side, row - j * side
            return self._tile(i, j)[top : top + height, left : left + width]
        out = np.empty((height, width), np.float32)
        for j in range(row // side, (row + height - 1) // side + 1):
            for i in range(column // side, (column + width - 1) // side + 1):
                left, top = max(column, i * side), max(row, j * side)
                right, bottom = min(column + width, (i + 1) * side), min(row + height, (j + 1) * side)
                out[top - row : bottom - row, left - column : right - column] = self._tile(i, j)[
                    top - j * side : bottom - j * side, left - i * side : right - i * side
                ]
        return out

    def _tile(self, i: int, j: int) -> Patch:
        if (i, j) in self._tiles:
            self._tiles.move_to_end((i, j))
            return self._tiles[i, j]
        side = self._side
        halo = int(np.ceil(_BLUR_REACH * self._sigma))
        wide = side + 2 * halo
        tile = self._ground.patch(i * side - halo, j * side - halo, wide, wide)
        if self._sigma > 0.0:
            size = (2 * halo + 1, 2 * halo + 1)
            cv2.GaussianBlur(tile, size, self._sigma, tile)
            tile = tile[halo:-halo, halo:-halo]
        self._tiles[i, j] = tile
        while len(self._tiles) > KEPT_TILES:
            self._tiles.popitem(last=False)
        return tile


class ProceduralGround:
    """An invented landscape. `date` 0 is what the chips show, 1 what the strips show (other date, clouds)."""

    def __init__(self, settings: GroundSettings, texel_m: float, key: int, date: int) -> None:
        self.texel_m = texel_m
        self._settings = settings
        self._key = key
        self._date = date
        self._landscape = Landscape(settings, key, date)
        x, y = np.meshgrid(*(np.arange(300) * settings.cloud.size_km * 1e3 / 5.3,) * 2)
        clear = 1.0 - min(settings.cloud.cover, 1.0)
        self._cloud_level = float(np.quantile(self._cloud_noise(x, y), clear))

    def patch(self, column: int, row: int, width: int, height: int) -> Patch:
        """Reflectance of the texels of a window, (height, width)."""
        base, strength = self._painted(column, row, width, height)
        octaves = max(3, int(np.log2(24.0 / self.texel_m)) + 1)  # texture from two texels to 50 m
        reflectance = np.empty((height, width), np.float32)
        bands = fractal(column, row, width, height, self._key + 7, octaves, 0.8)
        for top, band in zip(range(0, height, BAND), bands):
            rows = slice(top, top + BAND)
            seen = reflectance[rows]
            cv2.multiply(strength[rows], band, seen, STRENGTH_UNIT * self._settings.detail, cv2.CV_32F)
            cv2.accumulate(base[rows], seen)
            seen *= np.float32(1.0 / 255.0)
            np.clip(seen, 0.01, 0.95, out=seen)
        return self._as_seen(reflectance, column, row) if self._date else reflectance

    def _painted(self, column: int, row: int, width: int, height: int) -> tuple[Grey, Grey]:
        """Reflectance times 255 and strength of the texture, from the landscape's polygons."""
        base, strength = np.zeros((height, width), np.uint8), np.zeros((height, width), np.uint8)
        west, north = column * self.texel_m, -row * self.texel_m
        east, south = west + width * self.texel_m, north - height * self.texel_m
        origin = np.array([column + 0.5, row + 0.5])
        rim = 2.0 * self.texel_m  # smooth edges are a texel wider than their polygon
        for shapes in self._landscape.shapes(west - rim, south - rim, east + rim, north + rim):
            texels = shapes.corners * (np.array([1.0, -1.0]) / self.texel_m) - origin
            corners = np.rint(texels * 16.0).astype(np.int32)  # OpenCV draws in 1/16 texel
            for tone in sorted(set(shapes.tones.tolist())):
                cv2.fillPoly(base, list(corners[shapes.tones == tone]), (tone,), cv2.LINE_AA, 4)
            if shapes.strengths is not None:
                for one in sorted(set(shapes.strengths.tolist())):
                    cv2.fillPoly(strength, list(corners[shapes.strengths == one]), (one,), cv2.LINE_8, 4)
        return base, strength

    def _as_seen(self, reflectance: Patch, column: int, row: int) -> Patch:
        """Light and weather of the strips' date."""
        other, cloud = self._settings.other_date, self._settings.cloud
        if other.gamma == 1.0 and not other.ramp and not cloud.cover:
            return reflectance
        height, width = reflectance.shape
        east = (np.arange(column, column + width) + 0.5) * self.texel_m
        if other.gamma != 1.0:
            reflectance = reflectance ** np.float32(other.gamma)
        if other.ramp:
            reflectance = reflectance * (1.0 + other.ramp * np.sin(east / 10e3)).astype(np.float32)
        if cloud.cover > 0.0:
            step = max(1, int(50.0 / self.texel_m))
            columns, rows = np.arange(0, width + step, step), np.arange(0, height + step, step)
            x = (column + columns + 0.5) * self.texel_m
            y = -(row + rows + 0.5) * self.texel_m
            noise = self._cloud_noise(*np.meshgrid(x, y))
            full = _between(noise, step, width, height)
            cover = np.clip((full - self._cloud_level) / 0.15 + 0.5, 0.0, 1.0)
            reflectance = (reflectance * (1.0 - cover) + cloud.brightness * cover).astype(np.float32)
        return np.clip(reflectance, 0.0, 1.0).astype(np.float32)

    def _cloud_noise(self, x: Array, y: Array) -> Array:
        size = self._settings.cloud.size_km * 1e3
        return sum(
            (smooth_noise(x / size * 2**n, y / size * 2**n, self._key + 300 + n) / 2**n for n in range(4)),
            start=np.zeros_like(x),
        )


class ImageGround:
    """An ortho-image as ground; beyond its borders it is mirrored, again and again."""

    def __init__(self, source: GroundImage, texel_m: float, epsg: int) -> None:
        self.texel_m = texel_m
        image = np.asarray(source.image, dtype=np.float32)
        low, high = np.quantile(image, [0.0, 0.999])
        self._image = np.clip((image - low) / max(high - low, 1e-9), 0.0, 1.0) * np.float32(0.9)
        self._to_image = Transformer.from_crs(
            CRS.from_epsg(epsg), CRS.from_user_input(source.crs), always_xy=True
        )
        a, b, c, d, e, f = source.affine
        rows, columns = image.shape
        middle = a * columns / 2 + b * rows / 2 + c, d * columns / 2 + e * rows / 2 + f
        lon, lat = Transformer.from_crs(source.crs, 4326, always_xy=True).transform(*middle)
        self._middle = f"{lat:.2f} deg north, {lon:.2f} deg east"
        self._pixels_from_map = np.linalg.inv(np.array([[a, b, c], [d, e, f], [0.0, 0.0, 1.0]]))

    def patch(self, column: int, row: int, width: int, height: int) -> Patch:
        """Reflectance of the texels of a window, (height, width); `ValueError` outside the image."""
        step = 64  # a map projection is straight over 64 texels to far below a texel
        columns, rows = np.arange(0, width + step, step), np.arange(0, height + step, step)
        east, north = np.meshgrid((column + columns + 0.5) * self.texel_m, -(row + rows + 0.5) * self.texel_m)
        x, y = self._to_image.transform(east, north)
        m = self._pixels_from_map
        if not (np.all(np.isfinite(x)) and np.all(np.isfinite(y))):
            raise ValueError(
                f"ground.image: the strip lies beyond the reach of the image's map; the image's middle is "
                f"at {self._middle}: set orbit.latitude_deg and orbit.longitude_deg near it"
            )
        image_x = m[0, 0] * x + m[0, 1] * y + m[0, 2] - 0.5
        image_y = m[1, 0] * x + m[1, 1] * y + m[1, 2] - 0.5
        full = []
        for values, size in ((image_x, self._image.shape[1]), (image_y, self._image.shape[0])):
            offset = np.floor(values.min() / (2 * size - 2)) * (2 * size - 2)
            full.append(_mirrored(_between(values - offset, step, width, height), size))
        return np.asarray(cv2.remap(self._image, full[0], full[1], cv2.INTER_LINEAR), dtype=np.float32)


def _between(values: Array, step: int, width: int, height: int) -> Patch:
    """A window (height, width) from values at every `step`-th point, by straight lines."""
    rows, columns = (np.arange(n, dtype=float) * step for n in values.shape)
    down = interpolation_weights(rows, np.arange(height, dtype=float), points=2)
    across = interpolation_weights(columns, np.arange(width, dtype=float), points=2)
    return (down @ values @ across.T).astype(np.float32)


def _mirrored(index: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    period = np.float32(2 * (size - 1))
    folded = np.mod(index, period)
    return np.minimum(folded, period - folded).astype(np.float32)
