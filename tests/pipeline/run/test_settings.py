"""Settings of a run: what the dump states, and what the user's file says instead."""

from dataclasses import fields, replace

import numpy as np
import pytest

from boresight.geometry.constants import ARCSEC
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump_schema import Errors
from boresight.pipeline.run.settings import Settings, calibration_settings, settings_from_tables
from boresight.star_id.finding.star_list import list_stars
from boresight.star_id.settings import StarSettings

OF_LOOKS = {"look_distortion_px": 0.4, "look_distortion_length_px": 1500.0}
STATED = Errors(position_m=3.0, clock_s=2e-4, vibration_arcsec=0.25, **OF_LOOKS)
PLACE = dict.fromkeys(("y_first_m", "x_offset_m", "rotation_rad"), 0.0)
DETECTOR = Ccd(n_px=512, pixel_m=1e-5, principal_sample=255.0, **PLACE)
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


GREY_VALUES = {("match", "no_data"), ("match", "saturation_dn")}  # of strips, which may be negative


def test_no_setting_is_negative_and_no_probability_or_share_above_one() -> None:
    tried = 0
    for section in ("stars", "match", "run", "verdict", "sky_strips"):
        for one in fields(getattr(Settings(), section)):
            kind = str(one.type)
            if not kind.startswith(("float", "int")) or (section, one.name) in GREY_VALUES:
                continue
            part = any(word in one.name for word in ("probability", "share_", "mtf_"))
            for value in (-1, *([1.5] if part else [])):
                given = value if kind.startswith("int") else float(value)
                with pytest.raises(RawDataError, match=rf"a.toml: {section}: found \w+.{one.name} must be"):
                    settings_from_tables({section: {one.name: given}}, "a.toml")
                tried += 1
    assert tried > 50


@pytest.mark.parametrize("shape", [(32, 32), (33, 90), (64, 64), (101, 70)])
def test_a_stated_psf_lists_stars_or_is_refused_by_name(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(5).normal(50.0, 2.0, shape)
    y, x = np.indices(shape)
    image += 900.0 * np.exp(-((x - 15.3) ** 2 + (y - 14.8) ** 2) / 2.0)
    quarter = min(shape) / 4.0
    for sigma, smear in ((quarter / 3.0, None), (None, (1.4 * quarter, -1.4 * quarter)), (1.0, (0.0, 0.5))):
        found = list_stars(image, StarSettings(psf_sigma_px=sigma, smear_px=smear))
        assert len(found.xy_px) == 1 or sigma != 1.0
    says = r"^settings: found .*, expected psf_sigma_px times 6 and smear_px"
    too_wide = ((1.01 * quarter / 3.0, None), (1e9, None), (None, (0.0, 2.1 * quarter)), (1.0, (1e9, 0)))
    for sigma, smear in too_wide:
        with pytest.raises(ValueError, match=says):
            list_stars(image, StarSettings(psf_sigma_px=sigma, smear_px=smear))


@pytest.mark.parametrize("smear", [5, "ab", (1, 2, 3), ("1", 2), (np.inf, 0), (0, np.nan), (1e301, 0)])
def test_a_pair_of_numbers_is_two_finite_ones(smear: object) -> None:
    with pytest.raises(ValueError, match=r"^StarSettings.smear_px must be two finite numbers, got"):
        StarSettings(smear_px=smear)  # type: ignore[arg-type]
