"""identify, centroids and star-camera-calibrate on rendered images, as a user types them."""

import json
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import astropy.units as units
import cv2
import numpy as np
import pandas as pd
import pytest
from astropy.coordinates import GCRS, SkyCoord, get_sun
from astropy.io import fits
from astropy.time import Time
from astropy.wcs import WCS
from drawn_campaigns import squared
from drawn_pictures import SERIES_COLOURS, kept_figures, numbers, shows_curves
from matplotlib.quiver import QuiverKey
from recorded_numbers import assert_recorded, columns_of, numbers_by_line, numbers_in
from scipy.spatial.transform import Rotation

from boresight.pipeline.report.panels import OURS

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "star_id"))

from command_line import invoked as run
from command_line import ran
from frames import SMALL_CAMERA as CAMERA
from frames import Sensor, as_seen, directions_of, render, star_frame

import boresight as bs
from boresight.features.sky_images import centroid_report, field_plan, identify_images, star_camera_report
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.starlight import GroundSite
from boresight.pipeline.errors import RawDataError
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.field import nominal_camera
from boresight.star_id.observer import Observer
from boresight.star_id.settings import StarSettings

MINI = Path(__file__).resolve().parents[3] / "fixtures" / "mini"


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


def test_identify_prints_one_json_object_a_line(folder):
    done = ran("identify", "--json", "--fov", 18.6, folder / "sky0.png", folder / "dark.png")
    first, second = (json.loads(line) for line in done.stdout.splitlines()[:2])
    assert first["identified"] and first["matches"] > 15 and first["false_alarm_probability"] < 1e-9
    assert set(first) >= {"file", "ra_deg", "dec_deg", "roll_deg", "fov_x_deg", "rms_arcsec", "cpu_ms"}
    assert first["fov_x_deg"] == pytest.approx(18.6, rel=0.01)
    assert 0.0 < first["pointing_sigma_arcsec"] < first["roll_sigma_arcsec"] < 100.0
    # N stars, each off by rms in two axes together, leave rms / sqrt(2 N) in one axis of the pointing; stars
    # differ in their errors, so that the weighted mean has less
    usual = first["rms_arcsec"] / np.sqrt(2.0 * first["matches"])
    assert 0.4 * usual < first["pointing_sigma_arcsec"] < 1.2 * usual
    assert 0.0 < first["fov_x_sigma_deg"] < 1e-3 * first["fov_x_deg"]
    assert not second["identified"] and "not identified" in second["reason"]
    ran("identify", "--fov", 18.6, folder / "dark.png", status=1)
    found = bs.identify(folder / "sky0.png", fov_deg=18.6)  # to the last digit, errors too
    stated = tuple(first[key] for key in ("ra_deg", "dec_deg", "roll_deg"))
    assert stated == (found.ra_deg, found.dec_deg, found.roll_deg)
    assert (first["pointing_sigma_arcsec"], first["roll_sigma_arcsec"]) == found.sigma_arcsec
    assert first["fov_x_sigma_deg"] == np.degrees(found.field.fov_x_sigma_rad)


def test_identify_draws_and_writes_world_coordinates(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ran("identify", "--fits", "--fov", 18.6, "--overlay", tmp_path / "seen.png", folder / "sky1.png")
    assert cv2.imread(str(tmp_path / "seen.png")).shape == (960, 1280, 3)
    asked = json.loads(run("identify", "--json", "--fov", 18.6, folder / "sky1.png").stdout.splitlines()[0])
    with fits.open(tmp_path / "sky1.wcs.fits") as hdus:
        middle = WCS(hdus[0].header).pixel_to_world(639.5, 479.5)  # of 1280 x 960 px
        assert len(hdus["STARS"].data) == asked["matches"]
    stated = SkyCoord(asked["ra_deg"] * units.deg, asked["dec_deg"] * units.deg)
    assert middle.separation(stated).arcsec < 30.0  # aberration of images without a time; a pixel is 52


def test_world_coordinates_of_a_mirror_image_hold_for_its_own_pixels(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("turned.png", cv2.imread(str(folder / "sky1.png"), cv2.IMREAD_UNCHANGED)[:, ::-1])
    assert (
        "MIRROR IMAGE" in ran("identify", "--fits", "--fov", 18.6, folder / "sky1.png", "turned.png").stdout
    )
    seen = {}
    for name in ("sky1", "turned"):
        with fits.open(f"{name}.wcs.fits") as hdus:
            table = np.sort(hdus["STARS"].data, order="HIP")
            seen[name] = table, WCS(hdus[0].header).pixel_to_world(table["X_PX"], table["Y_PX"])
    (table, at), (turned, turned_at) = seen["sky1"], seen["turned"]
    same, here, there = np.intersect1d(table["HIP"], turned["HIP"], return_indices=True)
    assert len(same) > 15
    assert np.abs(table["X_PX"][here] + turned["X_PX"][there] - 1279.0).max() < 0.5  # of 1280 columns
    assert np.abs(table["DX_PX"][here] + turned["DX_PX"][there]).max() < 0.5
    assert at[here].separation(turned_at[there]).arcsec.max() < 30.0  # half a pixel


def test_centroids_are_scored_against_a_truth(folder, tmp_path):
    images = sorted(folder.glob("sky*.png"))
    out, plot = tmp_path / "stars.csv", tmp_path / "score.png"
    asked = ("--truth", folder / "truth.csv", "--gain", 40, "--out", out, "--plot", plot)
    scores = []
    with kept_figures(centroid_report) as figures, pytest.MonkeyPatch.context() as patch:
        scored = centroid_report.score_centroids
        patch.setattr(
            centroid_report, "score_centroids", lambda *a, **k: scores.append(scored(*a, **k)) or scores[0]
        )
        done = ran("centroids", *images, *asked)
    assert shows_curves(plot, *SERIES_COLOURS[:2])
    (score,), table, truth = scores, pd.read_csv(out), pd.read_csv(folder / "truth.csv")
    found = columns_of(table)
    sizes = (found["sigma_x_px"] ** 2, found.pop("cov_xy_px2"), found["sigma_y_px"] ** 2)
    found["cov_px2"] = np.concatenate(sizes)  # covariances of round stars are rounding beside the variances
    assert_recorded("centroids", found | {f"score {key}": getattr(score, key) for key in score.__slots__})
    assert len(table) > 60 and table["file"].nunique() == len(images)
    rows = done.stdout.splitlines()
    bins = [numbers(line) for line in rows if re.match(r" +\d+ - +(\d+|inf) ", line)]
    seen = np.flatnonzero(score.stars)
    for k, found in zip(seen, bins, strict=True):
        printed = [score.stars[k], score.found[k] / score.stars[k], score.rms_px[k], score.bound_px[k]]
        printed += [*(np.array([score.rms_px[k], score.rms_error_px[k]]) / score.bound_px[k])]
        printed += [score.chi2[k], score.chi2_error[k]]
        assert found[-8:] == pytest.approx(printed, abs=5.1e-3)
        assert found[0] == pytest.approx(score.snr_edges[k], abs=0.51)
    last = numbers(rows[-1]), np.abs(score.phase_bias_px), score.phase_error_px
    assert last[0] == pytest.approx([np.nanmax(last[1]), np.nanmax(last[2])], abs=5.1e-5)
    # Every detection near a star of the truth is off by the errors of its row, and has its flux.
    pairs = []
    for name, rows_of in table.groupby("file"):
        true = truth[truth["file"] == Path(name).name] if "file" in truth else truth
        for one in rows_of[~rows_of["saturated"] & ~rows_of["blended"]].itertuples():
            off = np.hypot(true["x_px"] - one.x_px, true["y_px"] - one.y_px)
            if off.min() < 1.0:
                star = true.loc[off.idxmin()]
                C = np.array([[one.sigma_x_px**2, one.cov_xy_px2], [one.cov_xy_px2, one.sigma_y_px**2]])
                d = np.array([one.x_px - star["x_px"], one.y_px - star["y_px"]])
                pairs.append((d @ np.linalg.solve(C, d), one.flux_dn / star["flux_dn"], one.snr))
    distance2, flux, snr = np.array(pairs).T
    # 60 stars and more: the mean of chi2 of two has a standard error of 0.26, the median of some 0.2
    assert 1.2 < np.mean(np.minimum(distance2, 12.0)) < 2.9
    assert np.median(flux[snr > 25.0]) == pytest.approx(1.0, abs=0.03)  # fainter ones are found when bright
    left, right = figures[0].axes
    middle = np.sqrt(score.snr_edges[:-1] * np.minimum(score.snr_edges[1:], 2.0 * score.snr_edges[:-1]))
    for line, values in zip(left.lines, (score.rms_px, score.bound_px)):
        assert np.array_equal(line.get_ydata(), values, equal_nan=True)
        assert np.allclose(line.get_xdata(), middle)
    for axis, container in enumerate(right.containers):
        x, y = container.lines[0].get_data()
        assert np.array_equal(y, score.phase_bias_px[:, axis], equal_nan=True)
        n = len(y)  # the phases of a pixel, from its left edge to its right one, about its centre
        assert x[0] == pytest.approx(-0.5 + 0.5 / n) and np.allclose(np.diff(x), 1.0 / n)


def test_centroids_are_held_to_limits(folder, tmp_path):
    images, junit = sorted(folder.glob("sky*.png")), tmp_path / "junit.xml"
    given = ("centroids", *images, "--truth", folder / "truth.csv", "--gain", 40, "--junit", junit)
    kept = run(*given, "--max-x-bound", 1.3, "--min-complete", 0.99)
    assert kept.exit_code == 0 and "all 2 limits kept" in kept.stdout, kept.output
    missed = run(*given, "--max-x-bound", 0.5, "--min-complete", 0.99)
    assert missed.exit_code == 4 and "MISSED  max-x-bound" in missed.stdout
    suite = ElementTree.parse(junit).getroot()
    assert (suite.get("tests"), suite.get("failures")) == ("2", "1")
    assert run("centroids", images[0], "--max-x-bound", 1.1).exit_code == 2  # without a truth


def test_a_truth_without_its_columns_is_named(folder, tmp_path):
    (tmp_path / "truth.csv").write_text("x,y\n1,2\n")
    done = run("centroids", folder / "sky0.png", "--truth", tmp_path / "truth.csv")
    assert "x_px" in str(done.exception)


def assert_calibration_is_printed(lines, content):
    """Each line has the numbers of the report."""
    sigma, values = np.sqrt(np.diag(content["covariance"])), content["values"]
    stars, frames, outliers, rms, chi2_dof = numbers(lines[0].replace("chi2/dof", ""))
    assert (stars, frames, outliers) == (content["stars"], len(content["frames_used"]), content["outliers"])
    assert rms == pytest.approx(content["rms_px"], abs=5.1e-5)
    assert chi2_dof == pytest.approx(content["chi2"] / content["dof"], abs=5.1e-3)
    assert numbers(lines[1])[:3] == pytest.approx([1e3 * values[0], 1e3 * sigma[0], 5.0], abs=5.1e-7)
    assert numbers(lines[2]) == pytest.approx([*values[1:3], *sigma[1:3]], abs=5.1e-4)
    for k, name in enumerate(content["parameters"][3:], start=3):
        found = numbers(next(line for line in lines if line.startswith(name)).removeprefix(name))
        assert found == pytest.approx([values[k], sigma[k]], rel=0.06)
    error = content["error_anywhere_95_px"]
    at = next(k for k, line in enumerate(lines) if line.startswith("error of the map"))
    assert numbers(lines[at])[1:] == pytest.approx(list(error.values()), abs=5.1e-5)
    factor = content["sigmas_anywhere_95"]
    places = [error["middle"] / factor, error["corner"] / factor]
    assert numbers(lines[at + 1])[1:3] == pytest.approx(places, abs=5.1e-5)
    assert numbers(lines[at + 1])[3] == pytest.approx(factor, abs=0.051)


def assert_map_is_drawn(axes, cells):
    """Arrows of mean residuals in the middles of cells, the longest nine tenths of one, beside circles."""
    mean, error, count = (np.array(cells[key]) for key in ("mean_px", "error_px", "count"))
    circles, arrows = axes.collections
    rows, columns = count.shape
    middles = [
        ((column + 0.5) * CAMERA.width_px / columns, (row + 0.5) * CAMERA.height_px / rows)
        for row in range(rows)
        for column in range(columns)
    ]
    assert np.allclose(arrows.get_offsets(), middles)
    seen = count.ravel() > 0
    assert np.allclose(np.column_stack([arrows.U, arrows.V])[seen], mean.reshape(-1, 2)[seen])
    side = min(CAMERA.width_px / columns, CAMERA.height_px / rows)
    longest = np.hypot(*mean.reshape(-1, 2).T).max()
    assert longest / arrows.scale == pytest.approx(0.9 * side)  # px of the picture
    (key,) = (artist for artist in axes.artists if isinstance(artist, QuiverKey))
    # the largest power of ten below the longest arrow
    decade = float(f"1e{f'{longest:e}'.partition('e')[2]}")
    assert key.U == pytest.approx(decade) and float(key.label.removesuffix(" px")) == pytest.approx(decade)
    assert np.allclose(circles.get_offsets(), np.array(middles)[seen])
    assert np.allclose(circles.get_widths(), 2.0 * error.ravel()[seen] / arrows.scale)
    assert axes.get_ylim()[0] > CAMERA.height_px > 0.0 > axes.get_ylim()[1]  # row 0 on top


def test_a_camera_is_calibrated_and_then_known(folder, tmp_path):
    images = sorted(folder.glob("sky*.png"))
    out, report, plot = (tmp_path / name for name in ("camera.toml", "report.json", "map.png"))
    files = ("--out", out, "--report", report, "--plot", plot)
    with kept_figures(star_camera_report) as figures:
        done = ran("star-camera-calibrate", *images, "--fov", 19.0, *files)
    content = json.loads(report.read_text())
    assert_calibration_is_printed(done.stdout.splitlines(), content)
    assert_map_is_drawn(figures[0].axes[0], content["residual_map"])
    scale = content["values"][0] / 5e-6 / (CAMERA.focal_m / CAMERA.pixel_m)  # the pixel pitch is not known
    assert scale == pytest.approx(1.0, abs=4.0 * np.sqrt(content["covariance"][0][0]) / content["values"][0])
    found = bs.calibrate_star_camera(images, fov_deg=19.0)
    np.testing.assert_array_equal(found.fit.covariance, content["covariance"])
    xy = found.table()[["x_px", "y_px", "residual_x_px", "residual_y_px"]]
    np.testing.assert_array_equal(xy, np.hstack([found.fit.xy_px, found.fit.residual_px]))
    again = run("identify", "--json", "--camera", out, images[0])
    assert json.loads(again.stdout.splitlines()[0])["identified"]


def pointing(*arguments):
    """Direction of an image's middle as `identify` states it."""
    done = ran("identify", "--json", "--fov", 18.6, *arguments)
    line = json.loads(done.stdout.splitlines()[0])
    return SkyCoord(line["ra_deg"] * units.deg, line["dec_deg"] * units.deg)


def times_of(path, *names, utc="2020-01-01T00:00:00Z"):
    path.write_text("file,utc_mid\n" + "".join(f"{name},{utc}\n" for name in names))
    return path


def test_times_take_out_the_aberration_that_astropy_knows(folder, tmp_path):
    """The image's middle is where the light comes from; the star there stands elsewhere in the catalogue."""
    times = times_of(tmp_path / "times.csv", "sky0.png")
    sure = tmp_path / "settings.toml"  # without time, stars that move are otherwise weighed less
    sure.write_text("[stars]\nepoch_error_years = 1e-6\n", "utf-8")
    plain = pointing(folder / "sky0.png", "--settings", sure)
    moved = pointing(folder / "sky0.png", "--times", times)
    utc = Time("2020-01-01T00:00:00", scale="utc")
    theirs = plain.transform_to(GCRS(obstime=utc))
    expected = SkyCoord(theirs.ra, theirs.dec)
    assert moved.separation(plain).arcsec > 1.0
    assert moved.separation(expected).arcsec < 0.05  # of 20; the stars' parallaxes make a hundredth


def test_a_place_on_the_ground_takes_out_the_air(tmp_path):
    """A sky 40 degrees high, seen from the ground: the minute of arc by which air lifts it, and the lens that
    its uneven lift imitates, are gone when the site is given."""
    epoch = Epoch.from_utc("2020-01-01T00:00:00Z")
    site = GroundSite.in_standard_weather(np.radians(-31.0), np.radians(149.0), 1165.0)
    state = site.at(EarthRotation.over(epoch, 0.0, 1.0, bundled_earth_orientation()), 0.0)
    observer = Observer(epoch, 0.0, state.p_i, state.v_i, state.air)
    sky = as_seen(hipparcos_stars(8.0).places, observer)
    level = np.cross(state.air.zenith_i, [0.6, 0.0, 0.8])
    turn = Rotation.from_rotvec(np.radians(50.0) * level / np.linalg.norm(level))
    R_si = Rotation.align_vectors([[0.0, 0.0, 1.0]], [turn.apply(state.air.zenith_i)])[0]
    image, _ = star_frame(CAMERA, R_si, sky, Sensor(), np.random.default_rng(5))
    cv2.imwrite(str(tmp_path / "low.png"), image)
    times = times_of(tmp_path / "times.csv", "low.png")
    x, y, z = R_si.inv().apply(CAMERA.directions_from_pixels([[639.5, 479.5]]))[0]
    truth = SkyCoord(x=x, y=y, z=z, representation_type="cartesian")
    truth = SkyCoord(truth.spherical.lon, truth.spherical.lat)
    place = ("--times", times, "--site", -31.0, 149.0, 1165.0)
    on_the_ground, in_space = (pointing(tmp_path / "low.png", *one) for one in (place, place[:2]))
    assert on_the_ground.separation(truth).arcsec < 4.0  # 0.05 px, five of the errors stated
    assert in_space.separation(truth).arcsec > 50.0


def test_what_is_said_of_times_and_places_must_be_whole(folder, tmp_path):
    image, times = folder / "sky0.png", times_of(tmp_path / "times.csv", "another.png")
    for arguments, says in (
        (("--times", times), "no row for sky0.png"),
        (("--site", 50.0, 8.0, 100.0), "expected --times as well"),
        (("--orbit", MINI / "orbit.oem"), "expected --times as well"),
        (("--times", times_of(tmp_path / "b.csv", "sky0.png"), "--site", 95.0, 8.0, 100.0), "95.0, 8.0"),
        (("--times", times_of(tmp_path / "c.csv", "sky0.png", utc="2020-02-30T00:00:00Z")), "2020-02-30"),
        (("--times", times_of(tmp_path / "d.csv", "sky0.png", "sky0.png")), "each file once"),
    ):
        for command in ("identify", "star-camera-calibrate"):
            done = run(command, image, *arguments)
            assert isinstance(done.exception, RawDataError) and says in str(done.exception), (command, says)
    (tmp_path / "again").mkdir()
    (tmp_path / "again" / "sky0.png").write_bytes(image.read_bytes())
    times = times_of(tmp_path / "e.csv", "sky0.png")
    done = run("identify", image, tmp_path / "again" / "sky0.png", "--times", times)
    assert isinstance(done.exception, RawDataError) and "in several folders" in str(done.exception)
    assert run("identify", "--fits", image, "--times", times).exit_code == 2
    done = run("star-camera-calibrate", image, "--drift")
    assert isinstance(done.exception, RawDataError) and "--times" in str(done.exception)


def test_a_star_camera_is_calibrated_by_the_exposures_of_a_dump(tmp_path, monkeypatch):
    find, full_dn = star_camera_report.list_stars, set()
    monkeypatch.setattr(
        star_camera_report, "list_stars", lambda image, of: full_dn.add(of.saturation_dn) or find(image, of)
    )
    report = tmp_path / "report.json"
    files = ("--out", tmp_path / "camera.toml", "--report", report)
    done = run("star-camera-calibrate", MINI, "--drift", *files)
    assert done.exit_code == 0 and full_dn == {255.0}, done.output  # 8 bits
    content = json.loads(report.read_text())
    # rendered with 0.1 m, the principal point (512, 384), and Table 2's distortion, which has no q3
    truth = np.array([0.1, 512.0, 384.0, 2.29e-5, -2.96e-5, -9.30e-7, -4.25e-9])
    assert content["parameters"][7:] == ["q3"] and content["values"][7] == 0.0
    error = np.array(content["values"][:7]) - truth
    # chi2 of 7 degrees: 2e-4 on either side
    assert 0.4 < squared(error, np.array(content["covariance"])[:7, :7]) < 27.0
    assert abs(content["focal_drift_per_s"]) < 4.0 * content["focal_drift_sigma_per_s"]
    assert len(content["frames_used"]) == 42 and "drift of the focal length" in done.stdout


def test_an_image_that_cannot_be_read_is_left_out_and_told(folder, tmp_path):
    (tmp_path / "torn.png").write_bytes((folder / "sky0.png").read_bytes()[:2000])
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((64, 64), np.uint8))
    images = [*sorted(folder.glob("sky*.png")), tmp_path / "torn.png", tmp_path / "small.png"]
    report = tmp_path / "report.json"
    files = ("--out", tmp_path / "camera.toml", "--report", report)
    done = ran("star-camera-calibrate", *images, "--fov", 19.0, *files)
    rows = json.loads(report.read_text())["frames_refused"]
    refused = {Path(row["file"]).name: row["reason"] for row in rows}
    assert set(refused) == {"torn.png", "small.png"} and "64 x 64 px" in refused["small.png"]
    assert all(f"{name} not used" in done.stdout.replace(str(tmp_path) + "/", "") for name in refused)
    alone = run("star-camera-calibrate", tmp_path / "torn.png", "--fov", 19.0)
    assert alone.exit_code == 1 and "no image could be read" in alone.stdout


@pytest.fixture(scope="module")
def fisheyes(tmp_path_factory):
    """Four images by an equisolid lens of 150 deg, whose corners show what is behind the camera."""
    path, size = tmp_path_factory.mktemp("fisheye"), np.array([1200, 900])
    places, rng = hipparcos_stars(6.0).places, np.random.default_rng(6)
    focal_px = 600.0 / (2.0 * np.sin(0.25 * np.radians(150.0)))
    for k in range(4):
        u_s = Rotation.random(random_state=rng).apply(directions_of(places))
        angle = np.arccos(np.clip(u_s[:, 2], -1.0, 1.0))
        radius = 2.0 * focal_px * np.sin(0.5 * angle)
        xy = 0.5 * (size - 1.0) + [2.0, -1.5] - u_s[:, :2] * (radius / np.sin(angle))[:, None]
        seen = (angle < np.radians(89.0)) & ((xy > 0.0) & (xy < size - 1.0)).all(axis=1)
        flux = 150.0 * 10.0 ** (-0.4 * (places.v_mag[seen] - 5.0))
        cv2.imwrite(str(path / f"sky{k}.png"), render(xy[seen], flux, *size.tolist(), Sensor(), rng))
    return path


def test_a_fisheye_of_150_deg_is_identified_calibrated_and_known(fisheyes, tmp_path):
    images = sorted(fisheyes.glob("sky*.png"))
    first = json.loads(run("identify", "--json", "--fov", 155, images[0]).stdout.splitlines()[0])
    assert first["identified"] and first["fov_x_deg"] == pytest.approx(150.0, rel=1e-3)
    out, report, plot = tmp_path / "camera.toml", tmp_path / "camera.json", tmp_path / "map.png"
    files = ("--out", out, "--report", report, "--plot", plot)
    done = run("star-camera-calibrate", *images, "--fov", 145, *files)
    assert done.exit_code == 0 and "projection  equidistant" in done.stdout, done.output
    error = json.loads(report.read_text())["error_anywhere_95_px"]
    assert 0.0 < error["middle"] <= error["largest"] < 0.3 and error["corner"] > 0.0
    known = json.loads(run("identify", "--json", "--camera", out, images[1]).stdout.splitlines()[0])
    assert known["identified"] and known["matches"] > 0.9 * first["matches"]
    assert known["fov_x_deg"] == pytest.approx(150.0, rel=2e-4)  # 0.3 px of 1200
    flat = run("identify", "--fits", "--camera", out, images[1])
    assert isinstance(flat.exception, RawDataError) and "no tangent plane" in str(flat.exception)
    beyond = run("identify", "--fov", 180, images[0])
    assert isinstance(beyond.exception, RawDataError) and "0.5 and 175 degrees" in str(beyond.exception)


def test_fields_are_planned_away_from_the_sun(folder, tmp_path):
    out, plot = tmp_path / "plan.csv", tmp_path / "plan.png"
    utc = "2026-03-01T12:00:00Z"
    given = ("--fov", 18.6, "--frames", 5, "--candidates", 120, "--utc", utc, "--sun-deg", 80)
    with kept_figures(field_plan) as figures:
        done = ran("star-camera-plan", folder / "sky0.png", *given, "--out", out, "--plot", plot)
    table = pd.read_csv(out)
    assert table["image"].tolist() == [1, 2, 3, 4, 5] and shows_curves(plot, OURS)
    assert_recorded("star_camera_plan", columns_of(table))
    printed = numbers_by_line(done.stdout.replace(str(tmp_path), "").replace(str(folder), ""))
    assert_recorded("printed_star_camera_plan", printed, relative=5e-4)  # a last digit may round otherwise
    assert (table["largest_sigma_px"] < table["random_sigma_px"]).all()
    middle = SkyCoord(table["ra_deg"].to_numpy() * units.deg, table["dec_deg"].to_numpy() * units.deg)
    sun = get_sun(Time(utc.removesuffix("Z"), scale="utc"))
    assert middle.separation(SkyCoord(sun.ra, sun.dec)).deg.min() > 80.0
    sky, error = figures[0].axes
    for line, key in zip(error.lines, ("largest_sigma_px", "random_sigma_px"), strict=True):
        assert np.allclose(line.get_data(), [table["image"], table[key]])
    # Edges that are drawn are half a detector's height to half its diagonal from the middle of their field.
    low, high = np.degrees(np.arctan(np.tan(np.radians(9.3)) * np.array([960.0 / 1280.0, 1.25])))
    drawn = np.concatenate([np.column_stack(line.get_data()) for line in sky.lines])
    off = SkyCoord(*(drawn.T[:, :, None] * units.deg)).separation(middle[None]).deg
    assert len(drawn) == 120 * len(table)
    assert all(np.ptp(line.get_xdata()) < 180.0 for line in sky.lines)  # cut where it leaves the map
    assert ((off > 0.99 * low) & (off < 1.01 * high)).any(axis=1).all()
    assert np.allclose(np.sort(off[off > 0.995 * high])[[0]], high, rtol=0.02)
    for row, printed in zip(table.itertuples(), done.stdout.splitlines()[-7:-2], strict=True):
        stated = [row.image, row.ra_deg, row.dec_deg, row.roll_deg, row.stars, row.largest_sigma_px]
        assert numbers(printed) == pytest.approx([*stated, row.random_sigma_px], abs=5.1e-3)
    # the attitudes beside them look the same way: the optical axis is near the image's middle
    axes = Rotation.from_quat(table[["qx_si", "qy_si", "qz_si", "qw_si"]]).inv().apply([0.0, 0.0, 1.0])
    assert np.degrees(np.arccos((axes * middle.cartesian.xyz.value.T).sum(axis=1))).max() < 1.0


def test_a_camera_that_is_not_yet_built_is_planned_by_its_numbers(folder, tmp_path):
    """The numbers of the sensor that took an image give the same fields' errors as the image."""
    usual = ("--frames", 4, "--candidates", 60)
    sensor = Sensor()
    noise_e = np.hypot(sensor.read_noise_dn, 12.0**-0.5) * sensor.e_per_dn  # and of rounding
    flux = sensor.flux_at_v7_dn * sensor.e_per_dn
    snr_at_v7 = flux / (noise_e * np.sqrt(4.0 * np.pi) * sensor.sigma_px)
    numbers = (
        *("--limit-mag", 7.0 + 2.5 * np.log10(snr_at_v7 / 5.5), "--noise-e", noise_e),
        *("--psf-sigma-px", sensor.sigma_px, "--full-e", (255.0 - sensor.background_dn) * sensor.e_per_dn),
    )
    out = [tmp_path / "image.csv", tmp_path / "numbers.csv"]
    assert run("star-camera-plan", folder / "sky0.png", "--fov", 18.6, *usual, "--out", out[0]).exit_code == 0
    given = ("--size", 1280, 960, "--fov", 18.6, *numbers, *usual)
    done = run("star-camera-plan", *given, "--wanted-px", 0.5, "--out", out[1])
    assert done.exit_code == 0 and "1 images reach 0.5 px" in done.stdout, done.output
    image, planned = (pd.read_csv(path)["largest_sigma_px"] for path in out)
    # gain, width and zero point of one image are good to some per cent; the lens is without distortion
    np.testing.assert_allclose(planned, image, rtol=0.2)
    assert run("star-camera-plan", *given, "--wanted-px", 1e-3).exit_code == 4
    # the field of view by focal length and pitch is the same camera
    focal_mm = 1280 * 6e-3 / 2.0 / np.tan(np.radians(9.3))
    geometry = ("--size", 1280, 960, "--focal-mm", focal_mm, "--pixel-um", 6.0)
    run("star-camera-plan", *geometry, *numbers, *usual, "--out", tmp_path / "focal.csv")
    same = pd.read_csv(tmp_path / "focal.csv")["largest_sigma_px"]
    np.testing.assert_allclose(same, planned, rtol=1e-9)  # rounding


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ((), "--size"),
        (("--size", 1000, 1000), "--fov and --focal-mm"),
        (("--size", 1000, 1000, "--fov", 10, "--focal-mm", 50), "--fov and --focal-mm"),
        (("--size", 1000, 1000, "--focal-mm", 50), "--pixel-um"),
        (("--size", 1000, 1000, "--fov", 10), "--limit-mag"),
        (("--size", 1000, 1000, "--fov", 120, "--limit-mag", 6), "between 0.5 and 90"),
        (("--size", 1000, 31, "--fov", 20, "--limit-mag", 6), "32 pixels"),
    ],
)
def test_what_a_planned_camera_lacks_is_named(given, named):
    wrong = run("star-camera-plan", *given)
    assert isinstance(wrong.exception, RawDataError) and named in str(wrong.exception)


def test_the_smallest_and_widest_cameras_that_are_not_refused_have_the_field_that_is_stated():
    for size_px, fov_deg in (((32, 50), 89.9), ((900, 32), 0.51)):
        camera = field_plan.camera_of_numbers(
            field_plan.CameraNumbers(size_px=size_px, fov_deg=fov_deg), None
        )
        assert (camera.width_px, camera.height_px) == size_px
        assert np.degrees(camera.fov_x_rad) == pytest.approx(fov_deg, rel=1e-9)
    for fov_deg in (90.1, 0.49):
        with pytest.raises(RawDataError, match=r"between 0\.5 and 90"):
            field_plan.camera_of_numbers(field_plan.CameraNumbers(size_px=(32, 32), fov_deg=fov_deg), None)


@pytest.mark.parametrize("size_px", [(1920, 1080), (1024, 1024), (1200, 1500)])  # wide, square, tall
@pytest.mark.parametrize("fov_deg", [1.5, 64.0])  # beyond those of unknown cameras on either side
def test_triangles_are_as_large_as_those_of_any_image_of_a_stated_field_within_its_tolerance(
    fov_deg, size_px, monkeypatch
):
    spans = []
    monkeypatch.setattr(identify_images, "_built", spans.append)
    for tolerance in (0.1, 0.3):
        settings = StarSettings(fov_tolerance=tolerance)
        identify_images.sky_index(None, fov_deg, settings)
        for off in (1.0 - tolerance, 1.0, 1.0 + tolerance):
            camera = nominal_camera(size_px, np.radians(off * fov_deg))
            identify_images.sky_index(camera, None, settings)
            # the image of 4:3 whose detector has the same area, by its two corners
            wide = np.sqrt(camera.width_px * camera.height_px * 4.0 / 3.0) * camera.pixel_m
            assert spans[-1] == pytest.approx(2.0 * np.arctan(0.5 * wide / camera.focal_m), rel=1e-9)
            low, high = spans[0]
            assert low < spans.pop() < high
        spans.clear()


def test_a_field_of_too_few_stars_is_no_plan():
    done = run("star-camera-plan", "--size", 1000, 1000, "--fov", 1, "--limit-mag", 4, "--candidates", 40)
    assert done.exit_code == 1 and "do not determine the camera" in done.stdout


def test_no_plan_is_an_answer(folder):
    done = run("star-camera-plan", folder / "dark.png", "--fov", 18.6)
    assert done.exit_code == 1 and "no plan" in done.stdout
    few = run("star-camera-plan", folder / "sky0.png", "--fov", 18.6, "--frames", 9, "--candidates", 5)
    assert few.exit_code == 1 and "5 pointings to choose 9 from" in few.stdout
    wrong = run("star-camera-plan", folder / "sky0.png", "--fov", 18.6, "--utc", "tomorrow")
    assert isinstance(wrong.exception, RawDataError) and "tomorrow" in str(wrong.exception)


def test_the_time_in_a_header_counts_and_its_lack_is_in_the_stated_errors(folder, tmp_path):
    pixels = cv2.imread(str(folder / "sky0.png"), cv2.IMREAD_UNCHANGED)
    unit = fits.PrimaryHDU(pixels)
    unit.writeto(tmp_path / "plain.fits")
    unit.header["DATE-OBS"] = "2020-01-01T00:00:00"
    unit.writeto(tmp_path / "dated.fits")
    times = times_of(tmp_path / "times.csv", "plain.fits")
    files = (tmp_path / "plain.fits", tmp_path / "dated.fits")
    command = ("identify", "--json", "--fov", 18.6)
    plain, dated = (json.loads(run(*command, path).stdout) for path in files)
    told = json.loads(run(*command, files[0], "--times", times).stdout)
    assert dated["ra_deg"] == told["ra_deg"] and dated["fov_x_sigma_deg"] == told["fov_x_sigma_deg"]
    # an unknown velocity of the Earth changes the field of view by 5.7e-5 of itself, 1 sigma
    lack = np.sqrt(plain["fov_x_sigma_deg"] ** 2 - dated["fov_x_sigma_deg"] ** 2) / plain["fov_x_deg"]
    assert lack == pytest.approx(5.7e-5, rel=0.2)


def test_the_page_of_an_image_shows_its_detections_identified_or_not(folder, tmp_path):
    dark = np.random.default_rng(1).normal(50.0, 3.0, (CAMERA.height_px, CAMERA.width_px)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "<dark>.png"), dark)
    images = (folder / "sky0.png", tmp_path / "<dark>.png")
    done = run("identify", "--json", *images, "--report", tmp_path / "page.html")
    found = json.loads(done.stdout.splitlines()[0])
    page = (tmp_path / "page-sky0.html").read_text("utf-8")
    assert f"<h1>{found['matches']} stars identified</h1>" in page
    assert f"{found['dec_deg']:+.5f}° ± {found['pointing_sigma_arcsec']:.2f}″" in page
    assert f"{found['roll_deg']:.4f}° ± {found['roll_sigma_arcsec']:.1f}″" in page
    assert page.count('class="mark used"><title>HIP') == found["matches"]
    assert page.count("<figure") == 3 and 'src="http' not in page and 'href="http' not in page
    figures = [one.partition("</figure>")[0] for one in page.split("<figure")[1:]]
    drawn = {str(n): numbers_in(re.sub("[A-Za-z]", " ", one)) for n, one in enumerate(figures)}
    assert_recorded("identify_page", drawn, relative=1e-3)
    other = (tmp_path / "page-<dark>.html").read_text("utf-8")
    assert "<h1>Not identified</h1>" in other and "<dark>" not in other


def test_nothing_identified_ends_with_status_1(folder):
    assert run("identify", "--fov", 18.6, folder / "dark.png").exit_code == 1
