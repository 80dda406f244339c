"""A crop of an exposure from raw pixels to identified stars: `python scripts/figures/star_path.py`."""

from __future__ import annotations

from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from scipy.ndimage import gaussian_filter
from style import Ink, draw

from boresight.features.sky_images.identify_images import sky_index
from boresight.star_id.field import FieldSolution, solve_field
from boresight.star_id.settings import StarSettings

EXPOSURE = Path(__file__).parents[2] / "fixtures" / "mini" / "exposures" / "e0012.png"
SIDE_PX = 110
ERROR_SCALE = 150.0  # error ellipses are drawn enlarged


def solved(image: np.ndarray) -> FieldSolution:
    """The image identified, its field of view known to be about 18 degrees."""
    settings = StarSettings()
    found = solve_field(image, sky_index(None, 18.0, settings), settings, fov_x_rad=np.radians(18.0))
    assert isinstance(found, FieldSolution), found
    return found


def richest_crop(xy_px: np.ndarray, snr: np.ndarray, shape: tuple[int, int]) -> tuple[int, int]:
    """First column and row of the square with the brightest identified stars whose labels do not overlap."""

    def stars_in(corner: tuple[int, int]) -> float:
        inside = np.all((xy_px >= np.add(corner, 14)) & (xy_px < np.add(corner, SIDE_PX - 14)), axis=1)
        apart = inside.sum() < 2 or np.diff(np.sort(xy_px[inside, 1])).min() > 9.0
        return float(np.log(snr[inside]).sum()) if apart else 0.0

    corners = ((x, y) for x in range(0, shape[1] - SIDE_PX, 20) for y in range(0, shape[0] - SIDE_PX, 20))
    return max(corners, key=stars_in)


def paint(ink: Ink) -> Figure:
    image = cv2.imread(str(EXPOSURE), cv2.IMREAD_UNCHANGED)
    found = solved(image)
    stars = found.stars
    x0, y0 = richest_crop(found.xy_px, stars.snr[found.detections], image.shape)
    crop = image[y0 : y0 + SIDE_PX, x0 : x0 + SIDE_PX].astype(float)
    columns, rows = np.meshgrid(np.arange(x0, x0 + SIDE_PX), np.arange(y0, y0 + SIDE_PX))
    level, noise = stars.background.at(np.column_stack([columns.ravel(), rows.ravel()]).astype(float))
    above = crop - level.reshape(crop.shape)
    sigma = stars.psf.sigma_px
    filtered = gaussian_filter(above, sigma) * 2.0 * np.sqrt(np.pi) * sigma / noise.reshape(crop.shape)

    def inside(xy: np.ndarray) -> np.ndarray:
        return np.all((xy >= (x0 + 2, y0 + 2)) & (xy < (x0 + SIDE_PX - 2, y0 + SIDE_PX - 2)), axis=1)

    figure, panels = plt.subplots(1, 5, figsize=(13.5, 3.1), gridspec_kw={"wspace": 0.06})
    grey = {
        "cmap": "gray",
        "origin": "upper",
        "extent": (x0 - 0.5, x0 + SIDE_PX - 0.5, y0 + SIDE_PX - 0.5, y0 - 0.5),
    }
    typical = float(np.median(noise))
    panels[0].imshow(crop, vmin=level.min() - 4 * typical, vmax=level.max() + 14 * typical, **grey)
    panels[1].imshow(above, vmin=-4 * typical, vmax=14 * typical, **grey)
    panels[2].imshow(filtered, vmin=-3.0, vmax=18.0, **grey)
    seen = stars.xy_px[inside(stars.xy_px)]
    panels[2].plot(*seen.T, "o", mfc="none", mec="#ffb27a", ms=11, mew=1.2)
    for panel in panels[3:]:
        panel.imshow(above, vmin=-4 * typical, vmax=14 * typical, **grey)
    for n in np.flatnonzero(inside(stars.xy_px)):
        values, axes = np.linalg.eigh(stars.cov_px[n])
        angle = np.degrees(np.arctan2(axes[1, 1], axes[0, 1]))
        size = 2.0 * ERROR_SCALE * np.sqrt(values[::-1])
        panels[3].add_patch(Ellipse(stars.xy_px[n], *size, angle=angle, fill=False, ec="#8ab8ff", lw=1.3))
        panels[3].plot(*stars.xy_px[n], "+", color="#ffb27a", ms=7)
    for n in np.flatnonzero(inside(found.xy_px)):
        x, y = found.xy_px[n]
        right = x > x0 + 0.55 * SIDE_PX
        panels[4].plot(x, y, "o", mfc="none", mec="#8ab8ff", ms=10)
        panels[4].text(
            x + (-5 if right else 5),
            y,
            f"HIP {found.hip[n]}",
            color="white",
            fontsize=8.5,
            ha="right" if right else "left",
            va="center",
        )
    titles = (
        "raw pixels",
        "background removed",
        "matched filter, detections",
        f"centroids, errors × {ERROR_SCALE:.0f}",
        "identified",
    )
    for panel, title in zip(panels, titles):
        panel.set_title(title, color=ink.text, fontsize=11)
        panel.set(xlim=grey["extent"][:2], ylim=grey["extent"][2:])
        panel.set_xticks([])
        panel.set_yticks([])
    panels[0].set_ylabel(f"{SIDE_PX} px", color=ink.text)
    return figure


if __name__ == "__main__":
    draw("star_path", paint)
