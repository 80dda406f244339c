"""Apparent directions of ground points from a moving satellite, and the inverse: rays to the ground.

Light is emitted at t - range / c (light time: the Earth rotates until reception), refracted in the
atmosphere, and received at t by the satellite, whose velocity in the geocentric inertial frame changes the
apparent direction (aberration, full relativistic formula). Each effect can be switched off; at 530 km they
amount to 0.7 m (light time), 1.5 m at 25 deg roll (refraction) and 13.6 m (aberration).

Frame e is that of the instant of emission, in which the ground is at rest.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boresight.geometry.atmosphere import Atmosphere, standard_atmosphere
from boresight.geometry.constants import SPEED_OF_LIGHT, WGS84
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.geodesy import columns_at_height, geodetic_from_ecef, verticals
from boresight.geometry.record import record, scalar

__all__ = [
    "LightEffects",
    "OrbitLike",
    "aberrate",
    "apparent_directions_e",
    "apparent_ground_directions",
    "emission_points_e",
    "emission_rays_e",
    "lines_of_sight_e",
]

Array = NDArray[np.float64]


class OrbitLike(Protocol):
    """An orbit: geocentric inertial positions (N, 3), m, and velocities (N, 3), m/s, at TAI seconds (N,)."""

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last instant at which it is known, TAI seconds since the epoch."""

    def states_i(self, t_s: Array) -> tuple[Array, Array]:
        """Positions, m, and velocities, m/s, each (N, 3)."""


@record
class LightEffects:
    """Effects on light from the ground that are modelled, and the atmosphere of the refraction."""

    light_time: bool = scalar("Earth rotation between emission and reception", default=True)
    aberration: bool = scalar("by the satellite's geocentric inertial velocity", default=True)
    refraction: bool = scalar("bending of light in the atmosphere", default=True)
    atmosphere: Atmosphere = scalar("refractivity against height", default_factory=standard_atmosphere)


def aberrate(u: Array, velocity: Array) -> Array:
    """Unit vectors (..., 3) towards light sources for an observer moving at `velocity` (..., 3), m/s.

        u' = [ u / gamma + beta (1 + u.beta / (1 + 1/gamma)) ] / (1 + u.beta)

    (aberration; Explanatory Supplement 3rd ed., eq. 7.40, without the Sun's potential), all in the same axes.
    `aberrate(u', -velocity)` is the inverse.
    """
    flat_u, flat_v = np.broadcast_arrays(u, velocity)
    return _aberrated(flat_u.reshape(-1, 3).T, flat_v.reshape(-1, 3).T).T.reshape(flat_u.shape)


def apparent_ground_directions(
    p_e: Array, t_s: Array, orbit: OrbitLike, earth: EarthRotation, effects: LightEffects
) -> tuple[Array, Array]:
    """Apparent directions (N, 3), unit vectors in GCRS axes, of ground points `p_e` (N, 3), frame e, m, from
    a moving satellite at instants of reception `t_s` (N,), TAI seconds since the epoch; and distances (N,),
    m, from satellite at reception to ground point at emission.

    Raises `OrbitGapError` or `ValueError` if orbit or Earth rotation do not cover `t_s`.
    """
    satellite_e, v_e, R_ie = _states_e(t_s, orbit, earth)
    u_e, range_m = apparent_directions_e(p_e, satellite_e, v_e, earth.omega_e, effects)
    return np.einsum("nij,nj->ni", R_ie, u_e), range_m


def apparent_directions_e(
    ground_e: Array, p_e: Array, v_e: Array, omega_e: Array, effects: LightEffects
) -> tuple[Array, Array]:
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
        height = geodetic_from_ecef(ground_e, WGS84)[2]
        for _ in range(2):  # contraction 1e-6 an iteration
            down = _unit(aim - satellite)
            up = verticals(aim, height, WGS84)
            aim = emitter + _refraction(down, up, height, effects.atmosphere)[0]
    u = _unit(aim - satellite)
    return (_aberrated(u, _rows(v_e)) if effects.aberration else u).T, range_m


def lines_of_sight_e(
    u_i: Array,
    t_s: Array,
    orbit: OrbitLike,
    earth: EarthRotation,
    effects: LightEffects,
    height_m: ArrayLike = 0.0,
) -> tuple[Array, Array]:
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
    u_e: Array, p_e: Array, v_e: Array, omega_e: Array, effects: LightEffects, height_m: ArrayLike = 0.0
) -> tuple[Array, Array]:
    """Rays to the ground as `lines_of_sight_e`, from states in axes e at reception as `apparent_directions_e`
    takes them; `u_e` (N, 3) are apparent unit vectors.
    """
    if not (effects.light_time or effects.refraction):
        return p_e, (_aberrated(_rows(u_e), -_rows(v_e)) if effects.aberration else _rows(u_e)).T
    point, down, distance = _path_at_height(u_e, p_e, v_e, omega_e, effects, height_m)
    return (point - distance * down).T, down.T


def emission_points_e(
    u_e: Array, p_e: Array, v_e: Array, omega_e: Array, effects: LightEffects, height_m: ArrayLike
) -> Array:
    """Ground points (N, 3), frame e of emission, m, at a known height, seen in the directions `u_e`.

    Parameters as in `emission_rays_e`; `height_m` is above the ellipsoid. NaN for a line of sight that does
    not intersect the Earth.
    """
    return _path_at_height(u_e, p_e, v_e, omega_e, effects, height_m)[0].T


def _path_at_height(
    u_e: Array, p_e: Array, v_e: Array, omega_e: Array, effects: LightEffects, height_m: ArrayLike
) -> tuple[Array, Array, Array]:
    """Point, direction and distance of the light paths at a height; vectors are columns (3, N)."""
    down = _aberrated(_rows(u_e), -_rows(v_e)) if effects.aberration else _rows(u_e)
    satellite = _rows(p_e)
    point, up = columns_at_height(satellite, down, height_m, WGS84)
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


def _states_e(t_s: Array, orbit: OrbitLike, earth: EarthRotation) -> tuple[Array, Array, Array]:
    """Positions and inertial velocities (N, 3) in axes e of instants (N,), and R_ie (N, 3, 3); equal instants
    (pixels of one row) are evaluated once.
    """
    instants, index = np.unique(t_s, return_inverse=True)
    R_ie = earth.matrices_ie(instants)
    p_e, v_e = (np.einsum("nji,nj->ni", R_ie, state) for state in orbit.states_i(instants))
    return p_e[index], v_e[index], R_ie[index]


# Below, vectors are columns: (3, N), so that components lie together in memory.


def _refraction(down: Array, up: Array, height_m: ArrayLike, atmosphere: Atmosphere) -> tuple[Array, Array]:
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


def _aberrated(u: Array, velocity: Array) -> Array:
    beta = velocity / SPEED_OF_LIGHT
    inverse_gamma = np.sqrt(1.0 - _dot(beta, beta))
    along = _dot(u, beta)
    return np.asarray((inverse_gamma * u + (1.0 + along / (1.0 + inverse_gamma)) * beta) / (1.0 + along))


def _rotated(vectors: Array, omega: Array, seconds: Array) -> Array:
    """Vectors (3, N) after a right-handed rotation by omega `seconds`, below 1e-6 rad (error 1e-12 m)."""
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
    return np.array([a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))])
