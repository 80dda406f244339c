"""The verdict: consistent campaigns pass, each input error that refutes itself is named."""

import dataclasses
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from drawn_campaigns import BOLD, CAMERAS, TABLE_1
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest, norm

from boresight.calib import verdict as rules
from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.finding import Finding
from boresight.calib.reliability import Reliability
from boresight.calib.settings import CalibrationSettings
from boresight.calib.verdict import CheckKind, Outcome, Suspect, VerdictSettings, assess, p_residuals
from boresight.geometry.attitude_estimate import with_attitudes
from boresight.simulator.campaign import draw_strips

PLAN = replace(TABLE_1, strips=3, exposures=8, sigma_target_m=0.5)
SIGMA_START = np.full(3, 3e-3)


def drawn(seed, **changes):
    return draw_strips(replace(PLAN, **changes), CAMERAS, np.random.default_rng(seed))[0]


def verdict_on(strips, settings=None, R_cs0=BOLD, limits=None):
    estimate = calibrate_strips(strips, R_cs0, settings or CalibrationSettings())
    assert isinstance(estimate, InstallationEstimate)
    return assess(estimate, strips, limits, sigma_installation_rad=SIGMA_START)


def check(verdict, kind):
    return next(c for c in verdict.checks if c.kind is kind)


@pytest.mark.parametrize("dof", [3, 40])
def test_errors_understated_or_overstated_by_what_is_tolerated_are_as_probable_as_exact_ones(dof):
    of = chi2(dof)
    for share in (0.001, 0.025, 0.4):
        # sigmas that are 1.2 times too small make chi2 1.2² times as large, 1.5 times too large 1.5² as small
        assert p_residuals(1.44 * of.isf(share), dof, 1.2, 1.5) == pytest.approx(2.0 * share)
        assert p_residuals(of.ppf(share) / 2.25, dof, 1.2, 1.5) == pytest.approx(2.0 * share)
        plain = [p_residuals(end, dof) for end in (of.isf(share), of.ppf(share))]
        assert plain == pytest.approx([2.0 * share] * 2)
    assert p_residuals(of.median(), dof, 1.2, 1.5) == 1.0 and np.isnan(p_residuals(1.0, 0))


def test_consistent_campaigns_are_consistent_and_their_p_values_uniform():
    exact = VerdictSettings(sigma_understated=1.0, sigma_overstated=1.0)
    p_values = {CheckKind.STAR_RESIDUALS: [], CheckKind.TARGET_RESIDUALS: [], CheckKind.BETWEEN_STRIPS: []}
    for seed in range(80):
        strips = drawn(seed)
        estimate = calibrate_strips(strips, BOLD, CalibrationSettings(robust=False))
        assert assess(estimate, strips, sigma_installation_rad=SIGMA_START).outcome is Outcome.CONSISTENT
        verdict = assess(estimate, strips, exact)
        for kind, values in p_values.items():
            values.append(check(verdict, kind).p_value)
    for kind, values in p_values.items():
        assert kstest(values, "uniform").pvalue > 1e-3, kind  # one in 300 for three kinds


@pytest.mark.parametrize("share", [0.0, 0.15])
def test_gross_target_errors_that_are_rejected_do_not_refute(share):
    for seed in range(10):
        assert verdict_on(drawn(seed, gross_targets=share, strips=6)).outcome is Outcome.CONSISTENT


def test_attitudes_that_are_far_worse_than_stated_are_refuted_by_the_targets_that_they_reject():
    """No star contradicts them: the head has solved them itself."""
    for seed in range(3):
        strips = with_attitudes(drawn(seed, sigma_s_px=0.3), CalibrationSettings().attitudes)
        stated = [replace(s.attitudes, covariance_s=1e-4 * s.attitudes.covariance_s) for s in strips]
        verdict = verdict_on([replace(s, attitudes=small) for s, small in zip(strips, stated)])
        failed = check(verdict, CheckKind.TARGETS_REJECTED)
        assert not failed.holds and Suspect.HEAD_NOISE in failed.look_at


def seen_by(strips, directions):
    """The strips with star directions computed from the centroids by another camera model."""

    def wrong(exposure):
        v = directions(exposure.xy_px)
        return replace(exposure, u_s=v / np.linalg.norm(v, axis=1, keepdims=True))

    return [replace(strip, exposures=tuple(map(wrong, strip.exposures))) for strip in strips]


def pinhole(focal=1.0, x0=0.0, y0=0.0, p1=0.0, p2=0.0):
    """Directions from pixels, with an error of focal length (factor), principal point (px) or distortion."""

    def directions(xy_px):
        x, y = ((xy_px - [x0, y0]) * CAMERAS.star_pixel_rad / focal).T
        r2 = x * x + y * y
        dx, dy = 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.column_stack([-(x + dx), -(y + dy), np.ones(len(x))])

    return directions


@pytest.mark.parametrize(
    "error", [{}, {"p1": 2e-4}, {"p2": -2e-4}, {"focal": 1.0005}, {"x0": 24.0}, {"y0": -24.0}]
)
def test_a_wrong_star_camera_is_refuted_by_its_stars(error):
    for seed in range(3):
        verdict = verdict_on(seen_by(drawn(seed), pinhole(**error)))
        if not error:
            assert verdict.outcome is Outcome.CONSISTENT  # the pinhole model is that of the draws
            continue
        assert verdict.outcome is Outcome.REFUTED
        assert verdict.refuted_by[0].look_at[0] is Suspect.STAR_CAMERA_MODEL
        failed = {c.kind for c in verdict.refuted_by}
        assert CheckKind.STAR_RESIDUALS in failed or CheckKind.STARS_REJECTED in failed


def test_position_errors_five_times_the_stated_ones_are_refuted():
    found = [verdict_on(drawn(seed, sigma_position_m=10.0, strips=6)) for seed in range(20)]
    refuted = [v for v in found if v.outcome is Outcome.REFUTED]
    assert len(refuted) >= 19
    for verdict in refuted:
        assert Suspect.ORBIT in verdict.refuted_by[0].look_at
    between = [check(v, CheckKind.BETWEEN_STRIPS) for v in found]
    assert np.mean([not c.holds for c in between]) >= 0.9
    assert {c.n for c in between} == {15}


def test_the_strip_that_disagrees_with_the_others_is_named():
    for seed in range(5):
        strips = drawn(seed, strips=6)
        late = strips[seed]
        turn = Rotation.from_rotvec([0.0, 5e-5, 0.0])  # 26 m along the track: 13 sigma
        strips[seed] = replace(late, ground=replace(late.ground, u_c=turn.apply(late.ground.u_c)))
        found = check(verdict_on(strips), CheckKind.BETWEEN_STRIPS)
        assert not found.holds and found.names == ((late.strip_id,),)


def test_no_strip_is_named_by_a_check_beside_a_cause_that_refutes():
    strips = drawn(1, strips=6)
    turn = Rotation.from_rotvec([0.0, 5e-5, 0.0])
    strips[2] = replace(strips[2], ground=replace(strips[2].ground, u_c=turn.apply(strips[2].ground.u_c)))
    estimate = calibrate_strips(strips, BOLD, CalibrationSettings())
    cause = Finding(cause="clock of the exposures", item="all exposures", text="60 ms late.", refutes=True)
    verdict = assess(estimate, strips, reliability=Reliability((), (cause,), ()))
    assert check(verdict, CheckKind.BETWEEN_STRIPS).names == ()
    assert check(assess(estimate, strips), CheckKind.BETWEEN_STRIPS).names != ()


def repeated(strip, times):
    """Each target listed `times` times under other ids, with the same measurements."""
    rows = np.tile(np.arange(len(strip.ground.t_s)), times)
    ground = strip.ground.take(rows)
    ids = np.array([f"{i}-{n}" for n, i in enumerate(ground.target_id)])
    return replace(strip, ground=replace(ground, target_id=ids), R_oi_targets=strip.R_oi_targets[rows])


def test_targets_listed_many_times_are_named():
    verdict = verdict_on([repeated(strip, 21) for strip in drawn(4)])
    assert verdict.refuted_by[0].kind is CheckKind.DUPLICATED_TARGETS
    names = verdict.refuted_by[0].names
    assert len(names) == 36 and {len(group) for group in names} == {21}
    assert verdict.refuted_by[0].look_at == (Suspect.TARGET_LIST,)


def test_residuals_much_smaller_than_stated_are_a_caution_and_do_not_refute():
    strips = drawn(4, targets=60, sigma_target_m=0.0, sigma_vibration_rad=0.0)
    stated = [replace(s, ground=replace(s.ground, cov_c=25.0 * s.ground.cov_c)) for s in strips]
    verdict = verdict_on(stated, CalibrationSettings(sigma_vibration_rad=0.0))
    (small,) = verdict.cautions
    assert small.kind is CheckKind.TARGET_RESIDUALS and small.statistic < 0.2 * small.n
    assert not small.holds and Suspect.NOT_INDEPENDENT in small.look_at
    assert verdict.outcome is Outcome.CONSISTENT and verdict.refuted_by == ()
    too_large = [replace(s, ground=replace(s.ground, cov_c=s.ground.cov_c / 25.0)) for s in strips]
    assert verdict_on(too_large, CalibrationSettings(sigma_vibration_rad=0.0)).cautions == ()


def test_a_check_of_nothing_is_not_applicable_and_is_not_counted_as_held():
    verdict = verdict_on(drawn(2, strips=1))
    between = check(verdict, CheckKind.BETWEEN_STRIPS)
    assert between.n == 0 and np.isnan([between.p_value, between.p_plain]).all()
    assert not between.holds and not between.fails and between not in verdict.refuted_by
    n = len(verdict.checks)
    assert verdict.sentence == f"consistent: {n - 1} of {n - 1} checks hold, 1 not applicable"


def test_residuals_6_sigma_too_small_have_that_plain_p_within_the_tolerance_or_not():
    variance = 2.0 / (9.0 * 4422)  # of the cube root of chi2 / dof (Wilson & Hilferty 1931): good to 5 %
    z = (np.cbrt(3831.0 / 4422) - 1.0 + variance) / np.sqrt(variance)
    assert p_residuals(3831.0, 4422) == pytest.approx(2.0 * norm.cdf(z), rel=0.05)
    assert p_residuals(3831.0, 4422, 1.1, 2.0) == 1.0
    assert np.isnan(p_residuals(0.0, 0))


def test_one_target_listed_twice_is_found_where_its_two_matches_differ_by_rows():
    strips = drawn(4)
    ground = strips[1].ground
    later = 3e-4  # s: four rows; the satellite moves 2 m
    place = ground.range_m[2] * ground.u_i[2] - later * ground.v_rel_i[2]
    names = {f.name for f in dataclasses.fields(ground)} - {"references"}
    fields = {name: getattr(ground, name).copy() for name in names}
    fields["t_s"][3], fields["range_m"][3] = ground.t_s[2] + later, np.linalg.norm(place)
    fields["u_i"][3], fields["v_rel_i"][3] = place / np.linalg.norm(place), ground.v_rel_i[2]
    strips[1] = replace(strips[1], ground=type(ground)(**fields))
    estimate = calibrate_strips(strips, BOLD, CalibrationSettings())
    (names,) = check(assess(estimate, strips), CheckKind.DUPLICATED_TARGETS).names
    assert names == ("strip0001/002", "strip0001/003")


def test_a_matrix_far_from_the_one_of_the_ground_is_refuted():
    far = Rotation.from_rotvec([0.06, 0.0, 0.0]) * BOLD
    verdict = verdict_on(drawn(5), R_cs0=far)
    assert [c.kind for c in verdict.refuted_by] == [CheckKind.START_MATRIX]
    assert verdict.refuted_by[0].statistic == pytest.approx(400.0, rel=0.01)  # (60 mrad / 3 mrad)²


def test_an_estimate_that_has_not_converged_is_refuted():
    strips = drawn(6)
    far = Rotation.from_rotvec([0.004, 0.0, 0.0]) * BOLD
    settings = CalibrationSettings(most_iterations=1, robust=False)
    assert CheckKind.CONVERGENCE in {c.kind for c in verdict_on(strips, settings, far).refuted_by}


def test_agreement_between_strips_is_what_separate_matrices_gain():
    strips = drawn(7, strips=2)
    settings = CalibrationSettings(sigma_distortion_rad=0.0, robust=False)
    both = calibrate_strips(strips, BOLD, settings)
    alone = [calibrate_strips([strip], BOLD, settings) for strip in strips]
    gain = both.chi2 - sum(one.chi2 for one in alone)
    found = check(assess(both, strips), CheckKind.BETWEEN_STRIPS)
    assert found.n == 3 and found.statistic == pytest.approx(gain, rel=1e-2)  # second order in arcseconds
    drawn_chi2 = (1.1 * np.random.default_rng(1).normal(size=(400_000, 3))) ** 2  # errors may be 10 % larger
    share = np.mean(drawn_chi2.sum(axis=1) > found.statistic)
    assert found.p_value == pytest.approx(share, abs=4.0 * np.sqrt(share / 400_000) + 1e-5)


def test_weakest_axis_is_that_of_the_largest_variance():
    strips = drawn(8)
    estimate = calibrate_strips(strips, BOLD, CalibrationSettings())
    verdict = assess(estimate, strips)
    axis = verdict.weakest_axis_c
    assert verdict.weakest_sigma_rad == pytest.approx(np.sqrt(axis @ estimate.cov_theta @ axis))
    assert verdict.weakest_sigma_rad >= estimate.sigma_theta.max()


def test_of_causes_of_a_bias_the_first_is_told_and_of_heads_the_one_of_the_least_likely_check():
    bias = SimpleNamespace(names=("clock", "along", "up"), value=[9.0, -4.0, 6.0], sigma=[0.1, 1.0, 2.0])
    failed = SimpleNamespace(kind=CheckKind.ORBIT_BIAS, fails=True, p_value=1e-9)
    others = [SimpleNamespace(field=f"f{n}", file="dump.toml", cause="c", item=f"i{n}") for n in range(2)]
    (told,) = rules._orbit_finding(SimpleNamespace(bias=bias), [failed], others, "targets.csv")
    assert told.text.endswith("in targets.csv; or f0 in dump.toml.") and told.rivals == ("c, i0",)
    assert (told.value, told.sigma) == (-4.0, 1.0)  # m: 4 sigma and 3; the clock is not of the orbit
    checks = [SimpleNamespace(names=((f"h{p}",),), p_value=p, statistic=9.0, expected=3.0) for p in (2, 1, 3)]
    assert [one.subjects[0].head for one in rules._head_findings(checks)] == ["h1"]
