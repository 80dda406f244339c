"""The lists of mutations speak of lines and tests that exist; running them is `scripts/mutants.py`."""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

from mutants import faults, mutants  # noqa: E402


def test_every_mutation_changes_one_line_that_exists_and_names_tests_that_exist() -> None:
    assert [text for mutant in mutants() for text in faults(mutant)] == []
