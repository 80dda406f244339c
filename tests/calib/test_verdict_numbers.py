"""p-values and limits of the verdict against draws and against the statements that they make."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from drawn_campaigns import BOLD
from scipy.stats import binom, chi2, norm

from boresight.calib.calibration import calibrate_strips
from boresight.calib.error_table import CommonBias
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.heads import WithoutHead
from boresight.calib.settings import CalibrationSettings
from boresight.calib.verdict import Check, CheckKind, VerdictSettings, _excess, assess
from boresight.geometry.sightings import StripSightings
from boresight.records.ledger import Entry, Kind, Reason, Subject
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips

DRAWS = 400_000
# Square roots of covariances in which every element differs and the correlations are 0.5 to 0.9.
ROOT_THETA = np.array([[3.0, 0.0, 0.0], [-2.0, 1.0, 0.0], [4.0, 1.5, 2.5]]) * 1e-5  # rad
ROOT_BIAS = np.array([[2.0, 0.0, 0.0], [1.5, 0.8, 0.0], [3e-5, -1e-5, 2e-5]])  # m, m, s


@cache
def drawn() -> tuple[tuple[StripSightings, ...], InstallationEstimate]:
    plan = StripPlan(strips=3, exposures=8)
    strips = tuple(draw_strips(plan, CameraPair(BOLD), np.random.default_rng(4))[0])
    estimate = calibrate_strips(strips, BOLD, CalibrationSettings())
    assert isinstance(estimate, InstallationEstimate)
    return strips, estimate


def check(kind: CheckKind, sigma_rad: float = 3e-3, **changes: object) -> Check:
    strips, estimate = drawn()
    verdict = assess(
        replace(estimate, **changes),
        strips,
        sigma_installation_rad=np.full(3, sigma_rad),  # type: ignore[arg-type]
    )
    return next(one for one in verdict.checks if one.kind is kind)


def share_beyond(statistic: float, dof: int, factor: float) -> tuple[float, float]:
    """Share of draws, errors `factor` times as large as stated, beyond a statistic; four sigmas of it."""
    z = factor * np.random.default_rng(8).standard_normal((DRAWS, dof))
    share = float(np.mean((z**2).sum(axis=1) > statistic))
    return share, 4.0 * np.sqrt(share / DRAWS)


@pytest.mark.parametrize("rate", [1e-4, 0.03])
def test_all_checks_together_refute_consistent_data_at_the_stated_rate(rate: float) -> None:
    strips, estimate = drawn()
    limits = VerdictSettings(probability_false_alarm=rate)
    verdict = assess(estimate, strips, limits, sigma_installation_rad=np.full(3, 3e-3))
    assert len(verdict.checks) == 8 and sum(one.limit for one in verdict.checks) == pytest.approx(rate)
    fewer = assess(estimate, strips, limits)  # the check that is not made takes its share with it
    assert len(fewer.checks) == 7 and sum(one.limit for one in fewer.checks) <= rate


def test_distance_from_the_start_is_in_the_whole_covariance() -> None:
    z = np.array([2.0, -3.0, 3.5])  # its independent errors, in sigmas
    found = check(CheckKind.START_MATRIX, 1e-12, theta=ROOT_THETA @ z, cov_theta=ROOT_THETA @ ROOT_THETA.T)
    assert found.statistic == pytest.approx(z @ z, rel=1e-6) and found.n == 3
    share, four = share_beyond(z @ z, 3, 2.0)  # the start's sigma may be half the true one
    assert found.p_value == pytest.approx(share, abs=four)


def test_bias_of_the_orbit_is_tested_in_its_covariance_without_the_clock() -> None:
    z = np.array([2.0, -1.0, 9.0])
    bias = CommonBias(
        names=("along", "across", "clock"),
        value=ROOT_BIAS @ z,
        covariance=ROOT_BIAS @ ROOT_BIAS.T,
        stated=np.array([2.0, 2.0, 1e-4]),
    )
    found = check(CheckKind.ORBIT_BIAS, bias=bias)
    assert found.n == found.expected == 2 and found.statistic == pytest.approx(5.0)  # 2² + 1²
    share, four = share_beyond(5.0, 2, 1.1)
    assert found.p_value == pytest.approx(share, abs=four)
    assert [name for (name,) in found.names] == ["along +4 ± 2 m", "across +2.2 ± 1.7 m"]


@pytest.mark.parametrize(("statistic", "dof"), [(30.0, 12), (60.0, 40), (150.0, 200)])
def test_heads_are_compared_by_a_normal_deviate_as_likely_as_their_chi_square(statistic, dof):
    found = _excess(WithoutHead(head="", chi2=statistic, dof=dof))
    assert found == pytest.approx(norm.isf(chi2(dof).sf(statistic)), abs=0.02)  # of an approximation


def test_many_rejected_targets_have_the_probability_of_as_many_or_more() -> None:
    _, estimate = drawn()
    one = next(iter(estimate.rejected), None)
    assert one is None  # else the count below is not that of this test
    rejected = tuple(_rejected(n) for n in range(7))
    found = check(CheckKind.TARGETS_REJECTED, rejected=rejected, n_targets=23)
    # 7 or more of 30 where each is wrong with a probability of 0.15
    assert found.statistic == 7 and found.n == 30 and found.expected == pytest.approx(4.5)
    assert found.p_value == pytest.approx(sum(binom.pmf(k, 30, 0.15) for k in range(7, 31)))


def _rejected(n: int) -> Entry:
    return Entry(Subject(Kind.TARGET, strip="s", id=f"t{n}"), Reason.TARGET_RESIDUAL)
