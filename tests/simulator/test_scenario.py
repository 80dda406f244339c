"""Scenarios are strict: what cannot be is refused with the name of the setting."""

import dataclasses

import pytest

from boresight.simulator.scenario import (
    ScenarioError,
    builtin_scenario,
    builtin_scenario_names,
    mini_scenario,
    paper_scenario,
    scenario_from_dict,
    scenario_to_dict,
)

WAVE = {"axis": "roll", "period_s": 3.0, "amplitude_arcsec": 1.0}


@pytest.mark.parametrize("name", builtin_scenario_names())
def test_a_scenario_written_as_tables_is_read_back_the_same(name):
    scenario = builtin_scenario(name)
    assert scenario_from_dict(scenario_to_dict(scenario)) == scenario


def test_what_a_table_leaves_out_is_taken_from_its_base():
    scenario = scenario_from_dict({"based_on": "mini", "errors": {"gps_m": 0}})
    assert scenario.errors.gps_m == 0.0
    assert dataclasses.replace(scenario, errors=mini_scenario().errors) == mini_scenario()


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"orbit": {"altitude": 530}}, ["orbit.altitude", "altitude_km"]),
        ({"strips": {"lines": "many"}}, ["strips.lines", "a valid integer", "many"]),
        ({"strips": {"count": True}}, ["strips.count", "a valid integer", "True"]),
        ({"strips": {"count": 0}}, ["strips.count", "positive"]),
        ({"strips": {"spacing_s": 2.0}}, ["strips.spacing_s", "2.4", "2.0"]),
        ({"star_camera": {"principal_px": [1.0]}}, ["principal_px[1]", "expected a value", "[1.0]"]),
        (
            {"attitude": {"waves": [{"axis": "roll", "period_s": 3.0}]}},
            ["waves[0].amplitude_arcsec", "expected a value"],
        ),
        ({"attitude": {"waves": [WAVE | {"phase": 1.0}]}}, ["waves[0].phase", "unknown setting"]),
        ({"attitude": {"waves": [WAVE | {"period_s": "3"}]}}, ["waves[0].period_s", "valid number", "'3'"]),
        ({"installation": {"theta_rad": [1e-3] * 4}}, ["theta_rad", "at most 3", "4"]),
        ({"attitude": {"waves": [{"axis": "up", "period_s": 3.0, "amplitude_arcsec": 1.0}]}}, ["axis", "up"]),
        ({"sky": 3}, ["sky", "table"]),
        ({"star_camera": {"exposure_s": 0.3}}, ["exposure_s", "0.2"]),
        ({"based_on": "grand"}, ["grand", "mini", "paper", "sky"]),
        ({"line_camera": {"ccds": 3}}, ["rotation_urad", "3 values"]),
    ],
)
def test_an_impossible_setting_is_refused_by_name(tables, words):
    with pytest.raises(ScenarioError) as caught:
        scenario_from_dict(tables)
    for word in words:
        assert word in str(caught.value)


def test_the_full_size_scenario_is_that_of_the_papers_tables():
    scenario = paper_scenario()
    star, line, errors = scenario.star_camera, scenario.line_camera, scenario.errors
    assert (star.focal_mm, star.pixel_um, star.rate_hz) == (100.0, 6.4, 5.0)
    assert (star.width_px, star.height_px) == (5120, 3840)
    assert (line.focal_m, line.pixel_um, line.samples, line.ccds) == (10.0, 10.0, 6144, 4)
    assert scenario.strips.lines == 26000
    assert scenario.orbit.altitude_km == 530.0
    stated = errors.gps_m, errors.vibration_arcsec, errors.clock_s, errors.distortion_px
    assert stated == (2.0, 0.1, 1e-4, 0.3)
    assert scenario.installation.theta_rad == (0.003, 0.002, 0.001)  # errata: matrix (28), not the sentence
