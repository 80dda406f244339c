"""Hooks of the build: the README of the metadata, and the commit that a wheel or sdist is built from.

A package index shows README.md without the files beside it. Relative links therefore get the address of the
repository before them, which also gives the project's addresses; without it a link becomes its text and a
picture is left out.

The commit goes into what is built as `boresight/COMMIT`.

An sdist has no git: the file that it carries goes into the wheel built from it. Without git and without that
file the wheel states no commit.
"""

import os
import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

RELATIVE = re.compile(r"(!?)\[([^\[\]]*)\]\((?!https?://|mailto:|#)([^()\s]+)\)")
OF_PAGE = re.compile(r"(?<!!)\[([^\[\]]*)\]\(#[^()\s]*\)")  # headings have other anchors there


def readme_of_index(text: str, source: str = "") -> str:
    """README text whose links work on a package index; `source` is the address of the repository."""

    def absolute(link: re.Match[str]) -> str:
        picture, words, target = link.groups()
        if source:
            return f"{picture}[{words}]({source.rstrip('/')}/{'raw' if picture else 'blob'}/HEAD/{target})"
        return "" if picture else words

    return OF_PAGE.sub(r"\1", RELATIVE.sub(absolute, text))


def urls_of(repository: str) -> dict[str, str]:
    """Addresses of the project; of its repository where that is known."""
    fixed = {
        "Method": "https://doi.org/10.3390/s20195667",
        "Star catalogue": "https://www.cosmos.esa.int/web/hipparcos",
    }
    if not repository:
        return fixed
    own = {
        "Documentation": "blob/HEAD/docs/index.md",
        "Changelog": "blob/HEAD/CHANGELOG.md",
        "Issues": "issues",
    }
    return {"Source": repository} | {name: f"{repository}/{path}" for name, path in own.items()} | fixed


class ReadmeHook(MetadataHookInterface):
    """States README.md as the long description, and the project's addresses."""

    def update(self, metadata: dict[str, Any]) -> None:
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        source = os.environ.get("BORESIGHT_REPOSITORY", self.config.get("repository", "")).rstrip("/")
        metadata["urls"] = urls_of(source)
        metadata["readme"] = {"content-type": "text/markdown", "text": readme_of_index(text, source)}


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
