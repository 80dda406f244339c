"""The lists of mutations speak of lines and tests that exist; running them is `scripts/mutants.py`."""

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

import drawn_mutants  # noqa: E402
from drawn_mutants import changes_of, drawn_changes, nearest_tests  # noqa: E402
from forked_tests import first_named  # noqa: E402
from mutants import faults, mutants  # noqa: E402


def test_every_mutation_changes_one_line_that_exists_and_names_tests_that_exist() -> None:
    assert [text for mutant in mutants() for text in faults(mutant)] == []


def test_a_failed_test_is_named_with_the_spaces_of_its_id() -> None:
    lines = (
        "2 failed in 3 s",
        "FAILED tests/a/test_b.py::test_c[Kannala Brandt, 2 - terms] - assert 1 - 2 == 3",
        "FAILED tests/a/test_b.py::test_d - AssertionError",
    )
    assert first_named("\n".join(lines)) == "tests/a/test_b.py::test_c[Kannala Brandt, 2 - terms]"
    assert first_named("\n".join(lines[::2])) == "tests/a/test_b.py::test_d"
    assert first_named("ERROR tests/a/test_b.py") == "tests/a/test_b.py"
    assert first_named(lines[0]) == ""


SAMPLE = """
import numpy as np
def f(a: int, R, dof_of):
    name = "x" + "y"
    dof = 2 * len(a) - 3
    v = R.T @ a.sum(axis=0) + 0.5 * np.radians(a[0])
    return -v if dof < 1 else R.inv().apply(v) / ARCSEC
"""


def test_drawn_mutations_are_of_every_kind_and_leave_a_module_that_can_be_parsed():
    found = changes_of(SAMPLE, "calib/sample.py")
    kinds = {change.kind for change in found}
    assert kinds == {
        *("sign", "factor", "transposition", "dropped term", "off by one", "axes", "unit"),
        "degrees of freedom",
    }
    for change in found:
        assert ast.parse(change.applied(SAMPLE)) and change.applied(SAMPLE) != SAMPLE
        assert '"x" + "y"' in change.applied(SAMPLE)  # text is left alone
    texts = {change.new for change in found}
    assert {"(R)", "(v)", "1.0", "np.degrees((a[0]))", "((2 * len(a) - 3) + 1)"} <= texts


def test_a_seed_draws_the_same_mutations_with_tests_near_their_modules(monkeypatch):
    monkeypatch.setattr(drawn_mutants, "ROOMS", ("geometry", "gct_match", "calib", "simulator"))
    first, again, other = (drawn_changes(ROOT, seed, 30, "calib") for seed in (3, 3, 4))
    assert first == again != other
    every = drawn_changes(ROOT, 3, 30)
    assert len({(one.file, one.line) for one in every}) == 30
    assert len({one.file.partition("/")[0] for one in every}) > 3
    for change in every:
        source = (ROOT / change.file).read_text()
        assert source[change.start : change.end] == change.old
        ast.parse(change.applied(source))
        assert nearest_tests(ROOT, change.file), change.file
    assert nearest_tests(ROOT, "calib/verdict.py")[0] == "tests/calib/test_verdict.py"


def test_what_changes_no_result_is_not_drawn():
    shown = "    axes.legend(a * 2)\n    progress(a + 1, 9)\n"
    source = f"def f(a, axes):\n{shown}    return max(a, 1e-12) + 2.0 * a\n"
    texts = {change.old for change in changes_of(source, "calib/sample.py")}
    assert texts == {"max(a, 1e-12) + 2.0 * a", "2.0 * a", "2.0"}
    texts = {change.old for change in changes_of(source, "pipeline/report/sample.py")}
    assert texts == {"max(a, 1e-12) + 2.0 * a", "2.0 * a"}  # what a picture shows, not where
