"""Where in an ortho-image good targets are: texture that fixes a place in both directions, and that is
found only once.

The expected standard error of a chip's place follows from its gradients and the image's noise (Cramér-Rao,
both pictures as noisy as this one). A chip whose like is found again elsewhere, rows of crops or a grid of
streets, is worth little, however sharp. Of what remains the best are taken, far enough from one another to
cover the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from boresight.gct_match.imaging.views import normalised
from boresight.gct_match.records import Image
from boresight.gct_match.search.correlation import correlation_surface
from boresight.gct_match.texture import noise_of, sigma_from_gradients, smooth_gradients
from boresight.geometry.record import Bools

__all__ = ["SuggestedTarget", "suggest_targets"]


_COARSE_PIXELS = 2.5e5  # of the picture in which rivals are looked for
_RIVAL = 0.7  # a rival this high, out of 1, makes a chip worthless
_TRIED = 40  # places looked at for each one wanted, until three times as many are good


@dataclass(frozen=True, slots=True)
class SuggestedTarget:
    """A good place for a chip of `size_px`² pixels, best first."""

    column: float  # of its middle, (0, 0) at the centre of the image's first pixel
    row: float
    x: float  # of its middle, map coordinates
    y: float
    sigma_px: float  # expected standard error of its place, the worse direction, in pixels of this image
    rival: float  # highest correlation of the chip elsewhere in the image, 0 to 1

    @property
    def score(self) -> float:
        """Larger is better: information, less what a rival takes away."""
        return (1.0 - self.rival**2) / self.sigma_px


def suggest_targets(
    image: Image,
    transform: tuple[float, float, float, float, float, float],
    valid: Bools,
    *,
    size_px: int,
    most: int,
    largest_sigma_px: float = 0.02,
) -> tuple[SuggestedTarget, ...]:
    """The best places for chips in an ortho-image (H, W); fewer than `most` if no more are good.

    `transform` is that of the image's pixel corners (as in `Chip`), `valid` (H, W) false where it has no
    data or cloud. `ValueError` if the image is smaller than two chips.
    """
    if min(image.shape) < 2 * size_px:
        raise ValueError(
            f"the image of {image.shape[1]} x {image.shape[0]} px is smaller than two chips of {size_px} px"
        )
    sigma = _expected_sigma(image.astype(np.float32), valid, size_px)
    places = _best_places(sigma, size_px, _TRIED * most, largest_sigma_px)
    factor = int(np.clip(np.sqrt(image.size / _COARSE_PIXELS), 1, max(1, size_px // 12)))
    coarse = cv2.resize(
        image.astype(np.float32), None, fx=1.0 / factor, fy=1.0 / factor, interpolation=cv2.INTER_AREA
    )
    seen = normalised(coarse, np.ones(coarse.shape, dtype=bool))
    a, b, c, d, e, f = transform
    found: list[SuggestedTarget] = []
    for column, row in places:
        rival = _rival(seen, column // factor, row // factor, size_px // (2 * factor))
        if rival < _RIVAL:
            u, v = column + 0.5, row + 0.5
            place = (float(column), float(row), a * u + b * v + c, d * u + e * v + f)
            found.append(SuggestedTarget(*place, float(sigma[row, column]), rival))
        if len(found) >= 3 * most:
            break
    found.sort(key=lambda target: -target.score)
    return tuple(_spread(found, most, image.shape))


def _expected_sigma(image: Image, valid: Bools, size_px: int) -> Image:
    """(H, W) standard error of the place of a chip around each pixel, its worse direction; infinite near
    what is not valid.
    """
    gx, gy = smooth_gradients(image)
    most = 3.0 * np.float32(np.percentile(np.abs(gx[::5, ::5]), 90.0) + 1e-6)  # one bright edge is no texture
    gx, gy = np.clip(gx, -most, most), np.clip(gy, -most, most)
    window = (size_px, size_px)
    xx, xy, yy = (
        cv2.boxFilter(product, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
        for product in (gx * gx, gx * gy, gy * gy)
    )
    sigma = sigma_from_gradients(xx, xy, yy, noise_of(image), float(size_px**2))
    bad = cv2.boxFilter((~valid).astype(np.float32), -1, window, borderType=cv2.BORDER_CONSTANT) > 1e-6
    sigma[bad] = np.inf
    half = size_px // 2 + 1
    sigma[:half], sigma[-half:], sigma[:, :half], sigma[:, -half:] = np.inf, np.inf, np.inf, np.inf
    return sigma


def _best_places(sigma: Image, size_px: int, most: int, largest: float) -> list[tuple[int, int]]:
    """(column, row) of the lowest standard errors that are lowest within half a chip."""
    side = size_px // 2 * 2 + 1
    lowest = cv2.erode(sigma, np.ones((side, side), np.uint8))
    row, column = np.nonzero((sigma <= lowest) & (sigma < largest))
    order = np.argsort(sigma[row, column])[:most]
    return list(zip(column[order].tolist(), row[order].tolist()))


def _rival(seen: Image, x: int, y: int, half: int) -> float:
    """The highest correlation of a chip with the coarse picture, except at the chip's own place."""
    left, top = (
        min(max(0, x - half), seen.shape[1] - 2 * half),
        min(max(0, y - half), seen.shape[0] - 2 * half),
    )
    surface = correlation_surface(seen[top : top + 2 * half, left : left + 2 * half], seen)
    surface[max(0, top - half) : top + half + 1, max(0, left - half) : left + half + 1] = 0.0
    return float(np.clip(surface.max(), 0.0, 1.0))


def _spread(found: list[SuggestedTarget], most: int, shape: tuple[int, ...]) -> list[SuggestedTarget]:
    """The best, leaving out what lies too near a better one; the distance shrinks until enough are there."""
    distance = 0.7 * float(np.sqrt(shape[0] * shape[1] / max(most, 1)))
    chosen: list[SuggestedTarget] = []
    while found and len(chosen) < min(most, len(found)):
        chosen = []
        for target in found:
            near = any(np.hypot(target.column - o.column, target.row - o.row) < distance for o in chosen)
            if not near and len(chosen) < most:
                chosen.append(target)
        distance *= 0.7
        if distance < 1.0:
            break
    return chosen
