"""The pages for whoever carries this on: what they name is there, and what is there is named."""

import re
from pathlib import Path

import pytest
from journeys import ROOT
from recipe import recipe

from boresight.features.table import NAMES, features

FOLDERS = ("tests", "benchmarks", "scripts")  # whose README lists every module
PAGES = ("CONTRIBUTING.md", "docs/architecture.md", *(f"{folder}/README.md" for folder in FOLDERS))
# What a run makes, what a dump holds, a name that no file has; files of a feature that a reader adds.
ELSEWHERE = {"site", "truth", "utils.py", "benchmarks/results/table.md", "results/table.md", *recipe()}
ROOMS = [path for path in ROOT.iterdir() if path.is_dir() and not path.name.startswith(".")]
PLACES = {path.relative_to(ROOT).as_posix() for room in ROOMS for path in (room, *room.rglob("*"))}
PLACES |= {path.name for path in ROOT.iterdir()}


def named_places(page: str) -> set[str]:
    """Paths that a page names in backticks, in links and in its code, without patterns."""
    text = re.sub(r"\w+://\S+", "", (ROOT / page).read_text(encoding="utf-8"))
    code = re.findall(r"`[^`\n]+`|\]\([^)#]+|```.*?```", text, re.DOTALL)
    words = {word.rstrip("/.") for part in code for word in re.findall(r"[\w./{}*-]+", part)}
    is_path = re.compile(r"[a-z_][\w-]*(/[\w.-]+)+|\w+\.(py|md|toml|txt)")
    return {word for word in words if is_path.fullmatch(word) and "NAME" not in word and "ROOM" not in word}


@pytest.mark.parametrize("page", PAGES)
def test_places_that_a_guide_names_are_there(page: str) -> None:
    places = named_places(page)
    known = {"/".join(path.split("/")[n:]) for path in PLACES for n in range(path.count("/") + 1)}
    assert len(places) > 5 and places - known <= ELSEWHERE


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_readme_names_every_module_of_its_folder(folder: str) -> None:
    text = (ROOT / folder / "README.md").read_text(encoding="utf-8")
    modules = [path.name for path in (ROOT / folder).glob("*.py")]
    assert len(modules) > 10 and [name for name in modules if f"`{name}`" not in text] == []


def test_every_room_and_feature_has_its_tests_named() -> None:
    table = (ROOT / "tests" / "README.md").read_text(encoding="utf-8").partition("| changed | run |")[2]
    rows = dict(re.findall(r"^\| (`\w+/.*?) \| (.*) \|$", table, re.MULTILINE))
    named = {place for changed in rows for place in re.findall(r"`([\w/]+)/`", changed)} - {"features/NAME"}
    rooms = {path.parent.relative_to(ROOT).as_posix() for path in ROOT.glob("*/__init__.py")}
    inner = {path.parent.relative_to(ROOT).as_posix() for path in ROOT.glob("pipeline/*/__init__.py")}
    assert named - {"scripts"} == (rooms | inner) - {"features", "pipeline"}
    untested = [name for name in NAMES if not list((ROOT / "tests" / "features" / name).glob("test_*.py"))]
    assert [name for name in untested if f"of `{name}` `tests/" not in rows["`features/NAME/`"]] == []


def test_the_architecture_names_the_commands_of_every_feature() -> None:
    text = Path(ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| ([^|;]*)[^|]* \|", text, re.MULTILINE)
    stated = {name: sorted(filter(None, re.split(", *", commands.strip()))) for name, commands in rows}
    assert stated == {
        name: sorted(one.name for one in feature.commands)
        for name, feature in zip(NAMES, features(), strict=True)
    }


def test_the_makefile_has_the_targets_that_guides_name() -> None:
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    text = "".join((ROOT / page).read_text(encoding="utf-8") for page in PAGES)
    named = set(re.findall(r"(?:\$ |`)make (\w+)", text))
    assert len(named) > 3 and named <= targets
