"""Settings of a run: what the dump states, and what the user's file says instead."""

from dataclasses import replace

import pytest

from boresight.geometry.constants import ARCSEC
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.pipeline.files.dump_schema import Errors
from boresight.pipeline.run.settings import Settings, calibration_settings

STATED = Errors(
    position_m=3.0,
    clock_s=2e-4,
    vibration_arcsec=0.25,
    look_distortion_px=0.4,
    look_distortion_length_px=1500.0,
)
DETECTOR = Ccd(
    n_px=512, y_first_m=0.0, x_offset_m=0.0, rotation_rad=0.0, pixel_m=1e-5, principal_sample=255.0
)
CAMERA = LineCamera(8.0, (DETECTOR,), tdi_stages=1, time_of_row="middle")


def test_error_model_is_what_the_dump_states_in_si_units() -> None:
    used = calibration_settings(Settings(), STATED, CAMERA)
    assert used.sigma_position_m == 3.0
    assert used.sigma_clock_s == 2e-4
    assert used.sigma_vibration_rad == pytest.approx(0.25 * ARCSEC, rel=1e-12)
    assert used.sigma_distortion_rad == pytest.approx(0.4 * 1e-5 / 8.0, rel=1e-12)
    assert used.distortion_length_px == 1500.0


def test_user_replaces_what_the_dump_states() -> None:
    used = calibration_settings(Settings(calibration=(("sigma_clock_s", 5e-4),)), STATED, CAMERA)
    assert (used.sigma_clock_s, used.sigma_position_m) == (5e-4, 3.0)


def test_each_ccd_has_a_part_of_the_look_distortion_unless_the_dump_states_it() -> None:
    pixel_rad = 1e-5 / 8.0
    two = replace(CAMERA, ccds=(DETECTOR, replace(DETECTOR, n_px=300, y_first_m=0.005)))
    usual = calibration_settings(Settings(), STATED, two)
    assert usual.ccd_px == (512, 300) and replace(usual, ccd_px=(2, 2)).ccd_px == (2, 2)  # have a slope
    assert usual.sigma_ccd_rad == pytest.approx((0.08 * pixel_rad,) * 3, rel=1e-12)  # 0.2 of 0.4 px
    stated = STATED.model_copy(update={"look_ccd_shift_px": 0.7, "look_ccd_bend_px": 0.0})
    used = calibration_settings(Settings(), stated, two)
    assert used.sigma_ccd_rad == pytest.approx((0.7 * pixel_rad, 0.08 * pixel_rad, 0.0), rel=1e-12)
    assert stated.look_px == pytest.approx((0.4**2 + 0.7**2 + 0.08**2) ** 0.5, rel=1e-12)
