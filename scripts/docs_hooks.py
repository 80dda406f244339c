"""What the documentation site is given when it is built: the API reference, one page for each package, and
the benchmarks' records on the accuracy page.
"""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Iterator
from importlib.metadata import metadata
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parent))
from api_contents import undocumented

ROOT = Path(__file__).parents[1]
RECORDS = ROOT / "benchmarks" / "results"
TABLE = "table.md"
COLUMNS = ("rms_arcsec", "bound_arcsec", "paper_arcsec")  # of table4.csv, in the order of docs/accuracy.md
NAME = re.compile(
    r"`(boresight\.(?:records|geometry|star_id|gct_match|calib|simulator|pipeline|features)(?:\.\w+)+)`"
)
EXAMPLES = {
    "star_tracker": "Find, identify, calibrate a lens",
    "matching": "Match two arrays, and a strip",
    "vectors": "From vectors to the matrix",
    "own_arrays": "From your own arrays to the matrix",
}
DOOR = (
    "boresight.missions",
    "boresight.vectors",
    "boresight.matching",
    "boresight.features.sky_images.api",
    "boresight.features.targets.api",
    "boresight.features.geolocate.api",
    "boresight.features.planning.api",
    "boresight.features.simulation.api",
    "boresight.display",
)
PLOT = re.compile(r"<!-- plot ([\w-]+): (.*?) -->")
PACKAGES = {
    "records": "Frozen records with shape, unit and frame of each field, and the ledger of observations.",
    "geometry": "Constants, time, frames, light, the Earth, cameras, orbit and attitude.",
    "star_id": "A star image becomes named stars with directions and covariances.",
    "gct_match": "Ground targets found in a strip and measured to a few hundredths of a pixel.",
    "calib": "Directions and covariances become the installation matrix, with a covariance that holds.",
    "simulator": "Missions with known truth, as raw pixels.",
    "pipeline": "The spine: a dump becomes a matrix, a saved result and its page.",
    "features": "Every further job than calibrating, a folder each.",
}


def on_config(config: Any) -> Any:
    """Pages that `nav` does not name stand under "More", so that a new page needs no second place. The foot
    of each page has version, licence and addresses of the installed package.
    """
    named = set(re.findall(r"[\w/-]+\.md", str(config.nav)))
    others = sorted(path.name for path in Path(config.docs_dir).glob("*.md") if path.name not in named)
    if others:
        config.nav.insert(-2, {"More": others})
    project = metadata("boresight")
    links = dict(one.split(", ", 1) for one in project.get_all("Project-URL", []))
    shown = [f'<a href="{address}">{name}</a>' for name, address in links.items()]
    config.copyright = " · ".join([f"boresight {project['Version']}", project["License-Expression"], *shown])
    config.repo_url = links.get("Source")
    return config


def on_files(files: Files, *, config: Any) -> Files:
    """Add `api/PACKAGE.md` for each package, `api/boresight.md` for the names of `boresight` itself, and a
    page for each example: its docstring, code, output and picture."""
    head = "# boresight\n\nThe names of `import boresight as bs`.\n"
    content = "\n".join([head, *(f"::: {module}\n" for module in DOOR)])
    files.append(File.generated(config, "api/boresight.md", content=content))
    for name, title in EXAMPLES.items():
        files.append(File.generated(config, f"examples/{name}.md", content=_example(name, title)))
    for package, text in PACKAGES.items():
        parts = [f"# {package}\n\n{text}\n"]
        parts += [f"::: {module}\n" for module in modules_of(package) if module not in DOOR]
        page = File.generated(config, f"api/{package}.md", content="\n".join(parts))
        files.append(page)
    for plot in sorted(RECORDS.glob("*.png")):
        files.append(File.generated(config, f"results/{plot.name}", abs_src_path=str(plot)))
    return files


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Files) -> str:
    """Put table and records of the benchmarks where their marks stand, and link the method's names to the
    API pages.
    """
    if page.file.src_uri == "notes/method.md":
        markdown = NAME.sub(r"[`\1`][\1]", markdown)
    above = "../" * page.file.src_uri.count("/")
    markdown = PLOT.sub(rf"![\2]({above}results/\1.png)", markdown)
    if "<!-- table 4 -->" in markdown:
        markdown = markdown.replace("<!-- table 4 -->", _table4())
    markdown = markdown.replace("<!-- benchmark table -->", _table())
    return markdown.replace("<!-- benchmark records -->", "\n".join(_records()))


def on_post_build(config: Any) -> None:
    """Stop where an API page lacks an exported name or its text."""
    for package in PACKAGES:
        page = (Path(config.site_dir) / "api" / f"{package}.html").read_text(encoding="utf-8")
        if missing := undocumented(page, [one for one in modules_of(package) if one not in DOOR]):
            raise PluginError(f"api/{package}.html lacks {len(missing)} names, first {missing[0]}")


def _example(name: str, title: str) -> str:
    folder = ROOT / "docs" / "examples"
    text, code = (folder / f"{name}.py").read_text(encoding="utf-8").removeprefix('"""').split('"""\n', 1)
    output = (folder / f"{name}.txt").read_text(encoding="utf-8")
    picture = next((ROOT / "docs" / "images").glob(f"example_{name}.*")).name
    return (
        f"# {title}\n\n{text}\n```python\n{code.strip()}\n```\n\n"
        f"It prints\n\n```text\n{output.rstrip()}\n```\n\n"
        f"![The picture that the example draws](../images/{picture})\n\n"
        f"The file is `docs/examples/{name}.py`.\n"
    )


def _table() -> str:
    """The table of the benchmarks, its headings below those of the page."""
    path = RECORDS / TABLE
    text = path.read_text(encoding="utf-8") if path.is_file() else "`make benchmarks` has not been run."
    return re.sub(r"^# .*\n", "", text, flags=re.MULTILINE)


def _table4() -> str:
    """For docs/accuracy.md, a row for each pair of centroid errors: our rms, bound, and the paper's error."""
    with (RECORDS / "table4.csv").open(newline="") as stream:
        ours = [row for row in csv.DictReader(stream) if row["method"] == "information"]
    cells = {(row["sigma_s_px"], row["sigma_c_px"], row["axis"]): row for row in ours}
    pairs = dict.fromkeys((row["sigma_s_px"], row["sigma_c_px"]) for row in ours)
    rows = []
    for s, c in pairs:
        values = [f"{float(cells[s, c, axis][name]):.4f}" for name in COLUMNS for axis in "XYZ"]
        rows.append(f"| {float(s):.2f}, {float(c):.1f} | " + " | ".join(values) + " |")
    runs, frames = ours[0]["runs"], ours[0]["frames"]
    lines = [
        "| σ_s, σ_c, px | ours: X | Y | Z | bound: X | Y | Z | paper: X | Y | Z |",
        "| --- " * 10 + "|",
        *rows,
        "",
        f"Error in arc-seconds. Ours: rms of {runs} runs of {frames} frames at the level",
        "of vectors, as in the paper's Table 4. Bound: Cramér-Rao. Paper: size of its printed single draws.",
    ]
    return "\n".join(lines) + "\n"


def _records() -> Iterator[str]:
    for path in sorted(RECORDS.glob("*")):
        if path.name == TABLE:
            continue
        if path.suffix in (".txt", ".md", ".png"):
            yield f"### {path.stem.replace('_', ' ')}\n"
        if path.suffix == ".txt":
            yield f"```text\n{path.read_text(encoding='utf-8').rstrip()}\n```\n"
        elif path.suffix == ".md":
            yield re.sub(r"^#", "####", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
        elif path.suffix == ".png":
            yield f"![Plot of {path.stem.replace('_', ' ')}](results/{path.name})\n"


def modules_of(package: str) -> list[str]:
    """Dotted names of a package's modules, packages within it included, private ones not."""
    paths = sorted((ROOT / package).rglob("*.py"))
    names = [path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".") for path in paths]
    return [
        f"boresight.{name}" for name in names if not any(part.startswith("_") for part in name.split("."))
    ]
