"""Speed and accuracy of frames and light: Earth rotation, stars, ellipsoid, geoid, each beside its authority.

    python benchmarks/bench_frames.py

Accuracy is against direct evaluation by ERFA, astropy, skyfield with DE421, pyproj and NGA's test
points. Times are CPU time of one thread.
"""

import sys
import time
from importlib.metadata import version
from pathlib import Path

import erfa
import numpy as np
from astropy import units as u
from astropy.coordinates import GCRS, ITRS, CartesianRepresentation
from astropy.time import Time
from astropy.utils import iers
from pyproj import Transformer
from record import exit_status, head, judge_largest

from boresight.geometry.constants import ARCSEC, GM_EARTH, WGS84
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import MJD_ZERO_JD, Epoch, tai_minus_utc_s
from boresight.geometry.geodesy import (
    ecef_from_geodetic,
    local_axes_e,
    ray_ellipsoid_intersection,
)
from boresight.geometry.geoid import egm96
from boresight.geometry.starlight import apparent_star_directions

TESTS = Path(__file__).parents[1] / "tests" / "geometry"
TABLE = bundled_earth_orientation()
RADIUS = 6_908_137.0


def timed(function, *arguments):
    """CPU time of a call, s, the mean of as many as take half a second, and its result."""
    start, calls = time.process_time(), 0
    while (took := time.process_time() - start) < 0.5:
        result, calls = function(*arguments), calls + 1
    return took / calls, result


def earth_rotation():
    """Largest error on the equator of the last 20 years' dates, m, against ERFA and against astropy."""
    rng = np.random.default_rng(1)
    tai_utc = tai_minus_utc_s(TABLE.mjd_utc)
    direct, peer = [], []
    for row in rng.integers(len(TABLE.mjd_utc) - 7700, len(TABLE.mjd_utc) - 400, 200):
        day = TABLE.mjd_utc[row]  # at 0h UTC nothing has to be interpolated
        year, month, dom, _ = erfa.jd2cal(MJD_ZERO_JD, day)
        epoch = Epoch.from_utc(f"{year:04d}-{month:02d}-{dom:02d}")
        R = EarthRotation.over(epoch, -9000.0, 50_000.0, TABLE).matrices_ie([0.0])[0]
        tt = (tai_utc[row] + 32.184) / 86_400.0
        x, y, s = erfa.xys06a(MJD_ZERO_JD + day, tt)
        celestial = erfa.c2ixys(x + TABLE.dx_rad[row], y + TABLE.dy_rad[row], s)
        era = erfa.era00(MJD_ZERO_JD + day, TABLE.ut1_utc_s[row] / 86_400.0)
        motion = erfa.pom00(TABLE.xp_rad[row], TABLE.yp_rad[row], erfa.sp00(MJD_ZERO_JD + day, tt))
        direct.append(np.abs(R - erfa.c2tcio(celestial, era, motion).T).max() * WGS84.semi_major_m)
        with iers.conf.set_temp("auto_download", False):
            when = Time(day, format="mjd", scale="utc")
            p = CartesianRepresentation([WGS84.semi_major_m, 0.0, 0.0] * u.m)
            there = ITRS(p, obstime=when).transform_to(GCRS(obstime=when)).cartesian.xyz.to_value(u.m)
        peer.append(np.linalg.norm(R[:, 0] * WGS84.semi_major_m - there))
    return max(direct), max(peer)


def stars():
    """1000 stars at 20 epochs against skyfield, mas; through the very code of the test."""
    sys.path.insert(0, str(TESTS))
    import test_starlight as t

    places, theirs = t.star_places(1000, np.random.default_rng(2))
    ephemeris, timescale = t.load_file(str(t.EPHEMERIS)), t.load.timescale(builtin=True)
    worst = named = 0.0
    for k, year in enumerate(np.linspace(1995.1, 2026.5, 20)):
        epoch = Epoch(round((year - 2000.0) * 365.25 * 86_400))
        p_i, v_i = t.satellite_state(k)
        day, since = epoch.tt_jd(0.0)
        observer = (ephemeris["earth"] + t.Satellite(p_i, v_i)).at(timescale.tt_jd(float(day), float(since)))
        seen = observer.observe(theirs).apparent(deflectors=(10,)).xyz.au.T
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        sun = observer.observe(ephemeris["sun"]).xyz.au
        error = np.linalg.norm(apparent_star_directions(places, epoch, 0.0, p_i, v_i) - seen, axis=1)
        far = seen @ sun / np.linalg.norm(sun) < np.cos(np.radians(3.0))
        worst, named = max(worst, error[far].max()), max(named, error[:2].max())
    took, _ = timed(apparent_star_directions, places, epoch, 0.0, p_i, v_i)
    return worst / ARCSEC * 1e3, named / ARCSEC * 1e3, 1000 / took


def satellite(n, rng, steepest_deg):
    """n satellites in axes e, and directions down from them."""
    lat, lon = rng.uniform(-1.3, 1.3, n), rng.uniform(-np.pi, np.pi, n)
    axes = local_axes_e(lat, lon)
    p_e = ecef_from_geodetic(lat, lon, 530e3, WGS84)
    v_e = np.sqrt(GM_EARTH / RADIUS) * axes[:, :, 1]
    zenith, azimuth = np.radians(rng.uniform(0.0, steepest_deg, n)), rng.uniform(0.0, 2 * np.pi, n)
    local = [np.sin(zenith) * np.sin(azimuth), np.sin(zenith) * np.cos(azimuth), -np.cos(zenith)]
    return p_e, v_e, np.einsum("nij,nj->ni", axes, np.stack(local, axis=-1))


def ellipsoid():
    """Height of met points by pyproj, m, and rays a second."""
    rng, n = np.random.default_rng(4), 300_000
    p_e, _, u_e = satellite(n, rng, 60.0)
    took, met = timed(ray_ellipsoid_intersection, p_e, u_e, 2500.0, WGS84)
    *_, height = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*met.T)
    return np.abs(height - 2500.0).max(), n / took


def geoid():
    sys.path.insert(0, str(TESTS))
    from test_geoid import NGA_TEST_POINTS

    lat, lon, height = NGA_TEST_POINTS.T
    error = np.abs(egm96().undulation_m(np.radians(lat), np.radians(lon)) - height).max()
    rng, n = np.random.default_rng(5), 300_000
    took, _ = timed(egm96().undulation_m, rng.uniform(-1.5, 1.5, n), rng.uniform(-3.1, 3.1, n))
    return error, n / took


def wanted(what, value, unit, most):
    judge_largest(f"{what}: largest", float(value), most, unit)


def main():
    head("Frames and light: accuracy and speed, one thread")
    packages = ("pyerfa", "astropy", "skyfield", "pyproj", "astropy-iers-data")
    print(", ".join(f"{name} {version(name)}" for name in packages))

    def over():
        return EarthRotation.over(Epoch.from_utc("2025-09-01"), 0.0, 86_400.0, TABLE).matrices_ie(
            np.linspace(0.0, 86_400.0, 100_000)
        )

    direct, peer = earth_rotation()
    took, _ = timed(over)
    print()
    wanted("ITRS -> GCRS, ERFA directly, with dX, dY", 1e3 * direct, "mm", 1)
    wanted("ITRS -> GCRS, astropy (no dX, dY)", 1e3 * peer, "mm", 20)
    wanted("ITRS -> GCRS, 100 000 epochs of a day", took, "s", 0.3)
    worst, named, rate = stars()
    print()
    wanted("stars, 1000 x 20 epochs, skyfield", worst, "mas", 1)
    wanted("stars, Barnard's star and Polaris", named, "mas", 1)
    print(f"stars                                         {rate:10.0f} /s")
    error, rate = ellipsoid()
    wanted("ray to ellipsoid at a height, pyproj", 1e6 * error, "um", 1)
    print(f"ray to ellipsoid at a height                  {rate:10.0f} /s")
    error, rate = geoid()
    wanted("geoid, NGA's six points", 1e3 * error, "mm", 10)
    print(f"geoid                                         {rate:10.0f} /s")
    return exit_status()


if __name__ == "__main__":
    sys.exit(main())
