"""Public functions and classes, and module files, whose name more than one module of the package has.

    python scripts/public_names.py            lists them; status 1 if there is one
    python scripts/public_names.py --all      lists every public name with its module

A name is public if it stands at the top of a module without a leading underscore. By convention
(docs/architecture.md) several files may be called `__init__.py`, `api.py` (the public functions of a
feature) and `settings.py` (the settings of a room).
"""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ROOMS = tuple("boresight records geometry star_id gct_match calib simulator pipeline features".split())
BY_CONVENTION = {"__init__.py", "api.py", "settings.py"}


def modules() -> list[Path]:
    """Every module of the package, once: the links below `boresight/` are not followed."""
    found = [path for room in ROOMS for path in (ROOT / room).rglob("*.py")]
    return sorted(path for path in found if not any(parent.is_symlink() for parent in path.parents))


def names_by_place() -> dict[str, set[str]]:
    """Public names, and the modules that define them."""
    places = defaultdict(set)
    for path in modules():
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].add(str(path.relative_to(ROOT)))
    return places


def files_by_name() -> dict[str, set[str]]:
    """File names outside the convention, and where they are."""
    places = defaultdict(set)
    for path in modules():
        if path.name not in BY_CONVENTION:
            places[path.name].add(str(path.relative_to(ROOT)))
    return places


def repeated(places: dict[str, set[str]]) -> dict[str, list[str]]:
    """Those in more than one place."""
    return {name: sorted(where) for name, where in sorted(places.items()) if len(where) > 1}


def main() -> int:
    """Print the list; the number of names in more than one place is the status, at most 1."""
    if "--all" in sys.argv[1:]:
        for name, where in sorted(names_by_place().items()):
            print(f"{name:40} {', '.join(sorted(where))}")
        return 0
    found = repeated(names_by_place()) | repeated(files_by_name())
    for name, where in found.items():
        print(f"{name:40} {', '.join(where)}")
    print(f"{len(names_by_place())} public names in {len(modules())} modules, {len(found)} repeated")
    return bool(found)


if __name__ == "__main__":
    raise SystemExit(main())
