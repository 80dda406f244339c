"""Wang's method: exact without noise, less accurate than `calibrate` with it."""

import numpy as np
import pytest
from drawn_campaigns import BOLD, CAMERAS, R_CS0

from boresight.features.paper.wang import polynomial_residuals, wang_calibrate
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.simulator.campaign import StripPlan, draw_strips


def test_without_noise_and_waves_the_matrix_is_found():
    plan = StripPlan(strips=3, targets=20, sigma_s_px=1e-6, sigma_c_px=1e-6, wave_rad=(0.0, 0.0))
    strips, _ = draw_strips(plan, CAMERAS, np.random.default_rng(1))
    found = wang_calibrate(strips, R_CS0)
    assert len(found.R_cs_strips) == 3
    assert np.linalg.norm(theta_between(found.R_cs, BOLD)) < 1e-3 * ARCSEC


def test_a_strip_with_too_few_targets_or_exposures_is_rejected_with_the_reason():
    strips, _ = draw_strips(StripPlan(strips=2, targets=20), CAMERAS, np.random.default_rng(3))
    few, _ = draw_strips(StripPlan(strips=3, targets=5), CAMERAS, np.random.default_rng(3))
    found = wang_calibrate([*strips, few[2]], R_CS0)
    assert found.rejected == (("strip0002", "5 targets and 10 exposures, 7 and 2 needed"),)
    with pytest.raises(ValueError, match="none of 3 strips"):
        wang_calibrate(few, R_CS0)
    blind = draw_strips(StripPlan(strips=1, targets=20, exposures=1), CAMERAS, np.random.default_rng(3))[0]
    with pytest.raises(ValueError, match="none of 1 strips"):
        wang_calibrate(blind, R_CS0)


def test_polynomials_take_out_polynomials_and_nothing_else():
    t = np.linspace(0.0, 24.0, 200)
    cubic = np.column_stack([t**3, 1 - t, 0.5 * t**2])
    np.testing.assert_allclose(polynomial_residuals(t, cubic, 3), 0.0, atol=1e-9)
    wave = np.sin(2 * np.pi * t / 4.0)[:, None] * np.ones(3)
    assert np.std(polynomial_residuals(t, wave, 7)) > 0.6  # of 0.71: six waves are beyond order 7


@pytest.mark.parametrize(("origin_s", "unit_s"), [(0.0, 1.0), (8e8, 1.0), (-3e5, 1e-3), (50.0, 3600.0)])
def test_residuals_depend_neither_on_the_origin_nor_on_the_unit_of_time(origin_s, unit_s):
    t = np.sort(np.random.default_rng(4).uniform(0.0, 24.0, 150))
    waves = np.column_stack([np.sin(t / k) for k in (0.7, 1.1, 5.0)])
    for order in (3, 7):
        series = np.polynomial.Chebyshev.fit(t, np.zeros(150), order)
        basis = np.polynomial.chebyshev.chebvander(series.mapparms()[0] + series.mapparms()[1] * t, order)
        expected = waves - basis @ np.linalg.lstsq(basis, waves, rcond=None)[0]
        # 8e8 s is rounded to 1e-7 s, the waves change by 1.4 a second
        found = polynomial_residuals(origin_s + unit_s * t, waves, order)
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_result_is_the_mean_over_all_strips_not_the_first_one():
    strips, _ = draw_strips(StripPlan(strips=4, targets=20), CAMERAS, np.random.default_rng(6))
    found = wang_calibrate(strips, R_CS0)
    assert (found.R_cs * found.R_cs_strips.mean().inv()).magnitude() < 1e-12
    assert (
        found.R_cs * found.R_cs_strips[0].inv()
    ).magnitude() > 0.05 * ARCSEC  # strips scatter by arcseconds
    alone = wang_calibrate(strips[2:3], R_CS0).R_cs
    assert (found.R_cs_strips[2] * alone.inv()).magnitude() < 1e-12
