"""The page on continuous integration: its workflow is YAML, its commands and tests are the program's."""

import sys
from pathlib import Path

import pytest
from command_line import app

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

from ci_page import block, steps  # noqa: E402


def test_the_workflow_is_yaml_with_the_steps_that_are_run() -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML (extra `docs`) IS NOT INSTALLED: workflow not read")
    jobs = yaml.safe_load(block("yaml"))["jobs"]
    runs = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert [" ".join(step) for step in steps()] == [run for run in runs if "pip install" not in run]


def test_the_steps_name_commands_and_options_that_exist() -> None:
    from typer.main import get_command

    known = get_command(app).commands
    ours = [step[1:] for step in steps() if step[0] == "boresight"]
    assert [step[0] for step in ours] == ["simulate", "calibrate", "validate"]
    for name, *arguments in ours:
        options = {option for parameter in known[name].params for option in parameter.opts}
        assert {word for word in arguments if word.startswith("--")} <= options


def test_our_own_ci_runs_the_page() -> None:
    assert "scripts/ci_page.py" in (ROOT / ".ci" / "run").read_text()
    compile(block("python"), "docs/ci.md", "exec")
