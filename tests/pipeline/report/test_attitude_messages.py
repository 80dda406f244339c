"""The report of a mission whose star camera delivers attitudes: Allan deviation, residuals by temperature."""

import csv
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import ran
from handmade import ATTITUDE_HEAD, give_heads
from pytest import approx
from scipy.spatial.transform import Rotation

from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.table_files import list_values

HEAD = (
    ATTITUDE_HEAD.format(rotation="inertial to head", removed="annual and orbital")
    + """
[star_cameras.noise]
white_arcsec = [1.0, 1.0, 6.0]
"""
)


@pytest.fixture(scope="module")
def of_attitudes(finished, tmp_path_factory) -> Path:
    """The strip of `finished`, whose star camera delivers the attitudes that its stars have given."""
    folder = tmp_path_factory.mktemp("attitudes")
    dump, result = folder / "dump", folder / "result"
    shutil.copytree(finished[0], dump)
    exposures = pq.read_table(finished[1] / "sightings/exposures.parquet")
    q = Rotation.from_matrix(list_values(exposures, "R_si", 3, 3)).as_quat()
    t_s = exposures.column("t_s").to_numpy()
    utc = open_dump(finished[0]).epoch.utc_from_seconds(t_s)
    with (dump / "str1.csv").open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["utc", "qx", "qy", "qz", "qw", "temperature_c"])
        warm = 20.0 + 0.5 * (t_s - t_s[0])  # 0.5 K a second
        rows.writerows([u.rstrip("Z"), *map(repr, one), w] for u, one, w in zip(utc, q.tolist(), warm))
    give_heads(dump, HEAD)
    ran("calibrate", dump, "--out", result, "--workers", 1)
    return result


def test_residuals_are_shown_against_the_temperature_at_their_time(of_attitudes):
    ground = pq.read_table(of_attitudes / "evidence/ground.parquet").to_pandas()
    ground = ground[ground.state == "used"]
    assert len(ground) > 8
    slope, _ = np.polyfit(ground.t_s, ground.temperature_c, 1)
    assert slope == approx(0.5, rel=1e-6)  # K a second, as the file states
    page = (of_attitudes / "report.html").read_text()
    assert "temperature of the star camera, °C" in page
    assert f"Residuals of {len(ground)} targets on the ground against temperature" in page


def test_allan_deviation_begins_with_the_noise_of_single_attitudes(of_attitudes, finished):
    # At one step it is the noise of single attitudes, and the motion of the satellite in between: 1 to 2
    # arcsec, which exceeds the noise about x and y but not about z. Of 14 attitudes: 20 %, a factor of 2.
    stated = pq.read_table(finished[1] / "sightings/exposures.parquet")
    sigma = np.sqrt(np.diagonal(list_values(stated, "covariance_s", 3, 3).mean(axis=0)))
    allan = pq.read_table(of_attitudes / "evidence/allan.parquet")
    assert allan.column("averaged_s")[0].as_py() == approx(0.2, abs=1e-6)  # s between exposures
    first = list_values(allan, "deviation_rad", 3)[0]
    assert np.all(first > 0.5 * sigma) and first[2] < 2.0 * sigma[2]
    page = (of_attitudes / "report.html").read_text()
    assert "Allan deviation, arc-seconds" in page and "STR1 against the nominal motion" in page
    in_time = pq.read_table(of_attitudes / "evidence/attitude_noise.parquet")
    turns = list_values(in_time, "turn_rad", 3)
    assert np.allclose(np.diff(in_time.column("t_s").to_numpy()), 0.2, atol=1e-6)
    assert np.allclose(np.sqrt(0.5 * np.mean(np.diff(turns, axis=0) ** 2, axis=0)), first, rtol=1e-6)
    assert "arc-seconds, less their median" in page


def test_a_mission_with_star_images_has_neither(finished):
    page = (finished[1] / "report.html").read_text()
    assert "Allan deviation" not in page and "temperature of the star camera" not in page
