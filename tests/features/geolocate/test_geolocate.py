"""Image points to the ground: places that lead back to their pixels, and a 1-sigma that the errors themselves
show.
"""

import csv
import io
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from command_line import ran
from edits import rows_of
from pytest import approx
from scipy.spatial.transform import Rotation

from boresight.features.geolocate.positions import Pixels, ground_places, read_pixels
from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.constants import ARCSEC, WGS84
from boresight.geometry.geodesy import ecef_from_geodetic
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.results.strip_model import open_calibrated, strip_model

PIXELS = "ccd,sample,line\n0,10,20\n1,255.5,1000.25\n3,500,1990\n"


@pytest.fixture(scope="module")
def calibrated(finished):
    return open_calibrated(finished[1], finished[0])


@pytest.fixture(scope="module")
def model(calibrated):
    return strip_model(calibrated, calibrated.dump.strips[0].strip_id)


def test_the_command_gives_places_that_lead_back_to_their_pixels(finished, model, tmp_path):
    (tmp_path / "pixels.csv").write_text(PIXELS)
    strip = model.strip.strip_id
    told = ran("geolocate", finished[1], "--strip", strip, "--pixels", tmp_path / "pixels.csv")
    rows = list(csv.DictReader(io.StringIO(told.stdout)))
    assert len(rows) == 3
    for row in rows:
        lat, lon = np.radians([float(row["lat_deg"]), float(row["lon_deg"])])
        p_e = ecef_from_geodetic(lat, lon, float(row["height_m"]), WGS84)
        sample, line = model.pushbroom.pixels_from_ground(int(row["ccd"]), p_e[None, :])
        # Heights are written to the millimetre, 1/6000 of a pixel of the fixture.
        assert (sample[0], line[0]) == approx((float(row["sample"]), float(row["line"])), abs=1e-3)
        assert 0.0 < float(row["sigma_across_m"]) < 50.0


def test_a_file_is_written_when_one_is_named(finished, model, tmp_path):
    (tmp_path / "pixels.csv").write_text(PIXELS)
    out = tmp_path / "places.csv"
    asked = ("geolocate", finished[1], "--dump", finished[0], "--strip", model.strip.strip_id)
    told = ran(*asked, "--pixels", tmp_path / "pixels.csv", "--out", out, "--height-m", 300)
    assert "3 of 3 image points have a place" in told.stdout
    assert [row["height_m"] for row in rows_of(out)] == ["300.000", "300.000", "300.000"]


@pytest.mark.parametrize("part", ["matrix", "position", "clock", "attitude", "vibration", "terrain"])
def test_each_sigma_is_the_scatter_that_its_error_makes(calibrated, model, part):
    # Each error drawn on its own, 200 times, put into the model itself. An rms of 200 draws is good to 5 %
    # (1 sigma), so 15 % holds for all twelve. What the interpolation of attitudes adds is always there.
    alone, height_m = only(calibrated, part), 400.0
    pixels = Pixels(np.array([3]), np.array([480.0]), np.array([1500.0]))
    surface = ConstantHeight(height_m)
    stated, floor = (
        ground_places(one, strip_model(one, model.strip.strip_id), pixels, surface)
        for one in (alone, only(calibrated, "nothing"))
    )
    rng = np.random.default_rng(8)
    base = model.pushbroom.ground_points(3, pixels.sample, pixels.line, surface)[0]
    moved = np.array([place_with_error(model, alone, part, rng, pixels, height_m) - base for _ in range(200)])
    motion = alone.dump.orbit.velocities_e(model.pushbroom.instants(pixels.line))[0]
    up = base / np.array([WGS84.semi_major_m, WGS84.semi_major_m, WGS84.semi_minor_m]) ** 2
    up /= np.linalg.norm(up)
    along = motion - up * (motion @ up)
    along /= np.linalg.norm(along)
    rms = np.sqrt(((moved @ np.column_stack([along, np.cross(along, up)])) ** 2).mean(axis=0))
    expected = np.sqrt(
        [
            stated.sigma_along_m[0] ** 2 - floor.sigma_along_m[0] ** 2,
            stated.sigma_across_m[0] ** 2 - floor.sigma_across_m[0] ** 2,
        ]
    )
    assert expected.max() > 0.05  # m: every source of error here moves the point by more
    large = expected > 0.05 * expected.max()  # a clock error has no part across the track to speak of
    assert rms[large] == approx(expected[large], rel=0.15)


def only(calibrated, part):
    """The same matrix, found from other strips, with one source of error left: the mission's others zero,
    covariances tiny.
    """
    errors = calibrated.dump.errors.model_copy(
        update={
            "position_m": 2.0 if part == "position" else 0.0,
            "clock_s": 1e-4 if part == "clock" else 0.0,
            "vibration_arcsec": 0.5 if part == "vibration" else 0.0,
            "look_distortion_px": 0.0,
        }
    )
    cov_theta = calibrated.result.cov_theta if part == "matrix" else 1e-30 * np.eye(3)
    n = len(calibrated.result.covariance_s)
    covariance = np.diag([4e-12, 9e-12, 4e-10]) if part == "attitude" else 1e-30 * np.eye(3)
    return replace(
        calibrated,
        result=replace(
            calibrated.result, cov_theta=cov_theta, covariance_s=np.tile(covariance, (n, 1, 1)), taken_up={}
        ),
        dump=replace(calibrated.dump, errors=errors),
        sigma_terrain_m=5.0 if part == "terrain" else 0.0,
    )


def place_with_error(model, calibrated, part, rng, pixels, height_m):
    push: Pushbroom = model.pushbroom
    if part == "matrix":
        push = push.with_installation(
            Rotation.from_rotvec(rng.multivariate_normal(np.zeros(3), calibrated.result.cov_theta))
            * push.R_cs
        )
    elif part == "vibration":
        push = push.with_installation(Rotation.from_rotvec(rng.normal(0.0, 0.5 * ARCSEC, 3)) * push.R_cs)
    elif part == "attitude":
        track = model.track
        draws = rng.normal(0.0, [2e-6, 3e-6, 2e-5], (len(track.t_s), 3))
        turned = AttitudeTrack(track.t_s, Rotation.from_rotvec(draws) * track.R_si_nodes, track.nominal)
        push = replace(push, attitude=turned)
    elif part == "position":
        orbit = replace(push.orbit, positions_m=push.orbit.positions_m + rng.normal(0.0, 2.0, 3))
        push = replace(push, orbit=orbit)
    elif part == "clock":
        late = rng.normal(0.0, 1e-4)
        push = replace(push, rows=replace(push.rows, t_first_row_s=push.rows.t_first_row_s + late))
    surface = ConstantHeight(height_m + (rng.normal(0.0, 5.0) if part == "terrain" else 0.0))
    return push.ground_points(3, pixels.sample, pixels.line, surface)[0]


def test_wrong_pixels_are_named_with_their_line(calibrated, tmp_path):
    path = tmp_path / "pixels.csv"
    path.write_text("ccd,sample,line\n0,1,2\n9,1,2\n")
    with pytest.raises(RawDataError, match=r"line 3, ccd: found 9, expected 0 to 3"):
        read_pixels(path, calibrated)
    path.write_text("ccd,sample,row\n0,1,2\n")
    with pytest.raises(RawDataError, match="column line"):
        read_pixels(path, calibrated)


@pytest.mark.parametrize("sample, line", [(-0.6, 5.0), (1e9, 5.0), (5.0, -0.6), (5.0, 1e9), (np.nan, 5.0)])
def test_pixels_outside_the_image_are_refused(calibrated, model, sample, line):
    inside = Pixels(np.array([0, 0]), np.array([-0.4, sample]), np.array([5.0, line]))
    said = r"point 2, (sample|line): found .*, expected -0.5 to \d+.5, inside"
    with pytest.raises(RawDataError, match=said):
        ground_places(calibrated, model, inside, ConstantHeight(0.0))


def test_a_strip_that_is_not_there_or_has_no_attitude_is_named(calibrated):
    with pytest.raises(RawDataError, match="nowhere"):
        strip_model(calibrated, "nowhere")
    result = replace(calibrated.result, usable=np.zeros_like(calibrated.result.usable))
    blind = replace(calibrated, result=result)
    with pytest.raises(DataNotSufficientError, match="0 usable star exposures"):
        strip_model(blind, calibrated.dump.strips[0].strip_id)


def test_a_dump_that_has_moved_is_asked_for(finished, tmp_path):
    moved = tmp_path / "result"
    shutil.copytree(finished[1], moved, ignore=shutil.ignore_patterns("work", "evidence", "report.html"))
    (moved / "run.json").write_text('{"dump": "/nowhere/at/all"}')
    owner = (moved / "boresight-result.json").read_text()
    (moved / "boresight-result.json").write_text(re.sub(r"\[[^]]*\]", '["/nowhere"]', owner))
    with pytest.raises(RawDataError, match="--dump"):
        open_calibrated(moved, None)


def test_rows_half_a_step_outside_the_exposures_have_a_place_as_in_matching(calibrated, model):
    """Exposures from line 500 on, one each 400 lines: places from line 300 on, with a larger sigma."""
    strip = model.strip
    period = strip.clock.row_period_s
    first = float(model.pushbroom.instants(np.array([500.0]))[0])
    t_s = first + 400.0 * period * np.arange(5)
    covariance = np.tile(1e-12 * np.eye(3), (5, 1, 1))
    track = AttitudeTrack(t_s, model.track.R_si(t_s), calibrated.dump.orbit, covariance)
    cut = replace(model, track=track, pushbroom=replace(model.pushbroom, attitude=track))
    pixels = Pixels(np.zeros(4, dtype=int), np.full(4, 50.0), np.array([250.0, 310.0, 400.0, 900.0]))
    surface = ConstantHeight(300.0)
    found, true = (ground_places(calibrated, one, pixels, surface) for one in (cut, model))
    assert np.isfinite(found.lat_deg).tolist() == [False, True, True, True]
    assert np.isfinite(found.sigma_along_m).tolist() == [False, True, True, True]
    metre_deg = 1.0 / 111e3  # of latitude
    assert np.abs(found.lat_deg - true.lat_deg)[1:].max() < 50.0 * metre_deg
    assert found.sigma_along_m[1] > found.sigma_along_m[3]
