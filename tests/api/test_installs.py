"""What pyproject.toml declares and what constraints.txt pins belong together."""

import re
import runpy
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import boresight

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
DECLARED = [Requirement(text) for text in [*PROJECT["dependencies"], *EXTRAS["dev"], *EXTRAS["docs"]]]
PIN = re.compile(r"^([\w.\-]+)==([^\s;]+)[^\\]*\\\n((?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n?)+)", re.M)


def pins() -> dict[str, list[Version]]:
    """Pinned versions by name; several where they depend on the version of Python."""
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    found = PIN.findall(text)
    assert len(found) == len(re.findall(r"^\w", text, re.M)), "a requirement without pin and hashes"
    versions: dict[str, list[Version]] = {}
    for name, version, _ in found:
        versions.setdefault(canonicalize_name(name), []).append(Version(version))
    return versions


@pytest.mark.parametrize("requirement", DECLARED, ids=lambda requirement: requirement.name)
def test_every_dependency_is_pinned_with_hashes_to_what_is_declared(requirement: Requirement) -> None:
    pinned = pins().get(canonicalize_name(requirement.name))
    assert pinned, "not in constraints.txt: run `make lock`"
    assert all(requirement.specifier.contains(version) for version in pinned)


def test_every_runtime_dependency_declares_a_minimum_that_can_be_installed() -> None:
    for text in PROJECT["dependencies"]:
        assert re.fullmatch(r"[\w\-]+>=[\d.]+", text), f"{text}: .ci/run replaces >= by =="


def test_stated_python_versions_begin_with_the_required_one() -> None:
    stated = [c.split(" :: ")[-1] for c in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", c)]
    assert stated == ["3.11", "3.12", "3.13", "3.14"]
    assert PROJECT["requires-python"] == f">={stated[0]}"


def test_plain_constraints_are_the_pins_without_hashes() -> None:
    plain = (ROOT / "constraints-plain.txt").read_text(encoding="utf-8")
    lines = [line for line in plain.splitlines() if not line.startswith("#")]
    found = {canonicalize_name(Requirement(line).name) for line in lines}
    assert found == set(pins()), "run `make lock`"
    assert "--hash" not in plain
    assert len(lines) == sum(map(len, pins().values()))


README = """[page](docs/a.md#b) ![picture](docs/images/p.png) [site](https://example.org/x) [below](#below)"""


def test_readme_of_an_index_has_absolute_links_or_plain_words() -> None:
    hook = runpy.run_path(str(ROOT / "hatch_build.py"))["readme_of_index"]
    base = "https://example.org/boresight"
    with_source = hook(README, base)
    expected = f"[page]({base}/blob/HEAD/docs/a.md#b) ![picture]({base}/raw/HEAD/docs/images/p.png)"
    assert expected in with_source
    assert hook(README) == "page  [site](https://example.org/x) below"
    for source in ("", base):
        of_project = hook((ROOT / "README.md").read_text(encoding="utf-8"), source)
        assert not re.findall(r"\]\((?!https?://)", of_project)


def test_addresses_of_the_project_follow_from_that_of_its_repository() -> None:
    urls_of = runpy.run_path(str(ROOT / "hatch_build.py"))["urls_of"]
    assert set(urls_of("")) == {"Method", "Star catalogue"}
    own = urls_of("https://example.org/boresight")
    assert own["Source"] == "https://example.org/boresight" and own["Issues"].endswith("/issues")
    files = [address.partition("HEAD/")[2] for address in own.values() if "HEAD/" in address]
    assert len(files) == 2 and all((ROOT / file).is_file() for file in files)


def test_citation_recipe_and_package_state_one_version() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    recipe = (ROOT / "conda" / "recipe.yaml").read_text(encoding="utf-8")
    assert re.search(r"^version: (.*)$", citation, re.M)[1] == PROJECT["version"]  # type: ignore[index]
    assert boresight.__version__ == PROJECT["version"]
    assert re.search(r"^date-released: \d{4}-\d\d-\d\d$", citation, re.M)
    assert re.search(r'^  version: "(.*)"$', recipe, re.M)[1] == PROJECT["version"]  # type: ignore[index]
    of_conda = {"opencv-python-headless": "py-opencv", "matplotlib": "matplotlib-base"}
    needed = {of_conda.get(one.name, one.name) for one in map(Requirement, PROJECT["dependencies"])}
    run = recipe[recipe.index("  run:") : recipe.index("tests:")]
    assert set(re.findall(r"^    - ([\w-]+)", run, re.M)) == needed | {"python"}
