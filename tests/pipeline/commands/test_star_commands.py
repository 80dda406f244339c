"""identify, centroids and star-camera-calibrate on rendered images, as a user types them."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "star_id"))

from frames import Sensor, star_frame

from geometry.star_camera import StarCamera
from pipeline.cli import app
from star_id.catalogue import hipparcos_stars

CAMERA = StarCamera(
    0.1, 25.6e-6, 1280, 960, (641.3, 477.2), p1=2.29e-5, p2=-2.96e-5, q1=-9.30e-7, q2=-4.25e-9
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Four images of the sky, one of nothing, and the truth."""
    path = tmp_path_factory.mktemp("sky")
    rng, rows = np.random.default_rng(4), []
    for k in range(4):
        image, truth = star_frame(
            CAMERA, Rotation.random(random_state=rng), hipparcos_stars(8.0).places, Sensor(hot_pixels=30), rng
        )
        cv2.imwrite(str(path / f"sky{k}.png"), image)
        rows.append(pd.DataFrame({"file": f"sky{k}.png", "flux_dn": truth.flux_dn}))
        rows[-1][["x_px", "y_px"]] = truth.xy_px
    cv2.imwrite(str(path / "dark.png"), rng.normal(20, 2, (960, 1280)).round().astype(np.uint8))
    pd.concat(rows).to_csv(path / "truth.csv", index=False)
    return path


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """An index made by one test serves the next, and the user's own cache is let alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def run(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_identify_prints_one_json_object_a_line(folder):
    done = run("identify", "--json", "--fov", 18.6, folder / "sky0.png", folder / "dark.png")
    assert done.exit_code == 0, done.output
    first, second = (json.loads(line) for line in done.stdout.splitlines()[:2])
    assert first["identified"] and first["matches"] > 15 and first["false_alarm_probability"] < 1e-9
    assert set(first) >= {"file", "ra_deg", "dec_deg", "roll_deg", "fov_x_deg", "rms_arcsec", "cpu_ms"}
    assert first["fov_x_deg"] == pytest.approx(18.6, rel=0.01)
    assert not second["identified"] and "not identified" in second["reason"]


def test_identify_draws_and_writes_world_coordinates(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = run("identify", "--fits", "--fov", 18.6, "--overlay", tmp_path / "seen.png", folder / "sky1.png")
    assert done.exit_code == 0, done.output
    assert cv2.imread(str(tmp_path / "seen.png")).shape == (960, 1280, 3)
    assert (tmp_path / "sky1.wcs.fits").stat().st_size > 2880


def test_nothing_identified_ends_with_status_1(folder):
    assert run("identify", "--fov", 18.6, folder / "dark.png").exit_code == 1


def test_centroids_are_scored_against_a_truth(folder, tmp_path):
    images = sorted(folder.glob("sky*.png"))
    out, plot = tmp_path / "stars.csv", tmp_path / "score.png"
    done = run(
        "centroids", *images, "--truth", folder / "truth.csv", "--gain", 40, "--out", out, "--plot", plot
    )
    assert done.exit_code == 0, done.output
    assert "x bound" in done.stdout and "false detections" in done.stdout
    assert len(pd.read_csv(out)) > 60
    assert plot.stat().st_size > 5000


def test_the_method_of_the_centroids_may_be_chosen(folder, tmp_path):
    tables = []
    for method in ("fit", "window"):
        out = tmp_path / f"{method}.csv"
        done = run("centroids", folder / "sky0.png", "--method", method, "--out", out)
        assert done.exit_code == 0, done.output
        tables.append(pd.read_csv(out))
    fit, window = (table.set_index(table["x_px"].round()) for table in tables)
    both = fit.join(window, rsuffix="_window", how="inner")
    assert len(both) > 0.9 * len(fit)
    shift = (both["x_px"] - both["x_px_window"]) / both["sigma_x_px"]
    assert 0.0 < np.median(np.abs(shift)) < 0.3  # standard errors: other sums of the same noise
    assert run("centroids", folder / "sky0.png", "--method", "guess").exit_code == 2


def test_a_truth_without_its_columns_is_named(folder, tmp_path):
    (tmp_path / "truth.csv").write_text("x,y\n1,2\n")
    done = CliRunner().invoke(
        app, ["centroids", str(folder / "sky0.png"), "--truth", str(tmp_path / "truth.csv")]
    )
    assert "x_px" in str(done.exception)


def test_a_camera_is_calibrated_and_then_known(folder, tmp_path):
    images = sorted(folder.glob("sky*.png"))
    out, report, plot = (tmp_path / name for name in ("camera.toml", "report.json", "map.png"))
    files = ("--out", out, "--report", report, "--plot", plot)
    done = run("star-camera-calibrate", *images, "--fov", 19.0, *files)
    assert done.exit_code == 0, done.output
    content = json.loads(report.read_text())
    scale = content["values"][0] / 5e-6 / (CAMERA.focal_m / CAMERA.pixel_m)  # the pixel pitch is not known
    assert scale == pytest.approx(1.0, abs=4.0 * np.sqrt(content["covariance"][0][0]) / content["values"][0])
    again = run("identify", "--json", "--camera", out, images[0])
    assert json.loads(again.stdout.splitlines()[0])["identified"]
