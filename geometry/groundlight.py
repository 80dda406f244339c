"""Where the ground is seen from a moving satellite, and where a line of sight meets it: one physics, both
ways.

Light leaves the ground at t - range / c, when the Earth had not yet turned so far, is bent by the atmosphere,
and reaches the satellite at t, whose velocity in the geocentric inertial frame turns its apparent direction
(aberration, full relativistic formula). Each effect can be switched off to learn its size: for 530 km about
0.7 m, 1.5 m at 25 deg roll, and 13.6 m.

Frame e is that of the instant of emission, in which the ground is at rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boresight.geometry.atmosphere import Atmosphere, standard_atmosphere
from boresight.geometry.constants import SPEED_OF_LIGHT, WGS84
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.geodesy import columns_at_height, geodetic_from_ecef, vertical_at
from boresight.geometry.record import record, scalar

__all__ = [
    "LightEffects",
    "OrbitLike",
    "apparent_directions_e",
    "apparent_ground_directions",
    "boosted",
    "emission_points_e",
    "emission_rays_e",
    "lines_of_sight_e",
]

Array = NDArray[np.float64]


class OrbitLike(Protocol):
    """What is asked of an orbit: geocentric inertial states, m and m/s, at TAI seconds since the epoch."""

    def positions_i(self, t_s: Array) -> Array: ...

    def velocities_i(self, t_s: Array) -> Array: ...


@record
class LightEffects:
    """Which effects on the light from the ground are taken into account, and the atmosphere that bends it."""

    light_time: bool = scalar("Earth rotation between emission and reception", default=True)
    aberration: bool = scalar("by the satellite's geocentric inertial velocity", default=True)
    refraction: bool = scalar("bending of light in the atmosphere", default=True)
    atmosphere: Atmosphere = scalar("refractivity against height", default_factory=standard_atmosphere)


def boosted(u: Array, velocity: Array) -> Array:
    """Aberration: unit vectors towards light sources as seen by an observer moving at `velocity` (m/s).

        u' = [ u / gamma + beta (1 + u.beta / (1 + 1/gamma)) ] / (1 + u.beta)

    (Explanatory Supplement 3rd ed., eq. 7.40, without the Sun's potential). `boosted(u', -velocity)` undoes
    it.

    Parameters are (..., 3), in any one set of axes.
    """
    flat_u, flat_v = np.broadcast_arrays(u, velocity)
    return _boosted(flat_u.reshape(-1, 3).T, flat_v.reshape(-1, 3).T).T.reshape(flat_u.shape)


def apparent_ground_directions(
    p_e: Array, t_s: Array, orbit: OrbitLike, earth: EarthRotation, effects: LightEffects
) -> tuple[Array, Array]:
    """Directions in which a satellite sees points of the ground.

    Parameters
    ----------
    p_e : (N, 3) array
        Ground points, frame e, m.
    t_s : (N,) array
        Instants at which their light is received, TAI seconds since the epoch.

    Returns
    -------
    u_i : (N, 3) array
        Unit vectors, GCRS axes, as seen from the moving satellite.
    range_m : (N,) array
        Geometric distance from satellite at reception to ground point at emission.
    """
    states = _states_e(t_s, orbit, earth)
    u_e, range_m = apparent_directions_e(p_e, states.p_e, states.v_e, earth.omega_e, effects)
    return np.einsum("nij,nj->ni", states.R_ie, u_e), range_m


def apparent_directions_e(
    ground_e: Array, p_e: Array, v_e: Array, omega_e: Array, effects: LightEffects
) -> tuple[Array, Array]:
    """`apparent_ground_directions` for a caller who has everything in the axes of frame e at reception.

    Parameters
    ----------
    ground_e : (N, 3) array
        Ground points.
    p_e, v_e : (N, 3) arrays
        Satellite's position and its velocity **in the inertial frame**, both in axes e: `R_ei v_i`, m, m/s.
    omega_e : (3,) array
        `EarthRotation.omega_e`.

    Returns
    -------
    u_e : (N, 3) array
        Apparent unit vectors, axes e of reception.
    range_m : (N,) array
    """
    satellite, ground = _rows(p_e), _rows(ground_e)
    # Light time: in axes e of reception the ground point was turned back by omega tau at emission.
    seen, range_m = ground, _length(ground - satellite)
    for _ in range(2 if effects.light_time else 0):
        seen = _turned(ground, omega_e, range_m / -SPEED_OF_LIGHT)
        range_m = _length(seen - satellite)
    aim = seen
    if effects.refraction:
        height = geodetic_from_ecef(ground_e, WGS84)[2]
        for _ in range(2):  # contraction 1e-6 an iteration
            down = _unit(aim - satellite)
            up = _rows(vertical_at(aim.T, height, WGS84))
            aim = seen + _refraction(down, up, height, effects.atmosphere)[0]
    u = _unit(aim - satellite)
    return (_boosted(u, _rows(v_e)) if effects.aberration else u).T, range_m


def lines_of_sight_e(
    u_i: Array,
    t_s: Array,
    orbit: OrbitLike,
    earth: EarthRotation,
    effects: LightEffects,
    height_m: ArrayLike = 0.0,
) -> tuple[Array, Array]:
    """Straight rays in frame e that meet the ground where light seen in the directions `u_i` comes from.

    The inverse of `apparent_ground_directions`. The path of light in the turning frame e is slightly curved
    (light time, refraction); the ray is its tangent where it is `height_m` above the ellipsoid, so it is
    exact for ground at that height. At ground d metres higher or lower it is off by 2e-13 d^2 (light time)
    and 1e-8 tan z d^2 (refraction) metres.

    Parameters
    ----------
    u_i : (N, 3) array
        Apparent unit vectors, GCRS axes, as `apparent_ground_directions` returns them.
    t_s : (N,) array
        Instants of reception.
    height_m : number or (N,) array
        Ellipsoidal height at which the ray is exact: the expected height of the ground.

    Returns
    -------
    origin_e, direction_e : (N, 3) arrays
        A point at the satellite's distance (not exactly the satellite), m, and unit direction downwards. NaN
        for a line of sight that misses the Earth.
    """
    states = _states_e(t_s, orbit, earth)
    u_e = np.einsum("nji,nj->ni", states.R_ie, u_i)
    return emission_rays_e(u_e, states.p_e, states.v_e, earth.omega_e, effects, height_m)


def emission_rays_e(
    u_e: Array, p_e: Array, v_e: Array, omega_e: Array, effects: LightEffects, height_m: ArrayLike = 0.0
) -> tuple[Array, Array]:
    """`lines_of_sight_e` for a caller who has everything in the axes of frame e at the instant of reception.

    Parameters
    ----------
    u_e : (N, 3) array
        Apparent unit vectors.
    p_e, v_e : (N, 3) arrays
        Satellite's position and its velocity **in the inertial frame**, both in axes e: `R_ei v_i`, m and
        m/s.
    omega_e : (3,) array
        `EarthRotation.omega_e`.
    """
    if not (effects.light_time or effects.refraction):
        return p_e, (_boosted(_rows(u_e), -_rows(v_e)) if effects.aberration else _rows(u_e)).T
    met, down, distance = _seen_at_height(u_e, p_e, v_e, omega_e, effects, height_m)
    return (met - distance * down).T, down.T


def emission_points_e(
    u_e: Array, p_e: Array, v_e: Array, omega_e: Array, effects: LightEffects, height_m: ArrayLike
) -> Array:
    """Ground points (N, 3), m, frame e of emission, seen in the directions `u_e` at `height_m` above the
    ellipsoid.

    Where the height is known there is no need of a ray: parameters as in `emission_rays_e`. NaN for a line of
    sight that misses the Earth.
    """
    return _seen_at_height(u_e, p_e, v_e, omega_e, effects, height_m)[0].T


def _seen_at_height(
    u_e: Array, p_e: Array, v_e: Array, omega_e: Array, effects: LightEffects, height_m: ArrayLike
) -> tuple[Array, Array, Array]:
    """Points on the path of light at a height, the path's direction there, and the distance; columns."""
    down = _boosted(_rows(u_e), -_rows(v_e)) if effects.aberration else _rows(u_e)
    satellite = _rows(p_e)
    met, up = columns_at_height(satellite, down, height_m, WGS84)
    if effects.refraction:
        shift, bend = _refraction(down, up, height_m, effects.atmosphere)
        met, down = met - shift, down + bend
    distance = _length(met - satellite)
    if effects.light_time:
        # the path in axes e is turned(met + s down, omega (distance + s) / c), of which this is the tangent
        # at s = 0
        tau = distance / SPEED_OF_LIGHT
        down = _turned(down + _cross(omega_e, met) / SPEED_OF_LIGHT, omega_e, tau)
        met = _turned(met, omega_e, tau)
    return met, _unit(down), distance


@dataclass(frozen=True, slots=True, eq=False)
class _StatesE:
    """Satellite and Earth at N instants, in axes e of each."""

    p_e: Array  # (N, 3)
    v_e: Array  # (N, 3) inertial velocity
    R_ie: Array  # (N, 3, 3)


def _states_e(t_s: Array, orbit: OrbitLike, earth: EarthRotation) -> _StatesE:
    """States at instants that may repeat (all pixels of a row share theirs): each is evaluated once."""
    instants, place = np.unique(t_s, return_inverse=True)
    R_ie = earth.matrices_ie(instants)
    p_e, v_e = (np.einsum("nji,nj->ni", R_ie, of(instants)) for of in (orbit.positions_i, orbit.velocities_i))
    return _StatesE(p_e[place], v_e[place], R_ie[place])


# Below, vectors are columns: (3, N), so that components lie together in memory.


def _refraction(down: Array, up: Array, height_m: ArrayLike, atmosphere: Atmosphere) -> tuple[Array, Array]:
    """Shift along the ground (m) of the straight line's foot from the true one, and what to add to its
    direction to bend it.

    `down` is the straight line's direction, `up` the vertical at its foot.
    """
    cos_z = -_dot(down, up)
    away = down + cos_z * up  # horizontal, away from the satellite, of length sin z
    sin_z = np.sqrt(np.maximum(1.0 - cos_z * cos_z, 1e-24))
    displacement, angle = atmosphere.bending(cos_z, height_m)
    # along the curved ground: a step d on the tangent leaves it by d^2 / 2R
    shift = (displacement / sin_z) * away + (displacement**2 / (2.0 * WGS84.semi_major_m)) * up
    # d(down) / d(zenith distance) = cos z away / sin z + sin z up; the ray comes down steeper
    return shift, (-angle * cos_z / sin_z) * away - (angle * sin_z) * up


def _boosted(u: Array, velocity: Array) -> Array:
    beta = velocity / SPEED_OF_LIGHT
    inverse_gamma = np.sqrt(1.0 - _dot(beta, beta))
    along = _dot(u, beta)
    return np.asarray((inverse_gamma * u + (1.0 + along / (1.0 + inverse_gamma)) * beta) / (1.0 + along))


def _turned(vectors: Array, omega: Array, seconds: Array) -> Array:
    """Turned right-handedly about omega by |omega| seconds, for angles below 1e-6 (error 1e-12 m)."""
    first = _cross(omega, vectors)
    return np.asarray(vectors + seconds * first + (0.5 * seconds**2) * _cross(omega, first))


def _rows(vectors: Array) -> Array:
    """(N, 3) to (3, N), contiguous."""
    return np.ascontiguousarray(vectors.T)


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _length(a: Array) -> Array:
    return np.sqrt(_dot(a, a))


def _unit(a: Array) -> Array:
    return np.asarray(a / _length(a))


def _cross(a: Array, b: Array) -> Array:
    """a (3,) times b (3, N)."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
