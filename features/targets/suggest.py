"""Suggested targets: positions in an ortho-image whose texture is distinct and unique.

The expected standard error of a match follows from the chip's gradients and the image's noise (Cramér-Rao). A
chip that correlates with another part of the image, such as rows of crops or a grid of streets, is excluded,
however sharp it is. Of the others the best are taken, far enough from one another to cover the image.
"""

from __future__ import annotations

import cv2
import numpy as np
import skimage

from boresight.gct_match.imaging.views import normalised
from boresight.gct_match.records import Image
from boresight.gct_match.search.correlation import correlation_surface
from boresight.gct_match.texture import noise_of, sigma_from_gradients, smooth_gradients
from boresight.records.record import Bools, record, scalar

__all__ = ["SuggestedTarget", "suggest_targets"]

_COARSE_PIXELS = 2.5e5  # size of the picture in which rivals are searched
_RIVAL = 0.7  # chips with a rival of at least this correlation are excluded
_LARGEST_SIGMA_PX = 0.02  # expected standard error of a match from which a position does not qualify
_TRIED = 40  # positions tried for each one wanted, until three times as many qualify


@record(kw_only=True)
class SuggestedTarget:
    """A position for a target with a chip of `size_px`² pixels around it."""

    column: float = scalar("of the chip's middle, (0, 0) at the centre of the image's first pixel")
    row: float = scalar("of the chip's middle")
    x: float = scalar("of the chip's middle, map coordinates")
    y: float = scalar("of the chip's middle, map coordinates")
    sigma_px: float = scalar("expected standard error of a match in the worse direction, px of this image")
    rival: float = scalar("highest correlation of the chip elsewhere in the image, 0 to 1")

    @property
    def score(self) -> float:
        """Larger is better: 1 / sigma_px, reduced by the rival's share of the variance."""
        return (1.0 - self.rival**2) / self.sigma_px


def suggest_targets(
    image: Image,
    transform: tuple[float, float, float, float, float, float],
    valid: Bools,
    *,
    size_px: int,
    most: int,
) -> tuple[SuggestedTarget, ...]:
    """The best positions for targets in an ortho-image (H, W), best first, at most `most`.

    `transform` takes pixel corners to map coordinates, as in `Chip`; `valid` (H, W) is False where the image
    has no data or a cloud; `size_px` is the side of a chip. `ValueError` for an image smaller than two chips.
    """
    if min(image.shape) < 2 * size_px:
        raise ValueError(
            f"the image of {image.shape[1]} x {image.shape[0]} px is smaller than two chips of {size_px} px"
        )
    sigma = _expected_sigma(image.astype(np.float32), valid, size_px)
    positions = _peaks(sigma, size_px // 2, _TRIED * most)
    factor = int(np.clip(np.sqrt(image.size / _COARSE_PIXELS), 1, max(1, size_px // 12)))
    coarse = cv2.resize(
        image.astype(np.float32), None, fx=1.0 / factor, fy=1.0 / factor, interpolation=cv2.INTER_AREA
    )
    seen = normalised(coarse, np.ones(coarse.shape, dtype=bool))
    a, b, c, d, e, f = transform
    found: list[SuggestedTarget] = []
    for column, row in positions:
        rival = _rival(seen, column // factor, row // factor, size_px // (2 * factor))
        if rival < _RIVAL:
            u, v = column + 0.5, row + 0.5
            found.append(
                SuggestedTarget(
                    column=float(column),
                    row=float(row),
                    x=a * u + b * v + c,
                    y=d * u + e * v + f,
                    sigma_px=float(sigma[row, column]),
                    rival=rival,
                )
            )
        if len(found) >= 3 * most:
            break
    found.sort(key=lambda target: -target.score)
    return tuple(_spread(found, most, image.shape))


def _expected_sigma(image: Image, valid: Bools, size_px: int) -> Image:
    """(H, W) expected standard error, px, of a chip around each pixel, in the worse direction; infinite where
    the chip leaves the image or contains invalid pixels.
    """
    gx, gy = smooth_gradients(image)
    inside = np.abs(gx[valid][::25])  # without the empty border of a rotated or cut image
    most = 3.0 * np.float32(np.percentile(inside, 90.0) + 1e-6)  # limits the weight of single bright edges
    gx, gy = np.clip(gx, -most, most), np.clip(gy, -most, most)
    window = (size_px, size_px)
    xx, xy, yy = (
        cv2.boxFilter(product, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
        for product in (gx * gx, gx * gy, gy * gy)
    )
    sigma = sigma_from_gradients(xx, xy, yy, noise_of(image, valid), float(size_px**2))
    bad = cv2.boxFilter((~valid).astype(np.float32), -1, window, borderType=cv2.BORDER_CONSTANT) > 1e-6
    sigma[bad] = np.inf
    half = size_px // 2 + 1
    sigma[:half], sigma[-half:], sigma[:, :half], sigma[:, -half:] = np.inf, np.inf, np.inf, np.inf
    return sigma


def _peaks(sigma: Image, apart: int, most: int) -> list[tuple[int, int]]:
    """(column, row) of the minima of a map (H, W) that are lowest within `apart` px, lowest first."""
    peaks = skimage.feature.peak_local_max(
        1.0 / sigma,
        min_distance=apart,
        threshold_abs=1.0 / _LARGEST_SIGMA_PX,
        exclude_border=False,
        num_peaks=most,
    )
    return [(column, row) for row, column in peaks.tolist()]


def _rival(seen: Image, x: int, y: int, half: int) -> float:
    """Highest correlation, 0 to 1, of the chip around (x, y) with the coarse picture outside the chip."""
    left, top = (min(max(0, at - half), size - 2 * half) for at, size in zip((x, y), seen.shape[::-1]))
    surface = correlation_surface(seen[top : top + 2 * half, left : left + 2 * half], seen)
    surface[max(0, top - half) : top + half + 1, max(0, left - half) : left + half + 1] = 0.0
    return float(np.clip(surface.max(), 0.0, 1.0))


def _spread(found: list[SuggestedTarget], most: int, shape: tuple[int, ...]) -> list[SuggestedTarget]:
    """The best, without those too near a better one; the least distance shrinks until enough remain."""
    distance = 0.7 * float(np.sqrt(shape[0] * shape[1] / max(most, 1)))
    places = np.array([[target.column, target.row] for target in found]).reshape(-1, 2)
    chosen: list[int] = []
    while found and len(chosen) < min(most, len(found)):
        chosen = []
        for n, place in enumerate(places):
            if len(chosen) < most and not (np.hypot(*(places[chosen] - place).T) < distance).any():
                chosen.append(n)
        distance *= 0.7
        if distance < 1.0:
            break
    return [found[n] for n in chosen]
