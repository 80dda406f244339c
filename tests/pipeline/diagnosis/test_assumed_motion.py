"""Motion that no star exposure shows is a finding, with what is assumed of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.calib.finding import MOST_WORDS
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.attitude_estimate import with_attitudes
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.diagnosis.input_findings import assumed_motion
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips

STATED = CalibrationSettings(sigma_motion_rad=6.0 * ARCSEC, motion_time_s=0.8)


@pytest.mark.parametrize(("exposures", "told"), [(2, True), (3, False), (10, False)])
def test_with_two_exposures_a_strip_the_assumed_motion_is_told(exposures: int, told: bool) -> None:
    plan = StripPlan(strips=2, exposures=exposures)
    strips, _ = draw_strips(plan, CameraPair(Rotation.identity()), np.random.default_rng(1))
    fitted = with_attitudes(strips, STATED.attitudes)
    found = list(assumed_motion(fitted, STATED))
    assert len(found) == told
    assert not list(assumed_motion(fitted, replace(STATED, sigma_motion_rad=0.0)))
    for one in found:
        assert "6″ within 0.8 s are assumed" in one.text and "motion_arcsec" in one.field
        assert not one.is_fault and not one.refutes
        assert len(f"{one.cause} {one.item} {one.text}".split()) <= MOST_WORDS
