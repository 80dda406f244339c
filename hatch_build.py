"""Build hook: the commit that a wheel or sdist is built from goes into it as `boresight/COMMIT`.

An sdist has no git: the file that it carries goes into the wheel built from it. Without git and without that
file the wheel states no commit.
"""

import subprocess
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CommitHook(BuildHookInterface):
    """Adds `boresight/COMMIT` to what is built from a git checkout."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        root = Path(self.root)
        if version == "editable" or not (root / ".git").exists():
            return
        command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*", "--abbrev=12"]
        try:
            commit = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        except (OSError, subprocess.CalledProcessError):
            return
        file = Path(tempfile.mkdtemp()) / "COMMIT"
        file.write_text(commit, encoding="ascii")
        build_data["force_include"][str(file)] = "boresight/COMMIT"
