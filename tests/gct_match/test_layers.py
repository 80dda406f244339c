"""Which module of gct_match may import which: predict below search and refine, these below the top."""

import ast
from pathlib import Path

import pytest

ROOM = Path(__file__).parents[2] / "gct_match"
# highest first; modules of one floor do not import one another, but those of one folder may
FLOORS = (
    ("match",),
    ("consistency", "locate", "texture"),
    ("refine", "search"),
    ("predict",),
    ("imaging",),
    ("records", "settings"),
)
FLOOR = {part: n for n, floor in enumerate(FLOORS) for part in floor}
MODULES = sorted(path for path in ROOM.rglob("*.py") if path.name != "__init__.py")


def part_of(path: Path) -> str:
    """Folder of a module, or its own name at the top."""
    return path.relative_to(ROOM).with_suffix("").parts[0]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOM)))
def test_module_imports_only_what_lies_below_it(path: Path) -> None:
    own, prefix = part_of(path), "boresight.gct_match."
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(prefix):
            other = (node.module or "").removeprefix(prefix).split(".")[0]
            within = other == own and path.parent != ROOM
            assert within or FLOOR[other] > FLOOR[own], f"{path}:{node.lineno} imports {node.module}"


def test_every_module_has_a_floor() -> None:
    assert {part_of(path) for path in MODULES} == set(FLOOR)
