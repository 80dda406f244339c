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
from types import ModuleType

import pytest

__all__ = ["NO_END", "failure", "first_named", "import_libraries"]

OWN = ("boresight", "test", "conftest", "_pytest", "pytest", "__main__", "_distutils")
PASSED = (0, 5)  # exit statuses of pytest; 5: no test is left
POLL_S = 0.05
NO_END = "and others: no end, or no import"


def import_libraries(tree: Path) -> set[str]:
    """Import, in this process, every library that some test of a tree imports; the ids of all tests."""
    with tempfile.TemporaryDirectory() as folder:
        listed, printed = Path(folder) / "modules", Path(folder) / "printed"
        if (child := os.fork()) == 0:
            with _silent(printed, tree):
                pytest.main(["--collect-only", "-q", "-o", "addopts=", "-p", "no:cacheprovider", "tests"])
            libraries = [name for name, module in sorted(sys.modules.items()) if _is_library(name, module)]
            listed.write_text(json.dumps(libraries))
            os._exit(0)
        os.waitpid(child, 0)
        tests = {line for line in printed.read_text(errors="replace").splitlines() if "::" in line}
        for name in json.loads(listed.read_text()):
            with contextlib.suppress(Exception):  # parts of a library that cannot be imported alone
                importlib.import_module(name)
    if own := [name for name in sys.modules if name.partition(".")[0] == "boresight"]:
        raise RuntimeError(f"{own[0]} is imported already, so that no fork would see a change of it")
    return tests


def _is_library(name: str, module: ModuleType) -> bool:
    """Whether a module belongs to Python or to an installed package."""
    file = getattr(module, "__file__", None) or ""
    return not name.startswith(OWN) and (not file or file.startswith((sys.base_prefix, *site_folders())))


def site_folders() -> tuple[str, ...]:
    """Folders of installed packages on the search path."""
    return tuple(path for path in sys.path if "site-packages" in path)


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
