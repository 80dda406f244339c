"""`boresight plan` and `boresight experiment` from file to file."""

import re
import sys
from contextlib import nullcontext
from dataclasses import fields
from pathlib import Path

import astropy.units as u
import numpy as np
import pandas as pd
import pytest
from command_line import ran
from drawn_pictures import SERIES_COLOURS, shows_curves
from recorded_numbers import assert_recorded, columns_of, numbers_by_line

import boresight as bs
from boresight.features.paper.tables import hipparcos_fields
from boresight.features.paper.vector_experiments import ExperimentSettings
from boresight.features.planning import campaign_plan
from boresight.features.planning.api import forecast
from boresight.features.planning.campaign_plan import (
    Plan,
    PlannedErrors,
    PlannedGyro,
    PlannedSky,
    PlannedStrips,
    forecast_plan,
    read_plan,
)
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.run.settings import settings_from_values


def test_a_plan_is_told_with_its_table_and_plot(tmp_path: Path, few_draws: None):
    path = tmp_path / "plan.toml"
    path.write_text("[strips]\ncount = 12\n[errors]\ndistortion_px = 0.0\n", encoding="utf-8")
    told = ran("plan", path, "--target", 2, "--out", tmp_path / "out")
    assert "12 strips: 1-sigma" in told.stdout and "strips bring every axis to 2″" in told.stdout
    table = pd.read_csv(tmp_path / "out" / "plan.csv")
    assert_recorded("plan", columns_of(table) | numbers_by_line(told.stdout.replace(str(tmp_path), "")))
    twelve = table[(table["strips"] == 12) & (table["axis"] == "X")]["sigma_arcsec"].iloc[0]
    assert 0.15 < twelve < 0.35  # 2 m of GPS error seen from 530 km, over the root of 12
    assert shows_curves(tmp_path / "out" / "plan.png", *SERIES_COLOURS[:3])


def test_the_page_describes_every_key_with_an_example():
    sys.path.insert(0, str(Path(__file__).parents[3] / "scripts" / "figures"))
    from plan import DOCS, example

    text = (DOCS / "plan.md").read_text()
    for section in fields(Plan):
        assert f"[{section.name}]" in text
        for key in fields(getattr(Plan(), section.name)):
            assert re.search(rf"^{key.name} = \S+.*# \w+", text, re.MULTILINE), key.name
    assert example().strips.count == 12 and shows_curves(DOCS / "images" / "plan.png", *SERIES_COLOURS[:3])


def test_what_limits_an_axis_is_what_helps_most_when_it_is_gone(few_draws: None):
    found = forecast_plan(Plan(errors=PlannedErrors(position_m=20.0)))
    assert "X is limited by: position" in found.text
    of_x = found.without[found.without["axis"] == "X"].set_index("source")["sigma_arcsec"]
    assert of_x.idxmin() == "position" and of_x["position"] < 0.2 * of_x["all errors"]
    assert np.all(of_x <= 1.001 * of_x["all errors"])  # less error is never worse, but for rounding
    of_z = found.by_targets[found.by_targets["axis"] == "Z"]["sigma_arcsec"].to_numpy()
    assert of_z[-1] < 0.5 * of_z[0]
    assert_recorded(
        "plan_limits", columns_of(found.without, "without ") | columns_of(found.by_targets, "by ")
    )
    assert not len(found.campaigns)  # of the ground alone there is nothing to compare


def test_a_gyro_carries_two_exposures_over_a_strip(few_draws: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign_plan, "TARGET_COUNTS", ())  # the table alone is looked at
    monkeypatch.setattr(campaign_plan, "_without", lambda campaign: {campaign_plan.ALL_ERRORS: campaign})
    errors = PlannedErrors(position_m=0.0, clock_s=0.0, distortion_px=0.0)
    few = PlannedStrips(count=12, exposures=2, duration_s=4.0)
    without, good, poor = (
        forecast_plan(Plan(strips=few, errors=errors, gyro=PlannedGyro(random_walk_arcsec=walk)))
        .table["sigma_arcsec"]
        .to_numpy()[:3]
        for walk in (0.0, 0.02, 10.0)
    )
    assert np.all(good < 0.5 * without) and np.all(good < 0.9 * poor)


def test_strips_of_the_sky_are_forecast_as_they_are_planned(few_draws, monkeypatch):
    parts = []
    monkeypatch.setattr(
        campaign_plan, "compare_campaigns", lambda ground, sky, cameras: parts.append(sky) or {}
    )
    sky = PlannedSky(count=5, stars=37, rate_mrad_s=2.9, duration_s=6.25, sigma_px=0.07, exposures=13)
    forecast_plan(Plan(strips=PlannedStrips(count=3, stars=128), sky=sky))
    (part,) = parts
    assert part.strips == 5 and part.rate_rad_s == pytest.approx(2.9e-3)
    strip = part.plan
    assert (strip.targets, strip.sigma_c_px, strip.duration_s, strip.exposures) == (37, 0.07, 6.25, 13)


def test_campaigns_of_ground_and_sky_are_compared(few_draws: None):
    found = forecast_plan(Plan(strips=PlannedStrips(count=3, stars=128), sky=PlannedSky(count=2)))
    sigma = found.campaigns.pivot(index="campaign", columns="axis", values="sigma_arcsec")
    assert sigma.loc["sky", "X"] < 0.2 * sigma.loc["ground", "X"]  # no position error
    assert (sigma.loc["both"] <= 1.05 * sigma.min()).all()  # but for the draws of the strips
    assert "2 strips of the sky" in found.text
    assert_recorded("plan_sky", columns_of(found.campaigns) | numbers_by_line(found.text))
    # The strips of the ground alone are those of the table, and those of which one error after the other is
    # left out: one value on one screen, but for the fit of the attitudes, which all strips share.
    table = found.table[found.table["strips"] == 3].set_index("axis")["sigma_arcsec"]
    np.testing.assert_allclose(sigma.loc["ground", ["X", "Y", "Z"]], table[["X", "Y", "Z"]], rtol=1e-3)
    every = found.without[found.without["source"] == "all errors"].set_index("axis")["sigma_arcsec"]
    np.testing.assert_array_equal(every[["X", "Y", "Z"]], table[["X", "Y", "Z"]])


def test_a_target_out_of_reach_is_said_to_be_so(tmp_path: Path, few_draws: None):
    path = tmp_path / "plan.toml"
    path.write_text("[strips]\ncount = 2\n", encoding="utf-8")
    assert "no number of strips" in ran("plan", path, "--target", 0.01, status=1).stdout


def test_an_unknown_key_of_a_plan_is_refused_by_name(tmp_path: Path):
    path = tmp_path / "plan.toml"
    path.write_text("[targets]\ncout = 3\n", encoding="utf-8")
    with pytest.raises(RawDataError, match="cout"):
        read_plan(path)


def test_stars_of_a_field_are_the_skys():
    cameras = ExperimentSettings().cameras
    fields = hipparcos_fields(cameras, 300, seed=1)
    counts = np.array([len(field) for field in fields])
    assert 40 < counts.mean() < 70  # 18.6 x 14 degrees are 1/160 of the sky; 9 000 stars to V 6.5
    assert counts.std() > 8  # more along the Milky Way
    np.testing.assert_allclose(np.linalg.norm(np.concatenate(fields), axis=1), 1.0, atol=1e-12)


def test_an_unknown_experiment_is_wrong_usage():
    ran("experiment", "table9", "--out", "nowhere", status=2)


def test_only_some_experiments_go_through_pixels():
    ran("experiment", "figure8", "--out", "nowhere", "--pixels", status=2)


@pytest.mark.parametrize("text", ["[strips]\nduration_s = 1e-300", "[errors]\nclock_s = 1e299"])
def test_campaign_whose_information_has_no_number_is_told_and_ends(tmp_path, text):
    (tmp_path / "plan.toml").write_text(text)
    with pytest.raises(DataNotSufficientError, match="cannot be forecast"):
        forecast_plan(read_plan(tmp_path / "plan.toml"))


def test_no_number_of_a_plan_is_negative_but_an_angle_and_counts_have_a_range():
    sections = {part.name: part.default_factory() for part in fields(Plan)}
    numbers = {
        (name, key.name): getattr(section, key.name)
        for name, section in sections.items()
        for key in fields(section)
        if key.type in ("float", "int")
    }
    assert len(numbers) > 30
    for (name, key), value in numbers.items():
        given = {name: {key: type(value)(-1)}}
        if key == "star_from_zenith_deg":
            assert settings_from_values(Plan, given, "plan", "plan").cameras.star_from_zenith_deg == -1.0
            continue
        with pytest.raises(RawDataError, match=f"plan.{name}: found .*{key} must be"):
            settings_from_values(Plan, given, "plan", "plan")
        for count in (0, 10**13) if isinstance(value, int) and (name, key) != ("sky", "count") else ():
            said = f"plan.{name}: found {key} must be 1 to .*, got {count}"
            with pytest.raises(RawDataError, match=said):
                settings_from_values(Plan, {name: {key: count}}, "plan", "plan")
    for step_s, holds in ((9.9e-4, False), (1e-3, True), (100.0, True), (101.0, False)):
        with nullcontext() if holds else pytest.raises(ValueError, match="step_s must be"):
            PlannedGyro(step_s=step_s)
    with pytest.raises(ValueError, match="target_arcsec"):
        forecast(target_arcsec=1.01e9)
    for key in ("across", "along"):
        with pytest.raises(RawDataError, match=r"plan.targets: found across and along must increase"):
            settings_from_values(Plan, {"targets": {key: [1.0, -1.0]}}, "plan", "plan")


def test_numbers_of_a_plan_with_units_are_those_without(few_draws):
    given = {"strips": {"height_km": 5e5 * u.m}, "sky": {"count": 1, "rate_mrad_s": 0.2 * u.deg / u.s}}
    same = {"strips": {"height_km": 500.0}, "sky": {"count": 1, "rate_mrad_s": 0.2e3 * np.pi / 180.0}}
    tables = [bs.forecast(plan).campaigns["sigma_arcsec"].to_numpy() for plan in (given, same)]
    assert tables[0] == pytest.approx(tables[1], rel=1e-9)
    with pytest.raises(ValueError, match=r"plan.sky.rate_mrad_s: .* expected numbers in mrad/s"):
        bs.forecast({"sky": {"rate_mrad_s": 3.0 * u.s}})
