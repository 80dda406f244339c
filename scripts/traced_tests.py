"""Which test runs which line, as a plugin of pytest: what `mutants.py --draw` chooses tests by.

    pip install coverage
    TRACE=FOLDER PYTHONPATH=scripts pytest -p traced_tests -n 2 --dist worksteal
    python scripts/traced_tests.py FOLDER lines.json

What a fixture of a module or session runs counts for every test that asks for it. Processes that tests start
are not traced.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import coverage
import pytest

ROOT = Path(__file__).parents[1]
ROOMS = tuple("records geometry star_id gct_match calib simulator pipeline features boresight".split())


class Trace:
    """The lines that a process runs, each with its test or fixture."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.context = folder, ""
        self.tests: dict[str, dict[str, object]] = {}
        files = [f"{ROOT}/{room}/*" for room in ROOMS]
        data = folder / f"{os.getpid()}.coverage"
        self.coverage = coverage.Coverage(data_file=str(data), include=files, config_file=False)
        self.coverage.start()

    def switch(self, context: str) -> str:
        """Count the lines from now on for another context; the former one is returned."""
        former, self.context = self.context, context
        self.coverage.switch_context(context)
        return former

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        begun = time.process_time()
        self.switch(f"test {item.nodeid}")
        yield
        self.switch("")
        info = getattr(item, "_fixtureinfo", None)
        every = info.name2fixturedefs if info else {}
        needs = [f"fixture {name} of {one.baseid}" for name, of in every.items() for one in of]
        self.tests[item.nodeid] = {"needs": needs, "cpu_s": time.process_time() - begun, "passed": True}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            with (self.folder / "failed").open("a") as file:
                file.write(report.nodeid + "\n")

    @pytest.hookimpl(hookwrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef) -> Iterator[None]:
        shared = fixturedef.scope != "function"
        former = (
            self.switch(f"fixture {fixturedef.argname} of {fixturedef.baseid}") if shared else self.context
        )
        yield
        self.switch(former)

    def pytest_unconfigure(self) -> None:
        self.coverage.stop()
        self.coverage.save()
        (self.folder / f"{os.getpid()}.json").write_text(json.dumps(self.tests))


def pytest_configure(config: pytest.Config) -> None:
    folder = Path(os.environ["TRACE"])
    folder.mkdir(exist_ok=True)
    if "PYTEST_XDIST_WORKER" in os.environ or not config.getoption("numprocesses", None):
        config.pluginmanager.register(Trace(folder))


def joined(folder: Path) -> dict[str, object]:
    """The traces of all processes: processor time of each test that passed, and tests by file and line."""
    failed = folder / "failed"
    wrong = set(failed.read_text().splitlines()) if failed.is_file() else set()
    needs, cpu_s = defaultdict(set), {}
    for path in folder.glob("*.json"):
        for test, told in json.loads(path.read_text()).items():
            if test not in wrong:
                cpu_s[test] = told["cpu_s"]
                needs[f"test {test}"].add(test)
                for fixture in told["needs"]:
                    needs[fixture].add(test)
    lines: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for path in folder.glob("*.coverage"):
        data = coverage.CoverageData(str(path))
        data.read()
        for name in data.measured_files():
            file = Path(name).relative_to(ROOT).as_posix()
            for line, contexts in data.contexts_by_lineno(name).items():
                for context in contexts:
                    lines[file][str(line)] |= needs[context]
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()
    kept = {file: {line: sorted(tests) for line, tests in of.items()} for file, of in lines.items()}
    return {"commit": commit, "cpu_s": cpu_s, "lines": kept}


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(json.dumps(joined(Path(sys.argv[1]))), encoding="utf-8")
