"""Geodetic coordinates and rays to the ellipsoid, against Vallado's examples and pyproj."""

import numpy as np
import pytest
from pyproj import Transformer

from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import (
    ecef_from_geodetic,
    geodetic_from_ecef,
    local_axes_e,
    ray_ellipsoid_intersection,
    verticals,
)

TO_ECEF = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def places(n, rng, low=-500.0, high=9000.0):
    lat, lon = np.arcsin(rng.uniform(-1.0, 1.0, n)), rng.uniform(-np.pi, np.pi, n)
    return lat, lon, rng.uniform(low, high, n)


def test_vallado_example_3_3_geodetic_from_ecef():
    # Vallado, Fundamentals of Astrodynamics, 4th ed., example 3-3: one unit of the last printed digit.
    lat, lon, height = geodetic_from_ecef(np.array([6524834.0, 6862875.0, 6448296.0]), WGS84)
    assert np.degrees(lat) == pytest.approx(34.352496, abs=1e-6)
    assert np.degrees(lon) == pytest.approx(46.4464, abs=1e-4)
    assert height == pytest.approx(5085220.0, abs=10.0)


def test_vallado_example_3_2_ecef_from_geodetic():
    # Vallado, 4th ed., example 3-2: 7.9066357 S, 345.5975 E, 56 m; station vector in km, with his ellipsoid
    # of EGM96 (a = 6378.1363 km, 1/f = 298.257) 0.8 m smaller than WGS84: that is the tolerance.
    p = ecef_from_geodetic(np.radians(-7.9066357), np.radians(345.5975), 56.0, WGS84)
    np.testing.assert_allclose(p, [6119400.26, -1571479.55, -871561.13], rtol=0, atol=1.0)


def test_both_ways_agree_with_pyproj():
    # 1e-6 m, from the Dead Sea up to 20 km (at 800 km, PROJ itself is off by 2e-6 m).
    rng = np.random.default_rng(1)
    lat, lon, height = places(20_000, rng, -500.0, 20e3)
    theirs = np.column_stack(TO_ECEF.transform(np.degrees(lon), np.degrees(lat), height))
    ours = ecef_from_geodetic(lat, lon, height, WGS84)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-6)
    back = geodetic_from_ecef(theirs, WGS84)
    np.testing.assert_allclose(back[0] * 6.4e6, lat * 6.4e6, rtol=0, atol=1e-6)
    np.testing.assert_allclose(back[1] * 6.4e6 * np.cos(lat), lon * 6.4e6 * np.cos(lat), rtol=0, atol=1e-6)
    np.testing.assert_allclose(back[2], height, rtol=0, atol=1e-6)


@pytest.mark.parametrize("height_m", [0.0, -420.0, 8848.0])
def test_rays_meet_the_height_that_pyproj_gives(height_m):
    # 1e-6 m in height, and on the line, from 530 km at 0 to 60 deg from the nadir in all directions.
    rng = np.random.default_rng(2)
    lat, lon, _ = places(20_000, rng)
    origin = ecef_from_geodetic(lat, lon, 530e3, WGS84)
    zenith, azimuth = np.radians(rng.uniform(0.0, 60.0, 20_000)), rng.uniform(0.0, 2 * np.pi, 20_000)
    local = np.stack(
        [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), -np.cos(zenith)], axis=-1
    )
    direction = np.einsum("nij,nj->ni", local_axes_e(lat, lon), local)
    scale = rng.uniform(0.1, 3.0, (20_000, 1))
    met = ray_ellipsoid_intersection(origin, scale * direction, height_m, WGS84)
    *_, height = TO_ECEF.transform(*met.T, direction="INVERSE")
    np.testing.assert_allclose(height, height_m, rtol=0, atol=1e-6)
    off_line = np.linalg.norm(np.cross(met - origin, direction), axis=1)
    assert off_line.max() < 1e-6
    assert np.einsum("ni,ni->n", met - origin, direction).max() < 2000e3  # the near side


def test_rays_that_miss_or_look_away_give_nan():
    origin = np.repeat([[7000e3, 0.0, 0.0]], 3, axis=0)
    direction = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    met = ray_ellipsoid_intersection(origin, direction, 0.0, WGS84)
    assert np.isnan(met[:2]).all()
    np.testing.assert_allclose(met[2], [6378137.0, 0.0, 0.0], rtol=0, atol=1e-8)


def test_heights_may_differ_from_ray_to_ray():
    origin = np.array([[7000e3, 0.0, 0.0], [0.0, 7000e3, 0.0]])
    met = ray_ellipsoid_intersection(origin, -origin, np.array([100.0, 2000.0]), WGS84)
    np.testing.assert_allclose(np.linalg.norm(met, axis=1), 6378137.0 + np.array([100.0, 2000.0]), atol=1e-8)


def test_quick_vertical_is_that_of_geodetic_latitude():
    lat, lon, height = places(5000, np.random.default_rng(3))
    up = local_axes_e(lat, lon)[:, :, 2]
    # 3e-8 rad is what its description allows up to 9 km.
    p_e = ecef_from_geodetic(lat, lon, height, WGS84)
    assert np.abs(verticals(p_e.T, height, WGS84).T - up).max() < 3e-8


def test_local_axes_are_right_handed_east_north_up():
    axes = local_axes_e(0.3, -2.0)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-15)
    step = 1e-7
    p = ecef_from_geodetic(0.3, -2.0, 0.0, WGS84)
    east = ecef_from_geodetic(0.3, -2.0 + step, 0.0, WGS84) - p
    north = ecef_from_geodetic(0.3 + step, -2.0, 0.0, WGS84) - p
    np.testing.assert_allclose(east / np.linalg.norm(east), axes[:, 0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(north / np.linalg.norm(north), axes[:, 1], rtol=0, atol=1e-6)
