"""Inputs moved by prediction: against ERFA, and against what the residuals then do. Motion that no star
exposure shows is a finding, with what is assumed of it.
"""

from dataclasses import replace
from types import SimpleNamespace

import erfa
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.calib.finding import MOST_WORDS
from boresight.calib.hypotheses import HypothesisInputs, MovedInput, hypotheses
from boresight.calib.settings import CalibrationSettings
from boresight.calib.strips import prepare_strip
from boresight.geometry.attitude_estimate import with_attitudes
from boresight.geometry.constants import ARCSEC
from boresight.geometry.epoch import Epoch
from boresight.geometry.starlight import with_all_aberration
from boresight.pipeline.diagnosis import moved_inputs
from boresight.pipeline.diagnosis.input_findings import assumed_motion
from boresight.pipeline.diagnosis.moved_inputs import _line_of_sight, _turns
from boresight.simulator.campaign import CameraPair, StripPlan, draw_sky_strips, draw_strips

BOLD = Rotation.from_euler("xyz", [40, -65, 110], degrees=True)
CAMERAS = CameraPair(BOLD, n_ccds=2, ccd_px=12288)
SETTINGS = CalibrationSettings(robust=False)


EPOCH, T_S = Epoch.from_utc("2024-11-20T04:00:00"), np.array([0.0, 60.0, 4000.0])
R_SI = Rotation.random(3, random_state=5)
V_I = np.array([[7400.0, 900.0, -1200.0], [-300.0, 7500.0, 800.0], [100.0, -200.0, 7600.0]])


def test_attitudes_turn_with_a_velocity_as_by_the_aberration_that_a_head_left_in():
    u_s = BOLD.apply([0.0, 0.0, 1.0])
    # the orbital part is put in
    turned = with_all_aberration(R_SI, "annual", EPOCH, T_S, V_I, line_of_sight_s=u_s)
    expected = (turned * R_SI.inv()).as_rotvec()
    # Of second order in v/c, 6e-10 rad, and the annual part's own change: far below 1e-3 of 5 arc-seconds.
    fitted = SimpleNamespace(R_si=R_SI.as_matrix())
    strip = SimpleNamespace(strip_id="s", exposures=(1, 2, 3), times_s=T_S, fitted=fitted)
    turns = _turns([strip], lambda t_s: V_I, u_s)
    assert np.abs(turns["s"] - expected).max() < 1e-3 * 5.0 * ARCSEC


@pytest.mark.parametrize("removed", ["none", "annual"])
def test_attitudes_turn_with_their_line_of_sight_as_erfa_says(removed):
    """Axes of the head are bold, and the line of sight lies far from all of them."""
    u_s = BOLD.apply([0.36, -0.48, 0.8])
    source = SimpleNamespace(aberration_removed=removed)
    head = SimpleNamespace(name="STR1", line_of_sight_s=u_s)
    dump = SimpleNamespace(epoch=EPOCH, orbit=SimpleNamespace(states_i=lambda _: (None, V_I)))
    attitudes = SimpleNamespace(R_si=R_SI.as_matrix())
    strip = SimpleNamespace(strip_id="s01", exposures=[None] * 3, times_s=T_S, fitted=attitudes)

    def seen(u):
        return with_all_aberration(R_SI, removed, EPOCH, T_S, V_I, line_of_sight_s=u)

    for moved in _line_of_sight(dump, head, source, [strip]):
        d_s = np.array([float(one) for one in moved.item.partition("[")[2].strip("]").split(",")])
        assert abs(d_s @ u_s) < 0.02  # printed with two digits
        d_s -= (d_s @ u_s) * u_s
        d_s /= np.linalg.norm(d_s)
        step = np.radians(0.1)
        expected = (seen(u_s * np.cos(step) + d_s * np.sin(step)) * seen(u_s).inv()).as_rotvec() / 0.1
        # Digits of the printed direction: a hundredth of the turn, 0.45 arc-seconds a degree at most.
        assert np.abs(moved.turns_s["s01"] - expected).max() < 0.015 * 0.45 * ARCSEC
        assert np.abs(expected).max() > 0.02 * ARCSEC


def test_a_line_of_sight_that_is_not_used_is_no_cause():
    source = SimpleNamespace(aberration_removed="annual and orbital")
    assert not list(_line_of_sight(SimpleNamespace(epoch=None, orbit=None), None, source, []))


def test_stars_of_another_equinox_are_where_erfa_takes_them():
    """Over fifty years precession is not linear to what a scan shows, 0.1 arc-second."""
    u_i = Rotation.random(20, random_state=2).apply([0.0, 0.0, 1.0])
    stated = SimpleNamespace(u_i=u_i @ erfa.pmat06(erfa.DJ00, -50.0 * erfa.DJY).T)
    of_long, of_short = (-50.0 * moved_inputs._by_precession(years, stated) for years in (-50.0, 1.0))
    assert np.abs(of_long - (stated.u_i - u_i)).max() < 1e-12
    assert np.abs(of_short - (stated.u_i - u_i)).max() > 10.0 * ARCSEC


def test_a_clock_of_the_exposures_that_runs_fast_does_the_opposite_of_a_row_period_that_is_too_long():
    plan = StripPlan(strips=1, exposures=9, stars=15, targets=14)
    scans = draw_sky_strips(plan, CAMERAS, np.random.default_rng(3), rates_rad_s=(-0.0143,))
    (strip,) = with_attitudes(scans, SETTINGS.attitudes)
    head = SimpleNamespace(source=None, subject=None, times_in=("exposures.csv", "utc_mid"))
    inputs = list(moved_inputs._clock_of_exposures(head, [strip]))
    given = HypothesisInputs([prepare_strip(strip, SETTINGS)], BOLD, CAMERAS.pixel_rad, inputs=inputs)
    table = hypotheses(given)
    change = {one.cause: one.moves_c for one in table if one.item in ("all exposures", "strip sky0000")}
    both = change["clock of the exposures, rate"] + change["row period"]
    clock = change["clock of the exposures"]  # what is left is an offset, from the first row to an exposure
    offset = np.sum(both * clock) / np.sum(clock**2)
    assert np.abs(both - offset * clock).max() < 0.02 * np.abs(change["row period"]).max()
    assert np.abs(change["row period"]).max() > 10.0 * np.abs(clock).max()


def test_a_moved_input_changes_the_residuals_as_its_column_says():
    rng = np.random.default_rng(11)
    plan = StripPlan(strips=2, exposures=5, stars=15, sigma_target_m=0.5)
    strips = with_attitudes(draw_strips(plan, CAMERAS, rng)[0], SETTINGS.attitudes)
    size = 3e-6  # rad: its square is 1e-11
    directions = {one.strip_id: size * rng.normal(size=one.ground.u_i.shape) for one in strips}
    for one in strips:  # along the sphere
        u_i, du = one.ground.u_i, directions[one.strip_id]
        directions[one.strip_id] = du - np.sum(u_i * du, axis=1, keepdims=True) * u_i
    turns = {one.strip_id: np.tile(size * rng.normal(size=3), (len(one.exposures), 1)) for one in strips}
    words = {
        "cause": "trial",
        "item": "all",
        "words": ("", ""),
        **dict.fromkeys(("unit", "file", "field"), ""),
    }
    moved = MovedInput(directions_i=directions, turns_s=turns, **words)
    prepared = [prepare_strip(one, SETTINGS) for one in strips]
    table = hypotheses(HypothesisInputs(prepared, BOLD, CAMERAS.pixel_rad, inputs=[moved]))
    (column,) = [one.moves_c for one in table if one.cause == "trial"]

    def stated_otherwise(one):
        turn = Rotation.from_rotvec(turns[one.strip_id])
        R_si = (turn * Rotation.from_matrix(one.attitudes.R_si)).as_matrix()
        u_i = one.ground.u_i + directions[one.strip_id]
        ground = replace(one.ground, u_i=u_i / np.linalg.norm(u_i, axis=1, keepdims=True))
        return replace(one, ground=ground, attitudes=replace(one.attitudes, R_si=R_si))

    after = [prepare_strip(stated_otherwise(one), SETTINGS) for one in strips]
    change = [-(b.v_s - a.v_s) @ BOLD.as_matrix().T for a, b in zip(prepared, after)]
    assert np.abs(column - np.concatenate(change)).max() < 1e-3 * size


STATED = CalibrationSettings(sigma_motion_rad=6.0 * ARCSEC, motion_time_s=0.8)


@pytest.mark.parametrize(("exposures", "told"), [(2, True), (3, False), (10, False)])
def test_with_two_exposures_a_strip_the_assumed_motion_is_told(exposures: int, told: bool) -> None:
    plan = StripPlan(strips=2, exposures=exposures)
    strips, _ = draw_strips(plan, CameraPair(Rotation.identity()), np.random.default_rng(1))
    fitted = with_attitudes(strips, STATED.attitudes)
    found = list(assumed_motion(fitted, STATED))
    assert len(found) == told
    assert not list(assumed_motion(fitted, replace(STATED, sigma_motion_rad=0.0)))
    for one in found:
        assert "6″ within 0.8 s are assumed" in one.text and "motion_arcsec" in one.field
        assert not one.is_fault and not one.refutes
        assert len(f"{one.cause} {one.item} {one.text}".split()) <= MOST_WORDS
