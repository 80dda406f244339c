"""Colour filters in front of a sensor (a Bayer mosaic), recognised in the raw image, and made even.

The four pixels of each 2 x 2 cell then see skies of different brightness, all over the image alike. Bright
stars tell the response of the four to starlight: found in the image of cells (means of four pixels), measured
in the raw one. Each of the four, less its own background and divided by its response, then shows the same
stars; what remains of the difference is the noise, and the pixels are weighted by it.

Offsets of a grey sensor's readout make the same pattern in the sky, but not in starlight: a response that
enough stars do not show alike is one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.records.record import Floats
from boresight.star_id.beyond_chance import FEW_STARS, MAD_SIGMA, SELDOM_SIGMA
from boresight.star_id.finding.background import Background, background_image, estimate_backgrounds, median_of
from boresight.star_id.finding.lines import PART_PX, without_lines

__all__ = ["cell_response", "even_image", "has_mosaic", "merged_cells"]

# Tiles along each side of the image in which the levels of the four pixels of a colour cell are compared.
_TILES = 3
# Difference between the four levels, in a pixel's noise, from which they matter (set by hand; 2.4 standard
# errors of a tile).
_DIFFERENT_SIGMA = 0.15
# Side of the window around a star, px; its inner half holds the light, the rest is the sky.
_STAR_PX = 24
# Share of the tiles that must agree on the brightest and on the darkest of the four pixels: by chance a
# quarter does.
_ALIKE = 0.8
# Largest standard error of a response that is divided out: its square is added to the noise of starlight.
# Least response, of the mean: a darker pixel tells nothing of a star, and would be amplified.
_LARGEST_ERROR = 0.1


def has_mosaic(image: NDArray[Any]) -> bool:
    """Whether a raw image (H, W) shows four different levels in the pixels of each 2 x 2 cell."""
    height, width = image.shape
    rows, columns = (
        [k * (size - PART_PX) // (_TILES - 1) // 2 * 2 for k in range(_TILES)] for size in (height, width)
    )
    tiles = np.stack([image[r : r + PART_PX, c : c + PART_PX] for r in rows for c in columns])
    cells = tiles.reshape(len(tiles), PART_PX // 2, 2, PART_PX // 2, 2).transpose(0, 2, 4, 1, 3)
    quarter = PART_PX**2 // 16
    ends = (quarter, PART_PX**2 // 4 - quarter)
    cells = np.sort(cells.reshape(len(tiles), 4, -1).astype(np.float32), axis=2)
    if median_of(cells[:, :, ends[0]]) <= cells[:, :, 0].min():  # cut off: levels follow the noise
        return False
    level = cells[:, :, slice(*ends)].mean(axis=2)  # without stars
    between = np.sort(cells[:, :, ends[1]] - cells[:, :, ends[0]], axis=None)  # the quartiles
    noise = 0.5 * MAD_SIGMA * between[2 * len(tiles)]
    spread = np.sort(np.ptp(level, axis=1))[len(tiles) // 2]
    if spread <= max(_DIFFERENT_SIGMA * noise, 1e-3 * np.sort(level, axis=None)[2 * len(tiles)]):
        return False
    darkest, brightest = np.bincount(level.argmin(axis=1)), np.bincount(level.argmax(axis=1))
    # two of the four pixels are green: either of them may be an extreme
    agree = [np.sort(count)[-2:].sum() / len(tiles) for count in (darkest, brightest)]
    return bool(min(agree) >= _ALIKE and max(darkest.max(), brightest.max()) >= _ALIKE * len(tiles))


def cell_response(image: NDArray[Any], xy_px: Floats) -> Floats:
    """(2, 2) response of a cell's pixels to starlight, of mean one, by the light of unsaturated stars at
    `xy_px` (N, 2) of the raw image (H, W): the median of the stars' own; ones where too few stars show it
    alike, or none of the four differs from one."""
    size = np.array(image.shape[::-1])
    corner = (np.rint(xy_px).astype(np.int64) - _STAR_PX // 2) // 2 * 2
    corner = corner[((corner >= 0) & (corner + _STAR_PX <= size)).all(axis=1)]
    if len(corner) < FEW_STARS:
        return np.ones((2, 2))
    windows = np.stack([image[y : y + _STAR_PX, x : x + _STAR_PX] for x, y in corner]).astype(np.float64)
    half = _STAR_PX // 2
    cells = windows.reshape(-1, half, 2, half, 2).transpose(2, 4, 0, 1, 3)
    inner = slice(half // 4, half - half // 4)
    light = (cells[..., inner, inner] - np.median(cells, axis=(3, 4), keepdims=True)).sum(axis=(3, 4))
    mean = light.mean(axis=(0, 1))
    if np.count_nonzero(mean > 0.0) < FEW_STARS:
        return np.ones((2, 2))
    of_star = light[..., mean > 0.0] / mean[mean > 0.0]  # (2, 2, N)
    response = np.median(of_star, axis=2)
    scatter = MAD_SIGMA * np.median(np.abs(of_star - response[..., None]), axis=2)
    error = scatter * np.sqrt(0.5 * np.pi / of_star.shape[2])  # of a median, for normal errors
    differs = np.abs(response - 1.0) > SELDOM_SIGMA * error
    if not differs.any() or error.max() > _LARGEST_ERROR:
        return np.ones((2, 2))
    return np.asarray((response / response.mean()).clip(_LARGEST_ERROR))


def even_image(
    image: NDArray[Any], response: Floats, saturation_dn: float
) -> tuple[NDArray[np.float32], Background, float]:
    """The raw image (H, W) with the backgrounds of a cell's four pixels subtracted and their `response`
    divided out, what background then remains, and the value from which its pixels are saturated.

    `response` (2, 2) is that to starlight, of mean one. The background holds the pixels' weights."""
    height, width = (size // 2 * 2 for size in image.shape)
    even = np.zeros(image.shape, dtype=np.float32)
    unusable, parts = np.zeros(image.shape, dtype=bool), []
    cuts = [(slice(row, height, 2), slice(column, width, 2)) for row in (0, 1) for column in (0, 1)]
    for cut in cuts:
        part, no_stars = without_lines(np.ascontiguousarray(image[cut]), saturation_dn)
        parts.append(part)
        if no_stars is not None:
            unusable[cut] = no_stars
    skies = estimate_backgrounds(parts)
    for cut, part, sky, of_light in zip(cuts, parts, skies, response.ravel().tolist()):
        even[cut] = (part - background_image(sky.level_dn, part.shape)) / np.float32(of_light)
    level = [sky.level_dn for sky in skies]
    noise2 = [(sky.noise_dn / of_light) ** 2 for sky, of_light in zip(skies, response.ravel())]
    even += background_image(np.mean(level, axis=0), image.shape)
    top = float(saturation_dn / response.min())
    if np.isfinite(saturation_dn):
        even[image >= saturation_dn] = top
    mean2 = np.mean(noise2, axis=0)
    weight = mean2.mean() / np.array([grid.mean() for grid in noise2]).reshape(2, 2)
    sky = Background(np.mean(level, axis=0), np.sqrt(mean2), image.shape[1], image.shape[0], weight)
    return even, sky.without(unusable) if unusable.any() else sky, top


def merged_cells(image: NDArray[Any], saturation_dn: float) -> NDArray[np.float32]:
    """Means (H // 2, W // 2) of 2 x 2 pixels; saturated if one of them is."""
    height, width = (size // 2 * 2 for size in image.shape)
    cells = image[:height, :width].reshape(height // 2, 2, width // 2, 2)
    mean = cells.mean(axis=(1, 3), dtype=np.float32)
    if np.isfinite(saturation_dn):
        mean[cells.max(axis=(1, 3)) >= saturation_dn] = saturation_dn
    return mean
