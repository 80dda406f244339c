"""The ground as the cameras see it: an endless map of reflectance, made piece by piece.

A map is sampled at texels: texel (column, row) is the square whose centre lies at easting `(column + 0.5)
texel_m` and northing `-(row + 0.5) texel_m` of a UTM zone, so that arrays are north-up. `ProceduralGround`
invents fields, woods, water, settlements and roads; `ImageGround` lays out an ortho-image that the user
gave. Both are deterministic, and the same wherever a patch begins. What the optics blur is for
`BlurredGround`, between the ground and the camera.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer

from simulator.lattice_noise import fractal, smooth_noise, white
from simulator.scenario import GroundSettings

__all__ = ["BlurredGround", "Ground", "GroundImage", "ImageGround", "ProceduralGround", "gaussian_sigma_px"]

Patch = NDArray[np.float32]
Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

TILE = 1024  # texels: a tile of reflectance takes 2 MB, a row of tiles under one CCD's swath some 30 MB
_FIELD, _FOREST, _SETTLEMENT, _WATER = range(4)


class Ground(Protocol):
    """A map of reflectance, 0 to 1."""

    @property
    def texel_m(self) -> float: ...

    def patch(self, column: int, row: int, width: int, height: int) -> Patch:
        """Reflectance of the texels of a window, (height, width)."""


@dataclass(frozen=True, slots=True, eq=False)
class GroundImage:
    """An ortho-image: grey values, affine (a, b, c, d, e, f) of pixel corners as in rasterio, and its CRS."""

    image: NDArray[Any]  # (rows, columns)
    affine: tuple[float, float, float, float, float, float]
    crs: str


def gaussian_sigma_px(mtf_nyquist: float) -> float:
    """Width of the Gaussian whose transfer function has this value at half a cycle a pixel, in pixels."""
    return float(np.sqrt(-2.0 * np.log(mtf_nyquist)) / np.pi)


class BlurredGround:
    """A ground seen through optics, kept in tiles of 16 bits.

    `sigma_texel` is the width of the whole system; what linear interpolation between the texels blurs by
    itself (a variance of 1/6 texel^2 on average) is taken off. The last tiles used are kept.
    """

    def __init__(self, ground: Ground, sigma_texel: float, keep_tiles: int = 48) -> None:
        self.texel_m = ground.texel_m
        self._ground = ground
        self._sigma = float(np.sqrt(max(sigma_texel**2 - 1.0 / 6.0, 0.0)))
        self._keep = keep_tiles
        self._tiles: OrderedDict[tuple[int, int], NDArray[np.uint16]] = OrderedDict()

    def window(self, column: int, row: int, width: int, height: int) -> NDArray[np.uint16]:
        """Blurred reflectance times 65535, (height, width)."""
        out = np.empty((height, width), np.uint16)
        for j in range(row // TILE, (row + height - 1) // TILE + 1):
            for i in range(column // TILE, (column + width - 1) // TILE + 1):
                left, top = max(column, i * TILE), max(row, j * TILE)
                right, bottom = min(column + width, (i + 1) * TILE), min(row + height, (j + 1) * TILE)
                out[top - row : bottom - row, left - column : right - column] = self._tile(i, j)[
                    top - j * TILE : bottom - j * TILE, left - i * TILE : right - i * TILE
                ]
        return out

    def _tile(self, i: int, j: int) -> NDArray[np.uint16]:
        if (i, j) in self._tiles:
            self._tiles.move_to_end((i, j))
            return self._tiles[i, j]
        halo = int(np.ceil(4.0 * self._sigma)) + 1
        sharp = self._ground.patch(i * TILE - halo, j * TILE - halo, TILE + 2 * halo, TILE + 2 * halo)
        if self._sigma > 0.0:
            size = (2 * halo + 1, 2 * halo + 1)
            sharp = np.asarray(cv2.GaussianBlur(sharp, size, self._sigma), dtype=np.float32)
        tile = (sharp[halo:-halo, halo:-halo] * np.float32(65535.0)).astype(np.uint16)
        self._tiles[i, j] = tile
        while len(self._tiles) > self._keep:
            self._tiles.popitem(last=False)
        return tile


class ProceduralGround:
    """An invented landscape. `date` 0 is what the chips show, 1 what the strips show (settings
    `other_date`, `cloud`).
    """

    def __init__(self, settings: GroundSettings, texel_m: float, key: int, date: int) -> None:
        self.texel_m = texel_m
        self._settings = settings
        self._key = key
        self._date = date
        # Shares of the land become thresholds of noise; a sample of parcels gives its distribution.
        i, j = (index.ravel() for index in np.meshgrid(np.arange(100), np.arange(100)))
        self._levels = {
            kind: np.quantile(self._character(i, j, kind), 1.0 - share) for kind, share in self._shares()
        }
        self._cloud_level = self._cloud_threshold()

    def patch(self, column: int, row: int, width: int, height: int) -> Patch:
        base = np.full((height, width), 60, np.uint8)  # reflectance * 255
        rough = np.full((height, width), 40, np.uint8)  # relative strength of the texture * 255
        self._draw_parcels(base, rough, column, row)
        octaves = max(3, int(np.log2(48.0 / self.texel_m)) + 1)
        detail = fractal(column, row, width, height, self._key + 7, octaves, 0.8)
        detail *= rough
        detail *= np.float32(self._settings.detail / 255.0)
        detail += np.float32(1.0)
        detail *= base
        detail *= np.float32(1.0 / 255.0)
        np.clip(detail, 0.01, 0.95, out=detail)
        return self._as_seen(detail, column, row) if self._date else detail

    def _shares(self) -> list[tuple[int, float]]:
        s = self._settings
        return [(_WATER, s.water), (_SETTLEMENT, s.settlement), (_FOREST, s.forest)]

    def _character(self, i: NDArray[np.int64], j: NDArray[np.int64], kind: int) -> Array:
        """How much parcels (i, j) are of a kind: smooth over some parcels, so that each kind gathers."""
        own = np.array([_number(self._key + 31 * kind, int(a), int(b), 0) for a, b in zip(i, j)])
        return smooth_noise(i / 4.3, j / 4.3, self._key + 100 + kind) + 0.35 * (2.0 * own - 1.0)

    def _kind(self, i: int, j: int) -> int:
        for kind, share in self._shares():
            if share > 0.0 and self._character(np.array([i]), np.array([j]), kind)[0] > self._levels[kind]:
                return kind
        return _FIELD

    def _vertex(self, i: int, j: int) -> Array:
        """Corner (i, j) of the parcels, metres (east, north)."""
        jitter = np.array([_number(self._key, i, j, 1), _number(self._key, i, j, 2)])
        return (np.array([i, j]) + 0.6 * (jitter - 0.5)) * self._settings.parcel_m

    def _draw_parcels(self, base: Grey, rough: Grey, column: int, row: int) -> None:
        height, width = base.shape
        side = self._settings.parcel_m / self.texel_m
        i0, i1 = int(np.floor(column / side)) - 1, int(np.floor((column + width) / side)) + 1
        j0, j1 = int(np.floor(-(row + height) / side)) - 1, int(np.floor(-row / side)) + 1
        origin = np.array([column + 0.5, row + 0.5])
        canvas = _Canvas(base, rough, self.texel_m, origin)
        corners = {(i, j): self._vertex(i, j) for i in range(i0, i1 + 2) for j in range(j0, j1 + 2)}
        for j in range(j0, j1 + 1):
            for i in range(i0, i1 + 1):
                quad = np.array([corners[i, j], corners[i + 1, j], corners[i + 1, j + 1], corners[i, j + 1]])
                self._draw_parcel(canvas, i, j, quad)
        for j in range(j0, j1 + 1):  # roads run along the parcels' borders, over all of them
            for i in range(i0, i1 + 1):
                for n, other in enumerate(((i + 1, j), (i, j + 1))):
                    line_index = j if n == 0 else i
                    if _number(self._key, line_index, n, 3) < 0.3:
                        tone = 50 + int(60 * _number(self._key, line_index, n, 4))
                        canvas.line(corners[i, j], corners[other], 5.0 + 4.0 * (line_index % 3), tone, 15)

    def _draw_parcel(self, canvas: _Canvas, i: int, j: int, quad: Array) -> None:
        kind = self._kind(i, j)
        changed = self._date and _number(self._key, i, j, 9) < self._settings.other_date.changed_fields
        rng = np.random.default_rng([self._key, i & 0xFFFFFFFF, j & 0xFFFFFFFF, 1 if changed else 0])
        if kind == _WATER:
            canvas.fill(quad, 12 + int(rng.integers(8)), 12)
        elif kind == _FOREST:
            canvas.fill(quad, int(rng.integers(24, 40)), 120)
            canvas.fill(_shrunk(quad, 0.12), int(rng.integers(20, 34)), 150)
        elif kind == _FIELD:
            self._draw_field(canvas, quad, rng)
        else:
            self._draw_settlement(canvas, quad, rng)
        covered = self._date and _number(self._key, i, j, 10) < self._settings.other_date.occlusion
        if covered:
            canvas.fill(_shrunk(quad, 0.05), int(rng.choice([15, 200])), 30)

    def _draw_field(self, canvas: _Canvas, quad: Array, rng: np.random.Generator) -> None:
        tone = int(rng.integers(28, 110))
        canvas.fill(quad, tone, int(rng.integers(20, 60)))
        spacing = rng.uniform(9.0, 30.0)
        count = int(self._settings.parcel_m / spacing)
        turn = int(rng.integers(4))
        a, b, c, d = np.roll(quad, turn, axis=0)
        stripe = int(np.clip(tone * rng.choice([0.8, 0.9, 1.15]), 5, 250))
        for n in range(1, count):
            canvas.line(a + (b - a) * n / count, d + (c - d) * n / count, 0.18 * spacing, stripe, 40)
        for s, t in rng.uniform(0.1, 0.9, (int(rng.integers(0, 4)), 2)):  # single trees, sheds, ponds
            centre = (a + (b - a) * s) * (1 - t) + (d + (c - d) * s) * t
            canvas.disc(centre, rng.uniform(3.0, 7.0), int(rng.choice([14, 24, 170])))

    def _draw_settlement(self, canvas: _Canvas, quad: Array, rng: np.random.Generator) -> None:
        canvas.fill(quad, int(rng.integers(50, 80)), 50)
        a, b, c, d = quad
        n = max(2, round(self._settings.parcel_m / 32.0))
        for s in (np.arange(n) + 0.5) / n:
            for t in (np.arange(n) + 0.5) / n:
                u, v, keep = rng.uniform(-0.12, 0.12), rng.uniform(-0.12, 0.12), rng.uniform()
                length, depth = rng.uniform(9.0, 20.0), rng.uniform(7.0, 11.0)
                tone = int(np.exp(rng.uniform(np.log(30.0), np.log(210.0))))
                if keep < 0.2:
                    continue
                p, q = s + u / n, t + v / n
                centre = (a + (b - a) * p) * (1 - q) + (d + (c - d) * p) * q
                along = (b - a) / np.linalg.norm(b - a)
                across = np.array([-along[1], along[0]])
                if keep < 0.4:
                    canvas.disc(centre, rng.uniform(3.0, 6.0), 18)
                    continue
                for half, shade in ((-0.25, 1.0), (0.25, 0.72)):  # the two slopes of a roof
                    middle = centre + half * depth * across
                    canvas.box(middle, along * length / 2, across * depth / 4, int(tone * shade))
        canvas.line((a + b) / 2, (c + d) / 2, 6.0, 75, 15)
        canvas.line((a + d) / 2, (b + c) / 2, 6.0, 75, 15)

    def _as_seen(self, reflectance: Patch, column: int, row: int) -> Patch:
        """Light and weather of the strips' date."""
        other, cloud = self._settings.other_date, self._settings.cloud
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
            noise = self._cloud_noise(*np.meshgrid(x, y)).astype(np.float32)
            full = cv2.remap(noise, *_places(width, height, step), interpolation=cv2.INTER_LINEAR)
            cover = np.clip((full - self._cloud_level) / 0.15 + 0.5, 0.0, 1.0)
            reflectance = (reflectance * (1.0 - cover) + cloud.brightness * cover).astype(np.float32)
        return np.clip(reflectance, 0.0, 1.0).astype(np.float32)

    def _cloud_noise(self, x: Array, y: Array) -> Array:
        size = self._settings.cloud.size_km * 1e3
        return sum(
            (smooth_noise(x / size * 2**n, y / size * 2**n, self._key + 300 + n) / 2**n for n in range(4)),
            start=np.zeros_like(x),
        )

    def _cloud_threshold(self) -> float:
        x, y = np.meshgrid(*(np.arange(300) * self._settings.cloud.size_km * 1e3 / 5.3,) * 2)
        return float(np.quantile(self._cloud_noise(x, y), 1.0 - min(self._settings.cloud.cover, 1.0)))


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
        self._pixels_from_map = np.linalg.inv(np.array([[a, b, c], [d, e, f], [0.0, 0.0, 1.0]]))

    def patch(self, column: int, row: int, width: int, height: int) -> Patch:
        step = 64  # a map projection is straight over 64 texels to far below a texel
        columns, rows = np.arange(0, width + step, step), np.arange(0, height + step, step)
        east, north = np.meshgrid((column + columns + 0.5) * self.texel_m, -(row + rows + 0.5) * self.texel_m)
        x, y = self._to_image.transform(east, north)
        m = self._pixels_from_map
        image_x = m[0, 0] * x + m[0, 1] * y + m[0, 2] - 0.5
        image_y = m[1, 0] * x + m[1, 1] * y + m[1, 2] - 0.5
        across, down = (
            g.astype(np.float32) for g in np.meshgrid(np.arange(width) / step, np.arange(height) / step)
        )
        full = []
        for values, size in ((image_x, self._image.shape[1]), (image_y, self._image.shape[0])):
            offset = np.floor(values.min() / (2 * size - 2)) * (2 * size - 2)
            dense = cv2.remap((values - offset).astype(np.float32), across, down, cv2.INTER_LINEAR)
            full.append(_mirrored(np.asarray(dense, dtype=np.float32), size))
        return np.asarray(cv2.remap(self._image, full[0], full[1], cv2.INTER_LINEAR), dtype=np.float32)


class _Canvas:
    """Draws with sub-texel corners on the reflectance and roughness of a window."""

    def __init__(
        self, base: NDArray[np.uint8], rough: NDArray[np.uint8], texel_m: float, origin: Array
    ) -> None:
        self._base, self._rough = base, rough
        self._texel_m, self._origin = texel_m, origin

    def _texels(self, points: Array) -> NDArray[np.int32]:
        """Map coordinates as 1/16 texels of the window, as OpenCV's drawing wants them."""
        flipped = points * np.array([1.0, -1.0]) / self._texel_m - self._origin
        return np.rint(flipped * 16.0).astype(np.int32)

    def fill(self, polygon: Array, tone: int, rough: int) -> None:
        corners = self._texels(polygon)
        cv2.fillPoly(self._base, [corners], (float(tone),), cv2.LINE_AA, 4)
        cv2.fillPoly(self._rough, [corners], (float(rough),), cv2.LINE_8, 4)

    def box(self, centre: Array, half_a: Array, half_b: Array, tone: int) -> None:
        corners = centre + np.array([half_a + half_b, half_a - half_b, -half_a - half_b, half_b - half_a])
        cv2.fillPoly(self._base, [self._texels(corners)], (float(tone),), cv2.LINE_AA, 4)

    def line(self, a: Array, b: Array, width_m: float, tone: int, rough: int) -> None:
        along = b - a
        half = 0.5 * width_m * np.array([-along[1], along[0]]) / np.linalg.norm(along)
        self.fill(np.array([a + half, b + half, b - half, a - half]), tone, rough)

    def disc(self, centre: Array, radius_m: float, tone: int) -> None:
        x, y = (int(v) for v in self._texels(centre))
        cv2.circle(
            self._base, (x, y), max(1, int(16 * radius_m / self._texel_m)), (float(tone),), -1, cv2.LINE_AA, 4
        )


def _number(key: int, i: int, j: int, n: int) -> float:
    """One uniform number in [0, 1) that belongs to lattice point (i, j)."""
    return 0.5 * (1.0 + float(white(i, j, 1, 1, key * 64 + n)[0, 0]))


def _shrunk(quad: Array, by: float) -> Array:
    middle = quad.mean(axis=0)
    return middle + (1.0 - by) * (quad - middle)


def _places(width: int, height: int, step: int) -> tuple[Patch, Patch]:
    """Where the points of a window (height, width) lie on a grid of every `step`-th point."""
    x, y = np.arange(width, dtype=np.float32) / step, np.arange(height, dtype=np.float32) / step
    across, down = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    return across, down


def _mirrored(index: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    period = np.float32(2 * (size - 1))
    folded = np.mod(index, period)
    return np.minimum(folded, period - folded).astype(np.float32)
