"""Raw strips: the ground seen through the rigorous model, row by row, blurred, with noise and digits.

Where a pixel looks is computed through the true camera, orbit, attitude and terrain at nodes: every 64
samples (cubics in between) and often enough along the rows that the fastest vibration is followed
(straight lines in between). The ground's texels are read by linear interpolation at those places.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from boresight.geometry.attitude import lagrange_weights
from boresight.geometry.constants import WGS84
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.terrain import ConstantHeight, Surface, TerrainGrid
from boresight.simulator.ground import BlurredGround
from boresight.simulator.scenario import GroundSettings

__all__ = [
    "TrueScene",
    "all_panels",
    "digitised_strip",
    "needed_sample_step",
    "panels_near",
    "read_ground",
    "row_places",
    "scan",
]

Array = NDArray[np.float64]
Grey = NDArray[np.float32]

_PANEL_LINES, _PANEL_SAMPLES = 256, 512  # rendered at once: the ground under a panel stays in the cache
_SAMPLE_STEP = 64  # at most: the camera's distortion is smooth over so many
_TERRAIN_MISS_PX = 0.005  # what the nodes may miss where the slope of the terrain changes from cell to cell
_LINE_STEP_S = 0.28e-3  # 45 nodes in a period of 80 Hz: straight lines miss 0.0025 of its amplitude
_STEPS_OF_REMAP = 32  # OpenCV places its samples on a lattice of 1/32 texel


@dataclass(frozen=True, slots=True, eq=False)
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
        to_map = Transformer.from_crs(4978, self.epsg, always_xy=True)
        east, north, _ = to_map.transform(p_e[:, 0], p_e[:, 1], p_e[:, 2])
        column, row = east / self.ground.texel_m - 0.5, -north / self.ground.texel_m - 0.5
        shape = (len(lines), len(samples))
        return column.reshape(shape), row.reshape(shape)


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
    a, _, _, _, e, f = surface.transform
    cell_m = np.radians(abs(e)) * WGS84.semi_major_m * np.array([1.0, abs(a / e) * np.cos(np.radians(f))])
    bends = [np.nanquantile(np.abs(np.diff(surface.heights_m, 2, axis=n)), 0.999) / cell_m[n] for n in (0, 1)]
    miss_per_sample = max(bends) * max(ends) / 8.0
    return int(
        np.clip(
            _TERRAIN_MISS_PX / max(miss_per_sample, 1e-9), 1, min(_SAMPLE_STEP, model.camera.n_px(0) // 16)
        )
    )


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

    def panel_row(first: int, count: int, chosen: NDArray[np.bool_]) -> Grey:
        return _panel_row(scene, ccd, first, count, len(gain), rng, chosen) * (
            gain * np.float32(settings.dn_full_scale)
        )

    yield from digitised_strip(panel_row, lines, len(gain), settings, rng, rows, wanted)


def digitised_strip(
    seen_dn: Callable[[int, int, NDArray[np.bool_]], Grey],
    lines: int,
    samples: int,
    settings: GroundSettings,
    rng: np.random.Generator,
    rows: int,
    wanted: NDArray[np.bool_],
) -> Iterator[NDArray[Any]]:
    """An image in blocks of `rows` from its signal: noise, digits, and zeros in `panels` not `wanted`.

    `seen_dn(first, count, chosen)` gives the rows `first` ... of the signal, (count, samples), DN.
    """
    waiting: list[NDArray[Any]] = []
    for first, chosen in zip(range(0, lines, _PANEL_LINES), wanted):
        image = np.zeros((min(_PANEL_LINES, lines - first), samples), _grey_type(settings))
        if chosen.any():
            seen = seen_dn(first, len(image), chosen)
            shown = np.repeat(chosen, _PANEL_SAMPLES)[:samples]
            image[:, shown] = _digitised(seen, settings, rng)[:, shown]
        waiting.append(image)
        while (ready := sum(map(len, waiting))) >= rows or (first + _PANEL_LINES >= lines and ready):
            block = np.concatenate(waiting)
            yield block[:rows]
            waiting = [block[rows:]] if len(block) > rows else []


def read_ground(ground: BlurredGround, column: Array, row: Array, rng: np.random.Generator) -> Grey:
    """Reflectance at texel coordinates (H, W), by linear interpolation, float32.

    OpenCV rounds places to 1/32 texel. A random shift of up to half such a step, another for each pixel,
    turns this from a displacement of whole regions into a noise far below the camera's.
    """
    left, top = int(np.floor(column.min())) - 1, int(np.floor(row.min())) - 1
    width, height = int(np.ceil(column.max())) + 2 - left, int(np.ceil(row.max())) + 2 - top
    places = []
    for place, origin in ((column, left), (row, top)):
        shift = rng.random(place.shape, dtype=np.float32)
        shift -= np.float32(0.5)
        shift *= np.float32(1.0 / _STEPS_OF_REMAP)
        shift += (place - origin).astype(np.float32)
        places.append(shift)
    window = ground.window(left, top, width, height)
    seen = cv2.remap(window, places[0], places[1], cv2.INTER_LINEAR)
    return np.asarray(seen, dtype=np.float32) * np.float32(1.0 / 65535.0)


def row_places(
    scene: TrueScene, ccd: int, first: int, lines: int, sample_nodes: Array
) -> tuple[Array, Array]:
    """Columns and rows, (lines, nodes) each, of the ground's texels at which the samples `sample_nodes`
    (nodes,) of `lines` rows from `first` on look.
    """
    step = max(1, int(_LINE_STEP_S / scene.model.rows.row_period_s))
    line_nodes = np.arange(first, first + lines + step, step, dtype=float)
    columns, rows = scene.texels(ccd, sample_nodes, line_nodes)
    down = lagrange_weights(line_nodes, np.arange(first, first + lines, dtype=float), points=2)
    return down @ columns, down @ rows


def _panel_row(
    scene: TrueScene,
    ccd: int,
    first: int,
    lines: int,
    samples: int,
    rng: np.random.Generator,
    chosen: NDArray[np.bool_],
) -> Grey:
    """Reflectance seen by rows `first` ... of one CCD, (lines, samples), in the chosen panels."""
    seen = np.zeros((lines, samples), np.float32)
    nodes = np.append(np.arange(0.0, samples - 1.0, scene.sample_step), samples - 1.0)
    columns, rows = row_places(scene, ccd, first, lines, nodes)
    for left in (_PANEL_SAMPLES * np.flatnonzero(chosen)).tolist():
        right = min(left + _PANEL_SAMPLES, samples)
        across = lagrange_weights(nodes, np.arange(left, right, dtype=float)).T
        near = np.flatnonzero(across.any(axis=1))  # a few of all nodes carry weight in a panel
        few = slice(int(near[0]), int(near[-1]) + 1)
        places = columns[:, few] @ across[few], rows[:, few] @ across[few]
        seen[:, left:right] = read_ground(scene.ground, *places, rng)
    return seen


def _grey_type(settings: GroundSettings) -> Any:
    return np.uint8 if settings.bits <= 8 else np.uint16


def _digitised(image: Grey, settings: GroundSettings, rng: np.random.Generator) -> NDArray[Any]:
    """Grey values of a signal in DN: photon and read noise, rounding, saturation."""
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    noise *= np.sqrt(image * np.float32(1.0 / settings.e_per_dn) + np.float32(settings.read_noise_dn**2))
    image += noise
    np.clip(np.rint(image, out=image), 0, 2**settings.bits - 1, out=image)
    return image.astype(_grey_type(settings))
