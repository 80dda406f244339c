"""Mutations drawn by chance from the source, so that no list can be tuned to the tests: `mutants.py --draw`.

A mutation changes one expression: a sign, a factor, a transposition or inverse, a term that is dropped, a
count by one, axes that are exchanged, degrees of freedom, a unit. What changes no result is left alone: text,
types, messages, checks of arguments, counts of progress, sizes and places of what pictures show (constants of
modules that only draw; what they compute is not), and constants below 1e-9, which stand for zero. Without a
trace of all tests the nearest ones are asked: those that import the module, of the same room first.
"""

from __future__ import annotations

import ast
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

__all__ = ["Change", "changes_of", "drawn_changes", "nearest_tests"]

ROOMS = (
    "boresight",
    "records",
    "geometry",
    "star_id",
    "gct_match",
    "calib",
    "simulator",
    "pipeline",
    "features",
)
WITHOUT_NUMBERS = ("pipeline/console", "pipeline/report/templates")
MOST_TESTS = 4  # files
LOOKS = frozenset(
    "lw ms mew alpha fontsize linewidth linewidths capsize handlelength ncols dpi figsize pad labelpad "
    "zorder rotation width_ratios height_ratios wspace hspace markersize s length indent".split()
)
PICTURES = ("pipeline/report/", "figure.py", "plots.py", "overlay.py", "pictures.py", "page.py")
PLACES = {"progress", "told", "done", "legend", "text", "annotate", "subplots", "subplots_adjust", "margins"}
SMALLEST = 1e-9  # a constant below it only keeps a quotient or a logarithm finite
UNITS = {"ARCSEC": "1.0", "radians": "degrees", "degrees": "radians"}


@dataclass(frozen=True)
class Change:
    """One expression of a file, and what takes its place."""

    file: str
    line: int
    kind: str
    start: int  # character of the file
    end: int
    old: str
    new: str

    def applied(self, source: str) -> str:
        """The source of the file with this change."""
        return source[: self.start] + self.new + source[self.end :]

    def __str__(self) -> str:
        old, new = (" ".join(text.split())[:60] for text in (self.old, self.new))
        return f"{self.file}:{self.line} {self.kind}: `{old}` -> `{new}`"


def drawn_changes(root: Path, seed: int, count: int, room: str = "") -> list[Change]:
    """So many changes, drawn without repetition of a line from all modules, or from those of one room."""
    every: list[Change] = []
    for name in ROOMS if not room else (room,):
        for path in sorted((root / name).rglob("*.py")):
            file = path.relative_to(root).as_posix()
            if path.name != "__init__.py" and not file.startswith(WITHOUT_NUMBERS):
                every += changes_of(path.read_text(encoding="utf-8"), file)
    rng = random.Random(seed)
    rng.shuffle(every)
    lines: set[tuple[str, int]] = set()
    chosen: list[Change] = []
    for change in every:
        if len(chosen) < count and (change.file, change.line) not in lines:
            lines.add((change.file, change.line))
            chosen.append(change)
    return chosen


@cache
def changes_of(source: str, file: str) -> list[Change]:
    """All changes that a module allows; each leaves a module that can be parsed."""
    begins, lines = [0], source.splitlines(keepends=True)
    for line in lines:
        begins.append(begins[-1] + len(line))

    def place(node: ast.expr) -> tuple[int, int]:
        (a, from_), (b, to) = (node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset)
        first, last = (lines[n - 1].encode()[:at].decode() for n, at in ((a, from_), (b, to)))
        return begins[a - 1] + len(first), begins[b - 1] + len(last)

    def text(node: ast.expr) -> str:
        start, end = place(node)
        return source[start:end]

    found, tree = [], ast.parse(source)
    parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    drawn = any(part in file for part in PICTURES)
    for node in _numbers(tree):
        if isinstance(node, ast.Constant) and (drawn or _only_keeps_finite(node)):
            continue
        for kind, new in _of_expression(node, text, parents):
            found.append(Change(file, node.lineno, kind, *place(node), text(node), new))
    return found


def _numbers(tree: ast.AST) -> Iterator[ast.expr]:
    """Expressions that may compute something: not those of types, messages, decorators and checks."""
    todo: list[ast.AST] = [tree]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.Raise | ast.Assert | ast.Import | ast.ImportFrom | ast.JoinedStr):
            continue
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            if node.targets[0].id == "__all__":
                continue
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            if node.func.id in ("array", "RawDataError", "Finding", "Entry", "TypeVar", *PLACES):
                continue
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in PLACES:
            continue
        if isinstance(node, ast.expr):
            yield node
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list"):
                continue
            if name == "value" and isinstance(node, ast.keyword) and node.arg in LOOKS:
                continue
            values = value if isinstance(value, list) else [value]
            todo += [one for one in values if isinstance(one, ast.AST)]


def _of_expression(
    node: ast.expr, source_of: Callable[[ast.expr], str], parents: dict[ast.AST, ast.AST]
) -> Iterator[tuple[str, str]]:
    def text(part: ast.expr) -> str:
        return f"({source_of(part)})"

    match node:
        case ast.BinOp(left, operator, right) if not _is_of_text(node):
            signs = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*"}
            if (sign := signs.get(type(operator))) is not None:
                kind = "sign" if isinstance(operator, ast.Add | ast.Sub) else "factor"
                yield kind, f"({text(left)} {sign} {text(right)})"
                yield "dropped term", text(left)
        case ast.UnaryOp(ast.USub(), operand) if not isinstance(operand, ast.Constant):
            yield "sign", text(operand)
        case ast.Attribute(value, "T"):
            yield "transposition", text(value)
        case ast.Call(ast.Attribute(value, "inv"), [], []):
            yield "transposition", text(value)
        case ast.Call(ast.Attribute(value, name), [argument], []) if name in UNITS:
            yield "unit", f"{source_of(value)}.{UNITS[name]}({text(argument)})"
        case ast.Name(name) if name in UNITS and isinstance(node.ctx, ast.Load):
            yield "unit", UNITS[name]
        case ast.Constant(value) if isinstance(value, float) and value != 0.0:
            yield "factor", f"({2.0 * value!r})"
        case ast.Constant(value) if type(value) is int:
            parent = parents.get(node)
            if isinstance(parent, ast.keyword) and parent.arg == "axis" and value in (0, 1):
                yield "axes", str(1 - value)
            elif isinstance(parent, ast.Subscript | ast.Tuple) and value in (0, 1, 2):
                yield "axes", str((value + 1) % 3 if value else 1)
            elif isinstance(parent, ast.BinOp | ast.Compare | ast.Slice):
                yield "off by one", str(value + 1)
    parent = parents.get(node)
    name = parent.arg if isinstance(parent, ast.keyword) else ""
    if isinstance(parent, ast.Assign) and isinstance(parent.targets[0], ast.Name):
        name = parent.targets[0].id
    if name in ("dof", "degrees_of_freedom") and not isinstance(node, ast.Name):
        yield "degrees of freedom", f"({text(node)} + 1)"


def _only_keeps_finite(node: ast.Constant) -> bool:
    """Whether a constant is so small that it stands for zero."""
    return isinstance(node.value, float) and abs(node.value) < SMALLEST


def _is_of_text(node: ast.BinOp) -> bool:
    """Whether an operation joins text or lists."""
    kinds = ast.JoinedStr | ast.List | ast.Tuple | ast.ListComp | ast.Dict
    return any(
        isinstance(part, kinds) or (isinstance(part, ast.Constant) and isinstance(part.value, str | bytes))
        for part in ast.walk(node)
    )


def nearest_tests(root: Path, file: str) -> tuple[str, ...]:
    """Test files that import a module, at most `MOST_TESTS`: first its own and those of the same room, of
    these the shortest; where none does, all of its room that import a neighbour of the module.
    """
    room, module = file.partition("/")[0], file.removesuffix(".py").replace("/", ".")
    name, package = Path(file).stem, module.rpartition(".")[0]
    for wanted in (f"boresight.{module} import", f"boresight.{package}.", f"boresight.{room}."):
        near = [
            (path.stem != f"test_{name}", room not in path.parts, len(text), path)
            for path, text in _texts(root / "tests").items()
            if wanted in text or path.stem == f"test_{name}"
        ]
        if near:
            return tuple(path.relative_to(root).as_posix() for *_, path in sorted(near)[:MOST_TESTS])
    return ()


@cache
def _texts(tests: Path) -> dict[Path, str]:
    return {path: path.read_text(encoding="utf-8") for path in tests.rglob("test_*.py")}
