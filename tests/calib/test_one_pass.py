"""How sightings are cut into strips is bookkeeping: whatever the cut, the estimate is that of the whole."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from drawn_campaigns import BOLD, CAMERAS, TABLE_1, assert_chi_square, draw_other_camera, nees_of_estimate
from drawn_heads import HeadPlan, with_heads
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.hypotheses import MovedInput
from boresight.calib.reliability import examine
from boresight.calib.settings import CalibrationSettings
from boresight.calib.simultaneous_strips import groups_of, passes_of
from boresight.calib.verdict import Verdict, assess
from boresight.features.vectors.vector_estimate import calibrate_vector_sets
from boresight.geometry.attitude import ConstantRate
from boresight.geometry.attitude_estimate import with_attitudes
from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.geometry.sightings import GroundReferences, HeadAttitudes, StripSightings, VectorSets
from boresight.records.record import Floats, Ints
from boresight.simulator.campaign import CameraPair, draw_frames, draw_sky_strips, draw_strips

SECOND = Rotation.from_euler("xyz", [-35.0, 20.0, 110.0], degrees=True)
PLAN = replace(TABLE_1, strips=3, exposures=8, exposure_margin_s=0.3, targets=14, sigma_target_m=0.3)
NOISE = AttitudeNoise(
    white_rad=np.array([0.8, 0.9, 6.5]) * ARCSEC,
    correlated_rad=np.array([0.5, 0.5, 4.7]) * ARCSEC,
    correlation_time_s=np.array([0.8, 0.5, 1.2]),
    constant_rad=np.array([0.3, 0.4, 2.3]) * ARCSEC,
)
MODEL = CalibrationSettings()
LASTING = replace(MODEL, position_time_s=90.0, clock_time_s=20.0)  # strips are 62 s apart
Wrong = Callable[[StripSightings], StripSightings]
EXAMPLES = 20  # of a law, each of which cuts every strip of a campaign in a way of its own
KINDS = ("ground", "sky", "mixed", "heads", "attitudes", "cameras")
OBLIQUE = CameraPair(SECOND * BOLD, pixel_rad=2e-6, ccd_px=2048, n_ccds=3)


@cache
def campaign(kind: str) -> tuple[StripSightings, ...]:
    """Strips that the satellite took one after another."""
    rng = np.random.default_rng([55, KINDS.index(kind)])
    plan = replace(PLAN, gross_targets=0.05 if kind == "ground" else 0.0)
    ground, truth = draw_strips(plan, CAMERAS, rng)
    if kind == "cameras":
        others = draw_other_camera(ground, truth, plan, OBLIQUE, "oblique", rng)
        return tuple(map(with_reference, [replace(strip, camera="nadir") for strip in ground] + others))
    sky = draw_sky_strips(replace(PLAN, strips=2, sigma_c_px=0.05), CAMERAS, rng)
    if kind in ("heads", "attitudes"):
        heads = [
            HeadPlan(name, R_ch, NOISE, step_s=step_s, margin_s=0.3)
            for name, R_ch, step_s in (("A", BOLD, 0.2), ("B", BOLD * SECOND, 0.25))
        ][: 2 if kind == "heads" else 1]
        alignment = [SECOND] if kind == "heads" else []
        return tuple(with_heads(ground, truth, heads, alignment, PLAN.duration_s, rng))
    return tuple({"ground": ground, "sky": sky, "mixed": ground + sky}[kind])


def with_reference(strip: StripSightings) -> StripSightings:
    """The strip with two thirds of its targets from one mosaic."""
    J = len(strip.ground.t_s)
    names = np.where(np.arange(J) % 3 == 0, "", "mosaic")
    axes_i = strip.R_oi_targets.inv().as_matrix()
    place = np.column_stack([strip.ground.t_s / 60.0, np.arange(J) / J, np.zeros(J)])
    references = GroundReferences(names, axes_i, np.full((J, 3), 2.0), place)
    return replace(strip, ground=replace(strip.ground, references=references))


def told(
    strips: Sequence[StripSightings], model: CalibrationSettings = MODEL
) -> tuple[InstallationEstimate, Verdict]:
    several = {"nadir": BOLD, "oblique": OBLIQUE.R_cs}
    estimate = calibrate_strips(strips, several if strips[0].camera else BOLD, model)
    assert isinstance(estimate, InstallationEstimate)
    reliability = examine(estimate, strips, model, pixel_rad=CAMERAS.pixel_rad)
    return estimate, assess(estimate, strips, reliability=reliability)


@cache
def of_the_whole(kind: str, model: CalibrationSettings) -> tuple[InstallationEstimate, Verdict]:
    return told(campaign(kind), model)


def piece(strip: StripSightings, name: str, rows: Ints, span_s: tuple[float, float]) -> StripSightings:
    """Targets `rows` of a strip under another name, with the exposures and attitudes of a span."""
    first, last = span_s
    times = np.array([exposure.t_s for exposure in strip.exposures])
    seen = np.flatnonzero((times >= first) & (times <= last))

    def around(other: HeadAttitudes) -> HeadAttitudes:
        return other.take(np.flatnonzero((other.t_s >= first) & (other.t_s <= last)))

    found = replace(
        strip,
        strip_id=name,
        exposures=tuple(strip.exposures[k] for k in seen.tolist()),
        R_oi_exposures=strip.R_oi_exposures[seen],
        attitudes=strip.attitudes and strip.attitudes.take(seen),
        others=tuple(map(around, strip.others)),
        ground=strip.ground.take(rows),
        R_oi_targets=strip.R_oi_targets[rows],
    )
    return about_its_own_motion(found) if strip.ground.is_star.all() and len(seen) > 1 else found


def about_its_own_motion(scan: StripSightings) -> StripSightings:
    """A scan of the sky about the rate that its own exposures show, as it comes from images."""
    attitudes = with_attitudes([scan], MODEL.attitudes)[0].attitudes
    times = np.array([exposure.t_s for exposure in scan.exposures])
    motion = ConstantRate.fitted(times, Rotation.from_matrix(attitudes.R_si))
    return replace(scan, R_oi_exposures=motion.R_oi(times), R_oi_targets=motion.R_oi(scan.ground.t_s))


def spans(strip: StripSightings, cuts: Floats, overlap: int) -> list[tuple[float, float]]:
    """Time of each piece of a strip that is cut by rows: exposures from one cut to the next, and `overlap`
    of the neighbours'; the first and the last reach to the ends.
    """
    times = np.array([exposure.t_s for exposure in strip.exposures])
    step = times[1] - times[0]
    ends = np.concatenate([[-np.inf], cuts, [np.inf]])
    return [(a - overlap * step, b + overlap * step) for a, b in pairwise(ends)]


Cut = tuple[str, int, int]  # how a strip is cut, into how many pieces; of rows, exposures in common
CUTS = st.tuples(st.sampled_from(("whole", "CCD", "rows", "targets")), st.integers(2, 4), st.integers(0, 8))


def pieces(strip: StripSightings, cut: Cut, rng: np.random.Generator) -> list[StripSightings]:
    """The strip cut into others with names of their own; pieces without a target are left out."""
    (how, n, overlap), ground, everything = cut, strip.ground, [(-np.inf, np.inf)]
    part, times = np.zeros(len(ground.t_s), dtype=np.int64), everything
    if how == "CCD":
        part, times = ground.ccd % n, everything * n
    elif how == "targets":
        part, times = rng.integers(0, n, len(part)), everything * n
    elif how == "rows":
        cuts = np.linspace(ground.t_s.min(), ground.t_s.max(), n + 1)[1:-1]
        part, times = np.searchsorted(cuts, ground.t_s), spans(strip, cuts, overlap)
    names = [f"{rng.integers(10)}{strip.strip_id}{'abcd'[k]}" for k in range(len(times))]
    rows = [np.flatnonzero(part == k) for k in range(len(times))]
    return [piece(strip, *one) for one in zip(names, rows, times) if len(one[1])]


def same(found: tuple[InstallationEstimate, Verdict], whole: tuple[InstallationEstimate, Verdict]) -> None:
    (one, verdict), (other, expected) = found, whole
    apart = theta_between(one.R_cs, other.R_cs).ravel() / other.sigma_theta
    assert np.max(np.abs(apart)) < 0.05  # 1-sigma: what bookkeeping may move
    np.testing.assert_allclose(one.sigma_theta, other.sigma_theta, rtol=0.01)  # relative: the same
    for name in ("n_exposures", "n_stars", "n_targets", "dof", "dof_stars"):
        assert getattr(one, name) == getattr(other, name), name
    assert (one.agreement.dof, one.agreement.dof_gain) == (other.agreement.dof, other.agreement.dof_gain)
    assert one.pairs.shared == other.pairs.shared
    assert len(one.rejected) == len(other.rejected)
    assert verdict.outcome is expected.outcome
    assert [cause.cause for cause in verdict.findings[:1]] == [c.cause for c in expected.findings[:1]]


def with_ccd_moved(strip: StripSightings) -> StripSightings:
    """The strip with the looks of CCD 2 six pixels off along x."""
    u_c = strip.ground.u_c + 6e-6 * np.outer(strip.ground.ccd == 2, [1.0, 0.0, 0.0])
    return replace(strip, ground=replace(strip.ground, u_c=u_c / np.linalg.norm(u_c, axis=1, keepdims=True)))


def with_orbit_moved(strip: StripSightings) -> StripSightings:
    """The second strip of three with the satellite 30 m farther to the right than it was."""
    ground = strip.ground
    right_i = strip.R_oi_targets.inv().apply([0.0, 1.0, 0.0])
    u_i = ground.u_i - 30.0 * (strip.strip_id == "strip0001") * right_i / ground.range_m[:, None]
    return replace(strip, ground=replace(ground, u_i=u_i / np.linalg.norm(u_i, axis=1, keepdims=True)))


@pytest.mark.parametrize("wrong", [with_ccd_moved, with_orbit_moved])
@pytest.mark.parametrize("how", ["CCD", "rows"])
def test_the_first_cause_of_a_contradiction_is_that_of_the_whole(wrong: Wrong, how: str) -> None:
    rng, plan = np.random.default_rng(7), replace(PLAN, targets=30)
    strips = [wrong(strip) for strip in draw_strips(plan, CAMERAS, rng)[0]]
    expected = told(strips)
    assert expected[1].findings
    same(told([part for strip in strips for part in pieces(strip, (how, 3, 1), rng)]), expected)


def test_an_input_that_moves_strips_moves_their_pass() -> None:
    rng, strips = np.random.default_rng(8), campaign("ground")
    strips = tuple(with_attitudes(strips, MODEL.attitudes))
    parts = [part for strip in strips for part in pieces(strip, ("rows", 2, 0), rng)]
    tests = []
    for these in (strips, parts):
        moved = MovedInput(
            cause="light",
            item="all",
            unit="times",
            words=("", ""),
            file="",
            field="",
            directions_i={one.strip_id: 1e-5 * np.sin(one.ground.u_i) for one in these},
            turns_s={
                one.strip_id: 1e-5 * np.sin([exposure.t_s * np.arange(1, 4) for exposure in one.exposures])
                for one in these
                if not one.exposures[0].exposure_id.startswith("strip0001")
            },
        )
        estimate = calibrate_strips(these, BOLD, MODEL)
        assert isinstance(estimate, InstallationEstimate)
        found = examine(estimate, these, MODEL, pixel_rad=CAMERAS.pixel_rad, inputs=[moved])
        tests.append(next(one for one in found.tests if one.cause == "light"))
    assert tests[0].value == pytest.approx(tests[1].value, rel=1e-6)  # rounding, of sums in another order
    assert tests[0].sigma == pytest.approx(tests[1].sigma, rel=1e-6)


def test_exposures_of_one_instant_that_differ_are_refused() -> None:
    first, *_ = campaign("ground")
    other = replace(first.exposures[3], u_s=first.exposures[4].u_s)
    exposures = (*first.exposures[:3], other, *first.exposures[4:])
    again = replace(first, strip_id="again", exposures=exposures)
    with pytest.raises(ValueError, match="strip0000/003 of strip strip0000 and strip0000/003 of strip again"):
        calibrate_strips([first, again], BOLD, MODEL)


def test_a_strip_without_exposures_is_of_the_pass_that_covers_it_or_is_carried() -> None:
    strips = with_attitudes(campaign("heads"), MODEL.attitudes)
    rows = np.arange(len(strips[0].ground.t_s))
    late = rows >= 6
    ends = piece(strips[0], "ends", rows[~late], (-np.inf, np.inf))
    blind = replace(piece(strips[0], "blind", rows[late], (9e9, 9e9)), others=strips[0].others)
    assert [len(group) for group in groups_of([ends, blind])] == [2]
    (whole,) = passes_of([ends, blind], MODEL.attitudes)
    assert [name for name, _, _ in whole.parts] == ["blind", "ends"] and len(whole.exposures) == len(
        strips[0].exposures
    )
    assert len(passes_of([ends, blind.later(600.0)], MODEL.attitudes)) == 2


@settings(max_examples=EXAMPLES, derandomize=True, deadline=None, database=None)
@given(st.lists(st.integers(1, 3), min_size=5, max_size=5), st.integers(0, 999))
def test_frames_with_the_same_stars_are_one_frame(parts: list[int], seed: int) -> None:
    whole = draw_frames(5, 12, 9, 0.06, 0.3, CAMERAS, np.random.default_rng(55))
    cut = [
        (*whole.frame(number)[:3], *(one[np.arange(9) % n == k] for one in whole.frame(number)[3:]))
        for number, n in enumerate(parts)
        for k in range(n)
    ]
    frames = vector_sets([cut[k] for k in np.random.default_rng(seed).permutation(len(cut))])
    found, expected = calibrate_vector_sets(frames, BOLD), calibrate_vector_sets(whole, BOLD)
    same((found.estimate, found.verdict), (expected.estimate, expected.verdict))


def vector_sets(frames: Sequence[tuple[Floats, ...]]) -> VectorSets:
    """Frames, each of stars' u_s, v_stars, sigma_s and targets' w_c, v_targets, sigma_c."""
    names = ("u_s", "v_stars", "sigma_s", "w_c", "v_targets", "sigma_c")
    columns = {name: np.concatenate(column) for name, column in zip(names, zip(*frames))}
    star_start, target_start = (np.cumsum([0, *(len(one[n]) for one in frames)]) for n in (0, 3))
    return VectorSets(star_start=star_start, target_start=target_start, **columns)


@pytest.mark.parametrize(
    ("kind", "model"), [*((kind, MODEL) for kind in KINDS), ("mixed", LASTING), ("heads", LASTING)]
)
def test_the_estimate_is_that_of_the_whole_however_it_is_cut_into_strips(kind, model):
    @settings(max_examples=EXAMPLES, derandomize=True, deadline=None, database=None)
    @given(st.lists(CUTS, min_size=6, max_size=6), st.integers(0, 999))
    def law(cuts: list[Cut], seed: int) -> None:
        rng = np.random.default_rng(seed)
        strips = [part for one, cut in zip(campaign(kind), cuts) for part in pieces(one, cut, rng)]
        shuffled = [strips[k] for k in rng.permutation(len(strips))]
        same(told(shuffled, model), of_the_whole(kind, model))

    law()


def nees(model: CalibrationSettings, time_s: float, runs: int) -> list[float]:
    """Squared errors of campaigns whose orbit error has a correlation time."""
    plan, found = replace(PLAN, strips=4, sigma_position_m=0.0), []
    for run in range(runs):
        rng = np.random.default_rng([56, run])
        strips, _ = draw_strips(plan, CAMERAS, rng)
        t_s = np.concatenate([strip.ground.t_s for strip in strips])
        root = np.linalg.cholesky(np.exp(-np.abs(t_s[:, None] - t_s) / time_s) + 1e-12 * np.eye(len(t_s)))
        error_o = np.split(2.0 * root @ rng.standard_normal((len(t_s), 3)), 4)
        estimate = calibrate_strips(
            [displaced(strip, one) for strip, one in zip(strips, error_o)], BOLD, model
        )
        assert isinstance(estimate, InstallationEstimate)
        found.append(nees_of_estimate(estimate))
    return found


def displaced(strip: StripSightings, by_o: Floats) -> StripSightings:
    """The strip with stated positions of the satellite off by (J, 3), m, axes of the orbit."""
    ground = strip.ground
    u_i = ground.u_i - strip.R_oi_targets.inv().apply(by_o) / ground.range_m[:, None]
    return replace(strip, ground=replace(ground, u_i=u_i / np.linalg.norm(u_i, axis=1, keepdims=True)))


def test_an_orbit_error_that_lasts_over_strips_is_honest_where_its_time_is_stated() -> None:
    assert_chi_square(nees(replace(MODEL, position_time_s=300.0), 300.0, 40), 3)
    assert sum(nees(MODEL, 300.0, 40)) > chi2(df=3 * 40).ppf(0.9995)  # four strips, taken to have four errors


@pytest.mark.parametrize("mirrored", [1.0, -1.0])  # whichever was first
@pytest.mark.parametrize(
    ("one", "other", "apart_s"),
    [
        # exposures, and half as long a gap again is of one pass: three quarters of each one's longest step
        ([0.0, 0.2, 0.4], [0.0, 0.2, 0.4], 0.3),
        ([0.0, 1.0, 1.5, 3.5], [0.0, 0.4], 1.8),
        ([0.0, 0.4], [0.0, 1.0, 1.5, 3.5], 1.8),
        ([0.0, 0.4], [7.0], 0.8),  # of one exposure alone half a second
    ],
)
def test_strips_whose_exposures_go_on_are_of_one_pass_whatever_their_order(one, other, apart_s, mirrored):
    def strip(name, t_s):
        t_s = np.sort(mirrored * np.array(t_s))
        ground = SimpleNamespace(t_s=t_s)
        return SimpleNamespace(strip_id=name, times_s=t_s, exposures=t_s.tolist(), carrier="", ground=ground)

    for gap_s, passes in ((apart_s - 1e-6, 1), (apart_s + 1e-6, 2), (-0.3, 1)):
        late = np.array(other) - other[0] + one[-1] + gap_s
        for names in ("ab", "ba"):
            groups = groups_of([strip(names[0], one), strip(names[1], late)])
            assert len(groups) == passes and sum(map(len, groups)) == 2
