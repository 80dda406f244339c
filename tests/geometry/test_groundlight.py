"""Where the ground is seen: against ERFA's aberration, a root finder's light time, a ray traced through
shells.
"""

from itertools import pairwise

import erfa
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq

from boresight.geometry.constants import GM_EARTH, SPEED_OF_LIGHT, WGS84
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.geodesy import (
    ecef_from_geodetic,
    geodetic_from_ecef,
    local_axes_e,
    ray_ellipsoid_intersection,
)
from boresight.geometry.groundlight import (
    Atmosphere,
    LightEffects,
    aberrate,
    apparent_directions_e,
    apparent_ground_directions,
    emission_points_e,
    emission_rays_e,
    layered_atmosphere,
    lines_of_sight_e,
    refractivity_of_air,
    standard_atmosphere,
)

EARTH = EarthRotation.over(Epoch.from_utc("2024-04-09T05:00:00"), -1.0, 6000.0, bundled_earth_orientation())
NOTHING = LightEffects(light_time=False, aberration=False, refraction=False)


class CircularOrbit:
    """530 km up, 97.5 deg to the equator."""

    radius, tilt = 6_908_137.0, np.radians(97.5)

    def _circle(self, t_s, ahead):
        angle = np.sqrt(GM_EARTH / self.radius**3) * np.asarray(t_s)[:, None] + ahead
        along = np.array([0.0, np.cos(self.tilt), np.sin(self.tilt)])
        return np.cos(angle) * np.array([1.0, 0.0, 0.0]) + np.sin(angle) * along

    def positions_i(self, t_s):
        return self.radius * self._circle(t_s, 0.0)

    def velocities_i(self, t_s):
        return np.sqrt(GM_EARTH / self.radius) * self._circle(t_s, 0.5 * np.pi)

    def states_i(self, t_s):
        return self.positions_i(t_s), self.velocities_i(t_s)


ORBIT = CircularOrbit()


def ground_below(t_s, off_nadir_rad, azimuth_rad, height_m):
    """Ground points that the satellite sees at about these angles, without any effect on the light."""
    p_e = np.einsum("nji,nj->ni", EARTH.matrices_ie(t_s), ORBIT.positions_i(t_s))
    axes = local_axes_e(*geodetic_from_ecef(p_e, WGS84)[:2])
    sine, cosine = np.sin(off_nadir_rad), np.cos(off_nadir_rad)
    local = np.stack([sine * np.sin(azimuth_rad), sine * np.cos(azimuth_rad), -cosine], axis=-1)
    return ray_ellipsoid_intersection(p_e, np.einsum("nij,nj->ni", axes, local), height_m, WGS84)


def scattered_ground(n=3000, seed=7, steepest_deg=45.0):
    rng = np.random.default_rng(seed)
    t_s = rng.uniform(0.0, 5900.0, n)
    off_nadir, azimuth = np.radians(rng.uniform(0.0, steepest_deg, n)), rng.uniform(0.0, 2 * np.pi, n)
    return t_s, ground_below(t_s, off_nadir, azimuth, rng.uniform(-400.0, 8000.0, n))


def displacement(ground, t_s, seen, taken):
    """Shift on the ground (m) when light that obeys `seen` is taken to obey `taken`."""
    height = geodetic_from_ecef(ground, WGS84)[2]
    u_i, _ = apparent_ground_directions(ground, t_s, ORBIT, EARTH, seen)
    rays = lines_of_sight_e(u_i, t_s, ORBIT, EARTH, taken, height)
    return np.linalg.norm(ray_ellipsoid_intersection(*rays, height, WGS84) - ground, axis=1)


@pytest.mark.parametrize("light_time", [True, False])
@pytest.mark.parametrize("aberration", [True, False])
@pytest.mark.parametrize("refraction", [True, False])
def test_lines_of_sight_are_the_inverse_of_apparent_directions(light_time, aberration, refraction):
    # 1e-6 m on the ground; anywhere on the orbit, up to 45 deg off nadir, from the Dead Sea to the highest
    # summits.
    effects = LightEffects(light_time, aberration, refraction)
    t_s, ground = scattered_ground()
    assert displacement(ground, t_s, effects, effects).max() < 1e-6


def test_rays_made_for_another_height_are_off_by_what_is_said():
    # Docstring: 2e-13 d^2 (light time) + 1e-8 tan z d^2 (refraction) metres at d metres from the height they
    # are made for; 1.7e-8 is the worst of the second factor at sea level.
    t_s, ground = scattered_ground(steepest_deg=30.0)
    height = geodetic_from_ecef(ground, WGS84)[2]
    u_i, _ = apparent_ground_directions(ground, t_s, ORBIT, EARTH, LightEffects())
    for d in (-300.0, 300.0):
        rays = lines_of_sight_e(u_i, t_s, ORBIT, EARTH, LightEffects(), height + d)
        error = np.linalg.norm(ray_ellipsoid_intersection(*rays, height, WGS84) - ground, axis=1)
        up = local_axes_e(*geodetic_from_ecef(ground, WGS84)[:2])[:, :, 2]
        tan_z = np.tan(np.arccos(-np.einsum("ni,ni->n", rays[1], up)))
        assert np.all(error < (2.5e-13 + 2.5e-8 * tan_z / np.cos(np.arctan(tan_z)) ** 2) * d**2 + 1e-8)


def test_aberration_agrees_with_erfa():
    # erfa.ab adds the Sun's potential (0.4 mas at 1 au); put the Sun far away and only the aberration is
    # left.
    rng = np.random.default_rng(8)
    u = rng.normal(size=(500, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = rng.normal(size=(500, 3)) * 20e3
    beta = v / SPEED_OF_LIGHT
    bm1 = np.sqrt(1.0 - np.sum(beta**2, axis=1))
    np.testing.assert_allclose(aberrate(u, v), erfa.ab(u, beta, 1e12, bm1), rtol=0, atol=1e-15)
    np.testing.assert_allclose(aberrate(aberrate(u, v), -v), u, rtol=0, atol=1e-15)


def test_light_time_agrees_with_a_root_finder_on_true_matrices():
    # |R_ie(t - tau) p_e - s(t)| = c tau, solved for tau at each point with the matrix of the instant of
    # emission.
    t_s, ground = scattered_ground(60, seed=9)
    u_i, range_m = apparent_ground_directions(ground, t_s, ORBIT, EARTH, LightEffects(True, False, False))
    satellite = ORBIT.positions_i(t_s)
    for k in range(len(t_s)):

        def late(tau, k=k):
            emitted = EARTH.matrices_ie([t_s[k] - tau])[0] @ ground[k]
            return np.linalg.norm(emitted - satellite[k]) - SPEED_OF_LIGHT * tau

        tau = brentq(late, 1e-4, 1e-2, xtol=1e-16)
        emitted = EARTH.matrices_ie([t_s[k] - tau])[0] @ ground[k]
        # 1.5e-7 m: precession-nutation during the light time (8e-12 rad/s, 2 ms) is left out
        assert abs(range_m[k] - SPEED_OF_LIGHT * tau) < 1.5e-7
        true = (emitted - satellite[k]) / np.linalg.norm(emitted - satellite[k])
        assert np.linalg.norm(u_i[k] - true) * range_m[k] < 1.5e-7


def test_each_effect_has_its_known_size():
    # At 530 km: aberration range * v/c = 13.4 m at nadir; light time: the Earth turns 465 m/s * cos(lat) *
    # 1.8 ms.
    t_s = np.linspace(0.0, 5900.0, 200)
    nadir = ground_below(t_s, np.zeros(200), np.zeros(200), 0.0)
    all_on = LightEffects()
    aberration = displacement(nadir, t_s, all_on, LightEffects(aberration=False))
    height = np.linalg.norm(ORBIT.positions_i(t_s), axis=1) - np.linalg.norm(nadir, axis=1)
    speed = np.sqrt(GM_EARTH / ORBIT.radius)
    np.testing.assert_allclose(aberration, height * speed / SPEED_OF_LIGHT, rtol=2e-3)
    assert 13.3 < aberration.min() < aberration.max() < 14.1
    lat = geodetic_from_ecef(nadir, WGS84)[0]
    light_time = displacement(nadir, t_s, all_on, LightEffects(light_time=False))
    turned = np.linalg.norm(EARTH.omega_e) * np.linalg.norm(nadir[:, :2], axis=1) * height / SPEED_OF_LIGHT
    np.testing.assert_allclose(light_time, turned, rtol=5e-3, atol=1e-4)
    assert 0.8 < light_time[np.abs(lat) < 0.1].min()
    rolled = ground_below(t_s, np.full(200, np.radians(25.0)), np.full(200, 1.5), 0.0)
    refraction = displacement(rolled, t_s, all_on, LightEffects(refraction=False))
    assert 1.4 < refraction.min() < refraction.max() < 1.7
    assert displacement(nadir, t_s, all_on, LightEffects(refraction=False)).max() < 0.04


def displacement_by_quadrature(atmosphere, zenith_rad, height_m):
    """The displacement by the central angles of the refracted ray and of the straight one, both integrated
    exactly.

    Spheres about the Earth's centre, n(r) r sin z constant along the ray, the same in space for both.
    """
    radius = 6_371_000.0

    def refractivity(h):
        return np.interp(h, atmosphere.height_m, atmosphere.refractivity)

    impact = (radius + height_m) * np.sin(zenith_rad)

    def difference(h):
        # central angle per metre of height: a / (r sqrt(n^2 r^2 - a^2)), straight minus refracted
        r = radius + h
        n = 1.0 + refractivity(h)
        straight, curved = np.sqrt(r * r - impact**2), np.sqrt(n * n * r * r - impact**2)
        both = straight * curved * (straight + curved)
        return impact / r * (curved * curved - straight * straight) / both

    edges = np.concatenate([[height_m], np.arange(500.0 * np.ceil(height_m / 500.0 + 0.01), 80_001.0, 500.0)])
    pieces = [quad(difference, a, b, epsabs=1e-14, limit=200)[0] for a, b in pairwise(edges)]
    return (radius + height_m) * sum(pieces)


@pytest.mark.parametrize("zenith_deg", [0.5, 10.0, 27.0, 45.0, 60.0])
@pytest.mark.parametrize("height_m", [0.0, 2500.0])
def test_refraction_agrees_with_a_ray_through_shells(zenith_deg, height_m):
    # 1e-4 of the displacement is promised up to 60 deg.
    zenith = np.radians(zenith_deg)
    got, _ = standard_atmosphere().bending(np.cos(zenith), height_m)
    assert got == pytest.approx(
        displacement_by_quadrature(standard_atmosphere(), zenith, height_m), rel=1e-4, abs=1e-6
    )


@pytest.mark.parametrize("zenith_deg", [10.0, 25.0, 45.0, 60.0])
def test_rays_are_refracted_towards_the_nadir_as_erfa_refracts_starlight(zenith_deg):
    """By reversibility a ray that reaches space at the true zenith distance z + R leaves the ground at z,
    with ERFA's R of an observer there. As n r sin z is constant, the straight line meets the ground at
    sin z' = n sin z, farther from the nadir by the central angle z' - (z + R).
    """
    A, B = erfa.refco(1013.25, 15.0, 0.0, 0.6)
    z = np.radians(zenith_deg)
    R = A * np.tan(z) + B * np.tan(z) ** 3
    up, away = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])  # on the equator, eastwards
    u = -np.cos(z + R) * up + np.sin(z + R) * away
    foot = WGS84.semi_major_m * up
    origin, still, none = (foot - 8e5 * u)[None], np.zeros((1, 3)), np.zeros(3)
    effects = LightEffects(light_time=False, aberration=False, refraction=True)
    _, direction = emission_rays_e(u[None], origin, still, none, effects, 0.0)
    bend = np.arctan2(direction[0] @ away, -direction[0] @ up) - (z + R)
    assert bend == pytest.approx(-R, rel=0.01)  # ERFA's own accuracy, and the vertical 1e-6 rad farther on
    seen_from = emission_points_e(u[None], origin, still, none, effects, 0.0)[0]
    shift = (foot - seen_from) @ away
    n = 2.0 - np.sqrt(1.0 - 2.0 * (A - B))  # ERFA's: A = g (1 - b), B = -g (b - g / 2), g = n - 1
    expected = WGS84.semi_major_m * (np.arcsin(n * np.sin(z)) - (z + R))
    assert shift == pytest.approx(expected, rel=0.05)  # ERFA's scale height (b): 8.2 km for 8.4 km here


def test_refraction_bends_by_snell():
    zenith = np.radians(np.array([1.0, 30.0, 60.0]))
    _, angle = standard_atmosphere().bending(np.cos(zenith), 0.0)
    n = 1.0 + refractivity_of_air(0.6)
    np.testing.assert_allclose(np.sin(zenith - angle), np.sin(zenith) / n, rtol=0, atol=1e-9)


def test_refractivity_and_zenith_path_are_the_known_ones():
    # Ciddor 1996, table 1: 633.0 nm, dry air at 20 C and 100 kPa, n - 1 = 26824.4e-8; brought to 15 C and 101
    # 325 Pa by density (compressibility left out: 1e-4).
    at_20 = refractivity_of_air(0.633) * 100_000.0 / 101_325.0 * 288.15 / 293.15
    assert at_20 == pytest.approx(26824.4e-8, rel=1.5e-4)
    # Pressure is the weight of the air: the integral of N is N0 p0 / (g rho0) with mean g over the column
    # (9.7 m/s^2 at 8 km)
    i0 = standard_atmosphere().integrals[50, 0]
    assert i0 == pytest.approx(refractivity_of_air(0.6) * 101_325.0 / 1.225 / 9.784, rel=2e-3)


def test_layers_are_taken_as_they_are():
    # Two layers, plane-parallel in the limit of a small angle: tan z sec^2 z sum(N dh).
    air = layered_atmosphere([0.0, 1000.0, 5000.0], [1.0003, 1.0001, 1.0])
    got, _ = air.bending(np.cos(np.radians(20.0)), 0.0)
    plane = np.tan(np.radians(20.0)) / np.cos(np.radians(20.0)) ** 2 * (3e-4 * 1000 + 1e-4 * 4000)
    assert got == pytest.approx(plane, rel=1e-3)  # curvature: 7e-4
    assert isinstance(air, Atmosphere)
    with pytest.raises(ValueError, match="increasing order"):
        layered_atmosphere([0.0, 0.0], [1.1, 1.0])


def test_grazing_light_is_not_given_a_number():
    assert np.isnan(standard_atmosphere().bending(np.cos(np.radians(81.0)), 0.0)[0])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_axes_do_not_matter_to_the_pair_in_earth_fixed_axes(seed):
    # Turn everything (satellite, ground, spin axis) about z: directions turn along. 1e-15 rad * 600 km =
    # rounding.
    t_s, ground = scattered_ground(5, seed=seed)
    R = EARTH.matrices_ie(t_s)
    p_e = np.einsum("nji,nj->ni", R, ORBIT.positions_i(t_s))
    v_e = np.einsum("nji,nj->ni", R, ORBIT.velocities_i(t_s))
    c, s = np.cos(1.0), np.sin(1.0)
    Z = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    omega = np.array([0.0, 0.0, 7.292e-5])
    u_e, range_m = apparent_directions_e(ground, p_e, v_e, omega, LightEffects())
    turned, turned_range = apparent_directions_e(ground @ Z.T, p_e @ Z.T, v_e @ Z.T, omega, LightEffects())
    np.testing.assert_allclose(turned, u_e @ Z.T, rtol=0, atol=5e-15)
    np.testing.assert_allclose(turned_range, range_m, rtol=0, atol=5e-9)
    origin, direction = emission_rays_e(u_e, p_e, v_e, omega, NOTHING)
    np.testing.assert_array_equal(origin, p_e)
    np.testing.assert_allclose(direction, u_e, rtol=0, atol=1e-16)


def test_a_line_of_sight_past_the_earth_gives_nan():
    t_s = np.array([10.0])
    u_i = ORBIT.velocities_i(t_s) / np.linalg.norm(ORBIT.velocities_i(t_s))
    origin, direction = lines_of_sight_e(u_i, t_s, ORBIT, EARTH, LightEffects())
    assert np.isnan(origin).all() and np.isnan(direction).all()


def test_ground_and_sky_share_one_observer():
    # A ground point seen by GCRS velocity, a star by barycentric velocity: seen from a satellite that stands
    # above a place, light straight up from the nadir is deflected by v/c towards the motion.
    t_s = np.array([100.0])
    nadir = ground_below(t_s, np.zeros(1), np.zeros(1), 0.0)
    u_i, _ = apparent_ground_directions(nadir, t_s, ORBIT, EARTH, LightEffects())
    still, _ = apparent_ground_directions(nadir, t_s, ORBIT, EARTH, LightEffects(aberration=False))
    v = ORBIT.velocities_i(t_s)[0]
    speed = np.linalg.norm(v)
    assert (u_i - still)[0] @ v / speed == pytest.approx(speed / SPEED_OF_LIGHT, rel=1e-3)
    assert ecef_from_geodetic(0.0, 0.0, 0.0, WGS84)[0] == WGS84.semi_major_m
