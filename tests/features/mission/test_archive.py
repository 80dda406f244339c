"""The archive of a mission: nothing is lost or doubled, and its trends are those of its results."""

import json
import re
import sqlite3

import numpy as np
import pandas as pd
import pytest
from command_line import invoked, ran
from drawn_campaigns import squared
from drawn_mission import DrawnMission, Truth, bare_result, lopsided_pair
from killed_writers import kill_writers
from recorded_numbers import assert_recorded, flat, numbers_by_line

from boresight.features.mission.archive import add_mounting, add_results, series_of
from boresight.features.mission.mounting_course import YEAR_S
from boresight.features.mission.saved_mounting import utc_at
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.pipeline.errors import RawDataError

PAIR = lopsided_pair()


def mission_in(archive, results=40, refuted=(), exchanged=None, seed=0, step=1.0):
    """An archive of drawn results, and their truth."""
    rng = np.random.default_rng(seed)
    truth = Truth(rng, results, annual=0.0, orbit=0.0, steps=(step, 0.0))
    mission, like = DrawnMission(PAIR, rng), bare_result(PAIR)
    for k, t_s in enumerate(truth.t_s):
        theta = truth.theta(truth.t_s[k : k + 1], truth.cos_sin[k : k + 1])
        changes = {"verdict": "refuted"} if k in refuted else {}
        changes |= {"star_camera": "B"} if exchanged is not None and k >= exchanged else {}
        one = mission.result(like, f"r{k:03d}", t_s, theta, cos_sin=truth.cos_sin[k], **changes)
        add_mounting(one, archive)
    return truth


def test_a_series_of_the_archive_is_that_of_its_results(tmp_path):
    mission_in(tmp_path, 6, refuted=(2,), exchanged=1)
    (found,) = series_of(tmp_path)
    assert found.series.names == ("r000", "r001", "r003", "r004", "r005")
    assert [(row["id"], row["reason"]) for row in found.left_out] == [("r002", "refuted")]
    assert found.series.exchanges == (1,)
    expected = 5 * PAIR.F[0, 3:, 3:] + DrawnMission(PAIR, np.random.default_rng(0)).prior
    np.testing.assert_allclose(found.series.shared_F, expected, rtol=1e-12)


def test_of_results_that_share_a_strip_the_one_added_last_counts(tmp_path):
    """A strip in two results has the same errors in both: its information would be counted twice."""
    mission, like = DrawnMission(PAIR, np.random.default_rng(1)), bare_result(PAIR)
    dates = np.array(["2021-01-01T00:00:00Z", "2021-01-01T00:05:00Z", "2021-01-01T00:10:00Z"])
    of = {"a": [0], "b": [1, 2], "c": [0, 1], "d": [2]}  # c shares a strip with a and with b, d with b alone
    for n, (name, strips) in enumerate(of.items()):
        add_mounting(
            mission.result(
                like,
                name,
                1e6 * n,
                np.zeros(3),
                scale=n + 1.0,
                strips=np.array([f"s{k}" for k in strips]),
                strips_utc=dates[strips],
                track_deg=np.full((len(strips), 4), np.nan),
                verdict="refuted" if name == "d" else "consistent",
            ),
            tmp_path,
        )
    (found,) = series_of(tmp_path)
    assert found.series.names == ("c",)
    reasons = {row["id"]: row["reason"] for row in found.left_out}
    assert reasons["a"] == "1 of its 1 strips are in c, added later"
    assert reasons["b"] == "1 of its 2 strips are in c, added later" and reasons["d"] == "refuted"
    expected = 3.0 * PAIR.F[0, 3:, 3:] + DrawnMission(PAIR, np.random.default_rng(0)).prior
    np.testing.assert_allclose(found.series.shared_F, expected, rtol=1e-9, atol=1e-9)


def test_references_of_results_do_not_matter(tmp_path):
    rng, like = np.random.default_rng(2), bare_result(PAIR)
    saved = [
        DrawnMission(PAIR, rng).result(like, f"r{k}", k * 1e6, rng.normal(size=3) * ARCSEC) for k in range(4)
    ]
    for one in saved:
        add_mounting(one, tmp_path / "one")
    turn = deviation_from_theta(np.array([1e-5, -2e-5, 3e-5]))
    for k, one in enumerate(saved):
        pair = one.pair.about(turn * PAIR.R_cs_ref) if k % 2 else one.pair
        add_mounting(
            type(one)(**{name: getattr(one, name) for name in one.__slots__} | {"pair": pair}),
            tmp_path / "two",
        )
    (one,), (two,) = series_of(tmp_path / "one"), series_of(tmp_path / "two")
    np.testing.assert_allclose(two.series.right, one.series.right, rtol=1e-7, atol=1e-3 / ARCSEC)
    np.testing.assert_allclose(two.series.shared_right, one.series.shared_right, rtol=1e-6, atol=1e-3)


def test_a_finished_result_is_added_once_and_read_by_pandas_and_as_a_geopackage(finished, tmp_path):
    asked = ("archive", "add", finished[1], "--to", tmp_path)
    assert "added" in invoked(*asked).output
    assert "there already" in invoked(*asked).output
    with sqlite3.connect(tmp_path / "archive.gpkg") as database:
        rows = pd.read_sql("SELECT * FROM results", database)
        targets = pd.read_sql("SELECT * FROM targets", database)
        (head,) = database.execute("PRAGMA application_id").fetchone()
        features = [row[0] for row in database.execute("SELECT table_name FROM gpkg_geometry_columns")]
    assert head == 0x47504B47 and sorted(features) == ["targets", "tracks"]
    installation = json.loads((finished[1] / "installation.json").read_text())
    assert rows["verdict"].tolist() == [installation["verdict"]["outcome"]]
    assert json.loads(rows["covariance_rad2"][0]) == installation["covariance_rad2"]
    assert abs(rows["beta_rad"][0]) < np.pi / 2
    blob = targets["geom"][0]
    assert blob[:4] == b"GP\x00\x01" and len(blob) == 8 + 21


def test_an_archive_of_one_result_says_in_json_what_a_trend_needs(finished, tmp_path):
    invoked("archive", "add", finished[1], "--to", tmp_path)
    told = ran("trends", tmp_path, "--out", tmp_path / "t", "--json", status=1)
    assert "two results" in json.loads(told.stdout)["error"]["message"]


def test_a_folder_without_a_result_is_refused(tmp_path):
    with pytest.raises(RawDataError, match="a finished result"):
        add_results([tmp_path], tmp_path / "archive")
    with pytest.raises(RawDataError, match="an archive that"):
        series_of(tmp_path / "none")


def test_two_writers_that_are_killed_lose_and_double_nothing(tmp_path):
    """`python tests/features/mission/killed_writers.py --kills 200` is the same at length."""
    told, wrong = kill_writers(tmp_path, 10)
    assert not wrong and told >= 5


def test_trends_tell_step_prediction_and_alarm(tmp_path):
    truth = mission_in(tmp_path / "a", 60, refuted=(7,), step=3.0)
    last = truth.t_s[-1]
    asked = ("trends", tmp_path / "a", "--out", tmp_path / "t", "--at", utc_at(last + YEAR_S / 12))
    ran(*asked, "--require-arcsec", 100)
    content = json.loads((tmp_path / "t" / "trends.json").read_text())
    (one,) = content["series"]
    assert not content["alarm"] and one["results"] == 59
    (step,) = one["steps"]
    assert abs(int(step["before"][1:]) - truth.rows[0]) <= 1
    assert utc_at(last)[:10] < one["now"]["valid_utc"][1][:10]
    calibration = json.loads((tmp_path / "t" / "calibration.json").read_text())
    assert calibration["R_cs"] == one["now"]["R_cs"]
    assert calibration["valid_to_utc"] == one["now"]["valid_utc"][1]
    theta = truth.theta(np.array([last + YEAR_S / 12]), np.zeros((1, 2)))[0]
    R_true = deviation_from_theta(theta) * PAIR.R_cs_ref
    error = theta_between(type(R_true).from_matrix(np.array(calibration["R_cs"])), R_true)
    assert squared(error, np.array(calibration["covariance_rad2"])) < 16.3  # chi2(3), 0.1 %
    page = (tmp_path / "t" / "trends.html").read_text()
    assert page.count("<a href=") >= 3 * 59 and "refuted" in page and "report.html" in page
    for picture in page.split("<svg")[1:4]:  # marks of the axis: evenly from top to bottom of the panel
        y, value = np.array(re.findall(r'd="M64,([\d.]+)H948"/><text[^>]*>([^<]+)<', picture), dtype=float).T
        assert 3 <= len(y) <= 7 and 12.0 <= y.min() and y.max() <= 222.0 and np.ptp(y) > 105.0
        assert np.diff(y) == pytest.approx(np.ptp(y) / np.ptp(value) * -np.diff(value), abs=0.11)  # px
    drawn = re.sub(r'href="[^"]*"', "", page.partition("<svg")[2].partition("</svg>")[0])  # places of results
    drawn = re.sub(r"(?=<(?:path|g|a|text)\b)", "\n", drawn)
    said = re.sub(r"<(svg|style|footer|head)\b.*?</\1>|<[^>]+>", " ", page, flags=re.DOTALL)
    assert_recorded("trends", flat("", content) | numbers_by_line(drawn + said), relative=1e-3)
    assert "does not reach what is required" in ran(*asked, "--require-arcsec", 0.001, status=4).output
    assert "a step in the last 90 days" in ran(*asked[:-1], step["utc"], status=4).output


def test_cameras_have_series_of_their_own(tmp_path):
    rng, like = np.random.default_rng(4), bare_result(PAIR)
    for camera in ("pan", "xs"):
        for k in range(3):
            saved = DrawnMission(PAIR, rng).result(like, f"{camera}{k}", k * 1e6, np.zeros(3), camera=camera)
            add_mounting(saved, tmp_path)
    assert [one.key[2] for one in series_of(tmp_path)] == ["pan", "xs"]


def test_calibrate_adds_its_result(finished, tmp_path):
    ran("calibrate", finished[0], "--out", finished[1], "--archive", tmp_path, "-q")
    with sqlite3.connect(tmp_path / "archive.gpkg") as database:
        assert database.execute("SELECT count(*) FROM results").fetchone() == (1,)
