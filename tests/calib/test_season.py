"""A mounting that varies with the season is distinguished from one that jumps, over dumps of a year."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drawn_campaigns import TABLE_1
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips
from boresight.calib.reliability import examine
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.attitude_estimate import with_attitudes
from boresight.geometry.constants import ARCSEC, DAY_S
from boresight.geometry.installation import deviation_from_theta
from boresight.simulator.campaign import CameraPair, draw_strips

CAMERAS = CameraPair(Rotation.from_euler("xyz", [40, -65, 110], degrees=True), n_ccds=2, ccd_px=12288)
PLAN = replace(TABLE_1, strips=9, exposures=5, stars=15, sigma_target_m=0.5)
SETTINGS = CalibrationSettings()
DAYS = np.array([0, 31, 70, 118, 163, 201, 246, 290, 342])  # of the strips
ORDER = np.array([3, 7, 0, 4, 8, 2, 6, 1, 5])  # of their dates, by id


def causes(seed, turns_arcsec, days=DAYS):
    """Causes, items, sizes and sigmas found, of strips at `days` with the mounting turned about y of c."""
    drawn = with_attitudes(draw_strips(PLAN, CAMERAS, np.random.default_rng(seed))[0], SETTINGS.attitudes)
    strips = []
    for strip, day, turn in zip(drawn, days[ORDER], turns_arcsec[ORDER]):
        u_c = deviation_from_theta(np.array([0.0, turn * ARCSEC, 0.0])).apply(strip.ground.u_c)
        later = day * DAY_S
        exposures = tuple(replace(one, t_s=one.t_s + later) for one in strip.exposures)
        ground = replace(strip.ground, u_c=u_c, t_s=strip.ground.t_s + later)
        strips.append(replace(strip, exposures=exposures, ground=ground))
    estimate = calibrate_strips(strips, CAMERAS.R_cs, SETTINGS)
    found = examine(estimate, strips, SETTINGS, pixel_rad=CAMERAS.pixel_rad)
    return [(one.cause, one.item, one.value, one.sigma) for one in found.findings]


def season(phase_days, days=DAYS):
    return 6.0 * np.cos(2.0 * np.pi * (days - phase_days) / 365.25)


@pytest.mark.parametrize("seed, phase_days", [(0, 0.0), (4, 297.0), (18, 109.0)])
def test_a_season_is_reported_as_a_season_with_its_size(seed, phase_days):
    ((cause, item, size, sigma),) = causes(seed, season(phase_days))
    assert cause == "mounting varies with the season, about y of c"
    told_days = float(item.partition("most ")[2].partition(" days")[0])
    phase = 2.0 * np.pi * (told_days - phase_days) / 365.25
    # reported is the part of this phase; where noise lets the next but one win, 30° off
    assert size == pytest.approx(6.0 * np.cos(phase), abs=5.0 * sigma)
    assert abs(np.cos(phase)) > np.cos(np.pi / 6.0)


def test_a_jump_is_no_season():
    ((cause, item, *_),) = causes(1, 6.0 * (np.arange(9) >= 4))
    assert (cause, item) == ("mounting moved, about y of c", "from strip strip0003 on")


def test_a_mounting_at_rest_has_no_season():
    assert causes(2, np.zeros(9)) == []


def test_no_season_is_reported_of_a_month():
    days = DAYS / 12.0
    assert not any("season" in cause for cause, *_ in causes(0, season(23.0, DAYS), days))
