"""Runs of pytest in forks of one process that has imported all libraries: 1 s to begin in place of 5.

The package itself and the tests are imported by each fork, from the tree where it runs.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import re
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

__all__ = ["NO_END", "failure", "first_named", "import_libraries"]

OWN = ("boresight", "test", "conftest", "_pytest", "pytest", "__main__", "_distutils")
PASSED = (0, 5)  # exit statuses of pytest; 5: no test is left
POLL_S = 0.05
NO_END = "and others: no end"


def import_libraries(tree: Path) -> None:
    """Import, in this process, every library that some test of a tree imports."""
    with tempfile.TemporaryDirectory() as folder:
        listed = Path(folder) / "modules"
        if (child := os.fork()) == 0:
            with _silent(Path(folder) / "printed", tree):
                pytest.main(["--collect-only", "-q", "-p", "no:cacheprovider", str(tree / "tests")])
            own = {path.stem for path in (tree / "tests").rglob("*.py")}
            names = [n for n in sorted(sys.modules) if not n.startswith(OWN) and n not in own]
            listed.write_text(json.dumps(names))
            os._exit(0)
        os.waitpid(child, 0)
        for name in json.loads(listed.read_text()):
            with contextlib.suppress(Exception):  # parts of a library that cannot be imported alone
                importlib.import_module(name)


def failure(tests: Sequence[str], tree: Path, *, most_cpu_s: int, most_s: float) -> str:
    """The first of some tests that fails in a tree, its file where that cannot be imported, "" where all
    pass. Tests that take more than a time (of the processor, or elapsed) count as failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        printed = Path(folder) / "printed"
        if (child := os.fork()) == 0:
            os.setsid()
            resource.setrlimit(resource.RLIMIT_CPU, (most_cpu_s, most_cpu_s))
            with _silent(printed, tree):
                status = pytest.main(["-q", "-x", "-p", "no:cacheprovider", *tests])
            os._exit(int(status))
        if (status := _waited(child, most_s)) in PASSED:
            return ""
        return first_named(printed.read_text(errors="replace")) or f"{tests[0]} {NO_END}"


def first_named(printed: str) -> str:
    """The first test that pytest's summary names as failed, its id with spaces; "" where it names none."""
    named = re.search(r"^(?:FAILED|ERROR) (\S+?(?:\[.*?\])?)(?: - .*)?$", printed, re.MULTILINE)
    return named[1] if named else ""


def _waited(child: int, most_s: float) -> int:
    """The exit status of a fork; of one that does not end in time, that of a signal."""
    end = time.monotonic() + most_s
    while time.monotonic() < end:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status)
        time.sleep(POLL_S)
    os.killpg(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@contextlib.contextmanager
def _silent(printed: Path, tree: Path):
    """Work in a tree, with its modules first and what is printed in a file."""
    os.chdir(tree)
    os.environ |= {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    sys.dont_write_bytecode = True
    sys.path.insert(0, str(tree))
    out = os.open(printed, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(out, 1)
    os.dup2(out, 2)
    yield
    sys.stdout.flush()
    sys.stderr.flush()
