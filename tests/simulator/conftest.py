"""A small mission for the tests of the simulator: bold mounting, every error of Table 1 on."""

import numpy as np
import pytest
from still_stars import still_stars

from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.geoid import egm96
from boresight.simulator.mission import render_mission
from boresight.simulator.scenario import scenario_from_dict, scenario_to_dict

SMALL = {
    "based_on": "mini",
    "name": "small",
    "attitude": {"roll_deg": 7.0, "pitch_deg": -2.0},
    "installation": {"zenith_distance_deg": 40.0, "azimuth_deg": 130.0, "turn_deg": -70.0},
    "strips": {"count": 2, "lines": 300, "spacing_s": 15.0},
    "targets": {"per_strip": 4, "check_points_per_strip": 5, "chip_size_px": 48},
    "sky": {"faint_stars_per_deg2": 2.0},
}


def invented_catalogue(count=20_000, seed=5):
    """Stars all over the sky with sizeable proper motions and parallaxes."""
    rng = np.random.default_rng(seed)
    return still_stars(
        rng.uniform(0.0, 2.0 * np.pi, count),
        np.arcsin(rng.uniform(-1.0, 1.0, count)),
        pm_ra_rad_yr=rng.normal(0.0, 1e-6, count),
        pm_dec_rad_yr=rng.normal(0.0, 1e-6, count),
        parallax_arcsec=rng.uniform(0.0, 0.3, count),
        v_mag=rng.uniform(2.0, 8.0, count),
        b_v=np.full(count, np.nan),
        epoch_jyear=1991.25,
    )


@pytest.fixture(scope="session")
def tables():
    return bundled_earth_orientation(), egm96()


@pytest.fixture(scope="session")
def stars():
    return invented_catalogue()


@pytest.fixture(scope="session")
def small():
    return scenario_from_dict(SMALL)


@pytest.fixture(scope="session")
def mission(small, stars, tables):
    return render_mission(small, stars, *tables, seed=11)


@pytest.fixture(scope="session")
def quiet_mission(small, stars, tables):
    """The same mission with every error switched off."""
    values = scenario_to_dict(small)
    values["errors"].update(gps_m=0.0, vibration_arcsec=0.0, clock_s=0.0, distortion_px=0.0)
    values["targets"].update(sigma_m=[0.0, 0.0, 0.0])
    return render_mission(scenario_from_dict(values), stars, *tables, seed=11)
