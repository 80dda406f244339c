"""Data snooping: it ends, whatever the order; its limit, power and minimal detectable bias are as stated."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from drawn_campaigns import BOLD, CAMERAS, TABLE_1

from boresight.calib import gross_errors
from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.gross_errors import rejection_test, snoop
from boresight.calib.joint_solution import (
    Linearised,
    Problem,
    linearised,
    readmitted,
    solve_weighted,
    squared_mahalanobis,
)
from boresight.calib.rejection import _targets
from boresight.calib.settings import CalibrationSettings
from boresight.calib.strips import prepare_strip
from boresight.records.ledger import Kind, Reason, Subject
from boresight.simulator.campaign import draw_strips

PIXEL_RAD = CAMERAS.pixel_rad
PLAN = replace(TABLE_1, strips=3)
SETTINGS = CalibrationSettings()


def shifted(strips, s, j, shift_rad):
    """The strips with the measured direction of target j of strip s moved along x and y of frame c."""
    u_c = strips[s].ground.u_c.copy()
    u_c[j, :2] += shift_rad
    u_c[j] /= np.linalg.norm(u_c[j])
    return [replace(p, ground=replace(p.ground, u_c=u_c)) if n == s else p for n, p in enumerate(strips)]


def reordered(strip, order):
    return replace(strip, ground=strip.ground.take(order), R_oi_targets=strip.R_oi_targets[order])


def rejected(estimate):
    assert isinstance(estimate, InstallationEstimate)
    return {(r.subject.strip, r.subject.id) for r in estimate.rejected if r.reason is Reason.TARGET_RESIDUAL}


def test_rejected_targets_depend_neither_on_order_nor_on_the_iteration_limit():
    rng, found = np.random.default_rng(6), 0
    for trial in range(12):
        strips = draw_strips(replace(PLAN, gross_targets=0.06, gross_reach_px=4.0), CAMERAS, rng)[0]
        strips = shifted(strips, 1, trial, PIXEL_RAD * rng.uniform(-1.5, 1.5, 2))
        one = rejected(calibrate_strips(strips, BOLD, SETTINGS))
        found += len(one)
        other = [reordered(strip, rng.permutation(12)) for strip in strips]
        assert rejected(calibrate_strips(other, BOLD, SETTINGS)) == one
        for most in (6, 7, 21):
            assert rejected(calibrate_strips(strips, BOLD, replace(SETTINGS, most_iterations=most))) == one
    assert found > 15  # of 12 shifted ones and 26 drawn


def criterion(problem, about, kept, limit):
    return solve_weighted(problem, about, kept.astype(float)).chi2 + limit * np.sum(problem.inside & ~kept)


@pytest.mark.parametrize("seed", range(4))
def test_search_ends_where_no_single_change_is_better_from_any_start(seed):
    rng = np.random.default_rng(seed)
    plan = replace(PLAN, gross_targets=0.1, gross_reach_px=3.0)
    strips, _ = draw_strips(plan, CAMERAS, rng)
    problem = Problem.of([prepare_strip(strip, SETTINGS) for strip in strips], SETTINGS)
    about, limit = linearised(problem, BOLD), rejection_test(1e-3).limit
    for start in (problem.inside, rng.random(36) < 0.5, rng.random(36) < 0.8):
        kept = snoop(problem, about, start, limit).weight == 1.0
        best = criterion(problem, about, kept, limit)
        assert best <= criterion(problem, about, start, limit)
        statistic = squared_mahalanobis(solve_weighted(problem, about, kept.astype(float)))
        assert np.all(statistic[kept] < limit * (1 + 1e-5)) and np.all(statistic[~kept] > limit * (1 - 1e-5))
        for j in range(36):
            other = kept.copy()
            other[j] = not kept[j]
            assert criterion(problem, about, other, limit) > best - 1e-5 * limit


def test_good_targets_rejected_in_place_of_their_neighbour_are_exchanged():
    noisy_stars = replace(PLAN, strips=1, sigma_s_px=2.0)
    (strip,) = draw_strips(noisy_stars, CAMERAS, np.random.default_rng(3))[0]
    strip = reordered(strip, np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9]))  # three at one place and instant
    ids = np.array([f"t{n:02d}" for n in range(12)])
    strip = replace(strip, ground=replace(strip.ground, target_id=ids))
    (wrong,) = shifted([strip], 0, 10, np.array([1.2e-5, 1.2e-5]))
    problem = Problem.of([prepare_strip(wrong, SETTINGS)], SETTINGS)
    about, limit = linearised(problem, BOLD), rejection_test(1e-3).limit
    start = problem.inside.copy()
    start[[9, 11]] = False
    alone = squared_mahalanobis(solve_weighted(problem, about, start.astype(float)))
    assert alone[10] < limit < min(alone[9], alone[11])  # no single rejection or re-admission is better
    assert np.flatnonzero(snoop(problem, about, start, limit).weight == 0.0).tolist() == [10]


def test_the_minimal_detectable_bias_of_a_target_does_not_depend_on_its_being_rejected():
    """It is that of a target which all others predict. 1e-3: the matrix about which they do is another."""
    strips = draw_strips(PLAN, CAMERAS, np.random.default_rng(21))[0]
    plain = calibrate_strips(strips, BOLD, SETTINGS)
    for s, j in ((0, 2), (1, 11), (2, 5)):
        wrong = calibrate_strips(shifted(strips, s, j, [40.0 * PIXEL_RAD, 0.0]), BOLD, SETTINGS)
        row = 12 * s + j
        assert not wrong.targets.kept[row] and plain.targets.kept[row]
        same = np.delete(np.arange(36), row)
        np.testing.assert_array_equal(wrong.targets.kept[same], plain.targets.kept[same])
        assert wrong.targets.detectable_rad[row] == pytest.approx(plain.targets.detectable_rad[row], rel=1e-3)
        # the others are controlled by one less
        assert np.all(wrong.targets.detectable_rad[same] > (1.0 - 1e-3) * plain.targets.detectable_rad[same])


def test_minimal_detectable_bias_has_the_stated_power():
    strips, _ = draw_strips(PLAN, CAMERAS, np.random.default_rng(8))
    plain = replace(SETTINGS, robust=False)
    at = calibrate_strips(strips, BOLD, plain)
    test = rejection_test(SETTINGS.probability_false_alarm)
    for row in (0, 17, 30):
        s, j, size = row // 12, row % 12, at.targets.detectable_rad[row]
        gains = []
        for axis in ([1.0, 0.0], [0.0, 1.0], [np.sqrt(0.5), np.sqrt(0.5)]):
            both = [shifted(strips, s, j, sign * size * np.array(axis)) for sign in (1.0, -1.0)]
            statistic = [calibrate_strips(data, BOLD, plain).targets.statistic[row] for data in both]
            gains.append(np.mean(statistic) - at.targets.statistic[row])  # the odd part, noise, cancels
        x, y, both = gains
        least = np.linalg.eigvalsh([[x, both - 0.5 * (x + y)], [both - 0.5 * (x + y), y]])[0]
        assert least == pytest.approx(test.noncentrality, rel=1e-3)  # second order in 1e-5 rad
        assert at.targets.detectable_m[row] == pytest.approx(size * strips[s].ground.range_m[j])


def test_power_and_false_alarm_rate_of_the_test_are_those_of_the_chi_square():
    test, rng = rejection_test(1e-3), np.random.default_rng(1)
    shift = np.array([np.sqrt(test.noncentrality), 0.0])
    draws = np.sum((rng.standard_normal((400_000, 2)) + shift) ** 2, axis=1)
    assert np.mean(draws > test.limit) == pytest.approx(0.8, abs=0.003)  # 4 sigma of 400 000 draws
    good = np.max(np.sum(rng.standard_normal((20_000, 36, 2)) ** 2, axis=2), axis=1)
    assert np.mean(good > test.limit) == pytest.approx(1.0 - 0.999**36, abs=0.0055)  # 4 sigma


def test_where_neighbours_look_alike_the_shifted_target_is_rejected_or_named():
    """4 px is little more than what is detectable here. Of 40 000 such cases drawn with the same design, a
    neighbour that shares exposures is rejected in 1.7 %: more than 3 of 36 have a chance of 0.3 %. From 20 px
    on there is no doubt."""
    strips = draw_strips(PLAN, CAMERAS, np.random.default_rng(34))[0]
    assert not rejected(calibrate_strips(strips, BOLD, SETTINGS))
    rng, doubtful, others = np.random.default_rng(2), 0, 0
    for s, j in [(s, j) for s in range(3) for j in range(12)]:
        angle = rng.uniform(0.0, 2.0 * np.pi)
        axis = PIXEL_RAD * np.array([np.cos(angle), np.sin(angle)])
        culprit = (strips[s].strip_id, str(strips[s].ground.target_id[j]))
        estimate = calibrate_strips(shifted(strips, s, j, 4.0 * axis), BOLD, SETTINGS)
        instead = [
            entry
            for entry in estimate.rejected
            if entry.subject.kind is Kind.TARGET and entry.subject.id != culprit[1]
        ]
        assert all(culprit in [(each.strip, each.id) for each in entry.rivals] for entry in instead)
        assert all(
            culprit in [(each.strip, each.id) for each in group] for group in estimate.targets.doubtful
        )
        doubtful += len(estimate.targets.doubtful)
        others += bool(instead)
    assert doubtful >= 1 and others <= 3
    estimate = calibrate_strips(shifted(strips, s, j, 20.0 * axis), BOLD, SETTINGS)
    assert culprit in rejected(estimate) and not estimate.targets.doubtful


def likelihood_of_any_error(problem, about, whole, row):
    """Likelihood of a wrong target, summed over the two components of its error (rad²), all unknowns solved
    for each.
    """
    (line,), every = about.strips, np.ones(36)
    root = np.linalg.cholesky(np.linalg.inv(whole.variance[row]))  # of the error, in units of its noise
    best, total = np.linalg.solve(whole.variance[row], whole.whitened[row]), 0.0
    for z in np.stack(np.meshgrid(*[np.arange(-4.0, 4.1)] * 2), axis=-1).reshape(-1, 2):
        r = line.r.reshape(36, 2).copy()
        r[row] -= best + root @ z
        moved = Linearised(about.R_cs, [replace(line, r=r.reshape(line.r.shape))])
        total += np.exp(0.5 * (whole.chi2 - solve_weighted(problem, moved, every).chi2))
    return total * np.linalg.det(root) / np.linalg.det(whole.whitener[row])


def test_targets_that_contradict_each_other_have_the_weight_that_their_probabilities_give():
    """The error of a target looks like that of its neighbour, which less controls: whatever its size, the
    neighbour explains the residuals better than the likelihoods of the best errors say."""
    strips = draw_strips(PLAN, CAMERAS, np.random.default_rng(34))[0]
    axis = PIXEL_RAD * np.array([np.cos(np.pi / 3), np.sin(np.pi / 3)])
    wrong = shifted(strips, 1, 3, 4.0 * axis)
    estimate, (first, other) = calibrate_strips(wrong, BOLD, SETTINGS), (15, 16)
    problem = Problem.of([prepare_strip(strip, SETTINGS) for strip in wrong], SETTINGS)
    about, every = linearised(problem, estimate.R_cs), np.ones(36)
    whole = solve_weighted(problem, about, every)
    falls = whole.chi2 - np.array([solve_weighted(problem, about, every - unit).chi2 for unit in np.eye(36)])
    odds = np.divide(*(likelihood_of_any_error(problem, about, whole, row) for row in (first, other)))
    assert 1.0 < odds < 2.0 < 7.0 / 3.0 < np.exp(0.5 * (falls[first] - falls[other]))  # 0.7 between
    good = np.array([1.0, odds]) / (1.0 + odds)  # probability that each of the two is good
    expected = every.copy()
    expected[[first, other]] = good * estimate.rejection.limit / falls[[first, other]]
    np.testing.assert_allclose(estimate.targets.weight, expected, rtol=1e-3)  # sums over steps of one sigma
    ((first_target, second_target),) = estimate.targets.doubtful
    assert {first_target.id, second_target.id} == {"strip0001/003", "strip0001/004"}
    assert first_target.strip == second_target.strip == "strip0001"
    assert not rejected(estimate) and (estimate.n_targets, estimate.dof) == (36, 2 * 35 - 3)
    assert np.all(np.diag(estimate.cov_theta) > np.diag(whole.solution.covariance))


def test_statistics_with_a_target_re_admitted_are_those_of_a_new_solution():
    rng = np.random.default_rng(1)
    strips, _ = draw_strips(replace(PLAN, gross_targets=0.1, gross_reach_px=3.0), CAMERAS, rng)
    problem = Problem.of([prepare_strip(strip, SETTINGS) for strip in strips], SETTINGS)
    about, kept = linearised(problem, BOLD), rng.random(36) < 0.7
    step, rows = solve_weighted(problem, about, kept.astype(float)), np.flatnonzero(~kept)
    for row, (statistic, variance) in zip(rows, readmitted(step, rows), strict=True):
        more = kept | (np.arange(36) == row)
        anew = solve_weighted(problem, about, more.astype(float))
        assert statistic == pytest.approx(squared_mahalanobis(anew), rel=1e-8)  # same formula, other rounding
        np.testing.assert_allclose(variance, anew.variance, atol=1e-10)


def test_search_is_short_where_the_stated_errors_are_far_too_small(monkeypatch):
    rng = np.random.default_rng(5)
    strips, _ = draw_strips(replace(PLAN, targets=60, sigma_target_m=0.0), CAMERAS, rng)
    stated = [replace(one, ground=replace(one.ground, cov_c=one.ground.cov_c / 400.0)) for one in strips]
    settings = CalibrationSettings(
        sigma_position_m=0.0, sigma_clock_s=0.0, sigma_vibration_rad=0.0, sigma_distortion_rad=0.0
    )
    problem = Problem.of([prepare_strip(one, settings) for one in stated], settings)
    solved, of = [], gross_errors.solve_weighted
    monkeypatch.setattr(gross_errors, "solve_weighted", lambda *a: solved.append(a) or of(*a))
    test = rejection_test(1e-3)
    kept = snoop(problem, linearised(problem, BOLD), problem.inside, test.limit).weight
    assert np.mean(kept) < 2.0 / 3.0
    assert len(solved) < 2 * 60  # one by one to a third of the targets, then all that fail at once


def test_a_target_that_loses_all_weight_to_another_is_listed_without_rivals():
    """The search notes rivals of those that it rejects; a kept one may lose all weight beside one of them."""
    own = np.array(["s1", "s1"])
    lost = SimpleNamespace(
        strip_id=own, kept=np.array([True, False]), rivals={}, statistic=np.array([1.0, 30.0])
    )
    lost.subject = lambda row: Subject(Kind.TARGET, strip="s1", id=f"t{row}")
    ready = SimpleNamespace(strip=own, inside=np.ones(2, dtype=bool))
    (entry,) = _targets("s1", ready, 20.0, lost)
    assert (entry.subject.id, entry.reason, entry.rivals) == ("t1", Reason.TARGET_RESIDUAL, ())
