"""Figures of the pages show what the present code draws: their texts, numbers, lines and pictures."""

import base64
import io
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from drawn_pictures import assert_alike, same_picture
from PIL import Image

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"
SCRIPTS = ROOT / "scripts" / "figures"
SVG = ("frames", "sky_trace", "star_path", "strip_form", "strip_timing", "target_path")
PNG = ("plan", "star_camera_plan")
# Pictures that are compared elsewhere, or cannot be drawn here, and why.
OTHERS = {
    r"example_.*\.png": "tests/docs/test_examples.py",
    r"report\.png|signed-\d\.png": "tests/docs/test_pictures.py",
    r"terminal-.*\.svg": "tests/docs/test_demo_numbers.py",
    r"real_.*\.svg": "their data are too large for the repository (scripts/figures/real_mission.py)",
}
# A place moves by far less than a quarter of a point, a fifth of a line's width.
PLACE_PT = 0.25


# Draws into the folder that is named first, as each script by itself would.
DRAWING = """
import runpy, sys
for script in sys.argv[2:]:
    runpy.run_path(script, run_name="__main__")
"""


@pytest.fixture(scope="module")
def drawn(made_once) -> Path:
    """Folder of all figures, drawn by one process."""

    def fill(folder: Path) -> None:
        scripts = [SCRIPTS / f"{name}.py" for name in (*SVG, *PNG)]
        command = [sys.executable, "-c", DRAWING, folder, *scripts]
        paths = os.pathsep.join([str(SCRIPTS), os.environ.get("PYTHONPATH", "")])
        environment = os.environ | {"PYTHONPATH": paths}
        ran = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment)
        assert ran.returncode == 0, ran.stderr

    return made_once("drawn-figures", fill)


def test_every_picture_is_compared_with_the_present_code_or_has_a_reason() -> None:
    drawn_here = {f"{name}-{version}.svg" for name in SVG for version in ("light", "dark")}
    drawn_here |= {f"{name}.png" for name in PNG}
    present = {path.name for path in IMAGES.iterdir() if path.is_file()}
    others = {name for name in present if any(re.fullmatch(one, name) for one in OTHERS)}
    assert drawn_here | others == present and not drawn_here & others


@pytest.mark.parametrize("name", SVG)
def test_drawing_shows_what_the_present_code_draws(name: str, drawn: Path) -> None:
    for version in ("light", "dark"):
        kept, now = (read_svg(folder / f"{name}-{version}.svg") for folder in (IMAGES, drawn))
        assert_alike("\n".join(kept.texts), "\n".join(now.texts), name)
        assert kept.shapes == now.shapes
        assert np.abs(np.array(kept.places) - now.places).max() <= PLACE_PT
        assert all(same_picture(a, b) for a, b in zip(kept.pictures, now.pictures, strict=True))


@pytest.mark.parametrize("name", PNG)
def test_picture_shows_what_the_present_code_draws(name: str, drawn: Path) -> None:
    with Image.open(IMAGES / f"{name}.png") as kept, Image.open(drawn / f"{name}.png") as now:
        assert same_picture(kept, now)


def test_another_curve_or_text_is_another_drawing(tmp_path: Path) -> None:
    """The comparison sees a line that ends elsewhere by half a point, a word and a number."""
    text = (IMAGES / "strip_timing-light.svg").read_text(encoding="utf-8")
    (tmp_path / "a.svg").write_text(text.replace("<!-- row of target j -->", "<!-- row of target k -->"))
    (found,) = {
        (a, b)
        for a, b in zip(read_svg(IMAGES / "strip_timing-light.svg").texts, read_svg(tmp_path / "a.svg").texts)
        if a != b
    }
    assert found == ("row of target j", "row of target k")
    moved = re.sub(r'd="M ([\d.]+)', lambda m: f'd="M {float(m[1]) + 0.5}', text)
    (tmp_path / "b.svg").write_text(moved)
    kept, now = (read_svg(path).places for path in (IMAGES / "strip_timing-light.svg", tmp_path / "b.svg"))
    assert np.abs(np.array(kept) - now).max() == pytest.approx(0.5)
    with Image.open(IMAGES / "plan.png") as one, Image.open(IMAGES / "plan.png") as other:
        grey = np.asarray(other.convert("L")).copy()
        grey[200:206, 100:220] = 0  # a further line
        assert same_picture(one, other) and not same_picture(one, Image.fromarray(grey))


class Drawing:
    """What an SVG of Matplotlib shows: texts, kinds of shapes, their numbers, and raster pictures in it."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.shapes: list[str] = []
        self.places: list[float] = []
        self.pictures: list[Image.Image] = []


def read_svg(path: Path) -> Drawing:
    """The drawing in a file. Outlines of letters are left out: the text stands in a comment before them."""
    found = Drawing()
    parser = ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))
    for element in shown(ET.parse(path, parser).getroot()):
        if element.tag is ET.Comment:
            found.texts.append(str(element.text).strip())
            continue
        found.shapes.append(str(element.tag).rpartition("}")[2])
        for key, value in element.attrib.items():
            name = key.rpartition("}")[2]
            if name in ("d", "x", "y", "points", "width", "height", "transform"):
                found.places += map(float, re.findall(r"-?\d+(?:\.\d+)?(?:e-?\d+)?", value))
            elif name == "href" and value.startswith("data:"):
                raw = base64.b64decode("".join(value.partition(",")[2].split()))
                found.pictures.append(Image.open(io.BytesIO(raw)))
    return found


def shown(element: ET.Element) -> Iterator[ET.Element]:
    """Elements in their order; of a text its comment alone."""
    yield element
    for child in element:
        if str(element.get("id", "")).startswith("text_") and child.tag is not ET.Comment:
            continue
        yield from shown(child)
