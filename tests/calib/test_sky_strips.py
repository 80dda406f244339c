"""Strips that scan the sky: stars as targets without position; covariance honest, shared stars one star."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_campaigns import BOLD, CAMERAS, R_CS0, TABLE_1, assert_chi_square, nees_of_estimate, squared
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.calib.calibration import calibrate_strips
from boresight.calib.error_table import bias_columns, of_pass
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.settings import CalibrationSettings
from boresight.calib.strips import prepare_strip
from boresight.calib.verdict import CheckKind, assess
from boresight.geometry.constants import ARCSEC
from boresight.geometry.sightings import isotropic_covariance
from boresight.records.ledger import Kind, Reason, Subject
from boresight.simulator.campaign import DistortionCurve, draw_sky_strips, draw_strips

SKY = replace(TABLE_1, strips=2, sigma_c_px=0.05)
NONE = CalibrationSettings(
    sigma_position_m=0.0, sigma_clock_s=0.0, sigma_vibration_rad=0.0, sigma_distortion_rad=0.0
)


def test_stated_covariance_holds_from_the_sky_alone():
    rng, nees = np.random.default_rng(31), []
    for _ in range(40):
        estimate = calibrate_strips(
            draw_sky_strips(SKY, CAMERAS, rng, sigma_star_rad=0.02 * ARCSEC), R_CS0, CalibrationSettings()
        )
        assert isinstance(estimate, InstallationEstimate) and estimate.converged_covariance
        nees.append(nees_of_estimate(estimate))
    assert_chi_square(nees, 3)  # 1.89 to 4.45 a run


def test_no_position_of_the_satellite_moves_a_star():
    strip = draw_sky_strips(SKY, CAMERAS, np.random.default_rng(1))[0]
    settings = replace(NONE, sigma_position_m=2.0)
    assert not of_pass(prepare_strip(strip, settings), settings).any()


def test_the_row_clock_moves_a_star_by_the_rate_of_the_scan():
    still = replace(SKY, wave_rad=(0.0, 0.0), sigma_s_px=1e-4)
    strip = draw_sky_strips(still, CAMERAS, np.random.default_rng(2))[0]
    settings = replace(NONE, sigma_clock_s=1e-3)
    column = of_pass(prepare_strip(strip, settings), settings)[:, :, 3] @ BOLD.as_matrix().T
    # 1 ms of a scan at -14.5 mrad/s about y: 14.5 µrad along x, the field is too narrow for more
    np.testing.assert_allclose(column[:, 0], 14.5e-6, rtol=1e-3)
    assert np.abs(column[:, 1]).max() < 1e-10  # rad; the rate is that of stars of 1e-4 px


def copies(strip, n, sigma_star_rad, rng):
    """One scan n times, a minute apart: the noise is new each time, the errors of the star catalogue are the
    same.
    """
    known = strip.ground.u_i + sigma_star_rad * rng.standard_normal(strip.ground.u_i.shape)
    known /= np.linalg.norm(known, axis=1, keepdims=True)
    stated = isotropic_covariance(known, sigma_star_rad)
    for k in range(n):
        seen = strip.ground.u_c + 5e-8 * rng.standard_normal(strip.ground.u_c.shape)
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        ground = replace(strip.ground, u_i=known, u_c=seen, cov_target_i=stated)
        yield replace(strip, strip_id=f"copy{k}", ground=ground).later(60.0 * k)


@pytest.mark.parametrize(("most", "honest"), [(100, True), (0, False)])
def test_a_star_in_several_strips_is_one_star(most, honest):
    exact = replace(SKY, sigma_c_px=0.0, sigma_clock_s=0.0, sigma_vibration_rad=0.0, sigma_distortion_rad=0.0)
    settings = replace(NONE, robust=False, most_shared_targets=most)
    rng, nees = np.random.default_rng(5), []
    for _ in range(20):
        (strip,) = draw_sky_strips(replace(exact, strips=1, sigma_s_px=0.001), CAMERAS, rng)
        ground = replace(strip.ground, cov_c=isotropic_covariance(strip.ground.u_c, 5e-8))
        strips = list(copies(replace(strip, ground=ground), 8, 2e-6, rng))
        nees.append(nees_of_estimate(calibrate_strips(strips, BOLD, settings)))
    low, high = chi2(df=3 * 20).ppf([0.0005, 0.9995]) / 20
    assert (low < np.mean(nees) < high) == honest  # eight times as many stars as there are: far too sure


def test_the_verdict_on_stars_is_consistent():
    strips = draw_sky_strips(replace(SKY, strips=4), CAMERAS, np.random.default_rng(8))
    estimate = calibrate_strips(strips, R_CS0, CalibrationSettings())
    assert not assess(estimate, strips).refuted_by
    of = estimate.targets
    assert np.isnan(of.detectable_m).all() and np.isfinite(of.detectable_rad).all()


GROUND = replace(SKY, strips=12, targets=6, exposures=5, sigma_c_px=0.3, orbit_bias_m=(3.0, -4.0, 0.0))
SLOW = replace(SKY, duration_s=7.2, exposures=19)  # a quarter of the imaging rate: the clock moves stars less


def mixed(seed, ground=GROUND):
    """Ground and sky strips of one camera."""
    rng = np.random.default_rng(seed)
    curve = DistortionCurve.draw(SKY, CAMERAS, rng)
    on_ground, _ = draw_strips(ground, CAMERAS, rng, curve=curve)
    of_sky = draw_sky_strips(SLOW, CAMERAS, rng, rates_rad_s=(0.0036, -0.0036), curve=curve)
    return on_ground + of_sky


def test_an_orbit_bias_of_5_m_is_recovered_beside_the_sky_though_2_m_were_stated():
    nees, bias, named = [], [], 0
    true = {"along": 3.0, "across": -4.0, "radial": 0.0, "clock": 0.0}
    for seed in range(8):  # forty in benchmarks/sky_campaigns.py
        strips = mixed(seed)
        estimate = calibrate_strips(strips, R_CS0, CalibrationSettings())
        nees.append(nees_of_estimate(estimate))
        found = estimate.bias
        assert found.names[:2] == ("along", "across")
        assert (found.sigma[:2] > 2.0 / np.sqrt(12.0)).all()  # m: the mean of 12 strips' own errors is in it
        error = found.value - [true[name] for name in found.names]
        bias.append(squared(error, found.covariance) * 2.0 / len(error))
        refuted = [check.kind for check in assess(estimate, strips).refuted_by]
        named += refuted == [CheckKind.ORBIT_BIAS]
    assert_chi_square(nees, 3)  # 0.9 to 6.7 a run
    assert_chi_square(bias, 2)  # 0.4 to 5.2 a run
    assert named >= 7


def test_without_a_bias_the_verdict_on_ground_and_sky_is_consistent():
    strips = mixed(7, replace(GROUND, orbit_bias_m=(0.0, 0.0, 0.0)))
    estimate = calibrate_strips(strips, R_CS0, CalibrationSettings())
    assert not assess(estimate, strips).refuted_by
    assert np.all(np.abs(estimate.bias.value) < 4.0 * estimate.bias.sigma)


def test_the_ground_alone_states_no_bias():
    ground = mixed(3)[: GROUND.strips]
    estimate = calibrate_strips(ground, R_CS0, CalibrationSettings())
    assert estimate.bias is None and not any(name.startswith("bias") for name in estimate.pairs.shared)
    assert len(assess(estimate, ground).checks) == 7


def test_biases_move_the_targets_as_the_physics_says():
    strip = mixed(4)[0]
    ground, settings = strip.ground, replace(NONE, sigma_position_m=2.0, sigma_clock_s=1e-4)
    columns = bias_columns(prepare_strip(strip, settings), settings)
    axes = strip.R_oi_targets.inv().as_matrix()  # columns: forward, right, down
    for n, axis_i in enumerate((axes[:, :, 0], axes[:, :, 1], -axes[:, :, 2])):
        # A stated position 2 m ahead: the true one is 2 m back, and the target lies further ahead from there.
        from_there = ground.range_m[:, None] * ground.u_i + 2.0 * axis_i
        from_there /= np.linalg.norm(from_there, axis=1, keepdims=True)
        there = replace(strip, ground=replace(ground, u_i=from_there))
        change = prepare_strip(there, settings).v_s - prepare_strip(strip, settings).v_s
        np.testing.assert_allclose(change, columns[:, :, n], rtol=0, atol=1e-5 * 2.0 / 530e3)
    # A row stated 0.1 ms late was seen 0.1 ms earlier: with the target and the orbital frame of then.
    late_s, t = 1e-4, ground.t_s
    j = np.argsort(t, kind="stable")
    turn = (strip.R_oi_targets[j[1:]] * strip.R_oi_targets[j[:-1]].inv()).as_rotvec()
    rate = np.median(turn / np.diff(t[j])[:, None], axis=0)  # rad/s, axes of the orbital frame
    earlier = ground.range_m[:, None] * ground.u_i + late_s * ground.v_rel_i
    earlier /= np.linalg.norm(earlier, axis=1, keepdims=True)
    there = replace(
        strip,
        ground=replace(ground, u_i=earlier, t_s=t - late_s),
        R_oi_targets=Rotation.from_rotvec(-late_s * rate) * strip.R_oi_targets,
    )
    change = prepare_strip(there, settings).v_s - prepare_strip(strip, settings).v_s
    size = np.linalg.norm(columns[:, :, 3], axis=1).max()
    # one in a hundred: noise of the attitudes between which the instant moves makes 0.0024
    np.testing.assert_allclose(change, columns[:, :, 3], rtol=0, atol=0.01 * size)


def test_a_star_of_a_scan_that_contradicts_the_others_is_rejected_as_a_star():
    first, second = draw_sky_strips(SKY, CAMERAS, np.random.default_rng(5), sigma_star_rad=0.02 * ARCSEC)
    u_c = first.ground.u_c.copy()
    u_c[3] = Rotation.from_rotvec([0.0, 2e-5, 1e-5]).apply(u_c[3])  # some 10 px
    wrong = replace(first, ground=replace(first.ground, u_c=u_c))
    estimate = calibrate_strips([wrong, second], R_CS0, CalibrationSettings())
    assert isinstance(estimate, InstallationEstimate)
    (rejected,) = [one for one in estimate.rejected if one.reason is Reason.TARGET_RESIDUAL]
    expected = Subject(
        Kind.STAR, strip=first.strip_id, ccd=int(first.ground.ccd[3]), id=str(first.ground.target_id[3])
    )
    assert rejected.subject == expected
    assert "from the position that the other stars predict" in rejected.text
