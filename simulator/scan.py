"""Raw strips: the ground seen through the rigorous model, row by row, blurred, with noise and digits.

Where a pixel looks is computed through the true camera, orbit, attitude and terrain at nodes: every 64
samples, and often enough along the rows that the fastest vibration is followed; cubics in between. The
ground's texels are read by linear interpolation at those places.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from boresight.geometry.attitude import interpolation_weights
from boresight.geometry.constants import WGS84
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.terrain import ConstantHeight, Surface, TerrainGrid
from boresight.records.record import record
from boresight.simulator.ground import BlurredGround
from boresight.simulator.normal_numbers import normal_rows, random_bytes
from boresight.simulator.scenario import GroundSettings

__all__ = [
    "LineNodes",
    "TrueScene",
    "all_panels",
    "digitised_strip",
    "needed_sample_step",
    "panels_near",
    "read_ground",
    "scan",
]

Array = NDArray[np.float64]
Grey = NDArray[np.float32]

_PANEL_LINES, _PANEL_SAMPLES = 256, 512  # rendered at once: the ground under a panel stays in the cache
_SAMPLE_STEP = 64  # at most: the camera's distortion is smooth over so many
_TERRAIN_MISS_PX = 0.005  # what the nodes may miss where the slope of the terrain changes from cell to cell
_LINE_STEP_S = 1.0e-3  # 12 nodes in a period of 80 Hz: cubics miss 0.0015 of its amplitude
_BLOCK_LINES = 2048  # whose nodes are computed at once, a multiple of `_PANEL_LINES`
_WINDOW_RIM = 3  # texels around the nodes: cubics between them reach a little beyond
_STEPS_OF_REMAP = 32  # OpenCV places its samples on a lattice of 1/32 texel


@record
class TrueScene:
    """One strip's true geometry, and the ground below it as the camera's optics show it."""

    model: Pushbroom
    surface: Surface
    epsg: int  # UTM zone in which the ground is mapped
    ground: BlurredGround
    sample_step: int  # between nodes along the detector, from `needed_sample_step`

    def texels(self, ccd: int, samples: Array, lines: Array) -> tuple[Array, Array]:
        """Texel columns, rows (lines, samples) of a grid's pixels; `ValueError` if rays miss terrain."""
        line, sample = (axis.ravel() for axis in np.meshgrid(lines, samples, indexing="ij"))
        p_e = self.model.ground_points(ccd, sample, line, self.surface)
        if not np.all(np.isfinite(p_e)):
            raise ValueError(
                f"CCD {ccd}: {np.isnan(p_e[:, 0]).sum()} of {len(line)} lines of sight miss the terrain"
            )
        east, north, _ = _to_map(self.epsg).transform(p_e[:, 0], p_e[:, 1], p_e[:, 2])
        column, row = east / self.ground.texel_m - 0.5, -north / self.ground.texel_m - 0.5
        shape = (len(lines), len(samples))
        return column.reshape(shape), row.reshape(shape)


@cache
def _to_map(epsg: int) -> Transformer:
    return Transformer.from_crs(4978, epsg, always_xy=True)


def needed_sample_step(model: Pushbroom, surface: TerrainGrid, lines: int) -> int:
    """How far apart nodes along the detector may be.

    Where the terrain's slope changes by k between cells, a line of sight inclined by z is misplaced by up to
    `k tan z / 8` of the distance between nodes.
    """
    ends, first, last = [], 0.0, lines - 1.0
    for ccd in {0, model.camera.n_ccds - 1}:
        end = model.camera.n_px(ccd) - 1.0
        sample, line = np.array([0.0, end, 0.0, end]), np.array([first, first, last, last])
        low, high = (model.ground_points(ccd, sample, line, ConstantHeight(h)) for h in (0.0, 100.0))
        climb = np.linalg.norm(high - low, axis=1) / 100.0  # 1 / cos z
        ends.append(np.sqrt(np.maximum(climb.max() ** 2 - 1.0, 0.0)))
    miss_per_sample = _largest_bend(surface) * max(ends) / 8.0
    return int(
        np.clip(
            _TERRAIN_MISS_PX / max(miss_per_sample, 1e-9), 1, min(_SAMPLE_STEP, model.camera.n_px(0) // 16)
        )
    )


@lru_cache(maxsize=1)  # a mission's strips are of one terrain
def _largest_bend(surface: TerrainGrid) -> float:
    """By how much its slope changes from cell to cell, in one of a thousand places."""
    a, _, _, _, e, f = surface.transform
    cell_m = np.radians(abs(e)) * WGS84.semi_major_m * np.array([1.0, abs(a / e) * np.cos(np.radians(f))])
    bends = [np.nanquantile(np.abs(np.diff(surface.heights_m, 2, axis=n)), 0.999) / cell_m[n] for n in (0, 1)]
    return float(max(bends))


def all_panels(lines: int, samples: int) -> NDArray[np.bool_]:
    """Every panel that a CCD's image is rendered in, (rows of panels, panels in a row)."""
    return np.ones((-(-lines // _PANEL_LINES), -(-samples // _PANEL_SAMPLES)), dtype=bool)


def panels_near(places_px: Array, reach_px: float, lines: int, samples: int) -> NDArray[np.bool_]:
    """True, in the shape of `all_panels`, for panels within `reach_px` of one of the places (N, 2), sample
    and line.
    """
    near = ~all_panels(lines, samples)
    size = np.array([_PANEL_SAMPLES, _PANEL_LINES])
    for place in places_px:
        (left, top), (right, bottom) = ((place + way * reach_px) // size for way in (-1.0, 1.0))
        near[max(int(top), 0) : int(bottom) + 1, max(int(left), 0) : int(right) + 1] = True
    return near


def scan(
    scene: TrueScene,
    ccd: int,
    lines: int,
    settings: GroundSettings,
    gain: Grey,
    rng: np.random.Generator,
    rows: int,
    wanted: NDArray[np.bool_],
) -> Iterator[NDArray[Any]]:
    """One CCD's image in blocks (rows, samples), uint8 up to 8 bits and uint16 above.

    `gain` (samples,) is each pixel's own sensitivity; of `panels` those that are not `wanted` are zeros. The
    image does not depend on `rows`.
    """

    dn = gain * np.float32(settings.dn_full_scale)
    geometry = _StripGeometry(scene, ccd, (lines, len(gain)))

    def seen_dn(first: int, count: int) -> Callable[[slice], Grey]:
        columns_rows = geometry.places(first, count)
        shifts = _shifts((count, _PANEL_SAMPLES), rng)

        def of_panel(panel: slice) -> Grey:
            seen = geometry.seen(columns_rows, panel, shifts)
            seen *= dn[panel]
            return seen

        return of_panel

    yield from digitised_strip(seen_dn, lines, len(gain), settings, rng, rows, wanted)


def digitised_strip(
    seen_dn: Callable[[int, int], Callable[[slice], Grey]],
    lines: int,
    samples: int,
    settings: GroundSettings,
    rng: np.random.Generator,
    rows: int,
    wanted: NDArray[np.bool_],
) -> Iterator[NDArray[Any]]:
    """An image in blocks of `rows` from its signal: noise, digits, and zeros in `panels` not `wanted`.

    `seen_dn(first, count)` gives the signal of rows `first` ... as a function of a panel's samples,
    (count, samples), DN, which may be overwritten.
    """
    waiting: list[NDArray[Any]] = []
    for first, chosen in zip(range(0, lines, _PANEL_LINES), wanted):
        image = np.zeros((min(_PANEL_LINES, lines - first), samples), _grey_type(settings))
        if chosen.any():
            signal = seen_dn(first, len(image))
            for panel in _panels(chosen, samples):
                image[:, panel] = _digitised(signal(panel), settings, rng)
        waiting.append(image)
        while (ready := sum(map(len, waiting))) >= rows or (first + _PANEL_LINES >= lines and ready):
            block = np.concatenate(waiting)
            yield block[:rows]
            waiting = [block[rows:]] if len(block) > rows else []


def read_ground(ground: BlurredGround, column: Array, row: Array, rng: np.random.Generator) -> Grey:
    """Reflectance at texel coordinates (H, W), by linear interpolation, float32."""
    left, top = int(np.floor(column.min())) - 1, int(np.floor(row.min())) - 1
    width, height = int(np.ceil(column.max())) + 2 - left, int(np.ceil(row.max())) + 2 - top
    window = ground.window(left, top, width, height)
    near = [
        (place - origin).astype(np.float32) + shift
        for place, origin, shift in zip((column, row), (left, top), _shifts(column.shape, rng))
    ]
    return np.asarray(cv2.remap(window, near[0], near[1], cv2.INTER_LINEAR), dtype=np.float32)


def _shifts(shape: tuple[int, ...], rng: np.random.Generator) -> Grey:
    """Random shifts along either axis, (2, ...) texel.

    OpenCV rounds places to 1/32 texel. A random shift of up to half such a step, another for each pixel,
    turns this from a displacement of whole regions into a noise far below the camera's.
    """
    numbers = random_bytes(2 * int(np.prod(shape)), rng).reshape(2, *shape).astype(np.float32)
    return (numbers - np.float32(127.5)) * np.float32(1.0 / (256 * _STEPS_OF_REMAP))


@record
class LineNodes:
    """Texels that some samples of some lines of one CCD look at."""

    lines: Array  # (L,)
    columns: Array  # (L, n) texels
    rows: Array  # (L, n)

    @staticmethod
    def over(scene: TrueScene, ccd: int, first: int, lines: int, samples: Array) -> LineNodes:
        """Those needed for `lines` lines from `first` on, at samples (n,)."""
        step = int(np.clip(_LINE_STEP_S / scene.model.rows.row_period_s, 1, scene.sample_step))
        nodes = np.arange(first - step, first + lines + 2 * step, step, dtype=float)
        return LineNodes(nodes, *scene.texels(ccd, samples, nodes))

    def at(self, first: int, lines: int) -> tuple[Array, Array]:
        """Columns and rows, (lines, n) each, for each line from `first` on."""
        down = interpolation_weights(self.lines, np.arange(first, first + lines, dtype=float))
        near = np.flatnonzero(down.any(axis=0))
        few = slice(int(near[0]), int(near[-1]) + 1)
        return down[:, few] @ self.columns[few], down[:, few] @ self.rows[few]


class _StripGeometry:
    """Where the pixels of one CCD look, and what they see there. The nodes of one block of lines are kept."""

    def __init__(self, scene: TrueScene, ccd: int, size: tuple[int, int]) -> None:
        self._scene, self._ccd, self._lines = scene, ccd, size[0]
        self._nodes = np.append(np.arange(0.0, size[1] - 1.0, scene.sample_step), size[1] - 1.0)
        self._across: dict[int, tuple[slice, Grey]] = {}  # by first sample of a panel
        self._block: tuple[int, LineNodes] | None = None

    def places(self, first: int, lines: int) -> tuple[Array, Array]:
        """Columns and rows (lines, nodes) of texels at the nodes of lines of one block."""
        start = first - first % _BLOCK_LINES
        if self._block is None or self._block[0] != start:
            count = min(_BLOCK_LINES, self._lines - start)
            self._block = start, LineNodes.over(self._scene, self._ccd, start, count, self._nodes)
        return self._block[1].at(first, lines)

    def seen(self, columns_rows: tuple[Array, Array], panel: slice, shifts: Grey) -> Grey:
        """Reflectance seen by the samples of a panel, (lines, samples); `shifts` (2, lines, ...) texel."""
        few, weights = self._weights(panel)
        origins, sizes, maps = [], [], []
        for place, shift in zip(columns_rows, shifts):
            origin = int(np.floor(place[:, few].min())) - _WINDOW_RIM
            origins.append(origin)
            sizes.append(int(np.ceil(place[:, few].max())) + _WINDOW_RIM + 1 - origin)
            near = (place[:, few] - origin).astype(np.float32) @ weights
            near += shift[:, : near.shape[1]]
            maps.append(near)
        window = self._scene.ground.window(origins[0], origins[1], sizes[0], sizes[1])
        return np.asarray(cv2.remap(window, maps[0], maps[1], cv2.INTER_LINEAR), dtype=np.float32)

    def _weights(self, panel: slice) -> tuple[slice, Grey]:
        """The few nodes that carry weight in a panel, and their weights (nodes, samples)."""
        if panel.start not in self._across:
            across = interpolation_weights(self._nodes, np.arange(panel.start, panel.stop, dtype=float)).T
            near = np.flatnonzero(across.any(axis=1))
            few = slice(int(near[0]), int(near[-1]) + 1)
            self._across[panel.start] = few, across[few].astype(np.float32)
        return self._across[panel.start]


def _panels(chosen: NDArray[np.bool_], samples: int) -> list[slice]:
    """Samples of each chosen panel of a row of panels."""
    lefts = (_PANEL_SAMPLES * np.flatnonzero(chosen)).tolist()
    return [slice(left, min(left + _PANEL_SAMPLES, samples)) for left in lefts]


def _grey_type(settings: GroundSettings) -> Any:
    return np.uint8 if settings.bits <= 8 else np.uint16


def _digitised(image: Grey, settings: GroundSettings, rng: np.random.Generator) -> NDArray[Any]:
    """Grey values of a signal in DN: photon and read noise, rounding, saturation."""
    noise = np.multiply(image, np.float32(1.0 / settings.e_per_dn))
    noise += np.float32(settings.read_noise_dn**2)
    np.sqrt(noise, out=noise)
    noise *= normal_rows(image.shape[0], image.shape[1], rng)
    noise += image
    return np.clip(np.rint(noise, out=noise), 0, 2**settings.bits - 1, out=noise).astype(_grey_type(settings))
