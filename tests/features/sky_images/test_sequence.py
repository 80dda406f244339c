"""A sequence of star images: every frame is right or lost, and the stated covariance holds."""

import csv
import io
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace as Of

import cv2
import numpy as np
import pytest
import tomlkit
from command_line import invoked, ran
from drawn_campaigns import assert_chi_square, squared
from frames import Sensor, star_frame
from recorded_numbers import assert_recorded, columns_of
from rendered_sequences import CAMERA, EXPOSURE_S, errors_of, places_of, sequence
from scipy.spatial.transform import Rotation

import boresight as bs
from boresight.features.sky_images.identify_images import sky_index
from boresight.features.sky_images.tracking import (
    CameraMotion,
    StarFix,
    _psf_now,
    _shift_of,
    motion_of_fix,
    predicted_motion,
    with_fix,
)
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.files.star_side import star_camera_table
from boresight.star_id.finding.psf import Psf
from boresight.star_id.settings import StarSettings

INDEX = sky_index(CAMERA, None, StarSettings())


@pytest.fixture(scope="module")
def slew():
    simulated = sequence(INDEX, 7, 60)
    timing = {"times_s": simulated.times_s, "exposure_s": EXPOSURE_S}
    begun_s = time.process_time()
    found = bs.track(simulated.images, camera=CAMERA, **timing)
    took_ms = 1e3 * (time.process_time() - begun_s)
    assert (
        0.05 * took_ms < found.cpu_ms.sum() <= took_ms
    )  # a process that has to import yet takes most for that
    return simulated, found


def test_every_frame_of_a_slew_with_a_gap_and_glare_is_right_or_lost(slew) -> None:
    simulated, found = slew
    error, square = errors_of(found, simulated.truth)
    known = np.isfinite(square)
    assert set(np.flatnonzero(~known)) == set(simulated.glare)
    # 30 arcsec: a fifth of a pixel is 10, and roll is ten times less well known than direction
    assert np.abs(error[known]).max() < 30.0 * ARCSEC
    assert_chi_square(3.0 * square[known], 3)


def test_frames_are_tracked_and_recovery_takes_one_frame(slew) -> None:
    simulated, found = slew
    assert found.state[:3] == ("found anew", "found anew", "tracked")
    (blind,) = simulated.glare
    assert found.state[blind] == "lost" and found.reason[blind]
    assert found.state[blind + 1] != "lost"
    assert found.state.count("tracked") > 0.85 * len(found)


def test_the_rate_is_that_of_the_slew(slew) -> None:
    simulated, found = slew
    at = 30  # the rate is constant there
    step = (simulated.truth[at] * simulated.truth[at - 1].inv()).as_rotvec()
    rate = -np.degrees(step) / (simulated.times_s[at] - simulated.times_s[at - 1])
    # 0.03 deg/s: roll is known to some 5 arcsec, 0.02 deg/s of the difference of two frames 0.1 s apart
    np.testing.assert_allclose(found.rate_deg_s[at], rate, atol=0.03)


def test_a_plot_of_a_sequence_has_its_rates_and_a_line_where_a_frame_is_lost(slew) -> None:
    simulated, found = slew
    *rates, lost = found.plot().lines
    for line, rate, name in zip(rates, found.rate_deg_s.T, "xyz", strict=True):
        np.testing.assert_array_equal(line.get_xydata(), np.column_stack([simulated.times_s, rate]))
        assert line.get_label() == f"about {name}"
    assert set(lost.get_xdata()) == {simulated.times_s[n] for n in simulated.glare}


def test_a_jump_is_found_anew_and_not_tracked_wrongly() -> None:
    here, there = (sequence(INDEX, seed, 12, fastest_deg_s=0.0) for seed in (21, 22))
    images = here.images[:4] + there.images[:4]
    found = bs.track(images, camera=CAMERA)
    truth = Rotation.concatenate([here.truth[:4], there.truth[:4]])
    assert found.state[4] == "found anew"
    error, _ = errors_of(found, truth)
    assert np.abs(error).max() < 30.0 * ARCSEC


def test_the_table_has_a_row_a_frame(slew) -> None:
    _, found = slew
    table = found.table()
    assert len(table) == len(found) and tuple(table["state"]) == found.state
    assert "tracked" in repr(found)
    assert_recorded("tracked", columns_of(table.drop(columns="cpu_ms")), relative=1e-3)
    with pytest.raises(ValueError, match="lost"):
        found.R_si(found.state.index("lost"))


@pytest.mark.parametrize(("trail_px", "has_one"), [(0.35, False), (0.45, True)])  # 0.2 of the star's sigma
def test_a_trail_far_shorter_than_a_star_is_left_out(trail_px: float, has_one: bool) -> None:
    rate = np.array([trail_px * CAMERA.pixel_m / CAMERA.focal_m, 0.0, 0.0])
    found = _psf_now(Psf(2.0, 2.0, (0.0, 0.0), 1024, 1024), Of(rate_s=rate), CAMERA, 1.0)
    assert np.hypot(*found.smear_px) == pytest.approx(trail_px * has_one, rel=1e-2)


@pytest.mark.parametrize(
    ("reach", "shift", "squares"),
    [(2.5, (1.0, -2.0), 1), (9.0, (-8.0, 3.0), 6 * 6), (24.0, (5.0, 21.0), 16 * 16)],
)
def test_the_shift_of_most_stars_is_found_and_as_many_are_counted_as_squares_that_are_the_same(
    reach: float, shift: tuple[float, float], squares: int
) -> None:
    rng = np.random.default_rng(11)
    xy = rng.uniform(60.0, 340.0, (16, 2))
    image = rng.normal(100.0, 3.0, (400, 400))
    for n, at in enumerate(xy):
        # of three in sixteen, something else is in their places
        off = np.array(shift) if n % 6 else rng.uniform(-reach, reach, 2)
        row, column = np.indices(image.shape)
        image += 300.0 * np.exp(
            -0.5 * ((column - at[0] - off[0]) ** 2 + (row - at[1] - off[1]) ** 2) / 1.4**2
        )
    found, shifts = _shift_of(image, xy, Psf(1.4, 1.4, (0.0, 0.0), 400, 400), reach)
    assert found == pytest.approx(shift, abs=0.6)  # px: whole pixels of a dozen stars, 0.1 px, neighbours
    # within 3 px of the prediction a star is the same: that search is one, others have squares of 3 px
    assert shifts == squares


def test_times_must_increase() -> None:
    with pytest.raises(ValueError, match="times_s"):
        bs.track([np.zeros((1024, 1024), np.uint8)] * 2, camera=CAMERA, times_s=[1.0, 1.0])


def test_frames_have_the_width_and_height_of_the_camera() -> None:
    camera = replace(CAMERA, height_px=768)
    blank = np.zeros((768, 1024), np.uint8)  # without a star: lost, and not refused
    assert bs.track([blank], camera=camera).state == ("lost",)
    with pytest.raises(ValueError, match="768 x 1024 px"):
        bs.track([blank.T], camera=camera)


def test_the_filter_of_known_motion_states_its_errors() -> None:
    """Monte Carlo without images: accelerations, drifts of the focal length and measurement errors are drawn
    as the filter assumes."""
    rng, sigma, push, dt = np.random.default_rng(3), np.array([1.0, 1.0, 8.0]) * ARCSEC, 2e-4, 0.1
    focal_error, focal_drift, scale_sigma, squares = 1e-3, 1e-4, 2e-5, []
    for _ in range(100):
        R, rate = Rotation.random(random_state=rng), rng.normal(size=3) * 0.01
        scale = focal_error * rng.normal()

        def measured(R: Rotation, scale: float) -> StarFix:
            turned = Rotation.from_rotvec(rng.normal(size=3) * sigma) * R
            covariance = np.diag([*sigma**2, scale_sigma**2])
            return StarFix(turned, covariance, 40, scale + scale_sigma * rng.normal())

        motion: CameraMotion = motion_of_fix(measured(R, scale), 0.0, focal_error)
        for k in range(1, 10):
            change = push * rng.normal(size=3)
            R = Rotation.from_rotvec(-(rate + 0.5 * change * dt) * dt) * R
            rate, scale = rate + change * dt, scale + focal_drift * np.sqrt(dt) * rng.normal()
            predicted = predicted_motion(motion, k * dt, push, focal_drift)
            motion = with_fix(predicted, measured(R, scale))
        turned = (R * motion.R_si.inv()).as_rotvec()
        error = np.concatenate([turned, rate - motion.rate_s, [scale - motion.log_scale]])
        squares.append(squared(error, motion.covariance))
    assert_chi_square(squares, 7)


def test_a_wrong_focal_length_is_refined_and_its_error_is_as_stated() -> None:
    """The camera is given 0.05 % too long: 0.25 px at the edge."""
    long, squares = replace(CAMERA, focal_m=1.0005 * CAMERA.focal_m), []
    true_px = CAMERA.focal_m / CAMERA.pixel_m
    for seed in range(41, 45):
        simulated = sequence(INDEX, seed, 20, fastest_deg_s=0.2)
        found = bs.track(simulated.images, camera=long, times_s=simulated.times_s, exposure_s=EXPOSURE_S)
        error, square = errors_of(found, simulated.truth)
        known = np.isfinite(square)
        assert np.abs(error[known]).max() < 30.0 * ARCSEC
        squares.append(((found.focal_px[-1] - true_px) / found.focal_sigma_px[-1]) ** 2)
        # px: 14 frames, each of some 0.05 px by 48 stars; before 2 px wrong
        assert abs(found.focal_px[-1] - true_px) < 0.1 and found.focal_sigma_px[-1] < 0.03
    assert_chi_square(squares, 1)


def test_a_focal_length_that_is_exact_is_kept() -> None:
    simulated = sequence(INDEX, 46, 8, fastest_deg_s=0.0)
    found = bs.track(simulated.images, camera=CAMERA, focal_error=0.0)
    known = np.array(found.state) != "lost"
    np.testing.assert_allclose(found.focal_px[known], CAMERA.focal_m / CAMERA.pixel_m)
    assert (found.focal_sigma_px[known] == 0.0).all()


def test_the_command_says_of_every_frame_what_it_is(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("camera.toml").write_text(tomlkit.dumps(star_camera_table(CAMERA, 8)), "utf-8")
    images = sequence(INDEX, 31, 30, fastest_deg_s=0.0).images[:3]
    names = ["f0.png", "f1.png", "=f2.png"]
    for name, image in zip(names, images):
        cv2.imwrite(name, image)
    lines = ran("identify", *names, "--camera", "camera.toml", "--sequence").stdout.splitlines()
    assert ["found anew" in lines[0], "found anew" in lines[1], "tracked" in lines[2]] == [True] * 3
    table = invoked("identify", *names, "--camera", "camera.toml", "--sequence", "--csv")
    assert [row["file"] for row in csv.DictReader(io.StringIO(table.stdout))] == [*names[:2], "'=f2.png"]
    ran("identify", *names, "--sequence", status=2)


def test_frames_of_a_fisheye_are_tracked() -> None:
    """110 degrees along columns, equidistant: stars to V 5, 400 in view."""
    focal_px = 0.5 * 1536 / np.radians(55.0)
    sensor = {"width_px": 1536, "height_px": 1152, "principal_px": (767.5, 575.5)}
    fisheye = replace(CAMERA, focal_m=focal_px * CAMERA.pixel_m, **sensor, projection="equidistant")
    bright, rng, R = places_of(INDEX), np.random.default_rng(5), Rotation.random(random_state=8)
    bright = bright.take(np.flatnonzero(bright.v_mag < 5.0))
    images, truth, rate = [], [], np.radians([0.2, -0.1, 0.3])
    for _ in range(5):
        R = Rotation.from_rotvec(-0.1 * rate) * R
        images.append(star_frame(fisheye, R, bright, Sensor(faint_limit_v=8.0), rng)[0])
        truth.append(R)
    found = bs.track(images, camera=fisheye, exposure_s=0.0)
    assert found.state[2:] == ("tracked",) * 3
    error, square = errors_of(found, Rotation.concatenate(truth))
    assert_chi_square(3.0 * square, 3)
    assert np.abs(error).max() < 60.0 * ARCSEC  # a pixel is 260 arcsec
