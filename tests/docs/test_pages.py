"""The documentation's claims about the code, and its links. `make docs` builds the site, strictly."""

import re
import sys

import pytest
from journeys import ROOT, thing_of_name

NOTES = ROOT / "docs" / "notes"
METHOD = (NOTES / "method.md").read_text()
ROW = re.compile(r"^\| \((A?\d+)\) \|[^|]*\| ([^|]*) \|", re.MULTILINE)
ROOMS = "geometry|star_id|gct_match|calib|simulator|pipeline|features"
NAME = re.compile(rf"`boresight\.((?:{ROOMS})(?:\.\w+)+)`")
NAMED_TEST = re.compile(r"`(…|[\w/]*test_\w+\.py)(?:::(test_\w+))?")  # … is the file named before
LINK = re.compile(r"\]\(([^)#\s]+)(#[\w-]+)?\)")


def test_every_equation_of_the_paper_has_its_row():
    rows = [number for number, _ in ROW.findall(METHOD)]
    assert rows == [str(n) for n in range(1, 29)] + [f"A{n}" for n in range(1, 16)]


def test_every_equation_names_a_function():
    assert all(NAME.search(functions) for _, functions in ROW.findall(METHOD))


@pytest.mark.parametrize(
    "page", ["notes/method.md", "architecture.md", "design.md", "conventions.md", "exports.md", "glossary.md"]
)
def test_every_name_of_the_code_exists(page):
    names = NAME.findall((ROOT / "docs" / page).read_text())
    assert [name for name in names if thing_of_name(name) is None] == []


@pytest.mark.parametrize("page", ["star-half.md", "ground-half.md", "estimation.md"])
def test_a_guide_carries_few_figures(page):
    """Figures of runs belong on the generated pages; three in a hundred words of running text are enough."""
    text = (NOTES / page).read_text()
    text = re.sub(
        r"```.*?```|^    .*?$|^\|.*?$|^#.*?$|`[^`]*`|\]\([^)]*\)|^\d+\. ",
        "",
        text,
        flags=re.DOTALL | re.MULTILINE,
    )
    figures = re.findall(r"(?<![\w(])\d[\d.,]*", text)
    assert len(figures) <= 0.03 * len(text.split()), figures


def test_a_user_has_thirty_thousand_words_to_read_at_most():
    """Maintainers' notes, the architecture and the decisions are for those who change the code."""
    pages = {ROOT / "README.md", *(ROOT / "docs").glob("*.md")}
    pages -= {ROOT / "docs" / "architecture.md", ROOT / "docs" / "design.md"}
    assert sum(len(page.read_text().split()) for page in pages) <= 30_000


def test_links_of_readme_and_pages_lead_to_files():
    lost = [
        f"{page.name}: {target}"
        for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
        for target, _ in LINK.findall(page.read_text())
        if not re.match(r"[a-z]+:|(../)?api/", target) and not (page.parent / target).exists()
    ]
    assert lost == []


def test_all_formats_of_the_program_are_described():
    from boresight.features.exports.formats import FORMATS

    text = (ROOT / "docs" / "exports.md").read_text()
    assert all(f"`{name}`" in text for name in FORMATS)


def test_all_commands_of_the_program_are_among_the_tasks():
    from command_line import app

    text = (ROOT / "docs" / "tasks.md").read_text()
    names = [c.name or c.callback.__name__.replace("_", "-") for c in app.registered_commands]
    assert [name for name in names if f"boresight {name}" not in text] == []


def test_the_page_of_json_names_every_command_that_answers_in_it():
    from boresight.features.table import features
    from boresight.pipeline.console.program import SPINE

    told = (ROOT / "docs" / "json.md").read_text().partition(" print one JSON object")[0]
    commands = [one for feature in (SPINE, *features()) for one in feature.commands]
    with_json = {one.name for one in commands if one.with_json}
    assert set(re.findall(r"`([a-z0-9 -]+)`", told)) == with_json and len(with_json) > 10


def test_an_api_page_must_hold_every_exported_name_with_its_text():
    # `make docs` asks this of every page that it has built.
    sys.path.insert(0, str(ROOT / "scripts"))
    from api_contents import exported, undocumented

    names = dict(exported("boresight.geometry.orbit"))
    assert "boresight.geometry.orbit.Orbit" in names
    page = "".join(f'<h2 id="{name}">h</h2><p>{words} <b>and more</b>.</p>' for name, words in names.items())
    assert undocumented(page, ["boresight.geometry.orbit"]) == []
    without = page.replace('id="boresight.geometry.orbit.Orbit"', "")
    assert undocumented(without, ["boresight.geometry.orbit"]) == ["boresight.geometry.orbit.Orbit"]
    silent = page.replace(names["boresight.geometry.orbit.Orbit"], "")
    assert undocumented(silent, ["boresight.geometry.orbit"]) == ["boresight.geometry.orbit.Orbit"]


def test_every_test_that_the_faults_name_exists():
    file, lost = "", []
    for named, test in NAMED_TEST.findall((NOTES / "faults.md").read_text()):
        file = file if named == "…" else named
        found = [path.read_text() for path in (ROOT / "tests").rglob(file)]
        if not any(f"def {test}" in text for text in found):
            lost.append(f"{file}::{test}")
    assert lost == []
