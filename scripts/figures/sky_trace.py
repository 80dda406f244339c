"""docs/images/sky_trace-light.svg and -dark.svg: a star of the fixture's strip, the fitted trace and the
residual; traces of other rates and drifts."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import rasterio
from matplotlib.figure import Figure
from style import Ink, draw

from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.images.tiff import StripFiles
from boresight.star_id.strip_stars.find import StripMotion, StripStars, find_strip_stars
from boresight.star_id.strip_stars.settings import StripStarSettings
from boresight.star_id.strip_stars.trace import Motion, trace_images

FIXTURE = Path(__file__).parents[2] / "fixtures" / "sky"
HALF = 7


@cache  # for both versions
def stars() -> tuple[StripFiles, StripStars]:
    """Images of the strip, and their stars."""
    dump = open_dump(FIXTURE)
    images, count = dump.sky_strips[0].images, dump.line_camera.n_ccds
    motion = StripMotion(np.array([0.0, 2e3]), np.ones((count, 2)), np.zeros((count, 2)), 1)
    return images, find_strip_stars(images, motion, StripStarSettings(), 255.0)


def paint(ink: Ink) -> Figure:
    """Five panels: strip, fit, residual; a mismatched rate, a drift."""
    images, found = stars()
    k = int(np.flatnonzero(~found.saturated & ~found.blended)[1])
    ccd, (x, y) = int(found.ccd[k]), found.xy_px[k]
    column, row = round(float(x)), round(float(y))
    with rasterio.open(images.paths[ccd]) as image:
        window = rasterio.windows.Window(column - HALF, row - HALF, 2 * HALF + 1, 2 * HALF + 1)
        seen = image.read(1, window=window).astype(float)
    level = float(np.median(seen))
    fit = level + found.flux_dn[k] * _trace((x - column, y - row), 1.0, 0.0, 1, found.psf_sigma_px)
    panels = [
        (f"strip, SNR {found.snr[k]:.0f}", seen),
        ("fitted trace", fit),
        ("residual × 5", level + 5.0 * (seen - fit)),
        ("0.8 px a row, 16 stages", level + found.flux_dn[k] * _trace((0.0, 0.0), 0.8, 0.0, 16, 0.55)),
        ("drift 0.3 px a row, 16 stages", level + found.flux_dn[k] * _trace((0.0, 0.0), 1.0, 0.3, 16, 0.55)),
    ]
    figure, axes = plt.subplots(1, 5, figsize=(13.0, 3.1), sharey=True)
    for axis, (title, values) in zip(axes, panels):
        axis.imshow(
            values, cmap="gray", vmin=level - 10.0, vmax=float(seen.max()), extent=(-7.5, 7.5, 7.5, -7.5)
        )
        axis.set_title(title, fontsize=10, color=ink.text)
        axis.set_xlabel("sample, px")
    axes[0].set_ylabel("line, px")
    figure.tight_layout()
    return figure


def _trace(place: tuple[float, float], rate: float, drift: float, stages: int, sigma_px: float) -> np.ndarray:
    motion = Motion(np.array([rate]), np.array([drift]), stages)
    image = trace_images(np.array([place]), motion, sigma_px, HALF).value
    return np.asarray(image.reshape(2 * HALF + 1, 2 * HALF + 1), dtype=float)


if __name__ == "__main__":
    draw("sky_trace", paint)
