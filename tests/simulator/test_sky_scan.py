"""Scans of the sky: where stars cross the detectors, and the charge that they leave."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pytest import approx
from scipy.spatial.transform import Rotation, Slerp
from still_stars import still_stars

from boresight.geometry.constants import ARCSEC
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.starlight import SurveyedStars, apparent_star_directions
from boresight.pipeline.files.scenario_file import fly
from boresight.simulator import mission
from boresight.simulator.scenario import (
    ErrorSettings,
    ScenarioError,
    SkyScan,
    SkyStripSettings,
    mini_scenario,
    scenario_from_dict,
    scenario_to_dict,
)
from boresight.simulator.sky_scan import sky_around
from boresight.star_id.whole_catalogue import all_hipparcos

PLEIADES = SkyScan(56.75, 24.12, 2380.0, 20.0)
STILL = ErrorSettings(gps_m=0.0, vibration_arcsec=0.0, clock_s=0.0, distortion_px=0.0)


@pytest.fixture(scope="module", autouse=True)
def flown_once():
    """The missions of this module fly one orbit, 40 minutes of it: it is integrated once."""
    orbits, fly_it = {}, mission.flown_orbit

    def flown(settings, start_s, stop_s, earth):
        key = settings, start_s, stop_s, earth.epoch
        if key not in orbits:
            orbits[key] = fly_it(settings, start_s, stop_s, earth)
        return orbits[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mission, "flown_orbit", flown)
        yield


def scanned(stages=1, noise=0.0, **changes):
    """A mission with one scan of the Pleiades and nothing else, without read noise or hot columns."""
    mini = mini_scenario()
    sky = SkyStripSettings(
        scans=(replace(PLEIADES, **changes),),
        lines=2000,
        row_period_s=3.6e-3,
        flux_v0_e_per_s=1e9,
        hot_columns=0,
        cosmic_rays=0,
        uncatalogued_per_deg2=0.0,
        background_dn=0.0,
    )
    scenario = replace(
        mini,
        sky_strips=sky,
        errors=STILL,
        strips=replace(mini.strips, count=0),
        line_camera=replace(mini.line_camera, tdi_stages=stages),
        ground=replace(mini.ground, bits=16, e_per_dn=1.0, read_noise_dn=noise, pixel_gain_sigma=0.0),
    )
    return fly(scenario, seed=3)


@pytest.mark.parametrize("rate", [1.0, -1.2])
def test_a_star_crosses_where_the_pixel_looks_at_it(rate):
    flown = scanned(rate=rate)
    strip, stars = flown.strips[0], all_hipparcos().places
    truth = flown.truth
    attitude, looked_i, hip = Slerp(truth.t_attitude_s, truth.R_ci), [], []
    for star in (star for star in truth.sky_stars if star.hip):
        t_s = strip.t_first_row_s + star.line * strip.row_period_s
        u_c = truth.line_camera.directions_from_pixels(star.ccd, np.array([star.sample]))
        looked_i.append(attitude(t_s).inv().apply(u_c)[0])
        hip.append(star.hip)
    nodes = np.searchsorted(flown.orbit.t_s, PLEIADES.at_s + 3.6) + np.arange(2)
    earth = EarthRotation.over(flown.epoch, 0.0, 3e3, bundled_earth_orientation())
    at_s, R_ie = flown.orbit.t_s[nodes], earth.matrices_ie(flown.orbit.t_s[nodes])
    p_i = (R_ie @ flown.orbit.positions_m[nodes][:, :, None])[:, :, 0]
    v_i = (p_i[1] - p_i[0]) / (at_s[1] - at_s[0])
    places = stars.take(np.searchsorted(stars.hip, hip))
    u_i = apparent_star_directions(places, flown.epoch, float(at_s.mean()), p_i.mean(axis=0), v_i)
    assert len(hip) > 12
    # a catalogue's error of 0.03" per axis, and 4 s of the satellite's motion: 0.02"
    assert np.median(np.linalg.norm(u_i - looked_i, axis=1)) < 0.06 * ARCSEC


def test_true_places_differ_from_the_catalogue_by_its_error_in_right_ascension_and_declination():
    """4000 stars at 70° north, with unlike errors in 1991.25 that their proper motions enlarge until 2024."""
    n, rng = 4000, np.random.default_rng(6)
    middle_rad = np.radians([35.0, 70.0])  # right ascension and declination
    place = np.column_stack([rng.uniform(-0.05, 0.05, n), rng.uniform(-0.02, 0.02, n)]) + middle_rad
    places = still_stars(*place.T, epoch_jyear=1991.25)
    sigma, sigma_pm = np.array([0.02, 0.7]) * ARCSEC, np.array([0.003, 0.001]) * ARCSEC  # every other star
    each = np.arange(n) % 2
    errors = {"sigma_rad": sigma[each], "sigma_pm_rad_yr": sigma_pm[each]}
    survey = SurveyedStars(name="HIP", places=places, **errors, single=np.ones(n, dtype=bool))
    R_oi = Rotation.from_euler("ZY", [middle_rad[0], np.pi / 2.0 - middle_rad[1]]).inv()
    orbit = SimpleNamespace(
        epoch=Epoch.from_utc("2024-01-01T12:00:00Z"),
        states_i=lambda t_s: (np.array([[7e6, 0.0, 0.0]]), np.array([[0.0, 0.0, 7.5e3]])),
    )
    attitude = SimpleNamespace(scan=SimpleNamespace(t_s=0.0, R_oi_reference=R_oi))
    settings = SkyStripSettings(uncatalogued_per_deg2=0.0)
    found = sky_around(survey, attitude, 0.1, settings, orbit, np.random.default_rng(7))
    assert len(found.hip) == n
    moved = np.column_stack([found.ra_rad - place[:, 0], found.dec_rad - place[:, 1]])
    moved[:, 0] *= np.cos(place[:, 1])
    expected = np.sqrt(sigma**2 + (32.75 * sigma_pm) ** 2)[each]
    normal = moved / expected[:, None]
    # 5 sigma of a covariance of 2000 normal numbers of unit variance: 5 sqrt(2 / 2000)
    for half in (normal[0::2], normal[1::2]):
        assert np.cov(half.T) == approx(np.eye(2), abs=0.16)


@pytest.mark.parametrize(
    ("rate", "drift", "stages"), [(1.0, 0.0, 1), (0.8, 0.0, 16), (1.2, 0.1, 16), (-1.0, 0.0, 4)]
)
def test_an_image_holds_the_stars_charge_with_its_middle_at_the_crossing(rate, drift, stages):
    flown = scanned(stages, rate=rate, drift=drift)
    images = {strip.ccd: next(strip.blocks(strip.lines)) for strip in flown.strips}
    alone = 0
    for star in flown.truth.sky_stars:
        x, y = round(star.sample), round(star.line)
        image = images[star.ccd].astype(float)
        window = image[max(y - 16, 0) : y + 17, max(x - 9, 0) : x + 10]
        if window.shape != (33, 19) or star.charge_e < 5e3 or window.max() > 6e4:
            continue
        alone += 1
        # The oscillation changes the rate, and with it the time that a star takes, by up to 18" / s of 690.
        noise = np.sqrt(star.charge_e + 0.3**2 * window.size)  # photons, and the rounding of 627 pixels
        assert window.sum() == approx(star.charge_e, abs=5.0 * noise + 0.027 / abs(rate) * star.charge_e)
        rows, columns = np.mgrid[-16:17, -9:10]
        for grid, middle, size in ((columns, star.sample - x, 4.0), (rows, star.line - y, 7.0)):
            assert (grid * window).sum() / window.sum() == approx(
                middle, abs=5.0 * size / np.sqrt(star.charge_e)
            )
    assert alone >= 4


def test_a_star_leaves_charge_for_as_long_as_it_crosses_the_stages():
    slow, fast = (scanned(16, rate=rate, drift=0.0) for rate in (0.8, 1.2))
    charges = [{star.hip: star.charge_e for star in one.truth.sky_stars} for one in (slow, fast)]
    both = sorted(set(charges[0]) & set(charges[1]) - {0})
    assert len(both) > 3
    ratio = [charges[0][hip] / charges[1][hip] for hip in both]
    assert np.allclose(ratio, 1.2 / 0.8, rtol=1e-6)


def test_without_scans_the_scenario_is_stored_as_before_and_with_them_it_is_complete():
    mini = mini_scenario()
    assert "sky_strips" not in scenario_to_dict(mini)
    with_sky = replace(mini, sky_strips=SkyStripSettings(scans=(PLEIADES,)))
    assert scenario_from_dict(scenario_to_dict(with_sky)) == with_sky
    with pytest.raises(ScenarioError, match="at_s"):
        replace(mini, sky_strips=SkyStripSettings(scans=(replace(PLEIADES, at_s=3.0),)))
    with pytest.raises(ScenarioError, match="rate"):
        replace(mini, sky_strips=SkyStripSettings(scans=(replace(PLEIADES, rate=0.0),)))
