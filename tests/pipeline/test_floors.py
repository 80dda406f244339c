"""Who may import whom: the rooms of the house (docs/design.md)."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = {"records", "geometry", "star_id", "gct_match", "calib", "simulator", "pipeline", "features"}


def room_of(module: str) -> str:
    """`geometry` of `boresight.geometry.orbit`; a bare `geometry.orbit` is refused by a test of its own."""
    return module.removeprefix("boresight.").split(".")[0]


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """The imports, calls and constants of a source file, at whatever depth of its code."""
    kinds = (ast.Import, ast.ImportFrom, ast.Call, ast.Constant)
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return tuple(node for node in ast.walk(tree) if isinstance(node, kinds))


def imported_modules(path: Path) -> list[tuple[int, str]]:
    """Line and name of every absolute import in a source file, at whatever depth of its code.

    Of `from package import name` the name is `package.name`, for it may be a module.
    """
    found = []
    for node in nodes(path):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found += [(node.lineno, f"{node.module}.{alias.name}") for alias in node.names]
    return found


def our_imports(package: str) -> set[str]:
    """Those of our rooms that any module of `package` imports."""
    sources = (ROOT / package).rglob("*.py")
    return {room_of(module) for path in sources for _, module in imported_modules(path)} & ROOMS


@pytest.mark.parametrize("package", ["star_id", "gct_match", "calib", "simulator"])
def test_package_imports_nothing_of_ours_but_geometry_and_records(package: str) -> None:
    assert our_imports(package) <= {package, "geometry", "records"}


def test_geometry_imports_records_and_these_nothing_of_ours() -> None:
    assert our_imports("geometry") <= {"geometry", "records"}
    assert our_imports("records") <= {"records"}


@pytest.mark.parametrize("package", ["records", "geometry", "star_id", "gct_match", "calib", "simulator"])
def test_only_pipeline_prints_and_opens_files_outside_the_package(package: str) -> None:
    for path in (ROOT / package).rglob("*.py"):
        for node in nodes(path):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in ("print", "open", "input", "eval", "exec"), f"{path}:{node.lineno}"


def test_nothing_of_the_reading_side_opens_truth_but_validate() -> None:
    places = [
        f"{path}:{node.lineno}"
        for path in (ROOT / "pipeline").rglob("*.py")
        if path.name not in ("validate.py", "dump_writer.py")
        for node in nodes(path)
        if isinstance(node, ast.Constant) and node.value == "truth"
    ]
    assert places == []


def bare_imports(source: str) -> list[str]:
    """Imports of a room by its own name, in a program or in a string that holds one."""
    one = rf"(?:{'|'.join(sorted(ROOMS))})\b[\w.]*"
    begin = r"(?:^|\\n|[\"';:])[ \t]*"
    return re.findall(rf"(?m){begin}(?:from {one} import|import (?:[\w., ]+, ?)?{one})", source)


def test_rooms_are_imported_by_the_name_of_the_package() -> None:
    """From the root of the repository `import geometry` would work too, and make every module twice."""
    bare = (
        "import geometry",
        "  from calib.x import y",
        "import os, calib.x",
        "'import calib.x'",
        "a; import calib",
    )
    for text in bare:
        assert bare_imports(f"a\n{text}\n"), text
    assert bare_imports("import boresight.calib\nfrom boresight.calib import a\nfrom .calib import a") == []
    wrong = {
        str(path): found
        for folder in (*ROOMS, "boresight", "tests", "benchmarks", "scripts")
        for path in (ROOT / folder).rglob("*.py")
        if (found := bare_imports(path.read_text(encoding="utf-8"))) and path != Path(__file__)
    }
    assert wrong == {}


# Rooms within `pipeline`: each may import itself and those after it; rooms joined by + not one another.
FLOORS = (
    "console calibration_run report results calibration+head_noise+forecast diagnosis stages run files errors"
)
PIPELINE_FLOORS = [floor.split("+") for floor in FLOORS.split()]
BELOW = {
    room: {other for lower in PIPELINE_FLOORS[n + 1 :] for other in lower}
    for n, floor in enumerate(PIPELINE_FLOORS)
    for room in floor
}


@pytest.mark.parametrize(("room", "below"), BELOW.items(), ids=BELOW)
def test_rooms_of_the_pipeline_import_only_what_is_below_them(room: str, below: set[str]) -> None:
    folder = ROOT / "pipeline" / room
    sources = [*folder.rglob("*.py")] if folder.is_dir() else [folder.with_suffix(".py")]
    upward = [
        f"{path.relative_to(ROOT)}:{line} imports {module}"
        for path in sources
        for line, module in imported_modules(path)
        if module.startswith("boresight.pipeline.")
        and module.split(".")[2] not in {room, "__version__", *below}
    ]
    assert sources and upward == []


def test_every_room_of_the_pipeline_has_its_floor() -> None:
    found = {path.stem for path in (ROOT / "pipeline").iterdir() if path.name[:2] != "__"}
    assert found == BELOW.keys()


def test_nothing_prints_but_the_one_module_that_escapes():
    # A name with an escape character, printed as it is, is obeyed by the terminal.
    for path in sorted([*(ROOT / "pipeline").rglob("*.py"), *(ROOT / "features").rglob("*.py")]):
        if path.relative_to(ROOT).parts == ("pipeline", "console", "messages.py"):
            continue
        for call in (node for node in nodes(path) if isinstance(node, ast.Call)):
            name = getattr(call.func, "id", getattr(call.func, "attr", ""))
            if name in ("print", "echo", "write"):
                assert ast.unparse(call.func) not in ("print", "typer.echo", "sys.stdout.write"), path


FEATURES = sorted(path.name for path in (ROOT / "features").iterdir() if (path / "__init__.py").is_file())
DOOR_FOR_FEATURES = {"accepted", "display", "version"}  # forms of arguments, how results print, the version


def test_mathematics_and_spine_import_no_feature() -> None:
    for package in ("records", "geometry", "star_id", "gct_match", "calib", "simulator", "pipeline"):
        assert "features" not in our_imports(package), package


@pytest.mark.parametrize("feature", FEATURES)
def test_a_feature_imports_no_other_feature_and_not_the_door(feature: str) -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {module}"
        for path in (ROOT / "features" / feature).rglob("*.py")
        for line, module in imported_modules(path)
        if (parts := module.split("."))[0] == "boresight"
        and ((parts[1] == "features" and parts[2] != feature) or parts[1] not in ROOMS | DOOR_FOR_FEATURES)
    ]
    assert wrong == []


def test_each_feature_is_one_line_of_the_table() -> None:
    table = (ROOT / "features" / "table.py").read_text(encoding="utf-8")
    assert sorted(re.findall(r'^    "(\w+)",$', table, re.MULTILINE)) == FEATURES
