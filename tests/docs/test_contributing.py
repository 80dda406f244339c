"""CONTRIBUTING.md's "Add a feature", followed to the letter in a copy of the checkout."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest
from journeys import ROOT
from recipe import recipe

from boresight.features.table import NAMES, features

# Text of the line below which a step adds its own: that of the last feature.
LAST_LINES = {
    "features/table.py": f'    "{NAMES[-1]}",',
    "docs/tasks.md": f"`boresight {features()[-1].commands[-1].name} ",
    "docs/architecture.md": f"| `{NAMES[-1]}` |",
}
# Tests that look at the new feature beside its own: floors, pages, help without it.
GUARDS = ("pipeline/test_floors.py", "docs/test_guides.py", "docs/test_pages.py")
GUARDS += ("features/test_features_can_be_taken_out.py",)
NEAR = "strip_times or line_of_the_table or the_architecture_names or among_the_tasks"


def copy_folder(source: Path, copy: Path, changed: Iterable[str]) -> None:
    """A folder of links into `source`; on the way to `changed`, paths in it, folders and files of its own."""
    copy.mkdir()
    for path in source.iterdir():
        inner = [rest for first, _, rest in (file.partition("/") for file in changed) if first == path.name]
        if path.is_symlink():  # a room of the package: as git has it
            (copy / path.name).symlink_to(os.readlink(path))
        elif not inner:
            (copy / path.name).symlink_to(path)
        elif path.is_dir():
            copy_folder(path, copy / path.name, inner)
        else:
            shutil.copy(path, copy)


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy in which the steps have been followed."""
    copy = tmp_path_factory.mktemp("contributor") / "checkout"
    copy_folder(ROOT, copy, [*recipe(), "boresight/__init__.py"])
    for file, text in recipe().items():
        path = copy / file
        if file in LAST_LINES:
            before = path.read_text(encoding="utf-8").splitlines(keepends=True)
            (last,) = [n for n, line in enumerate(before) if LAST_LINES[file] in line]
            text = "".join([*before[: last + 1], text, *before[last + 1 :]])
        else:
            assert not path.exists(), file
            path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return copy


def told(checkout: Path, *command: str) -> str:
    """What a command prints that is run in the copy; it must succeed."""
    environment = os.environ | {"PYTHONPATH": str(checkout), "COLUMNS": "100"}
    environment.pop("PYTEST_ADDOPTS", None)
    done = subprocess.run(
        [sys.executable, "-m", *command], cwd=checkout, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_steps_make_a_command_that_help_lists_and_leave_the_others(checkout: Path) -> None:
    listed = told(checkout, "boresight", "--help")
    for feature in features():
        for command in feature.commands:
            assert f"  {command.name} " in listed
    assert "  strip-times " in listed
    assert "boresight strip-times my-dump" in told(checkout, "boresight", "strip-times", "--help")


def test_the_test_of_the_steps_passes_and_so_do_those_that_guard_features(checkout: Path) -> None:
    own = "tests/features/strip_times"
    guards = [f"tests/{file}" for file in GUARDS]
    ended = told(checkout, "pytest", "-p", "no:cacheprovider", "-rA", own, *guards, "-k", NEAR)
    passed = [line.partition("::")[0] for line in ended.splitlines() if line.startswith("PASSED")]
    assert set(passed) == {f"PASSED {file}" for file in (f"{own}/test_strip_times.py", *guards)}


def test_the_code_of_the_steps_is_formatted_as_ruff_asks(checkout: Path) -> None:
    files = [file for file in recipe() if file not in LAST_LINES]
    assert len(files) == 3
    told(checkout, "ruff", "check", "--no-cache", *files)
    told(checkout, "ruff", "format", "--no-cache", "--check", *files)
