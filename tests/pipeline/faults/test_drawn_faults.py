"""The faults that `benchmarks/faults_grid.py` tries are drawn by a seed."""

from pathlib import Path

import fault_dumps
import numpy as np
from drawn_faults import both, by_kind, drawn
from edits import rows_of


def test_one_seed_draws_one_fault_and_another_seed_another(sound: Path) -> None:
    names = [drawn(sound, seed, 7).name for seed in (1, 1, 2, 3)]
    assert names[0] == names[1] and len(set(names)) == 3


def test_a_dump_of_measured_points_has_more_than_forty_kinds(sound: Path) -> None:
    kinds = by_kind(sound, np.random.default_rng(3))
    assert len(kinds) > 40
    assert {"lines lost", "mounting bends", "noise of points", "times cut", "CCD longer"} <= kinds.keys()


def test_two_faults_at_once_change_what_either_changes(sound: Path, tmp_path: Path) -> None:
    kinds = by_kind(sound, np.random.default_rng(5))
    first, second = kinds["strip clock"][0], kinds["lines lost"][0]
    fault_dumps.linked(sound, tmp_path / "dump")
    two = both(first, second)
    two.make(tmp_path / "dump")
    for name in ("strips.csv", "points.csv"):
        assert rows_of(tmp_path / "dump" / name) != rows_of(sound / name)
    assert two.own == first.own + second.own and (two.words, two.other_words) == (first.words, second.words)
