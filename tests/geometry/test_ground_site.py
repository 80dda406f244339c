"""A camera on the ground against astropy: the stars' directions, air and all."""

import astropy.units as units
import numpy as np
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.time import Time
from astropy.utils import iers
from still_stars import still_stars

from boresight.geometry.constants import ARCSEC
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.starlight import GroundSite, apparent_star_directions, refract_by_air
from boresight.star_id.observer import Observer, sky_directions

UTC = "2019-07-29T20:47:26"
SITE = GroundSite(np.radians(52.2), np.radians(4.4), 30.0, 1009.0, 17.5)


def sky(n, rng):
    """Stars without motion at random places of the catalogue frame."""
    return still_stars(rng.uniform(0, 2 * np.pi, n), np.arcsin(rng.uniform(-1, 1, n)))


def test_stars_stand_over_the_horizon_where_astropy_sees_them():
    stars = sky(4000, np.random.default_rng(8))
    epoch = Epoch.from_utc(UTC + "Z")
    earth = EarthRotation.over(epoch, 0.0, 1.0, bundled_earth_orientation())
    state = SITE.at(earth, 0.0)
    outside = apparent_star_directions(stars, epoch, 0.0, state.p_i, state.v_i)
    seen = refract_by_air(outside, state.air)
    iers.conf.auto_download = False
    frame = AltAz(
        obstime=Time(UTC, scale="utc"),
        location=EarthLocation.from_geodetic(4.4 * units.deg, 52.2 * units.deg, 30.0 * units.m),
        pressure=1009.0 * units.hPa,
        temperature=17.5 * units.deg_C,
        relative_humidity=0.0,
        obswl=0.55 * units.micron,
    )
    theirs = SkyCoord(stars.ra_rad * units.rad, stars.dec_rad * units.rad, frame="icrs").transform_to(frame)
    altitude = np.arcsin(seen @ state.air.zenith_i)
    high = theirs.alt.deg > 10.0
    assert high.sum() > 1000
    # 0.2": polar motion and UT1 of two tables, and light deflection, which astropy's unit vectors lack here
    assert np.abs(altitude - theirs.alt.rad)[high].max() < 0.2 * ARCSEC
    # and without the air it is minutes: the test would see a wrong sign
    assert np.abs(np.arcsin(outside @ state.air.zenith_i) - theirs.alt.rad)[high].max() > 300.0 * ARCSEC


def test_behind_a_direction_seen_through_the_air_is_the_star_of_the_catalogue():
    stars = sky(4000, np.random.default_rng(9))
    epoch = Epoch.from_utc(UTC + "Z")
    state = SITE.at(EarthRotation.over(epoch, 0.0, 1.0, bundled_earth_orientation()), 0.0)
    seen = refract_by_air(apparent_star_directions(stars, epoch, 0.0, state.p_i, state.v_i), state.air)
    high = seen @ state.air.zenith_i > np.sin(np.radians(5.0))  # lower a camera sees no star
    found = sky_directions(seen[high], Observer(epoch, 0.0, state.p_i, state.v_i, state.air))
    true = SkyCoord(stars.ra_rad * units.rad, stars.dec_rad * units.rad).cartesian.xyz.value.T[high]
    # a thousandth of what a centroid tells; the air alone is some minutes
    assert high.sum() > 1500 and np.abs(found - true).max() < 1e-3 * ARCSEC


def test_refraction_keeps_the_vertical_plane_and_the_length():
    u = np.random.default_rng(2).normal(size=(500, 3))
    u /= np.linalg.norm(u, axis=1)[:, None]
    epoch = Epoch.from_utc(UTC + "Z")
    air = SITE.at(EarthRotation.over(epoch, 0.0, 1.0, bundled_earth_orientation()), 0.0).air
    seen = refract_by_air(u, air)
    assert np.abs(np.linalg.norm(seen, axis=1) - 1.0).max() < 1e-14
    across = np.cross(u, air.zenith_i)
    assert np.abs(np.einsum("ni,ni->n", across, seen)).max() < 1e-14


def test_standard_weather_is_that_of_the_published_table():
    """US Standard Atmosphere 1976: 2000 m of geopotential height, 794.95 hPa and 275.15 K."""
    site = GroundSite.in_standard_weather(0.0, 0.0, 2000.0)
    assert abs(site.pressure_hpa - 794.95) < 0.01  # hPa
    assert abs(site.temperature_c + 273.15 - 275.15) < 1e-9
