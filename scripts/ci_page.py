"""Run what docs/ci.md shows: the steps of its workflow and its tests: `python scripts/ci_page.py FOLDER`.

The steps run in FOLDER, with the programs of this Python. Steps that use actions,
and the one that installs, are left to GitHub.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "ci.md"
STEP = re.compile(r"^ +- run: (.*)$", re.MULTILINE)


def block(kind: str) -> str:
    """Text of the page's first block of a kind."""
    found = re.search(rf"^```{kind}\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert found is not None, f"{PAGE} has no block of {kind}"
    return found[1]


def steps() -> list[list[str]]:
    """Commands of the workflow, without the one that installs."""
    return [shlex.split(line) for line in STEP.findall(block("yaml")) if "pip install" not in line]


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "test_limits.py").write_text(block("python"), encoding="utf-8")
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    for step in steps():
        print("$", *step, flush=True)
        subprocess.run(step, cwd=folder, check=True, env=os.environ | {"PATH": path})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
