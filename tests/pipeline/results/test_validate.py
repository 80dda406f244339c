"""Errors against a known truth: of the matrix in its covariance, of ground points along and across track."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fixture_strips import FIXTURE
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC
from boresight.geometry.groundlight import LightEffects
from boresight.geometry.installation import deviation_from_theta
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.results.place_errors import PassErrors
from boresight.pipeline.results.reading import SavedResult, read_saved_result
from boresight.pipeline.results.strip_model import open_calibrated, strip_model, whole_strip_model
from boresight.pipeline.results.summary import validation_summary
from boresight.pipeline.results.validate import true_installation, validation_of


@pytest.fixture(scope="module")
def known(finished: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Dump, SavedResult]:
    """The one-strip dump with its truth, and its result with the true matrix in place of the estimate."""
    root = tmp_path_factory.mktemp("known") / "dump"
    shutil.copytree(finished[0], root)
    shutil.copytree(FIXTURE / "truth", root / "truth", dirs_exist_ok=True)
    dump = open_dump(root)
    return dump, replace(read_saved_result(finished[1]), R_cs=true_installation(dump))


def test_nees_is_in_the_whole_covariance(known: tuple[Dump, SavedResult]) -> None:
    # A correlation of 0.9 makes it 21; the diagonal alone would make it 3.
    dump, true = known
    sigma = np.array([1e-6, 2e-6, 4e-5])
    C = sigma[:, None] * np.array([[1.0, 0.9, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 1.0]]) * sigma
    theta = sigma * np.array([1.0, -1.0, 1.0])
    found = validation_of(replace(true, R_cs=deviation_from_theta(theta) * true.R_cs, cov_theta=C), dump)
    np.testing.assert_allclose(found.error_rad, theta, rtol=1e-6)  # second order of 4e-5 rad
    assert found.nees == pytest.approx(2.0 / (1.0 - 0.9) + 1.0, rel=1e-5)
    np.testing.assert_allclose(found.sigma_rad, sigma, rtol=1e-12)


@pytest.mark.parametrize(("axis", "along"), [("y", True), ("x", False)])
def test_errors_on_the_ground_are_told_along_and_across_the_track(axis, along, known):
    # Frame c: x along the motion, y along the CCDs. 1e-4 rad at 530 km or more is above 50 m; yaw of the
    # Earth's rotation puts less than a tenth of it into the other direction.
    dump, true = known
    wrong = replace(true, R_cs=Rotation.from_euler(axis, 1e-4) * true.R_cs)
    after = validation_of(wrong, dump).after
    mine, other = after.rms_m if along else after.rms_m[::-1]
    assert mine > 45.0 and other < 0.15 * mine
    x, y, z = dump.orbit.positions_e(dump.strips[0].t_first_row_s + np.array([0.0, 1.0])).T
    east, north = np.diff(np.arctan2(y, x))[0], np.diff(np.arctanh(z / np.hypot(np.hypot(x, y), z)))[0]
    motion = (east + 1j * north) / np.hypot(east, north)  # on Mercator's map, of which angles are true
    turned = (after.east_m + 1j * after.north_m) / (after.along_m - 1j * after.across_m)  # to the right: -i
    assert np.abs(turned / motion - 1.0).max() < 0.02  # the flattening of the Earth


def test_rows_that_are_dated_late_move_places_as_the_strip_model_does(finished, known) -> None:
    calibrated = open_calibrated(finished[1], finished[0])
    model, dump, late_s = strip_model(calibrated, known[0].strips[0].strip_id), calibrated.dump, 1e-3
    seen = model.pushbroom
    rows = replace(seen.rows, t_first_row_s=seen.rows.t_first_row_s + late_s)
    at = np.zeros(3, dtype=int), np.array([10.0, 200.0, 400.0]), np.array([50.0, 90.0, 120.0])
    here = seen.ground_points(0, *at[1:], ConstantHeight(0.0))
    moved = replace(seen, rows=rows).ground_points(0, *at[1:], ConstantHeight(0.0))
    t_s = seen.instants_of_lines(at[0], at[2])
    up = here / np.linalg.norm(here, axis=1, keepdims=True)
    along = dump.orbit.velocities_e(t_s)
    along -= up * np.sum(along * up, axis=1, keepdims=True)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    expected = [np.sum((moved - here) * one, axis=1) / late_s for one in (along, np.cross(along, up))]
    errors = PassErrors.of(calibrated.result, dump, model.strip, model.track, 0.0).at(t_s, here)
    # m/s: the rate of the attitude is that over a second; the camera's rotation alone is 580 m/s
    assert errors.own[:, :, -2] / dump.errors.clock_s == pytest.approx(np.transpose(expected), abs=70.0)
    # Errors of two heads' matrices turn the attitudes by their shares, which are in axes of s.
    two = {"heads": [{"name": "b"}, {"name": "a"}], "heads_covariance_rad2": np.eye(6).tolist()}
    taken, name = np.arange(42.0).reshape(6, 7), model.strip.strip_id
    result = replace(known[1], installation=known[1].installation | two, taken_up={name: taken})
    shares, C = {"a": np.diag([0.0, 0.5, 0.75]), "b": np.diag([1.0, 0.5, 0.25])}, result.R_cs.as_matrix()
    found = PassErrors.of(result, dump, model.strip, replace(model.track, shares=shares), 0.0)
    assert found.in_matrix[:6, -2] == pytest.approx(-dump.errors.clock_s * taken[:, 6])
    assert C.T @ found.shares @ np.kron(np.eye(2), C) == pytest.approx(np.hstack([shares["b"], shares["a"]]))


def with_run(true: SavedResult, **changes: object) -> SavedResult:
    settings = true.installation["settings"]
    run = settings["run"] | changes
    return replace(true, installation=true.installation | {"settings": settings | {"run": run}})


def test_ground_is_computed_with_the_effects_on_light_of_the_dump(known: tuple[Dump, SavedResult]) -> None:
    # Aberration by the satellite's velocity of 7.6 km/s is 25.3 urad: 13.4 m from 530 km, along the track.
    dump, true = known
    all_effects = validation_of(true, dump).after
    fewer = validation_of(true, replace(dump, light=LightEffects(aberration=False))).after
    moved = np.abs(np.mean(fewer.along_m - all_effects.along_m))
    assert 12.0 < moved < 16.0
    assert abs(np.mean(fewer.across_m - all_effects.across_m)) < 0.1 * moved


def test_exposures_around_a_strip_are_those_of_the_margin_of_the_result(known):
    dump, true = known
    first, last = dump.span_s(dump.strips[0])
    t = true.t_exposures_s
    outside = replace(true, usable=true.usable & ((t < first - 0.1) | (t > last + 0.1)))  # at most 0.4 s away
    wide = validation_of(with_run(outside, exposure_margin_s=0.5), dump)
    narrow = validation_of(with_run(outside, exposure_margin_s=0.1), dump)
    assert len(wide.after.point_id) == 22
    assert len(narrow.after.point_id) == 0 and narrow.without == wide.without + 22


def without_the_end(true: SavedResult, dump: Dump) -> SavedResult:
    """A result of which no exposure after the middle of the strip can be used."""
    first, last = dump.span_s(dump.strips[0])
    return replace(true, usable=true.usable & (true.t_exposures_s < 0.5 * (first + last)))


def test_check_points_of_rows_without_attitude_have_no_error(known: tuple[Dump, SavedResult]) -> None:
    dump, true = known
    whole, part = validation_of(true, dump), validation_of(without_the_end(true, dump), dump)
    seen = len(part.after.point_id)
    assert 0 < seen < len(whole.after.point_id)
    assert part.without == whole.without + len(whole.after.point_id) - seen


def test_products_of_a_whole_strip_need_exposures_over_all_of_its_rows(finished, known):
    dump, true = known
    calibrated = open_calibrated(finished[1], finished[0])
    strip_id = dump.strips[0].strip_id
    assert whole_strip_model(calibrated, strip_id).strip.strip_id == strip_id
    part = replace(calibrated, result=without_the_end(true, dump))
    assert strip_model(part, strip_id).strip.strip_id == strip_id  # for the rows that are covered
    with pytest.raises(DataNotSufficientError, match=r"s at the end"):
        whole_strip_model(part, strip_id)


def test_check_points_are_held_against_the_prediction(known: tuple[Dump, SavedResult]) -> None:
    # The true matrix with a covariance of 1 arcsec is as predicted; one that is 40 arcsec off about y, 100 m
    # along the track, is not, and across the track it still is.
    dump, true = known
    # The matrix is of other passes: none of their errors is in it.
    stated = replace(true, cov_theta=(np.array([1.0, 1.0, 8.0]) * ARCSEC) ** 2 * np.eye(3), taken_up={})
    right = validation_of(stated, dump).predicted
    assert [one.direction for one in right] == ["along", "across"] and all(one.allowed for one in right)
    off = replace(stated, R_cs=Rotation.from_rotvec([0.0, 40.0 * ARCSEC, 0.0]) * true.R_cs)
    along, across = validation_of(off, dump).predicted
    assert not along.allowed and across.allowed
    # 1 arcsec at 530 to 545 km is 2.6 m; position 2 m, clock 0.1 ms at 7 km/s 0.7 m, vibration 0.3 m: 3.4 m
    exact = replace(off, covariance_s=1e-20 * off.covariance_s)
    assert validation_of(exact, dump).predicted[0].predicted_m == pytest.approx(3.4, abs=0.15)
    # 36 exposures of 1 arcsec or less, four of them at an instant: no more than 2.6 m beside that
    assert 3.5 < along.predicted_m < np.hypot(3.5, 2.6)
    # A matrix of these three passes has a third of the errors of each in it.
    of_three = validation_of(replace(off, taken_up=true.taken_up), dump).predicted[0]
    assert of_three.predicted_m < 0.9 * along.predicted_m


def test_a_prediction_that_is_stated_too_small_is_told(known: tuple[Dump, SavedResult]) -> None:
    dump, true = known
    errors = replace_errors(dump, position_m=0.01, clock_s=0.0)
    off = Rotation.from_rotvec([0.0, 2.0 * ARCSEC, 0.0]) * true.R_cs
    tiny = {"cov_theta": (0.01 * ARCSEC) ** 2 * np.eye(3), "covariance_s": 1e-6 * true.covariance_s}
    sure = replace(true, R_cs=off, **tiny)
    along, _ = validation_of(sure, errors).predicted
    assert not along.allowed and along.predicted_m < 1.0
    assert "not allowed" in validation_summary(validation_of(sure, errors))


def replace_errors(dump: Dump, **changes: float) -> Dump:
    return replace(dump, errors=dump.errors.model_copy(update=changes))
