"""Apparent directions of ground points from a moving satellite, and the inverse: rays to the ground.

Light is emitted at t - range / c (light time: the Earth rotates until reception), refracted in the
atmosphere, and received at t by the satellite, whose velocity in the geocentric inertial frame changes the
apparent direction (aberration, full relativistic formula). Each effect can be switched off; at 530 km they
amount to 0.7 m (light time), 1.5 m at 25 deg roll (refraction) and 13.6 m (aberration).

Frame e is that of the instant of emission, in which the ground is at rest.

Refraction is that of an atmosphere of spherical layers: along a ray n(r) r sin z is constant (Snell).
Compared with the straight line that it follows in space, the ray meets the ground nearer to the nadir, and
steeper. With z the zenith distance of the straight line at the ground of height h, N = n - 1, and integrals
over height from h upwards

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

from dataclasses import replace
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from boresight.geometry.constants import SPEED_OF_LIGHT, WGS84
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.geodesy import columns_at_height, ecef_from_geodetic, geodetic_from_ecef, verticals
from boresight.records.record import Floats, array, record, scalar

__all__ = [
    "EFFECTS",
    "Atmosphere",
    "LightEffects",
    "OrbitLike",
    "aberrate",
    "apparent_directions_e",
    "apparent_ground_directions",
    "emission_points_e",
    "emission_rays_e",
    "layered_atmosphere",
    "lines_of_sight_e",
    "moves_by_light",
    "refractivity_of_air",
    "standard_atmosphere",
]

EFFECTS = ("light_time", "aberration", "refraction")  # fields of `LightEffects`, keys of `[conventions]`
HIGHER = 1e-2  # of itself, by which a height is moved

_EARTH_RADIUS_M = 6_371_000.0  # mean; the curvature term is a thousandth of the whole
_TOP_M = 84_852.0  # top of the 1976 layers used here
_LOWEST_M = -1_000.0  # lowest height of the table of the air, m: below the Dead Sea's shore
_STEP_M = 20.0  # step of that table, m; the air changes by 1/400 in it
_STEEPEST = np.cos(np.radians(80.0))  # beyond 80 deg the expansion fails


class OrbitLike(Protocol):
    """An orbit: geocentric inertial positions (N, 3), m, and velocities (N, 3), m/s, at TAI seconds (N,)."""

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last instant at which it is known, TAI seconds since the epoch."""

    def states_i(self, t_s: Floats) -> tuple[Floats, Floats]:
        """Positions, m, and velocities, m/s, each (N, 3)."""


@record
class Atmosphere:
    """Refractivity against height and its integrals; built by `standard_atmosphere` or
    `layered_atmosphere`.
    """

    height_m: Floats = array("K", "heights above the ellipsoid, evenly spaced")
    refractivity: Floats = array("K", "n - 1")
    integrals: Floats = array("K, 4", "I0 (m), I1 (m²), I2 (m³), J (m) from each height upwards")

    def bending(self, cos_z: ArrayLike, height_m: ArrayLike) -> tuple[Floats, Floats]:
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

    def _at(self, height: Floats) -> list[Floats]:
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


@record
class LightEffects:
    """Effects on light from the ground that are modelled, and the atmosphere of the refraction."""

    light_time: bool = scalar("Earth rotation between emission and reception", default=True)
    aberration: bool = scalar("by the satellite's geocentric inertial velocity", default=True)
    refraction: bool = scalar("bending of light in the atmosphere", default=True)
    atmosphere: Atmosphere = scalar("refractivity against height", default_factory=standard_atmosphere)


def aberrate(u: Floats, velocity: Floats) -> Floats:
    """Unit vectors (..., 3) towards light sources for an observer moving at `velocity` (..., 3), m/s.

        u' = [ u / gamma + beta (1 + u.beta / (1 + 1/gamma)) ] / (1 + u.beta)

    (aberration; Explanatory Supplement 3rd ed., eq. 7.40, without the Sun's potential), all in the same axes.
    `aberrate(u', -velocity)` is the inverse.
    """
    flat_u, flat_v = np.broadcast_arrays(u, velocity)
    return _aberrated(flat_u.reshape(-1, 3).T, flat_v.reshape(-1, 3).T).T.reshape(flat_u.shape)


def apparent_ground_directions(
    p_e: Floats, t_s: Floats, orbit: OrbitLike, earth: EarthRotation, effects: LightEffects
) -> tuple[Floats, Floats]:
    """Apparent directions (N, 3), unit vectors in GCRS axes, of ground points `p_e` (N, 3), frame e, m, from
    a moving satellite at instants of reception `t_s` (N,), TAI seconds since the epoch; and distances (N,),
    m, from satellite at reception to ground point at emission.

    Raises `OrbitGapError` or `ValueError` if orbit or Earth rotation do not cover `t_s`.
    """
    satellite_e, v_e, R_ie = _states_e(t_s, orbit, earth)
    u_e, range_m = apparent_directions_e(p_e, satellite_e, v_e, earth.omega_e, effects)
    return np.einsum("nij,nj->ni", R_ie, u_e), range_m


def moves_by_light(
    p_e: Floats, t_s: Floats, orbit: OrbitLike, earth: EarthRotation, effects: LightEffects
) -> Floats:
    """Change (N, 3, 4) of apparent directions by each of `EFFECTS` once, modelled or not, and by heights that
    are larger by `HIGHER`; parameters and axes as in `apparent_ground_directions`.
    """
    satellite_e, v_e, R_ie = _states_e(t_s, orbit, earth)

    def seen(at_e: Floats, effects: LightEffects) -> Floats:
        u_e, _ = apparent_directions_e(at_e, satellite_e, v_e, earth.omega_e, effects)
        return np.asarray(np.einsum("nij,nj->ni", R_ie, u_e))

    stated, moves = seen(p_e, effects), list[Floats]()
    for name in EFFECTS:
        is_modelled = getattr(effects, name)
        switched: dict[str, Any] = {name: not is_modelled}
        change = stated - seen(p_e, replace(effects, **switched))
        moves.append(change if is_modelled else -change)
    lat, lon, height_m = geodetic_from_ecef(p_e)
    higher = seen(ecef_from_geodetic(lat, lon, (1.0 + HIGHER) * height_m), effects) - stated
    return np.stack([*moves, higher], axis=2)


def apparent_directions_e(
    ground_e: Floats, p_e: Floats, v_e: Floats, omega_e: Floats, effects: LightEffects
) -> tuple[Floats, Floats]:
    """Apparent unit vectors (N, 3), axes e of reception, and ranges (N,), m, of ground points (N, 3) as
    `apparent_ground_directions`, from states in axes e at reception: `p_e`, m, and `v_e`, m/s, (N, 3), are
    the satellite's position and its velocity **in the inertial frame**, both in axes e, `R_ei v_i`; `omega_e`
    (3,) is `EarthRotation.omega_e`.
    """
    satellite, ground = _rows(p_e), _rows(ground_e)
    # Light time: in axes e of reception the ground point at emission is rotated back by omega tau.
    emitter, range_m = ground, _length(ground - satellite)
    for _ in range(2 if effects.light_time else 0):
        emitter = _rotated(ground, omega_e, range_m / -SPEED_OF_LIGHT)
        range_m = _length(emitter - satellite)
    aim = emitter
    if effects.refraction:
        height = geodetic_from_ecef(ground_e)[2]
        for _ in range(2):  # contraction 1e-6 an iteration
            down = _unit(aim - satellite)
            up = verticals(aim, height)
            aim = emitter + _refraction(down, up, height, effects.atmosphere)[0]
    u = _unit(aim - satellite)
    return (_aberrated(u, _rows(v_e)) if effects.aberration else u).T, range_m


def lines_of_sight_e(
    u_i: Floats,
    t_s: Floats,
    orbit: OrbitLike,
    earth: EarthRotation,
    effects: LightEffects,
    height_m: ArrayLike = 0.0,
) -> tuple[Floats, Floats]:
    """Straight rays in frame e to the ground points seen in the apparent directions `u_i` (N, 3), unit
    vectors in GCRS axes, at instants of reception `t_s` (N,): the inverse of `apparent_ground_directions`.

    In the rotating frame e the path of light is slightly curved (light time, refraction); the ray is its
    tangent at `height_m` above the ellipsoid, a number or (N,), so it is exact for ground at that height, the
    expected one. For ground d metres higher or lower its error is 2e-13 d^2 (light time) plus 1e-8 tan z d^2
    (refraction) metres. Returned are a point (N, 3) at the satellite's distance (not exactly the satellite),
    m, and the unit direction (N, 3) downwards; NaN for a line of sight that does not intersect the Earth.
    """
    satellite_e, v_e, R_ie = _states_e(t_s, orbit, earth)
    u_e = np.einsum("nji,nj->ni", R_ie, u_i)
    return emission_rays_e(u_e, satellite_e, v_e, earth.omega_e, effects, height_m)


def emission_rays_e(
    u_e: Floats, p_e: Floats, v_e: Floats, omega_e: Floats, effects: LightEffects, height_m: ArrayLike = 0.0
) -> tuple[Floats, Floats]:
    """Rays to the ground as `lines_of_sight_e`, from states in axes e at reception as `apparent_directions_e`
    takes them; `u_e` (N, 3) are apparent unit vectors.
    """
    if not (effects.light_time or effects.refraction):
        return p_e, (_aberrated(_rows(u_e), -_rows(v_e)) if effects.aberration else _rows(u_e)).T
    point, down, distance = _path_at_height(u_e, p_e, v_e, omega_e, effects, height_m)
    return (point - distance * down).T, down.T


def emission_points_e(
    u_e: Floats, p_e: Floats, v_e: Floats, omega_e: Floats, effects: LightEffects, height_m: ArrayLike
) -> Floats:
    """Ground points (N, 3), frame e of emission, m, at a known height, seen in the directions `u_e`.

    Parameters as in `emission_rays_e`; `height_m` is above the ellipsoid. NaN for a line of sight that does
    not intersect the Earth.
    """
    return _path_at_height(u_e, p_e, v_e, omega_e, effects, height_m)[0].T


def _path_at_height(
    u_e: Floats, p_e: Floats, v_e: Floats, omega_e: Floats, effects: LightEffects, height_m: ArrayLike
) -> tuple[Floats, Floats, Floats]:
    """Point, direction and distance of the light paths at a height; vectors are columns (3, N)."""
    down = _aberrated(_rows(u_e), -_rows(v_e)) if effects.aberration else _rows(u_e)
    satellite = _rows(p_e)
    point, up = columns_at_height(satellite, down, height_m)
    if effects.refraction:
        shift, bend = _refraction(down, up, height_m, effects.atmosphere)
        point, down = point - shift, down + bend
    distance = _length(point - satellite)
    if effects.light_time:
        # path in axes e: rotated(point + s down, omega (distance + s) / c), here its tangent at s = 0;
        # second-order terms of its direction, 3e-12 rad at 5000 km, are left out
        down = down + _cross(omega_e / SPEED_OF_LIGHT, point + distance * down)
        point = _rotated(point, omega_e, distance / SPEED_OF_LIGHT)
    return point, _unit(down), distance


def _states_e(t_s: Floats, orbit: OrbitLike, earth: EarthRotation) -> tuple[Floats, Floats, Floats]:
    """Positions and inertial velocities (N, 3) in axes e of instants (N,), and R_ie (N, 3, 3); equal instants
    (pixels of one row) are evaluated once.
    """
    instants, index = np.unique(t_s, return_inverse=True)
    R_ie = earth.matrices_ie(instants)
    p_e, v_e = (np.einsum("nji,nj->ni", R_ie, state) for state in orbit.states_i(instants))
    return p_e[index], v_e[index], R_ie[index]


# Below, vectors are columns: (3, N), so that components lie together in memory.


def _refraction(
    down: Floats, up: Floats, height_m: ArrayLike, atmosphere: Atmosphere
) -> tuple[Floats, Floats]:
    """Shift (3, N), m, from the true ground point to the straight line's, and the change (3, N) of direction.

    `down` is the direction of the straight line outside the atmosphere, `up` the vertical where it meets the
    ground. The refracted ray is steeper and meets the ground nearer to the nadir.
    """
    cos_z = -_dot(down, up)
    sin_z = np.sqrt(np.maximum(1.0 - cos_z * cos_z, 1e-24))
    displacement, angle = atmosphere.bending(cos_z, height_m)
    # The horizontal unit vector away from the satellite is the sum of down and cos z up, divided by sin z.
    # Along the curved ground a tangent step d ends d^2 / 2R above it.
    along = displacement / sin_z
    shift = along * down + (along * cos_z + displacement**2 / (2.0 * WGS84.semi_major_m)) * up
    # d(down) / d(zenith distance) = cos z away + sin z up; the refracted ray is steeper
    return shift, (angle / -sin_z) * (cos_z * down + up)


def _aberrated(u: Floats, velocity: Floats) -> Floats:
    beta = velocity / SPEED_OF_LIGHT
    inverse_gamma = np.sqrt(1.0 - _dot(beta, beta))
    along = _dot(u, beta)
    return np.asarray((inverse_gamma * u + (1.0 + along / (1.0 + inverse_gamma)) * beta) / (1.0 + along))


def _rotated(vectors: Floats, omega: Floats, seconds: Floats) -> Floats:
    """Vectors (3, N) after a right-handed rotation by omega `seconds`, below 1e-6 rad (error 1e-12 m)."""
    first = _cross(omega, vectors)
    return np.asarray(vectors + seconds * first + (0.5 * seconds**2) * _cross(omega, first))


def _rows(vectors: Floats) -> Floats:
    """(N, 3) to (3, N), contiguous."""
    return np.ascontiguousarray(vectors.T)


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _length(a: Floats) -> Floats:
    return np.sqrt(_dot(a, a))


def _unit(a: Floats) -> Floats:
    return np.asarray(a / _length(a))


def _cross(a: Floats, b: Floats) -> Floats:
    """a (3,) times b (3, N)."""
    return np.array([a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))])


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


def _with_integrals(height: Floats, refractivity: Floats) -> Atmosphere:
    def upwards(integrand: Floats) -> Floats:
        pieces = 0.5 * _STEP_M * (integrand[1:] + integrand[:-1])
        return np.concatenate([np.cumsum(pieces[::-1])[::-1], [0.0]])

    m0, m1, m2 = (upwards(refractivity * height**k) for k in (0, 1, 2))
    moments = m0, m1 - height * m0, m2 - 2.0 * height * m1 + height**2 * m0
    return Atmosphere(height, refractivity, np.column_stack([*moments, upwards(refractivity**2)]))


def _relative_density_1976(height_m: Floats) -> Floats:
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
    above: Floats, temperature: float, rate: float, g_over_r: float, pressure: Floats | float
) -> tuple[Floats, Floats]:
    """Pressure and density over their sea-level values at a height `above` the layer's base."""
    here = np.maximum(temperature + rate * above, 100.0)  # outside its layer the value is discarded
    ratio = (temperature / here) ** (g_over_r / rate) if rate else np.exp(-g_over_r * above / temperature)
    return pressure * ratio, pressure * ratio * 288.15 / here
