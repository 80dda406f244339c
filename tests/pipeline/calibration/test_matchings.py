"""One strip searched, the others matched from its matrix; strips that need no second matching."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fixture_strips import FIXTURE
from scipy.spatial.transform import Rotation

from boresight.pipeline.calibration import rounds
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.calibration.rounds import is_settled, match_again, match_first, match_strips
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.run.cached import StageRunner
from boresight.pipeline.run.settings import RunSettings, Settings
from boresight.pipeline.run.unit_store import UnitStore
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, match_strip_targets, pushbroom_of
from boresight.pipeline.stages.strip_tasks import _without_hidden_points, strips_to_match
from boresight.records.ledger import Entry, Kind, Reason, Subject


@pytest.fixture(scope="module")
def tasks() -> list[StripTask]:
    return strips_to_match(open_dump(FIXTURE), Settings())[0]


@pytest.fixture
def store(demo: Path, tmp_path: Path) -> UnitStore:
    """Copy of the finished units of the demo."""
    return UnitStore(shutil.copytree(demo / "demo-result" / "work", tmp_path / "work"))


@pytest.fixture(scope="module")
def searches(tmp_path_factory: pytest.TempPathFactory) -> UnitStore:
    """Strips that were searched once are not searched again."""
    return UnitStore(tmp_path_factory.mktemp("searches"))


@pytest.fixture(scope="module")
def all_searched(tasks: list[StripTask], searches: UnitStore) -> list[MatchedTargets]:
    return match_strips(tasks, StageRunner(searches), "matching-0")


def test_measured_points_beyond_the_horizon_are_left_out_whatever_their_direction(tasks):
    seen_at = tasks[0].orbit.positions_e(pushbroom_of(tasks[0]).instants_of_lines(0, np.array([100.0])))[0]
    to_top = Rotation.align_vectors([seen_at], [[0.0, 0.0, 1.0]])[0]
    radius_m = 6371e3
    far = np.tile([0.5, 1.2], 8) * np.arccos(radius_m / np.linalg.norm(seen_at))  # of the way to the horizon
    ways = Rotation.from_euler("ZY", np.column_stack([np.arange(16) // 2 * np.pi / 4.0, far]))
    p_e = radius_m * (to_top * ways).apply([0.0, 0.0, 1.0])
    targets = [SimpleNamespace(p_e=one, target_id=f"p{n}") for n, one in enumerate(p_e)]
    of_line = {"ccd": np.zeros(16, dtype=int), "xy_px": np.full((16, 2), 100.0), "targets": targets}
    points = SimpleNamespace(**of_line, take=lambda kept: kept.tolist())
    left, found = _without_hidden_points(replace(tasks[0], points=points), False)
    assert left.points == [True, False] * 8
    told = {one.subject.id: one.detail.partition(" of ")[0] for one in found}
    assert told == dict.fromkeys((f"p{n}" for n in range(1, 16, 2)), "beyond the horizon")


def test_matrix_is_that_of_searching_every_strip(store, all_searched, monkeypatch):
    dump, again = open_dump(FIXTURE), Settings(run=RunSettings(settled_px=0.0))  # all matched again
    from_one = calibrate_dump(dump, again, store).estimate
    searched = lambda tasks, start_from, runner: (tasks, all_searched)  # noqa: E731
    monkeypatch.setattr(rounds, "match_first", searched)
    everywhere = calibrate_dump(dump, again, store).estimate
    sigma = np.sqrt(np.diag(everywhere.cov_theta))
    # The second matching starts from matrices that differ by a tenth of a pixel; positions then agree to some
    # 1e-4 px, where 1 sigma of the matrix is 0.4 px and more. About Z, which one strip determines little,
    # 1.2e-3 sigma were seen.
    assert np.all(np.abs(from_one.theta - everywhere.theta) < 2e-3 * sigma)
    assert from_one.n_targets == everywhere.n_targets


def test_strips_that_a_wrong_matrix_misses_are_searched(tasks, all_searched):
    wrong = Rotation.from_rotvec([0.01, 0.0, 0.0]) * tasks[0].R_cs, np.full(3, 5e-6)
    runner = StageRunner()
    used, matched = match_first(tasks, lambda task, found: wrong, runner)
    assert used == tasks  # compared by identity: none was matched from the wrong matrix
    assert runner.computed == {True: 5}  # one searched; two missed, then searched
    for one, expected in zip(matched, all_searched):
        assert np.array_equal(one.target_id, expected.target_id) and np.array_equal(one.xy_px, expected.xy_px)


def test_search_goes_on_until_a_strip_determines_a_matrix(tasks, all_searched, searches):
    runner = StageRunner(searches)
    used, matched = match_first(tasks, lambda task, found: None, runner)
    assert used == tasks and runner.computed == {False: 3}
    assert [len(one.target_id) for one in matched] == [len(one.target_id) for one in all_searched]


def test_a_settled_strip_has_the_matrix_and_the_predictions_of_a_second_matching(store: UnitStore) -> None:
    dump = open_dump(FIXTURE)
    once = calibrate_dump(dump, Settings(), store)
    twice = calibrate_dump(dump, Settings(run=RunSettings(settled_px=0.0)), store)
    assert [one.farthest_px < 2.0 for one in once.matched] == [True] * 3
    sigma = np.sqrt(np.diag(twice.estimate.cov_theta))
    # Pixels of templates fall elsewhere by up to 2 px: places differ by half of their sigma of some 0.004 px,
    # few by more, where a translation becomes an affine map. Vibration and clock move them by 0.4 px, alike.
    assert np.all(np.abs(once.estimate.theta - twice.estimate.theta) < 0.05 * sigma)
    for one, two in zip(once.matched, twice.matched):
        assert np.array_equal(one.target_id, two.target_id) and np.array_equal(one.ccd, two.ccd)
        square = (one.xy_px - two.xy_px) ** 2 / np.diagonal(one.cov_px + two.cov_px, axis1=1, axis2=2)
        assert 0.0 < np.median(square) < 0.25
        assert np.abs(one.predicted_px - two.predicted_px).max() < 0.01  # px; before launch thousands


def test_strips_are_matched_again_where_a_target_was_refused_or_lay_far_from_its_prediction(
    tasks: list[StripTask], all_searched: list[MatchedTargets]
) -> None:
    before = [
        all_searched[0],
        replace(all_searched[1], farthest_px=2.1),
        replace(
            all_searched[2],
            omissions=(Entry(Subject(Kind.TARGET, strip="s03", id="t01"), Reason.LOW_CORRELATION),),
        ),
    ]
    runner = StageRunner()
    found = match_again(tasks, before, 2.0, runner, "matching-2")
    assert np.array_equal(found[0].xy_px, before[0].xy_px)
    assert runner.computed == {True: 2}
    # both were searched as widely as before: the same places
    for one, expected in zip(found[1:], all_searched[1:]):
        assert np.array_equal(one.xy_px, expected.xy_px) and one.omissions == expected.omissions


def test_a_strip_whose_templates_were_all_predicted_four_pixels_off_is_not_settled(store, tasks):
    exact = calibrate_dump(open_dump(FIXTURE), Settings(), store)
    assert all(is_settled(one, 2.0) for one in exact.matched)
    task, farthest = exact.tasks[2], exact.matched[2].farthest_px
    turned = Rotation.from_rotvec([4.0 * task.camera.pixel_rad, 0.0, 0.0]) * task.R_cs
    off = match_strip_targets(replace(task, R_cs=turned))
    assert isinstance(off, MatchedTargets) and len(off.target_id) == len(exact.matched[2].target_id)
    assert 4.0 - farthest < off.farthest_px < 4.0 + farthest
    assert not is_settled(off, 2.0)
