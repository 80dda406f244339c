"""Raw images of the star camera: charge of stars, background and particles, then noise and digits.

Works in the image alone: where the stars are is handed over as paths in pixels, one point for each instant
of the exposure. Charges are electrons, grey values DN. Photon noise is taken as Gaussian of the same
variance, which holds for the tens of electrons and more that every pixel of such a camera collects.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from boresight.simulator.normal_numbers import normal_numbers
from boresight.simulator.scenario import SkySettings

__all__ = ["expose", "hot_pixels", "star_charge"]

Array = NDArray[np.float64]
Frame = NDArray[np.float32]

_BAND_ROWS = 32  # that become digits at once: they stay in the cache


def star_charge(v_mag: Array, b_v: Array, exposure_s: float, sky: SkySettings) -> Array:
    """Electrons (N,) that stars leave in the image, from V and B-V (unknown colours, NaN, count as 0.6)."""
    magnitude = v_mag + sky.color_term * np.where(np.isnan(b_v), 0.6, b_v)
    return sky.flux_v0_e_per_s * exposure_s * 10.0 ** (-0.4 * magnitude)


def hot_pixels(width: int, height: int, sky: SkySettings, rng: np.random.Generator) -> NDArray[np.float64]:
    """The camera's own hot pixels, (M, 3): column, row, DN that each adds to every exposure."""
    columns = rng.integers(0, width, sky.hot_pixels)
    rows = rng.integers(0, height, sky.hot_pixels)
    return np.column_stack([columns, rows, rng.uniform(*sky.hot_pixel_dn, sky.hot_pixels)])


def expose(
    paths_px: Array,
    charge_e: Array,
    size: tuple[int, int],
    sky: SkySettings,
    hot: Array,
    rng: np.random.Generator,
) -> NDArray[Any]:
    """One raw image, (height, width), uint8 up to 8 bits and uint16 above.

    Each star stands at `paths_px` (N, K, 2) at K instants that share the exposure evenly, the smear, and
    leaves `charge_e` (N,) electrons; `size` is (width, height), `hot` (M, 3) from `hot_pixels`.
    """
    width, height = size
    charge = np.zeros((height, width), np.float32)
    _add_stars(charge, paths_px, charge_e, sky)
    _add_cosmic_rays(charge, sky, rng)
    if sky.bloom:
        _bloom(charge, _background(width, height, sky, slice(None)), sky)
    image = np.empty((height, width), np.uint8 if sky.bits <= 8 else np.uint16)
    for top in range(0, height, _BAND_ROWS):
        rows = slice(top, top + _BAND_ROWS)
        background = _background(width, height, sky, rows)
        own = hot[(hot[:, 1] >= top) & (hot[:, 1] < top + _BAND_ROWS)] - (0.0, top, 0.0)
        image[rows] = _digitised(charge[rows], background, own, sky, rng)
    return image


def _digitised(
    charge: Frame, background: Frame, hot: Array, sky: SkySettings, rng: np.random.Generator
) -> Frame:
    """Grey values of some rows of an image, whole numbers; overwrites `charge`."""
    shot_e = charge + background * np.float32(sky.e_per_dn) if sky.background_shot_noise else charge
    image = normal_numbers(charge.shape, rng)
    image *= np.sqrt(shot_e * np.float32(sky.e_per_dn**-2) + np.float32(sky.read_noise_dn**2))
    image += background
    charge *= np.float32(1.0 / sky.e_per_dn)
    image += charge
    np.add.at(image, (hot[:, 1].astype(int), hot[:, 0].astype(int)), hot[:, 2])
    return np.clip(np.rint(image, out=image), 0, 2**sky.bits - 1, out=image)


def _background(width: int, height: int, sky: SkySettings, rows: slice) -> Frame:
    """(rows, width), DN: a level, a slope along either side, and a bow that grows with the square of the
    radius.
    """
    x = (np.arange(width) + 0.5) / width - 0.5
    y = (np.arange(height) + 0.5) / height - 0.5
    slope_x, slope_y = sky.background_gradient_dn
    along_x = sky.background_dn + slope_x * x + 2.0 * sky.background_bow_dn * x * x
    along_y = slope_y * y + 2.0 * sky.background_bow_dn * y * y
    return np.maximum(along_y[rows, None].astype(np.float32) + along_x.astype(np.float32), np.float32(0.0))


def _add_stars(charge: Frame, paths_px: Array, charge_e: Array, sky: SkySettings) -> None:
    """Adds each star's Gaussian, integrated over the pixels and averaged over its path."""
    if not len(paths_px):
        return
    height, width = charge.shape
    centre = paths_px.mean(axis=1)
    radius2 = (((centre + 0.5) / (width, height) - 0.5) ** 2).sum(axis=1) * 2.0  # 1 in the corners
    sigma = sky.psf_sigma_px + (sky.psf_sigma_corner_px - sky.psf_sigma_px) * radius2
    reach = np.abs(paths_px - centre[:, None]).max(initial=0.0)
    half = int(np.ceil(6.0 * sigma.max() + reach)) + 1  # beyond 6 sigma less than 2e-9 of the light is lost
    first = np.rint(centre).astype(int) - half
    edges = np.arange(2 * half + 2) - 0.5
    for n in np.flatnonzero(((first + 2 * half >= 0) & (first < (width, height))).all(axis=1)):
        x0, y0 = first[n]
        along_x = np.diff(ndtr((edges + (x0 - paths_px[n, :, :1])) / sigma[n]), axis=1)  # (K, W)
        along_y = np.diff(ndtr((edges + (y0 - paths_px[n, :, 1:])) / sigma[n]), axis=1)
        stamp = along_y.T @ along_x * (charge_e[n] / len(along_x))
        left, top = max(0, -x0), max(0, -y0)
        right, bottom = min(2 * half + 1, width - x0), min(2 * half + 1, height - y0)
        charge[y0 + top : y0 + bottom, x0 + left : x0 + right] += stamp[top:bottom, left:right]


def _add_cosmic_rays(charge: Frame, sky: SkySettings, rng: np.random.Generator) -> None:
    """Straight tracks of 1 to 15 px in any direction; each leaves its electrons evenly along its way."""
    height, width = charge.shape
    for _ in range(rng.poisson(sky.cosmic_rays)):
        start = rng.uniform((0, 0), (width, height))
        angle, length = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(1.0, 15.0)
        left_e = np.exp(rng.uniform(*np.log(sky.cosmic_ray_e)))
        steps = np.linspace(0.0, length, int(4 * length) + 1)
        x = (start[0] + steps * np.cos(angle)).astype(int)
        y = (start[1] + steps * np.sin(angle)).astype(int)
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        np.add.at(charge, (y[inside], x[inside]), left_e / len(steps))


def _bloom(charge: Frame, background: Frame, sky: SkySettings) -> None:
    """Charge above saturation runs up and down its column until pixels with room have taken it."""
    well = (2**sky.bits - 1) * sky.e_per_dn - background * np.float32(sky.e_per_dn)
    for column in np.flatnonzero((charge > well).any(axis=0)):
        c, room = charge[:, column], well[:, column]
        for direction in (slice(None), slice(None, None, -1)):
            carried = 0.0
            line, limit = c[direction], room[direction]
            share = 0.5 if direction == slice(None) else 1.0  # what is left after half went one way
            for row in range(len(line)):
                excess = max(line[row] - limit[row], 0.0) * share
                line[row] -= excess
                taken = min(max(limit[row] - line[row], 0.0), carried)
                line[row] += taken
                carried += excess - taken
