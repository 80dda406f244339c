"""Public functions drawn at random, with docstrings, to be judged: `python scripts/sample_docstrings.py`.

Marks what a program can see: no docstring, a first sentence that does not stand alone, an array argument or
result without a shape, an exception that is raised and not mentioned. `--all` lists the marked ones of all.
"""

from __future__ import annotations

import argparse
import ast
import random
import re
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
ROOMS = ("records", "geometry", "star_id", "gct_match", "calib", "simulator", "pipeline", "features")
COMMANDS = ("pipeline/console/",)  # their docstrings are help on the console
ARRAYS = re.compile(r"NDArray|Floats|Ints|Bools|Texts|\bArray\b|\bImage\b")
# (N, 3), (63, 2), (h, w), (lines, samples), "elementwise", "in the broadcast shape of the arguments".
SHAPE = re.compile(
    r"\([^()]*\b[A-Z]\b[^()]*\)|\(\d+(?:, ?\d+)*,?\)|\b\d x \d\b|\(\.\.\.[^)]*\)|as (?:`|the)"
    r"|an? image|scalar|\((?:\d, )?(?:h|n|m|lines|rows|height|count|runs)\b[^()]*\)|elementwise|broadcast"
)
NOT_ALONE = re.compile(r"^(The same|Likewise|As above|Ditto|And )")


@dataclass(frozen=True)
class Function:
    """A public function and what its source says."""

    place: str
    name: str
    signature: str
    doc: str
    raises: frozenset[str]


def functions() -> list[Function]:
    """Public functions and methods of public classes, in the order of files."""
    found = []
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            for node in tree.body:
                public = [node] if isinstance(node, ast.FunctionDef) else []
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    public = [item for item in node.body if isinstance(item, ast.FunctionDef)]
                owner = f"{node.name}." if isinstance(node, ast.ClassDef) else ""
                for item in public:
                    overload = any(ast.unparse(d) == "overload" for d in item.decorator_list)
                    if not item.name.startswith("_") and not overload:  # overloads show the implementation's
                        found.append(_function(path, owner, item))
    return found


def _function(path: Path, owner: str, node: ast.FunctionDef) -> Function:
    # A raised call of a lower-case name is a function that makes the exception.
    raised = {
        call.func.id
        for statement in ast.walk(node)
        if isinstance(statement, ast.Raise)
        and isinstance(call := statement.exc, ast.Call)
        and isinstance(call.func, ast.Name)
        and call.func.id[0].isupper()
    }
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    signature = f"{node.name}({ast.unparse(node.args)}){returns}"
    doc = ast.get_docstring(node) or ""
    return Function(
        f"{path.relative_to(ROOT)}:{node.lineno}", owner + node.name, signature, doc, frozenset(raised)
    )


def marks(function: Function) -> list[str]:
    """What a machine finds wanting in a docstring."""
    wanting = []
    if not function.doc:
        return ["no docstring"]
    if NOT_ALONE.match(function.doc):
        wanting.append("first sentence does not stand alone")
    if ARRAYS.search(function.signature) and not SHAPE.search(function.doc):
        wanting.append("no shape")
    if not function.place.startswith(COMMANDS) and "_command.py" not in function.place:
        wanting += [f"{name} not mentioned" for name in sorted(function.raises) if name not in function.doc]
    return wanting


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--all", action="store_true", help="only the marked ones, of all")
    options = parser.parse_args()
    everything = functions()
    drawn = everything if options.all else random.Random(options.seed).sample(everything, options.count)
    wanting = 0
    for function in drawn:
        found = marks(function)
        wanting += bool(found)
        if found or not options.all:
            print(f"{function.place}  {function.signature}\n    " + function.doc.replace("\n", "\n    "))
            print(f"    !! {'; '.join(found)}\n" if found else "")
    print(f"{wanting} of {len(drawn)} marked; {len(everything)} public functions in all")
    return int(wanting > 0)


if __name__ == "__main__":
    sys.exit(main())
