"""The tests that run a line, from a trace of all tests (`traced_tests.py`): the only ones that can notice
a change of it, but for those that work in other processes.
"""

from __future__ import annotations

import ast
import difflib
import json
import subprocess
from dataclasses import dataclass
from pathlib import Path

__all__ = ["LineTests"]

CONSTANTS = "tests/test_recorded_constants.py::test_constants_are_the_recorded_ones[{}]"  # by room


@dataclass(frozen=True)
class LineTests:
    """Tests by file and line, of the sources of some commit."""

    root: Path
    commit: str
    cpu_s: dict[str, float]  # of each test
    lines: dict[str, dict[str, list[str]]]  # tests by file and line

    @staticmethod
    def read(path: Path, root: Path) -> LineTests:
        """As `traced_tests.py` wrote it."""
        told = json.loads(path.read_text(encoding="utf-8"))
        return LineTests(root, told["commit"], told["cpu_s"], told["lines"])

    def of(self, file: str, start: int, most_cpu_s: float) -> list[str]:
        """Tests that run the statement at a character of a file, as many as fit a time: records first, those
        of its room next, the quickest first. A statement that is run on import has all that run its file,
        and the record of constants.
        """
        source = (self.root / file).read_text(encoding="utf-8")
        first, last = _statement(source, start)
        known = self.lines.get(file, {})
        found: set[str] = set()
        former = self._former_lines(file, source)
        for line in range(first, last + 1):
            found.update(known.get(str(former.get(line)), ()))
        of_module = _is_of_the_module(source, start)
        if not found and of_module:
            found.update(test for tests in known.values() for test in tests)
        found |= {CONSTANTS.format(file.partition("/")[0])} if of_module else set()
        places = (file.partition("/")[0], file.rpartition("/")[0])  # tests of the same room or folder first
        by_place = {test: not test.startswith(tuple(f"tests/{place}/" for place in places)) for test in found}
        order = sorted(
            found, key=lambda one: ("recorded" not in one, by_place[one], self.cpu_s.get(one, 0.0), one)
        )
        return self._affordable(order, most_cpu_s)

    def _affordable(self, tests: list[str], most_cpu_s: float) -> list[str]:
        """The first of some tests, as many as a time allows, but one at least."""
        taken, chosen = 0.0, []
        for test in tests:
            cpu_s = self.cpu_s.get(test, 0.0)
            if not chosen or taken + cpu_s <= most_cpu_s:
                taken += cpu_s
                chosen.append(test)
        return chosen

    def _former_lines(self, file: str, source: str) -> dict[int, int]:
        """Lines of the traced source by lines of the present one."""
        shown = subprocess.run(
            ["git", "show", f"{self.commit}:{file}"], cwd=self.root, capture_output=True, text=True
        )
        before, now = shown.stdout.splitlines(), source.splitlines()
        blocks = difflib.SequenceMatcher(None, before, now, autojunk=False).get_matching_blocks()
        return {b + 1 + n: a + 1 + n for a, b, size in blocks for n in range(size)}


def _statement(source: str, start: int) -> tuple[int, int]:
    """First and last line of the smallest statement, or head of a compound one, around a character."""
    line = source.count("\n", 0, start) + 1
    best = (1, source.count("\n") + 1)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.stmt):
            end = node.end_lineno or node.lineno
            if body := getattr(node, "body", None):
                end = max(body[0].lineno - 1, node.lineno)
            if node.lineno <= line <= end and end - node.lineno <= best[1] - best[0]:
                best = (node.lineno, end)
    return best


def _is_of_the_module(source: str, start: int) -> bool:
    """Whether a character belongs to no body of a function."""
    line = source.count("\n", 0, start) + 1
    functions = (n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef))
    return not any(f.body[0].lineno <= line <= (f.end_lineno or 0) for f in functions)
