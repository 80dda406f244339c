"""Refraction between the ground and a satellite in an atmosphere of spherical layers.

Along a ray n(r) r sin z is constant (Snell). Compared with the straight line that it follows in space, the
ray meets the ground nearer to the nadir, and steeper. With z the zenith distance of the straight line at the
ground of height h, N = n - 1, and integrals over height from h upwards

    I0 = int N,   I1 = int N (h' - h),   I2 = int N (h' - h)^2,   J = int N^2,

the displacement is, to second order in N and in height over Earth radius R,

    tan z sec^2 z [ I0 - (3 sec^2 z - 1) I1 / R + (15 sec^4 z - 9 sec^2 z) I2 / (2 R^2) - (3 sec^2 z - 1) J /
    2 ]

(the difference of the central angles of the two lines, int a dr / (r sqrt(n^2 r^2 - a^2)) with a = r sin z,
expanded; that integral: Noerdlinger 1999, ISPRS J. 54, 360-373), and sin z_ground = sin z / n(h). Good to
1e-4 of the displacement up to z = 60 deg.

The standard atmosphere is the US Standard Atmosphere 1976 (dry air), with the refractivity of Ciddor (1996,
Appl. Opt. 35, 1566, eq. 1) at 0.6 um. Weather changes the displacement by a few per cent.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boresight.geometry.record import Floats, array, record

__all__ = ["Atmosphere", "layered_atmosphere", "refractivity_of_air", "standard_atmosphere"]

Array = NDArray[np.float64]

_EARTH_RADIUS_M = 6_371_000.0  # mean; the curvature term is a thousandth of the whole
_TOP_M = 84_852.0  # top of the 1976 layers used here
_LOWEST_M = -1_000.0  # lowest height of the table of the air, m: below the Dead Sea's shore
_STEP_M = 20.0  # step of that table, m; the air changes by 1/400 in it
_STEEPEST = np.cos(np.radians(80.0))  # beyond 80 deg the expansion fails


@record
class Atmosphere:
    """Refractivity against height and its integrals; built by `standard_atmosphere` or
    `layered_atmosphere`.
    """

    height_m: Floats = array("K", "heights above the ellipsoid, evenly spaced")
    refractivity: Floats = array("K", "n - 1")
    integrals: Floats = array("K, 4", "I0 (m), I1 (m²), I2 (m³), J (m) from each height upwards")

    def bending(self, cos_z: ArrayLike, height_m: ArrayLike) -> tuple[Array, Array]:
        """Displacement (m, >= 0) and change of zenith distance (rad, >= 0) where the straight line meets the
        ground.

        `cos_z` is the cosine of the straight line's zenith distance at ground of height `height_m`; the two
        are broadcast. Below -1000 m the lowest layer is extended; beyond 80 deg the result is NaN.
        """
        c = np.asarray(cos_z, dtype=float)
        c = np.where(c > _STEEPEST, c, np.nan)
        n, i0, i1, i2, j = self._at(np.asarray(height_m, dtype=float))
        sec2 = 1.0 / (c * c)
        tan2 = np.maximum(sec2 - 1.0, 0.0)
        tan = np.sqrt(tan2)
        first = (i1 / _EARTH_RADIUS_M + 0.5 * j) * (3.0 * sec2 - 1.0)
        second = (i2 / (2.0 * _EARTH_RADIUS_M**2)) * (15.0 * sec2 - 9.0) * sec2
        # z - arcsin(sin z / n): the sine of the difference to second order in N is enough (1e-10 rad)
        return tan * sec2 * (i0 - first + second), n * tan * (1.0 - n - 0.5 * n * tan2)

    def _at(self, height: Array) -> list[Array]:
        """Refractivity and the integrals at heights, linear between the steps."""
        index = np.clip((height - self.height_m[0]) / _STEP_M, 0.0, len(self.height_m) - 1.0)
        below = np.minimum(index.astype(np.int64), len(self.height_m) - 2)
        f = index - below
        columns = (self.refractivity, *np.ascontiguousarray(self.integrals.T))
        return [(1.0 - f) * column.take(below) + f * column.take(below + 1) for column in columns]


def refractivity_of_air(wavelength_um: float) -> float:
    """n - 1 of dry air at 15 C, 101 325 Pa and 450 ppm CO2 (Ciddor 1996, eq. 1); 0.3 to 1.7 um."""
    s2 = wavelength_um**-2.0
    return 1e-8 * (5_792_105.0 / (238.0185 - s2) + 167_917.0 / (57.362 - s2))


@cache
def standard_atmosphere() -> Atmosphere:
    """US Standard Atmosphere 1976 at 0.6 um."""
    height = np.asarray(np.arange(_LOWEST_M, _TOP_M + _STEP_M, _STEP_M))
    return _with_integrals(height, refractivity_of_air(0.6) * _relative_density_1976(height))


def layered_atmosphere(lowest_m: ArrayLike, refractive_index: ArrayLike) -> Atmosphere:
    """Atmosphere of homogeneous layers, each from its lowest height (L,), m, to the next; indices n (L,).

    The last layer has no upper end, so its n must be 1. Raises `ValueError` unless heights increase and both
    lengths agree. Some geolocation software (Rugged) states its atmosphere in this form.
    """
    lowest, index = np.asarray(lowest_m, dtype=float), np.asarray(refractive_index, dtype=float)
    if lowest.ndim != 1 or lowest.shape != index.shape or np.any(np.diff(lowest) <= 0.0):
        raise ValueError("layers need as many refractive indices as heights, in increasing order of height")
    height = np.arange(lowest[0], lowest[-1] + _STEP_M, _STEP_M)
    n, top = index - 1.0, np.append(lowest[1:], max(lowest[-1], height[-1]))
    from_, to = (np.maximum(bound - height[:, None], 0.0) for bound in (lowest, top))
    moments = [((to**k - from_**k) / k) @ n for k in (1, 2, 3)]
    refractivity = n[np.searchsorted(lowest, height, side="right") - 1]
    return Atmosphere(height, refractivity, np.column_stack([*moments, (to - from_) @ n**2]))


def _with_integrals(height: Array, refractivity: Array) -> Atmosphere:
    def upwards(integrand: Array) -> Array:
        pieces = 0.5 * _STEP_M * (integrand[1:] + integrand[:-1])
        return np.concatenate([np.cumsum(pieces[::-1])[::-1], [0.0]])

    m0, m1, m2 = (upwards(refractivity * height**k) for k in (0, 1, 2))
    moments = m0, m1 - height * m0, m2 - 2.0 * height * m1 + height**2 * m0
    return Atmosphere(height, refractivity, np.column_stack([*moments, upwards(refractivity**2)]))


def _relative_density_1976(height_m: Array) -> Array:
    """Density over its sea-level value (US Standard Atmosphere 1976, table 4 and eqs. 18, 23, 33)."""
    base_m = np.array([0.0, 11e3, 20e3, 32e3, 47e3, 51e3, 71e3])  # geopotential
    lapse = np.array([-6.5e-3, 0.0, 1e-3, 2.8e-3, 0.0, -2.8e-3, -2e-3])  # K/m
    g_over_r = 9.80665 * 28.9644e-3 / 8.31432  # K/m
    geopotential = 6_356_766.0 * height_m / (6_356_766.0 + height_m)
    density, temperature, pressure = np.zeros_like(height_m), 288.15, np.array(1.0)
    for k, (base, rate) in enumerate(zip(base_m, lapse)):
        top = base_m[k + 1] if k + 1 < len(base_m) else 84_852.0
        inside = (geopotential >= base if k else True) & (geopotential < top)
        density = np.where(
            inside, _layer(geopotential - base, temperature, rate, g_over_r, pressure)[1], density
        )
        pressure, _ = _layer(np.array(top - base), temperature, rate, g_over_r, pressure)
        temperature += rate * (top - base)
    return density


def _layer(
    above: Array, temperature: float, rate: float, g_over_r: float, pressure: Array | float
) -> tuple[Array, Array]:
    """Pressure and density over their sea-level values at a height `above` the layer's base."""
    here = np.maximum(temperature + rate * above, 100.0)  # outside its layer the value is discarded
    ratio = (temperature / here) ** (g_over_r / rate) if rate else np.exp(-g_over_r * above / temperature)
    return pressure * ratio, pressure * ratio * 288.15 / here
