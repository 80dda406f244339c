"""A feature is a folder and a line of the table: without them, everything else works."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib import import_module
from math import pi
from pathlib import Path

import pytest
from fixture_strips import begun
from outside import ROOT

ROOMS = ("records", "geometry", "star_id", "gct_match", "calib", "simulator", "pipeline", "features")
FEATURES = sorted(path.parent.name for path in (ROOT / "features").glob("*/__init__.py"))


def without(features: Sequence[str], folder: Path) -> Path:
    """A copy of the package without features; what is not taken out are links."""
    package = folder / "boresight"
    package.mkdir()
    for path in (ROOT / "boresight").glob("*.py"):
        shutil.copy(path, package)
    for room in ROOMS[:-1]:
        (package / room).symlink_to(ROOT / room)
    (package / "features").mkdir()
    for path in (ROOT / "features").iterdir():
        if path.name not in (*features, "table.py", "__pycache__"):
            (package / "features" / path.name).symlink_to(path)
    table = (ROOT / "features" / "table.py").read_text(encoding="utf-8")
    for name in features:
        assert table.count(f'    "{name}",\n') == 1
        table = table.replace(f'    "{name}",\n', "")
    (package / "features" / "table.py").write_text(table, encoding="utf-8")
    return folder


def run_in(folder: Path, *command: str) -> str:
    """What the program in a folder prints."""
    code = (
        "import sys; sys.path.insert(0, '.'); "
        "sys.meta_path[:] = [one for one in sys.meta_path if type(one).__name__ != 'type' or "
        "one.__name__ != 'RedirectingFinder']; "  # that of an editable install would find the whole package
        f"sys.argv[1:] = {list(command)!r}; import boresight.console as it; it.run_command_line()"
    )
    done = subprocess.run(
        [sys.executable, "-I", "-c", code],
        cwd=folder,
        env=os.environ | {"COLUMNS": "100"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("feature", FEATURES)
def test_the_program_lists_all_other_commands_without_a_feature(feature: str, tmp_path: Path) -> None:
    listed = run_in(without([feature], tmp_path), "--help")
    assert "calibrate" in listed
    for name in FEATURES:
        for command in import_module(f"boresight.features.{name}").FEATURE.commands:
            is_listed = f"\n  {command.name.split()[0]} " in listed
            assert is_listed == (name != feature), command.name


def test_a_dump_is_calibrated_without_any_feature(tmp_path: Path, finished: tuple[Path, Path]) -> None:
    begun(tmp_path / "result", finished, exposures=12)
    printed = run_in(without(FEATURES, tmp_path), "calibrate", str(finished[0]), "--out", "result")
    (row,) = [line for line in printed.splitlines() if line.startswith("theta, arcsec")]
    theta = json.loads((tmp_path / "result" / "installation.json").read_text())["theta_rad"]
    assert row.split()[2:] == [f"{value * 648000 / pi:+.3f}" for value in theta]
    page = (tmp_path / "result" / "report.html").read_text()
    assert page.rstrip().endswith("</html>") and 'id="targets"' in page
