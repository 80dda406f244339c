"""Commands run as a user runs them, outside the repository."""

import os
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[1]
DEMO = ("calibrate", "fixtures/mini", "--out", "demo-result")  # as in README and tutorial


def run(*command: str | Path, cwd: Path) -> str:
    """Standard output of a command that must succeed, run without this process's search path."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    how = {"cwd": cwd, "env": environment, "capture_output": True, "text": True}
    done = subprocess.run([str(part) for part in command], **how)
    assert done.returncode == 0, done.stderr
    return done.stdout
