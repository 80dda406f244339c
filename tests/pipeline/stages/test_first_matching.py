"""One strip searched, the others matched from its matrix: as good as all of them searched."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from fixture_strips import FIXTURE
from scipy.spatial.transform import Rotation

from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.settings import Settings
from boresight.pipeline.stages import calibrate
from boresight.pipeline.stages.cached import StageRunner
from boresight.pipeline.stages.calibrate import calibrate_dump, strips_to_match
from boresight.pipeline.stages.first_matching import match_first, match_strips
from boresight.pipeline.stages.strip import MatchedTargets, StripTask
from boresight.pipeline.work.unit_store import UnitStore


@pytest.fixture(scope="module")
def tasks() -> list[StripTask]:
    return strips_to_match(open_dump(FIXTURE), Settings())[0]


@pytest.fixture
def store(demo: Path, tmp_path: Path) -> UnitStore:
    """Copy of the finished units of the demo."""
    return UnitStore(shutil.copytree(demo / "demo-result" / "work", tmp_path / "work"))


@pytest.fixture(scope="module")
def all_searched(tasks: list[StripTask]) -> list[MatchedTargets]:
    return match_strips(tasks, StageRunner(), "matching-0")[0]


def test_matrix_is_that_of_searching_every_strip(
    store: UnitStore, all_searched: list[MatchedTargets], monkeypatch: pytest.MonkeyPatch
) -> None:
    dump = open_dump(FIXTURE)
    from_one = calibrate_dump(dump, Settings(), store).estimate
    searched = lambda tasks, start_from, runner: (tasks, all_searched, [True] * len(tasks))  # noqa: E731
    monkeypatch.setattr(calibrate, "match_first", searched)
    everywhere = calibrate_dump(dump, Settings(), store).estimate
    sigma = np.sqrt(np.diag(everywhere.cov_theta))
    # The second matching starts from matrices that differ by a tenth of a pixel; positions then agree to some
    # 1e-4 px, where 1 sigma of the matrix is 0.4 px and more.
    assert np.all(np.abs(from_one.theta - everywhere.theta) < 1e-3 * sigma)
    assert from_one.n_targets == everywhere.n_targets


def test_strips_that_a_wrong_matrix_misses_are_searched(
    tasks: list[StripTask], all_searched: list[MatchedTargets]
) -> None:
    wrong = Rotation.from_rotvec([0.01, 0.0, 0.0]) * tasks[0].R_cs, np.full(3, 5e-6)
    used, matched, computed = match_first(tasks, lambda task, found: wrong, StageRunner())
    assert used == tasks  # compared by identity: none was matched from the wrong matrix
    assert len(computed) == 5  # one searched; two missed, then searched
    for one, expected in zip(matched, all_searched):
        assert np.array_equal(one.target_id, expected.target_id) and np.array_equal(one.xy_px, expected.xy_px)


def test_search_goes_on_until_a_strip_determines_a_matrix(
    tasks: list[StripTask], all_searched: list[MatchedTargets]
) -> None:
    used, matched, _ = match_first(tasks, lambda task, found: None, StageRunner())
    assert used == tasks
    assert [len(one.target_id) for one in matched] == [len(one.target_id) for one in all_searched]
