"""A checkout whose links below `boresight/` are text files, as git makes them on Windows."""

import shutil
import subprocess
import sys
from pathlib import Path

import boresight


def test_says_in_one_sentence_that_the_links_are_missing(tmp_path: Path) -> None:
    here = Path(boresight.__file__).parent
    (tmp_path / "boresight").mkdir()
    shutil.copy(here / "__init__.py", tmp_path / "boresight" / "__init__.py")
    (tmp_path / "boresight" / "geometry").write_text("../geometry")
    command = [sys.executable, "-c", "import sys; sys.path.insert(0, '.'); import boresight"]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    last = run.stderr.strip().splitlines()[-1]
    assert run.returncode == 1
    assert last.startswith("ImportError: ") and "core.symlinks=true" in last and str(tmp_path) in last
