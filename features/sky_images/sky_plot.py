"""The picture of `StarSolution.plot`: what `boresight identify --overlay` draws, with lines of right
ascension and declination, arrows to north and east and a bar of scale.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from boresight.records.record import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_sky"]

STEPS_DEG = np.outer(10.0 ** np.arange(-3.0, 2.0), [1.0, 2.0, 5.0]).ravel()  # between lines, and of the bar
LINES, MESH = 5, 40  # lines of each kind across the field; nodes along each side
INK = "#7fb2e6"


def draw_sky(
    ax: Axes, picture: NDArray[Any], size_px: tuple[int, int], sky_of: Callable[[Floats], Floats]
) -> Axes:
    """Draw an image's `picture` over its pixels; `sky_of` gives (N, 2) right ascension and declination, deg,
    of (N, 2) pixels.
    """
    width, height = size_px
    ax.imshow(picture, extent=(-0.5, width - 0.5, height - 0.5, -0.5), interpolation="antialiased")
    x, y = np.meshgrid(np.linspace(0.0, width - 1.0, MESH), np.linspace(0.0, height - 1.0, MESH))
    middle = np.array([[0.5 * (width - 1.0), 0.5 * (height - 1.0)]])
    ra0, dec0 = sky_of(middle)[0].tolist()
    ra, dec = sky_of(np.column_stack([x.ravel(), y.ravel()])).T.reshape(2, MESH, MESH)
    ra = ra0 + (ra - ra0 + 180.0) % 360.0 - 180.0  # no step within the field
    words = (lambda value: f"{value % 360.0:g}°"), (lambda value: f"{value:+g}°")
    for values, fmt in zip((ra, dec), words):
        span = float(np.nanmax(values) - np.nanmin(values))
        step = float(STEPS_DEG[np.argmin(np.abs(np.log(STEPS_DEG * LINES / span)))])
        levels = step * np.arange(np.ceil(np.nanmin(values) / step), np.nanmax(values) / step)
        lines = ax.contour(x, y, values, levels=levels, colors=INK, linewidths=0.6, linestyles="-", alpha=0.8)
        ax.clabel(lines, fontsize=7, fmt=fmt)
    east_north, arcsec_px = _axes_at(sky_of, middle)
    length = 0.12 * min(size_px)
    foot = np.array([0.9 * width, 0.85 * height])
    for name, towards in zip("EN", east_north):
        (x1, y1), (x2, y2) = (foot + length * towards).tolist(), (foot + 1.25 * length * towards).tolist()
        ax.annotate("", (x1, y1), (foot[0], foot[1]), arrowprops={"arrowstyle": "->", "color": INK})
        ax.text(x2, y2, name, color=INK, ha="center", va="center", clip_on=True)
    bar_deg = float(STEPS_DEG[STEPS_DEG * 3600.0 / arcsec_px < 0.25 * width][-1])
    at = 0.04 * width + np.array([0.0, bar_deg * 3600.0 / arcsec_px])
    ax.plot(at, np.full(2, 0.92 * height), color=INK, linewidth=2.0, solid_capstyle="butt")
    ax.text(at[0], 0.91 * height, f"{bar_deg:g}°", color=INK, va="bottom", clip_on=True)
    ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="column, px", ylabel="row, px")
    ax.set_title(f"RA {ra0:.3f}°, Dec {dec0:+.3f}°")
    return ax


def _axes_at(sky_of: Callable[[Floats], Floats], middle: Floats) -> tuple[Floats, float]:
    """Unit vectors of pixels towards east and north (rows) at a pixel (1, 2), and a pixel's size, arcsec."""
    (ra0, dec0), *beside = sky_of(middle + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])).tolist()
    off = [((ra - ra0 + 180.0) % 360.0 - 180.0, dec - dec0) for ra, dec in beside]
    east_north = 3600.0 * np.array(off).T * [[np.cos(np.radians(dec0))], [1.0]]  # by column and row
    towards = np.linalg.inv(east_north).T
    return towards / np.linalg.norm(towards, axis=1)[:, None], float(np.sqrt(abs(np.linalg.det(east_north))))
