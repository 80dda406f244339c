"""A dump whose data contradict themselves gives a result that says so, with exit status 3."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from boresight.pipeline.cli import app

runner = CliRunner()


@pytest.fixture
def doubled(one_strip: Path) -> Path:
    """A dump that lists each of its targets three times under other ids."""
    lines = (one_strip / "targets.csv").read_text().splitlines()
    copies = [f"{line.partition(',')[0]}-{k},{line.partition(',')[2]}" for line in lines[1:] for k in (1, 2)]
    (one_strip / "targets.csv").write_text("\n".join(lines + copies) + "\n")
    return one_strip


def test_targets_listed_under_several_ids_refute_the_result(doubled: Path, tmp_path: Path) -> None:
    command = ["calibrate", str(doubled), "--out", str(tmp_path / "out"), "--workers", "1", "--no-report"]
    ran = runner.invoke(app, command)
    assert ran.exit_code == 3, ran.output
    assert ran.stdout.splitlines()[0].startswith("verdict                   refuted by "), ran.stdout
    assert "targets listed more than once" in ran.output
    content = json.loads((tmp_path / "out/installation.json").read_text())
    (check,) = [c for c in content["verdict"]["checks"] if c["kind"] == "equal coordinates of targets"]
    assert content["verdict"]["outcome"] == "refuted" and not check["holds"]
    name = (doubled / "targets.csv").read_text().splitlines()[1].partition(",")[0]
    assert any({name, f"{name}-1", f"{name}-2"} <= set(group) for group in check["names"])
    again = runner.invoke(app, command)  # nothing to do, and the verdict stands
    assert again.exit_code == 3 and "refuted by" in again.output
    assert runner.invoke(app, [*command, "--accept-inconsistent"]).exit_code == 0
