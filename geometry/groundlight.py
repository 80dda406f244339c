"""Where the ground is seen from a moving satellite, and where a line of sight meets it: one physics, both
ways.

Light leaves the ground at t - range / c, when the Earth had not yet turned so far, is bent by the atmosphere,
and reaches the satellite at t, whose velocity in the geocentric inertial frame turns its apparent direction
(aberration, full relativistic formula). Each effect can be switched off to learn its size: for 530 km about
0.7 m, 1.5 m at 25 deg roll, and 13.6 m.

Frame e is that of the instant of emission, in which the ground is at rest.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geometry.atmosphere import Atmosphere, standard_atmosphere
from geometry.constants import SPEED_OF_LIGHT, WGS84
from geometry.earth_rotation import EarthRotation
from geometry.geodesy import ellipsoid_normals, geodetic_from_ecef, ray_ellipsoid_intersection

__all__ = [
    "LightEffects",
    "OrbitLike",
    "apparent_ground_directions",
    "boosted",
    "emission_rays_e",
    "lines_of_sight_e",
]

Array = NDArray[np.float64]


class OrbitLike(Protocol):
    """What is asked of an orbit: geocentric inertial states, m and m/s, at TAI seconds since the epoch."""

    def positions_i(self, t_s: Array) -> Array: ...

    def velocities_i(self, t_s: Array) -> Array: ...


@dataclass(frozen=True, slots=True)
class LightEffects:
    """Which effects on the light from the ground are taken into account, and the atmosphere that bends it."""

    light_time: bool = True
    aberration: bool = True
    refraction: bool = True
    atmosphere: Atmosphere = field(default_factory=standard_atmosphere)


def boosted(u: Array, velocity: Array) -> Array:
    """Aberration: unit vectors towards light sources as seen by an observer moving at `velocity` (m/s).

        u' = [ u / gamma + beta (1 + u.beta / (1 + 1/gamma)) ] / (1 + u.beta)

    (Explanatory Supplement 3rd ed., eq. 7.40, without the Sun's potential). `boosted(u', -velocity)` undoes
    it.

    Parameters are (..., 3), in any one set of axes.
    """
    beta = velocity / SPEED_OF_LIGHT
    inverse_gamma = np.sqrt(1.0 - np.einsum("...i,...i->...", beta, beta))[..., None]
    along = np.einsum("...i,...i->...", u, beta)[..., None]
    return np.asarray((inverse_gamma * u + (1.0 + along / (1.0 + inverse_gamma)) * beta) / (1.0 + along))


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
    p_i, v_i, R_ie = orbit.positions_i(t_s), orbit.velocities_i(t_s), earth.matrices_ie(t_s)
    satellite_e = np.einsum("nji,nj->ni", R_ie, p_i)
    # Light time: in axes e of reception the ground point was turned back by omega * tau at emission.
    seen_e, to_ground = p_e, p_e - satellite_e
    for _ in range(2 if effects.light_time else 0):
        tau = np.linalg.norm(to_ground, axis=1) / SPEED_OF_LIGHT
        seen_e = _turned(p_e, earth.omega_e, -tau)
        to_ground = seen_e - satellite_e
    range_m = np.linalg.norm(to_ground, axis=1)
    if effects.refraction:
        height = geodetic_from_ecef(seen_e, WGS84)[2]
        aim = seen_e
        for _ in range(3):  # contraction 1e-5 an iteration
            up, down = ellipsoid_normals(*geodetic_from_ecef(aim, WGS84)[:2]), _unit(aim - satellite_e)
            shift, _ = _refraction(down, up, height, effects.atmosphere)
            aim = seen_e + shift
        to_ground = aim - satellite_e
    u_i = np.einsum("nij,nj->ni", R_ie, _unit(to_ground))
    return (boosted(u_i, v_i) if effects.aberration else u_i), range_m


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
    R_ei = np.swapaxes(earth.matrices_ie(t_s), 1, 2)
    u_e, p_e, v_e = (
        np.einsum("nij,nj->ni", R_ei, vectors)
        for vectors in (u_i, orbit.positions_i(t_s), orbit.velocities_i(t_s))
    )
    return emission_rays_e(u_e, p_e, v_e, earth.omega_e, effects, height_m)


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
    direction = boosted(u_e, -v_e) if effects.aberration else u_e
    if not (effects.light_time or effects.refraction):
        return p_e, direction
    met = ray_ellipsoid_intersection(p_e, direction, height_m, WGS84)
    if effects.refraction:
        up = ellipsoid_normals(*geodetic_from_ecef(met, WGS84)[:2])
        shift, bend = _refraction(direction, up, height_m, effects.atmosphere)
        met, direction = met - shift, _unit(direction + bend)
    distance = np.linalg.norm(met - p_e, axis=1)
    if effects.light_time:
        # The path in axes e is turned(met + s u, omega (distance + s) / c); the ray is its tangent at s = 0.
        tau = distance / SPEED_OF_LIGHT
        direction = _unit(_turned(direction + np.cross(omega_e, met) / SPEED_OF_LIGHT, omega_e, tau))
        met = _turned(met, omega_e, tau)
    distance = distance[:, None]
    return met - distance * direction, direction


def _refraction(down: Array, up: Array, height_m: ArrayLike, atmosphere: Atmosphere) -> tuple[Array, Array]:
    """Horizontal shift (m) of the straight line's foot from the true one, and what to add to its direction to
    bend it.

    `down` (N, 3) is the straight line's direction, `up` (N, 3) the vertical at its foot.
    """
    cos_z = -np.einsum("ni,ni->n", down, up)
    away = down + cos_z[:, None] * up  # horizontal, away from the satellite, of length sin z
    sin_z = np.linalg.norm(away, axis=1)
    outwards = away / np.where(sin_z > 1e-12, sin_z, 1.0)[:, None]
    displacement, angle = atmosphere.bending(cos_z, height_m)
    steeper = -cos_z[:, None] * outwards - sin_z[:, None] * up  # d(down)/d(zenith distance), reversed
    return displacement[:, None] * outwards, np.tan(angle)[:, None] * steeper


def _turned(vectors: Array, omega: Array, seconds: Array) -> Array:
    """Vectors (N, 3) turned right-handedly about omega by |omega| * seconds, for angles below 1e-6 (error
    1e-12 m)."""
    first = np.cross(omega, vectors)
    return np.asarray(
        vectors + seconds[:, None] * first + (0.5 * seconds**2)[:, None] * np.cross(omega, first)
    )


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
