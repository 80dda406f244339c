"""Several heads at once, with errors as real star trackers have: honest covariances, the bad one named."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from drawn_campaigns import assert_chi_square, nees_of_estimate, squared
from drawn_heads import HeadPlan, with_heads
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.heads import carried, measured_alignment
from boresight.calib.settings import CalibrationSettings
from boresight.calib.verdict import assess
from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.geometry.sightings import HeadAttitudes, StripSightings
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips

R_A = Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True)
R_B = Rotation.from_euler("xyz", [-75.0, 20.0, 35.0], degrees=True)
R_C = Rotation.from_euler("xyz", [155.0, 15.0, -70.0], degrees=True)
SHAKEN = Rotation.from_rotvec([2e-3, -1e-3, 3e-3])  # by the launch
PLAN = StripPlan(strips=2, sigma_position_m=2.0, sigma_clock_s=1e-4, sigma_vibration_rad=0.1 * ARCSEC)
SETTINGS = CalibrationSettings(sigma_distortion_rad=0.0)
RUNS = 24


def noise(
    white: list[float], correlated: list[float], time_s: list[float], constant: list[float]
) -> AttitudeNoise:
    return AttitudeNoise(
        white_rad=np.array(white) * ARCSEC,
        correlated_rad=np.array(correlated) * ARCSEC,
        correlation_time_s=np.array(time_s),
        constant_rad=np.array(constant) * ARCSEC,
    )


# Arc-seconds and seconds, as of the two trackers of Sentinel-2A (10 Hz, z along the line of sight).
NOISE_A = noise([0.6, 0.9, 6.0], [0.4, 0.7, 4.7], [0.5, 0.8, 1.2], [0.3, 0.3, 2.3])
NOISE_B = noise([0.9, 0.7, 6.8], [0.7, 0.35, 4.9], [1.2, 0.4, 0.9], [0.3, 0.4, 2.2])


@cache
def flown(
    seed: int,
    heads: int,
    wrong_arcsec: tuple[float, float] = (0.0, 0.0),
    count: int = PLAN.strips,
    step_s: float = 0.1,
) -> tuple[StripSightings, ...]:
    """So many strips: of two, as many errors of the matrix are drawn as of more."""
    a, b = (wrong * ARCSEC for wrong in wrong_arcsec)
    plans = [
        HeadPlan("A", R_A, NOISE_A, step_s=step_s, wrong_rad=a),
        HeadPlan("B", R_B, NOISE_B, step_s=step_s, shift_s=0.033, wrong_rad=b),
    ]
    return tuple(seen_by(plans[:heads], replace(PLAN, strips=count), np.random.default_rng(seed)))


def seen_by(heads: Sequence[HeadPlan], plan: StripPlan, rng: np.random.Generator) -> list[StripSightings]:
    """Strips with the attitudes of heads, whose alignment is stated as it was before the launch."""
    strips, truth = draw_strips(plan, CameraPair(R_A), rng)
    alignment = [SHAKEN * R_A.inv() * head.R_ch for head in heads[1:]]
    return with_heads(strips, truth, heads, alignment, plan.duration_s, rng)


def estimated(strips: Sequence[StripSightings]) -> InstallationEstimate:
    estimate = calibrate_strips(strips, SHAKEN * R_A, SETTINGS)
    assert isinstance(estimate, InstallationEstimate)
    return estimate


def nees_of_heads(estimate: InstallationEstimate) -> float:
    """The squared error of the matrices of all heads."""
    errors = [theta_between(one.R_cs, R) for one, R in zip(estimate.heads, (R_A, R_B, R_C))]
    return squared(np.concatenate(errors), estimate.cov_heads)


@pytest.mark.parametrize("heads", [1, 2])
def test_covariance_of_all_heads_holds_with_coloured_noise(heads: int) -> None:
    nees, agreement, dof = 0.0, 0.0, 0
    for seed in range(RUNS):
        estimate = estimated(flown(seed, heads))
        nees += nees_of_heads(estimate)
        agreement, dof = agreement + estimate.agreement.chi2, dof + estimate.agreement.dof
    assert_chi_square(nees, 3 * heads * RUNS)
    if heads == 2:  # differences of the heads by themselves: 0.1 % two-sided. The motion between the rows is
        # estimated from the same rows and takes 2 % of the squares (1.7 to 3.1 % in six draws of 40 runs).
        assert chi2(df=0.98 * dof).ppf(0.0005) < agreement < chi2(df=dof).ppf(0.9995)


@pytest.mark.parametrize("heads", [1, 2])
def test_two_rows_a_strip_do_not_show_how_the_satellite_moves_between_them(heads: int) -> None:
    """Waves of 3 s, up to twice the assumed motion: the squares stay below the upper limit of 0.1 %."""
    between = PLAN.duration_s + 0.8
    plan = replace(PLAN, exposures=2, wave_s=(3.0, 3.1))
    nees = 0.0
    for seed in range(RUNS):
        plans = [HeadPlan("A", R_A, NOISE_A, step_s=between), HeadPlan("B", R_B, NOISE_B, step_s=between)]
        rows = seen_by(plans[:heads], plan, np.random.default_rng([2, seed]))
        estimate = calibrate_strips(rows, SHAKEN * R_A, replace(SETTINGS, sigma_motion_rad=6.0 * ARCSEC))
        assert isinstance(estimate, InstallationEstimate)
        nees += nees_of_estimate(estimate, R_A)
    assert nees < chi2(df=3 * RUNS).ppf(0.9995)


SLOW = {  # errors that go on from one strip to the next, which begin 62 s apart
    "correlated over 100 s": {"correlated_rad": [3.0, 3.0, 8.0], "correlation_time_s": [100.0] * 3},
    "correlated over 20 minutes": {"correlated_rad": [3.0, 2.0, 8.0], "correlation_time_s": [1200.0] * 3},
    "constant over a strip": {"constant_rad": [3.0, 2.0, 8.0], "constant_time_s": [400.0, 100.0, 1e5]},
    "comes back with every orbit": {"periodic_rad": [6.0, 4.0, 12.0], "period_s": 350.0, "harmonics": 2},
}


@pytest.mark.parametrize(
    ("slow", "heads"), [*((slow, 2) for slow in SLOW), *((slow, 1) for slow in list(SLOW)[2:])]
)
def test_covariance_holds_with_errors_of_heads_that_outlast_a_strip(slow: str, heads: int) -> None:
    stated = {key: np.multiply(v, ARCSEC if key.endswith("rad") else 1) for key, v in SLOW[slow].items()}
    plans = [
        HeadPlan(name, R, replace(of_head, **stated), step_s=0.2, shift_s=shift)
        for name, R, of_head, shift in (("A", R_A, NOISE_A, 0.0), ("B", R_B, NOISE_B, 0.033))
    ]
    nees = 0.0
    for seed in range(RUNS):
        nees += nees_of_heads(estimated(seen_by(plans[:heads], PLAN, np.random.default_rng(seed))))
    # Of one head, motion that is assumed as well as found makes the stated sigma larger: 2.5 a run.
    low, high = chi2(df=3 * heads * RUNS).ppf([1e-6 if heads == 1 else 0.0005, 0.9995])
    assert low < nees < high


@pytest.mark.parametrize(("strips", "largest_share"), [(3, 0.75), (14, 0.4)])
def test_errors_that_come_back_are_recovered_as_far_as_strips_lie_around_the_orbit(strips, largest_share):
    sizes, runs, squares, shares = np.array([6.0, 4.0, 12.0]) * ARCSEC, 10, 0.0, []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        waves = rng.standard_normal((2, 6))
        plans = [
            HeadPlan(name, R, replace(of_head, periodic_rad=sizes, period_s=350.0), step_s=0.2, waves=own)
            for name, R, of_head, own in (("A", R_A, NOISE_A, waves[0]), ("B", R_B, NOISE_B, waves[1]))
        ]
        estimate = estimated(seen_by(plans, replace(PLAN, strips=strips), rng))  # begin 62 s apart
        assert [(one.head, one.period_s) for one in estimate.periodic] == [("", 350.0), ("B", 350.0)]
        for one, own in zip(estimate.periodic, waves):
            found = np.concatenate([one.cosine_rad, one.sine_rad])
            sigma = np.concatenate([one.sigma_cosine_rad, one.sigma_sine_rad])
            squares += float(np.sum(((found - own.reshape(2, 3) * sizes) / sigma) ** 2))
            shares.append(sigma / one.stated_rad)
    assert_chi_square(squares, 12 * runs)
    # Three strips span a third of a period, 14 two and a half periods: 0.63 and 0.34 of the stated error are
    # left about the axis of the smallest.
    share = np.mean(shares, axis=0)
    assert share.max() < largest_share and (strips == 14 or share.min() > 0.3)


def blinded(
    strips: Sequence[StripSightings], strip_ids: set[str], drop: set[str] = frozenset()
) -> list[StripSightings]:
    """The strips, those of `strip_ids` without the reference head; heads of `drop` in them alone."""
    none = strips[0].attitudes.take(np.zeros(0, dtype=np.int64))
    return [
        replace(strip, exposures=(), R_oi_exposures=Rotation.identity(0), attitudes=none)
        if strip.strip_id in strip_ids
        else replace(strip, others=tuple(one for one in strip.others if one.head not in drop))
        for strip in strips
    ]


@pytest.mark.parametrize("compared", [True, False])
def test_another_head_carries_strips_in_which_the_reference_head_is_blind(compared: bool) -> None:
    nees, gain = 0.0, []
    for seed in range(RUNS):
        strips = flown(seed, 2, step_s=0.2)
        ids = [strip.strip_id for strip in strips]
        estimate = estimated(blinded(strips, set(ids[1::2]), set() if compared else {"B"}))
        assert [one.name for one in estimate.heads] == ["", "B"] and estimate.n_strips == len(ids)
        nees += nees_of_heads(estimate)
        if compared and seed < 10:
            gain.append(estimate.sigma_theta / estimated(strips[::2]).sigma_theta)
    assert_chi_square(nees, 6 * RUNS)
    if compared:  # A's own errors, which make X and Y here, average over its own strips only
        x, y, z = np.mean(gain, axis=0)
        assert x < 1.0 and y < 1.0 and z < 0.85  # Z is the targets': 0.71 if A had no errors


def test_white_noise_alone_states_too_small_an_error() -> None:
    nees = 0.0
    for seed in range(RUNS):
        white = [StripSightings(**{name: getattr(strip, name) for name in NAMES}) for strip in flown(seed, 1)]
        nees += nees_of_estimate(estimated(white), R_A)
    assert nees > 1.3 * chi2(df=3 * RUNS).ppf(0.9995)  # 3.8 a run at most if it were honest


NAMES = ("strip_id", "exposures", "ground", "R_oi_exposures", "R_oi_targets", "attitudes")


def test_second_head_makes_the_estimate_better_by_what_its_own_noise_allows() -> None:
    ratios = [estimated(flown(n, 2)).sigma_theta / estimated(flown(n, 1)).sigma_theta for n in range(6)]
    x, y, z = np.mean(ratios, axis=0)
    assert x < 1.0 and y < 1.0  # Z is the targets'
    assert x * y * z > 0.3  # two like heads: 0.35 if nothing else had errors


def test_head_that_moves_from_strip_to_strip_is_named() -> None:
    named, seeds = 0, 10
    for seed in range(seeds):
        for n, name in enumerate(("A", "B")):
            wrong = (8.0, 0.0) if n == 0 else (0.0, 8.0)  # arcsec, per axis
            estimate = estimated(flown(1000 + seed, 2, wrong, 4, 0.2)).with_reference("A")
            found = {group for check in assess(estimate, []).refuted_by for group in check.names}
            named += found == {(name,)}
    assert named >= 0.95 * 2 * seeds


def test_heads_that_agree_are_not_suspected() -> None:
    outcomes = [assess(estimated(flown(seed, 2, count=4)), []) for seed in range(6)]
    kinds = {check.kind.value for verdict in outcomes for check in verdict.refuted_by}
    assert not kinds & {"agreement between heads", "alignment between heads from strip to strip"}


NOISE_C = noise([5.0, 0.8, 0.5], [1.0, 0.3, 3.0], [0.9, 0.4, 1.5], [0.3, 1.7, 0.6])
FEW = replace(PLAN, strips=3, duration_s=1.2)


def three_heads(seed: int) -> list[StripSightings]:
    """Three strips with some attitudes of three unlike heads; in one of them the reference head is blind."""
    plans = [
        HeadPlan("A", R_A, NOISE_A, step_s=0.4),
        HeadPlan("B", R_B, NOISE_B, step_s=0.4, shift_s=0.033),
        HeadPlan("C", R_C, NOISE_C, step_s=0.4, shift_s=0.11),
    ]
    drawn = seen_by(plans, FEW, np.random.default_rng(seed))
    return blinded(drawn, {drawn[1].strip_id}, set())


def test_a_blind_strip_is_carried_by_the_head_that_spans_most_of_its_targets() -> None:
    blind = three_heads(1)[1]
    assert not blind.exposures
    by_name = {one.head: one for one in blind.others}
    t_s = np.sort(blind.ground.t_s)

    def of(head: str, first_s: float, last_s: float) -> HeadAttitudes:
        """Attitudes that begin and end a hundredth of a second beyond two of the targets."""
        times = np.array([first_s - 0.01, 0.5 * (first_s + last_s), last_s + 0.01])
        return replace(by_name[head].take(np.arange(3)), t_s=times)

    for b, c, expected in (
        ((1, -1), (0, -1), "C"),  # one target more at the begin
        ((0, -1), (0, -2), "B"),  # ... at the end
        ((2, -1), (0, -3), "B"),  # as many: the first by name
        ((3, -4), (1, -2), "C"),
    ):
        heads = [of(name, t_s[n], t_s[m]) for name, (n, m) in (("B", b), ("C", c))]
        for others in (heads, heads[::-1]):
            found = carried(replace(blind, others=tuple(others)))
            assert found.carrier == expected and len(found.exposures) == 3
            assert [one.head for one in found.others] == [{"B": "C", "C": "B"}[expected]]
    one_row = by_name["B"].take(np.array([0]))  # an attitude alone spans nothing
    assert carried(replace(blind, others=(one_row, of("C", t_s[4], t_s[5])))).carrier == "C"


def test_three_heads_are_tied_by_the_one_that_carries_a_strip() -> None:
    runs, nees = 60, 0.0
    chi2_all, dof_all, gain, dof_gain = 0.0, 0, 0.0, 0
    for seed in range(runs):
        estimate = estimated(three_heads(seed))
        assert [one.name for one in estimate.heads] == ["", "B", "C"]
        nees += nees_of_heads(estimate)
        chi2_all, dof_all = chi2_all + estimate.agreement.chi2, dof_all + estimate.agreement.dof
        gain, dof_gain = gain + estimate.agreement.gain, dof_gain + estimate.agreement.dof_gain
    for found, dof in ((nees, 9 * runs), (chi2_all, dof_all), (gain, dof_gain)):
        low, high = chi2(df=dof).ppf([0.0005, 0.9995])
        assert low < found < high, (found / runs, dof / runs)


def test_attitudes_between_two_of_the_reference_head_alone_measure_the_alignment() -> None:
    whole, true = flown(0, 2)[0], R_A.inv() * R_B
    two = {"exposures": whole.exposures[:2], "R_oi_exposures": whole.R_oi_exposures[:2]}
    strip = replace(whole, attitudes=whole.attitudes.take(np.arange(2)), **two)
    assert (strip.others[0].R_sh * true.inv()).magnitude() > 700.0 * ARCSEC  # by the launch
    error = measured_alignment([strip], "B") * true.inv()
    assert error.magnitude() < 60.0 * ARCSEC  # 5 sigma of both heads about their lines of sight


def test_the_covariance_of_all_heads_has_three_rows_a_head_and_begins_with_that_of_the_reference() -> None:
    estimate = estimated(flown(3, 2))
    assert estimate.cov_heads.shape == (6, 6)
    np.testing.assert_allclose(estimate.cov_heads[:3, :3], estimate.cov_theta, rtol=1e-9)
