"""Every hypothesis injects itself at the level of sightings: no error, its detectable one, and one ten times
as large.
"""

from dataclasses import fields, replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from drawn_campaigns import BOLD, TABLE_1
from recorded_numbers import assert_recorded, numbers_in
from scipy.stats import binom, chi2, kstest, ncx2

from boresight.calib.calibration import calibrate_strips
from boresight.calib.finding import MOST_WORDS
from boresight.calib.hypotheses import HypothesisInputs, hypotheses
from boresight.calib.reliability import PROBABILITY_FOUND, Contradiction, _fits, _tests, blind_spots, examine
from boresight.calib.settings import CalibrationSettings
from boresight.calib.strips import prepare_strip
from boresight.geometry.attitude_estimate import with_attitudes
from boresight.geometry.installation import theta_between
from boresight.records.ledger import Subject
from boresight.simulator.campaign import CameraPair, draw_strips

CAMERAS = CameraPair(BOLD, n_ccds=2, ccd_px=12288)
PLAN = replace(TABLE_1, strips=3, exposures=5, stars=15, sigma_target_m=0.5)
SETTINGS = CalibrationSettings(robust=False)
DRAWS = 8


def drawn(seed):
    return with_attitudes(draw_strips(PLAN, CAMERAS, np.random.default_rng(seed))[0], SETTINGS.attitudes)


def examined(strips, settings=SETTINGS):
    estimate = calibrate_strips(strips, BOLD, settings)
    return estimate, examine(estimate, strips, settings, pixel_rad=CAMERAS.pixel_rad, sigma_understated=1.0)


def injected(strips, h, size):
    """The strips with looks that move as by an error of this size of a hypothesis."""
    out, last = [], 0
    change_c = np.zeros((sum(len(strip.ground.ccd) for strip in strips), 3))
    change_c[h.rows] = h.moves_c
    for strip in strips:
        first, last = last, last + len(strip.ground.ccd)
        u_c = strip.ground.u_c + size * change_c[first:last]
        u_c = u_c / np.linalg.norm(u_c, axis=1, keepdims=True)
        out.append(replace(strip, ground=replace(strip.ground, u_c=u_c)))
    return out


@cache
def clean(seed):
    strips = drawn(seed)
    return strips, *examined(strips)


@cache
def table_of(seed):
    strips, estimate, _ = clean(seed)
    prepared = [prepare_strip(strip, SETTINGS) for strip in strips]
    return hypotheses(HypothesisInputs(prepared, estimate.R_cs, CAMERAS.pixel_rad))


N = len(table_of(0))


def test_right_inputs_give_uniform_p_values_and_no_finding():
    found = [clean(seed)[2] for seed in range(DRAWS)]
    assert not any(one.findings for one in found)
    causes = {test.cause for test in found[0].tests}
    p_values = {c: [t.p_value for one in found for t in one.tests if t.cause == c] for c in causes}
    statistic = np.mean([t.statistic for one in found for t in one.tests if not t.is_unseen])
    # 8 draws with some 12 independent numbers of variance 2: 1 sigma is 0.14, the band 3.5 of them.
    assert 0.5 < statistic < 1.5
    for cause in ("rotation of a CCD", "row period", "place of a CCD, across the track"):
        assert kstest(p_values[cause], "uniform").pvalue > 1e-4, cause


@pytest.mark.parametrize("n", range(N))
def test_an_error_is_measured_and_moves_the_matrix_as_predicted(n):
    seed = n % DRAWS
    strips, estimate, reliability = clean(seed)
    test, h = reliability.tests[n], table_of(seed)[n]
    factor = 10.0 if n % 3 == 0 else 0.5  # a search for the cause takes half a second
    size = factor * test.detectable if not test.is_unseen else 1.0
    size = min(size, 2e-4 / np.abs(h.moves_c).max())  # rad: linear
    spoilt, after = examined(injected(strips, h, size))
    moved = theta_between(spoilt.R_cs, estimate.R_cs)
    expected = size * test.effect_rad
    assert np.linalg.norm(moved - expected) < 0.03 * np.linalg.norm(expected) + 0.05 * estimate.sigma_theta[0]
    if test.is_unseen:
        return
    assert after.tests[n].value - test.value == pytest.approx(size, rel=0.03)
    concerned = int(np.any(h.moves_c != 0.0, axis=1).sum())
    if factor < 1.0:
        return
    if concerned < 3:  # no more than single observations, which are named by themselves
        assert after.findings or after.suspects
    elif size > 5.0 * test.detectable:
        named = after.findings[0]
        is_rival = f"{h.cause}, {h.item}" in named.rivals  # the data do not tell them apart, and say so
        assert (named.cause, named.item) == (h.cause, h.item) or is_rival
        assert len(f"{named.cause} {named.item} {named.text}".split()) <= MOST_WORDS
        if is_rival:
            return
        assert named.value == pytest.approx(size, abs=6.0 * named.sigma + 0.03 * size)


@pytest.mark.parametrize("robust", [False, True])
def test_every_number_of_examinations_is_the_recorded_one(robust):
    """Of a clock beside a rotated CCD, a datum, a height beside targets that scatter, and of these alone."""
    table, first, rng = {(h.cause, h.item): h for h in table_of(6)}, drawn(6), np.random.default_rng(2)

    def scattered(strip, pixels, stray):
        u_c = strip.ground.u_c + rng.normal(scale=pixels * CAMERAS.pixel_rad, size=(12, 3))
        u_c[5] += [0.0, stray * CAMERAS.pixel_rad, 0.0]
        u_c /= np.linalg.norm(u_c, axis=1, keepdims=True)
        return replace(strip, ground=replace(strip.ground, u_c=u_c))

    late = table["clock of the rows", "strip strip0001"], 30.0
    rotated = table["rotation of a CCD", "CCD 1"], 1.5
    datum = table["datum of the targets, east", "all strips"], 40.0
    height = table["orbit or targets, height", "strip strip0002"], -300.0
    blurred = [scattered(strip, 3.0, 0.0) for strip in first]
    spoilt = {
        "clock and CCD": injected(injected([scattered(first[0], 0.0, 90.0), *first[1:]], *late), *rotated),
        "datum": injected(first, *datum),
        "height": injected(first, *height),
        "scatter": blurred,
        "scatter of a strip": [first[0], blurred[1], first[2]],
    }
    found = {}
    for name, strips in spoilt.items():
        one = examined(strips, CalibrationSettings(robust=robust))[1]
        found[f"{name}: rest"] = one.rest or ()
        for row in (*one.tests, *one.findings, *one.suspects):
            for field in fields(row):
                value = getattr(row, field.name)
                numbers = numbers_in(value) if field.name == "text" else np.ravel(value).tolist()
                if numbers and isinstance(numbers[0], float) and field.name != "p_value":  # of the statistic
                    found.setdefault(f"{name}: {type(row).__name__} {field.name}", []).extend(numbers)
    assert_recorded(f"reliability_{robust}", found)


def test_the_detectable_error_is_found_in_nine_of_ten():
    found = tried = 0
    for seed in range(DRAWS):
        strips, _, reliability = clean(seed)
        limit = PROBABILITY_FOUND / N
        for n in range(seed, N, 2 * DRAWS):
            test = reliability.tests[n]
            if not test.is_unseen:
                spoilt = injected(strips, table_of(seed)[n], test.detectable)
                tried += 1
                found += examined(spoilt)[1].tests[n].p_value < limit
    low, high = binom(tried, 0.9).ppf([0.001, 0.9999])
    assert low <= found <= high


def test_nine_of_ten_are_exact():
    """An error of this size shifts a value, normal with its 1-sigma, by as much (the tests above)."""
    tests = [one for one in clean(0)[2].tests if not one.is_unseen]
    sizes = np.array([(one.detectable, one.sigma) for one in tests])
    found = ncx2(1, (sizes[:, 0] / sizes[:, 1]) ** 2).sf(chi2(1).isf(PROBABILITY_FOUND / N))
    assert found == pytest.approx(np.full(len(sizes), 0.9))
    chance = [chi2(1).sf((one.value / one.sigma) ** 2) for one in tests]
    assert [one.p_value for one in tests] == pytest.approx(chance)


def test_a_tolerated_factor_of_the_stated_sigma_makes_as_much_undetectable():
    strips, estimate, reliability = clean(0)
    after = examine(estimate, strips, SETTINGS, pixel_rad=CAMERAS.pixel_rad, sigma_understated=1.5)
    detectable = [test.detectable for test in reliability.tests]
    assert [test.detectable for test in after.tests] == pytest.approx(np.multiply(1.5, detectable))


def test_what_all_strips_share_is_unseen_and_told_first():
    spots = blind_spots(clean(0)[2].tests)
    unseen = {spot.cause for spot in spots if spot.is_unseen}
    assert {"clock of the rows", "place of the CCDs, along the track"} <= unseen
    assert all(a.is_unseen or not b.is_unseen for a, b in pairwise(spots))


def test_a_strip_that_was_rejected_whole_still_names_its_clock():
    settings = CalibrationSettings()
    strips = drawn(3)
    late = next(h for h in table_of(3) if (h.cause, h.item) == ("clock of the rows", "strip strip0002"))
    spoilt = injected(strips, late, 20.0)
    estimate = calibrate_strips(spoilt[:2], BOLD, settings)  # as if nothing had been matched in it
    found = examine(estimate, spoilt, settings, pixel_rad=CAMERAS.pixel_rad)
    named = found.findings[0]
    assert (named.cause, named.item, named.unit) == (late.cause, late.item, "ms")
    assert named.value == pytest.approx(20.0, abs=5.0 * named.sigma) and len(named.explains) == 12


def test_what_a_large_error_leaves_names_neither_a_further_cause_nor_single_targets():
    """A column is linear: of a clock 0.2 s off, hundreds of times its sigma, parts in a hundred are left."""
    table = {(h.cause, h.item): h for h in table_of(5)}
    late, period = (table[cause, "strip strip0001"] for cause in ("clock of the rows", "row period"))
    test_of = {(t.cause, t.item): t for t in clean(5)[2].tests}
    size = 6.0 * test_of[period.cause, period.item].sigma  # would be told by itself
    strips = injected(injected(drawn(5), late, 200.0), period, size)
    sigma_rad = np.radians(2.5 / 3600.0)  # a pixel: ten times the noise
    (n,) = [n for n, one in enumerate(strips) if one.strip_id == "strip0001"]
    u_c = strips[n].ground.u_c.copy()
    u_c[3] += [0.0, sigma_rad, 0.0]
    strips[n] = replace(strips[n], ground=replace(strips[n].ground, u_c=u_c))
    _, found = examined(strips, CalibrationSettings())
    assert [(one.cause, one.item) for one in found.findings] == [(late.cause, late.item)]
    assert found.suspects == ()
    apart = injected(drawn(5), period, size)
    assert (period.cause, period.item) in [
        (one.cause, one.item) for one in examined(apart, CalibrationSettings())[1].findings
    ]


def test_of_causes_that_explain_the_same_the_one_of_most_observations_is_told_and_the_others_listed():
    """With two strips, the clock of either explains what is between them."""
    strips, size = drawn(2)[:2], 15.0
    prepared = [prepare_strip(strip, SETTINGS) for strip in strips]
    table = hypotheses(HypothesisInputs(prepared, clean(2)[1].R_cs, CAMERAS.pixel_rad))
    late = next(h for h in table if (h.cause, h.item) == ("clock of the rows", "strip strip0001"))
    found = examined(injected(strips, late, size))[1].findings[0]
    assert found.cause == late.cause
    items = {found.item, *(one.rpartition(", ")[2] for one in found.rivals)}
    assert items == {"strip strip0000", "strip strip0001"}
    assert all(one.rpartition(", ")[2] in f"{found.item}: {found.text}" for one in found.rivals)


def test_a_displaced_target_is_told_by_the_linear_form_and_far_off_by_rays():
    rng = np.random.default_rng(4)
    by_place, axes_o = rng.normal(size=(2, 3)), rng.normal(size=(3, 2))
    P, stated_m = by_place @ axes_o, np.array([1200.0, -1600.0])
    linear_m, taken_m = rng.normal(0.0, 500.0, (2, 2))
    for variance_m2 in (1.0, 100.0, 1e4):
        cov_m2 = variance_m2 * np.array([[1.5, 0.4], [0.4, 0.5]])
        known = {"residual": P @ linear_m, "estimated": P @ taken_m, "covariance": P @ cov_m2 @ P.T}
        one = Contradiction(subject=Subject("target"), distance=9.0, by_place=by_place, **known)
        off_m, covariance = one.displaced_m(stated_m, axes_o)
        rays = 10.0**2 / (10.0**2 + variance_m2)  # 2 km curve by 10 m at 400 km
        np.testing.assert_allclose(off_m, rays * (stated_m + taken_m) + (1 - rays) * linear_m, rtol=1e-9)
        np.testing.assert_allclose(covariance, cov_m2, rtol=1e-9)


def test_what_is_left_of_a_hypothesis_beside_others_is_what_it_has_as_a_further_unknown(monkeypatch):
    found = []
    monkeypatch.setattr("boresight.calib.reliability._tests", lambda one: found.append(one) or _tests(one))
    examined(drawn(1))
    (one,) = found
    chosen = [n for n, h in enumerate(one.table) if h.item == "strip strip0001"][:2]  # its clock and period
    own, given, right, _, by_theta = one.beside(one.step, chosen)
    seen = np.flatnonzero(own > 1e-6 * np.maximum(given, own + by_theta))
    own, given, right = own[seen], given[seen], right[seen]
    fits = list(_fits(one, [[*chosen, n] for n in seen.tolist()], one.solved(one.step.weight > 0.0)))
    alone = np.array([(fit.size[-1], fit.sigma[-1]) for fit in fits])
    np.testing.assert_allclose(np.transpose([right / own, own**-0.5]), alone, rtol=1e-6)
    assert len(seen) > 70 and np.min(own / given) < 0.5  # some explain much the same
