"""What the report asks to look at: each pattern names its cause and its items, and good data give none."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from pytest import approx

from boresight.gct_match.locate import match_template
from boresight.gct_match.records import Reason, Refusal
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef, local_axes_e
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.report.findings import (
    clouds,
    displaced_strip,
    doubtful,
    lost_strip,
    silent_ccds,
    single_targets,
    spread,
)
from boresight.pipeline.report.ground_map import REJECTED, UNMATCHED, USED
from boresight.pipeline.results.folder import store_of
from boresight.pipeline.stages.calibrate import calibrate_dump
from boresight.pipeline.stages.input_findings import heights
from boresight.pipeline.stages.strip import _displaced_m, compass, pushbroom_of

NAMES = [f"t{n}" for n in range(12)]


def row(strip_id, target_id, *, ccd=0, state=UNMATCHED, cause="low correlation", **more):
    numbers = dict.fromkeys(("residual_m", "residual_east_m", "residual_north_m"), np.nan)
    texts = {"strip_id": strip_id, "target_id": target_id, "state": state, "cause": cause, "reason": "why"}
    return numbers | texts | {"ccd": ccd} | more


@pytest.mark.parametrize(
    ("sign", "words"),
    [
        (-1.0, "the targets' heights are EGM96 but stated as ellipsoidal"),
        (1.0, "the targets' heights are ellipsoidal but stated as EGM96"),
    ],
)
def test_heights_off_by_the_geoid_name_the_kind_of_height(sign, words):
    # A height H above EGM96 taken for ellipsoidal is too low by the undulation N: above the terrain by -N.
    geoid_m = -37.5
    (found,) = heights(NAMES, sign * geoid_m + np.linspace(-1.0, 1.0, 12), geoid_m)
    assert found.cause == "kind of height" and found.is_fault
    assert words in found.text and f"{sign * geoid_m:+.1f} m (median)" in found.text


def test_other_heights_are_named_by_size_or_by_target_and_noise_is_not():
    noise = np.random.default_rng(3).normal(0.0, 1.5, 12)
    assert list(heights(NAMES, noise, -37.5)) == []
    assert list(heights(NAMES, np.where(np.arange(12) < 10, np.nan, 200.0), -37.5)) == []  # two known
    (offset,) = heights(NAMES, noise + 12.0, -37.5)
    assert offset.cause == "heights of targets or terrain" and "+1" in offset.text
    wrong = noise.copy()
    wrong[4] += 310.0
    (one,) = heights(NAMES, wrong, -37.5)
    assert (one.cause, one.item) == ("height", "target t4") and "+31" in one.text


def test_ccds_without_a_match_are_named_and_the_dead_ones_called_dead():
    rows = [row(s, f"{s}{n}", ccd=2) for s in ("a", "b", "c") for n in range(3)]
    rows += [row(s, f"{s}u", ccd=1, state=USED) for s in ("a", "b", "c")]
    lost = {(s, 2): s != "c" for s in ("a", "b", "c")}
    (dead,) = silent_ccds(rows, lost)
    assert dead.cause == "dead detector or empty file" and dead.item == "CCD 2 in strips a, b"
    assert dead.targets == ("a/a0", "a/a1", "a/a2", "b/b0", "b/b1", "b/b2")
    (silent,) = silent_ccds(rows, dict.fromkeys(lost, False))
    assert (silent.cause, silent.item) == ("images or look directions", "CCD 2") and len(silent.targets) == 9
    assert "remote_camera.toml" in silent.text
    assert list(silent_ccds(rows, {("a", 2): False})) == []  # a cloud over one strip's CCD


def test_bright_places_without_contrast_are_clouds_and_dark_ones_are_not():
    used = [(f"u{n}", 100.0, 20.0) for n in range(3)]
    seen = {USED: used, UNMATCHED: [("white", 240.0, 3.0), ("dark", 10.0, 1.0), ("town", 240.0, 60.0)]}
    (cloud,) = clouds("s1", seen)
    assert cloud.item == "strip s1" and cloud.targets == ("s1/white",) and not cloud.is_fault
    assert list(clouds("s1", seen | {UNMATCHED: [("dark", 10.0, 1.0)]})) == []
    assert list(clouds("s1", seen | {USED: used[:2]})) == []  # too few to know what the ground looks like


@pytest.mark.parametrize("cause", ["inconsistent", "target residual"])
def test_single_targets_that_contradict_the_rest_are_named(cause):
    (found,) = single_targets([row("s1", "t1", cause=cause), row("s1", "t2", state=USED, cause="")])
    assert "target t1 (strip s1)" in found.item and found.targets == ("s1/t1",) and found.is_fault
    many = [row("s1", f"t{n}", cause=cause) for n in range(4)]
    assert list(single_targets(many)) == []  # no matter of single targets


def test_targets_that_the_data_do_not_tell_apart_are_one_fault():
    (found,) = doubtful(SimpleNamespace(doubtful=(("s1/t3", "s1/t9"),)))
    assert (found.cause, found.item, found.is_fault) == ("gross error", "one target of 2", True)
    assert found.text.startswith("s1/t3 or s1/t9 is wrong; the data do not tell which")


def test_a_gross_error_says_where_the_chip_lies():
    # The residual is where the image shows the target minus where it is stated: 30 m to the east.
    residual = {"residual_m": 30.0, "residual_east_m": 30.0, "residual_north_m": 1.0}
    (found,) = single_targets([row("s1", "t1", state=REJECTED, cause="target residual", **residual)])
    assert found.text == "why; its chip or coordinates lie about 30 m west of the true place."


def test_displacements_are_told_by_the_compass():
    assert compass(60.0, 0.5) == "60 m east"
    assert compass(-12.0, 7.0) == "12 m west, 7 m north"
    assert compass(0.0, -0.25) == "0.25 m south"


def test_the_place_of_an_inconsistent_chip_is_found_on_the_ground(finished):
    dump, result = finished
    found = calibrate_dump(open_dump(dump), store=store_of(result))
    task, matched = found.tasks[0], found.matched[0]
    model, name, ccd = pushbroom_of(task), str(matched.target_id[0]), int(matched.ccd[0])
    (p_e,) = [target.p_e for target in task.targets if target.target_id == name]
    lat, lon, _ = geodetic_from_ecef(p_e[None], WGS84)
    east, north, _ = local_axes_e(lat, lon)[0].T
    true_e = p_e - 60.0 * east + 25.0 * north  # the chip lies 60 m east and 25 m south of it
    pixels = [np.concatenate(model.pixels_from_ground(ccd, p[None])) for p in (true_e, p_e)]
    off = tuple((pixels[0] - pixels[1]).tolist())
    refusal = Refusal(Reason.INCONSISTENT, 9.0, 4.0, off, name, ccd)
    assert _displaced_m(task, refusal) == approx((60.0, -25.0), abs=0.05)  # m: the ground is not a plane


def test_a_displaced_strip_is_a_matter_of_time_only_where_it_moved_along_the_lines():
    late = displaced_strip(
        "s2", ("s2/a",), (12, 0.2, 21.2), later_ms=19.0, motion_m_s=7000.0, sigma_position_m=2.0
    )
    assert (late.cause, late.item) == ("clock or orbit", "strip s2")
    assert "19.0 ms too late" in late.text and "133 m along" in late.text and "0.3 ms, 1σ" in late.text
    early = displaced_strip(
        "s2", ("s2/a",), (12, 0.2, -21.2), later_ms=-19.0, motion_m_s=7000.0, sigma_position_m=2.0
    )
    assert "19.0 ms too early" in early.text
    across = displaced_strip(
        "s2", ("s2/a",), (12, 30.0, 21.2), later_ms=19.0, motion_m_s=7000.0, sigma_position_m=2.0
    )
    assert across.cause == "attitude, orbit or mounting" and "ms" not in across.text


def test_a_strip_without_any_match_is_empty_or_another_one():
    assert lost_strip("s2", ("s2/a",), all_flat=True).cause == "empty images"
    other = lost_strip("s2", ("s2/a",), all_flat=False)
    assert other.item == "strip s2" and "mirrored" in other.text and "utc_first_row" in other.text


def test_targets_in_one_part_of_the_swath_are_a_weakness_and_no_fault():
    (found,) = spread(0.37)
    assert "37%" in found.text and not found.is_fault
    assert list(spread(0.9)) == []


def test_a_strip_window_of_one_grey_value_is_refused_as_such():
    template = np.random.default_rng(1).uniform(0.0, 255.0, (64, 64))
    refused = match_template(template, np.full((200, 240), 3.0), start_px=(114, 90))
    assert not refused and refused.reason is Reason.ONE_GREY_VALUE
    assert refused.sentence.startswith("the strip has the grey value 3 ")
