"""What a shell offers for values: of every option and argument of every command."""

import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import rasterio
import typer
from command_line import app
from rasters import write_raster
from typer._completion_classes import BashComplete

from boresight.features.exports.formats import FORMATS
from boresight.features.operators.sentinel2_product import BANDS
from boresight.features.paper.tables import EXPERIMENTS
from boresight.features.table import features
from boresight.pipeline.console.messages import Accepted
from boresight.pipeline.console.program import SPINE

ROOT = Path(__file__).parents[3]
PROGRAM = "import sys; sys.argv = ['boresight']; import boresight.console as c; c.run_command_line()"
COMMANDS = [command.name for one in (SPINE, *features()) for command in one.commands]
STRIPS = ["s01", "s02", "s03"]

# Options and arguments that take one of a known set of values: the words before it, and what is offered.
KNOWN: dict[tuple[str, str], tuple[tuple[str, ...], list[str]]] = {
    ("calibrate", "--accept"): ((), [one.value for one in Accepted]),
    ("experiment", "name"): ((), [*EXPERIMENTS, "all"]),
    ("export", "--format"): (("r",), list(FORMATS)),
    ("export", "--strip"): (("RESULT",), STRIPS),
    ("geolocate", "--strip"): (("RESULT",), STRIPS),
    ("import points", "--strip"): (("a.gcp", "DUMP/points.csv"), STRIPS),
    ("import points", "--ccd"): (("a.gcp", "DUMP/points.csv", "--strip", "s02"), ["0", "1"]),
    ("import points", "--height-kind"): ((), ["ellipsoidal", "egm96"]),
    ("import points", "--image"): (("POINTS",), ["left.tif", "right.tif"]),
    ("import sentinel2", "--attitudes"): ((), ["raw", "corrected", "refined"]),
    ("import sentinel2", "--band"): ((), list(BANDS)),
    ("match", "--strip"): (("DUMP",), STRIPS),
    ("sentinel2", "--band"): ((), list(BANDS)),
    ("simulate", "scenario"): ((), ["mini", "paper", "sky"]),
    ("targets suggest", "--band"): (("ORTHO",), ["1", "2", "3", "4"]),
    ("targets suggest", "--heights"): ((), ["ellipsoidal", "egm96", "egm2008"]),
    ("virtual-ccd", "--strip"): (("RESULT",), STRIPS),
}
# Options with words that nothing here knows, and why.
FREE_BECAUSE = {
    "the address of a machine": "calibrate --scheduler",
    "a name that the user gives": (
        "dump init --mission, export --spice-remote-camera, export --spice-star-camera, "
        "targets suggest --reference"
    ),
    "a designator that others have given": (
        "export --object-id, import dimap --object-id, import sentinel2 --object-id"
    ),
    "an id that the user gives": (
        "export --camera, compare --camera, what-if --camera, geolocate --camera, validate --camera, "
        "virtual-ccd --camera"
    ),
    "a time": (
        "sky-strip-plan --utc, star-camera-plan --utc, targets suggest --days, export --valid-from, "
        "export --valid-to, trends --at"
    ),
    "a name in a catalogue that is not read yet": "targets suggest --asset",
    "a strip of the result": "what-if --only, what-if --without",
    "a strip of the result, and a number": "what-if --sigma",
}
FREE = {tuple(one.rsplit(" ", 1)) for words in FREE_BECAUSE.values() for one in words.split(", ")}
SETTINGS = ("simulate", "--set")
# Numbers without a least value: signed ones, and those of which the command itself says what it expects.
WITHOUT_LEAST = (
    "identify --site, star-camera-calibrate --site, targets suggest --bbox, targets suggest --height-m, "
    "import points --height-m, dimap --height-m, virtual-ccd --height-m, geolocate --height-m, "
    "sky-strip-plan --v-mag, star-camera-plan --limit-mag, export --spice-spacecraft, identify --fov, "
    "star-camera-plan --fov, star-camera-calibrate --fov, identify --size, star-camera-plan --size, "
    "identify --interval, identify --exposure"
)


def offered(*words: str) -> list[str]:
    """What the program answers bash for the last of these words."""
    typed = ["boresight", *words]
    given = {
        "_BORESIGHT_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(typed),
        "COMP_CWORD": str(len(typed) - 1),
    }
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=os.environ | given, capture_output=True, text=True, cwd=ROOT
    )
    return ran.stdout.split()


@cache
def root() -> typer.core.TyperGroup:
    """The program with its commands, made once."""
    return typer.main.get_command(app)


def answers(*words: str) -> list[str]:
    """The same within this process."""
    completion = BashComplete(root(), {}, "boresight", "_BORESIGHT_COMPLETE")
    return [item.value for item in completion.get_completions(list(words[:-1]), words[-1])]


def parameters() -> Iterator[tuple[tuple[str, str], object]]:
    """Arguments and options with a value of all commands: (command, name) and typer's description."""
    for name in COMMANDS:
        command = root()
        for word in name.split():
            command = command.commands[word]
        for one in command.params:
            if not getattr(one, "is_flag", False):
                yield (name, one.opts[0]), one


@pytest.fixture(scope="module")
def places(made_once) -> dict[str, str]:
    """Files whose content is offered, by the words of `KNOWN` that stand for them."""

    def fill(folder: Path) -> None:
        (folder / "result").mkdir()
        (folder / "result" / "run.json").write_text(f'{{"dump": "{ROOT / "fixtures" / "mini"}"}}')
        (folder / "dump").mkdir()
        rows = (ROOT / "fixtures" / "mini" / "strips.csv").read_text().splitlines()
        rows = [row for row in rows if not row.startswith(("s02,2", "s02,3"))]
        (folder / "dump" / "strips.csv").write_text("\n".join(rows))
        point = "46.0 7.0 500.0 1 1 1"
        rows = (f"{n} {point} dir/left.tif 10 20 1 1 dir/right.tif 11 21 1 1" for n in range(2))
        (folder / "a.gcp").write_text("# WKT: none\n" + "\n".join(rows) + "\n")
        placed = {"crs": "EPSG:32648", "transform": rasterio.Affine(1, 0, 5e5, 0, -1, 4e6)}
        write_raster(folder / "ortho.tif", np.ones((4, 2, 2), np.uint8), **placed)

    folder = made_once("completed", fill)
    return {
        "RESULT": str(folder / "result"),
        "DUMP": str(folder / "dump"),
        "DUMP/points.csv": str(folder / "dump" / "points.csv"),
        "POINTS": str(folder / "a.gcp"),
        "ORTHO": str(folder / "ortho.tif"),
    }


def test_every_value_of_every_command_is_a_file_a_number_a_free_word_or_offered(places) -> None:
    """A file or folder is left to the shell, which `complete -o default` lets offer them; so is a number."""
    found = dict(parameters())
    assert len(COMMANDS) >= 28 and {command for command, _ in found} == set(COMMANDS)
    assert set(KNOWN) | FREE | {SETTINGS} <= set(found)
    for (command, name), one in found.items():
        told, words = f"{command} {name}", command.split()
        if (command, name) in KNOWN:
            before, expected = KNOWN[command, name]
            words += [places.get(word, word) for word in before]
            words += [name] if name.startswith("-") else []
            assert answers(*words, "") == expected, told
            assert answers(*words, expected[-1]) == [expected[-1]], told
            assert answers(*words, "no-such-word") == [], told
        elif (command, name) != SETTINGS:  # tested by itself
            words += [name] if name.startswith("-") else ["x"] * (name == "out")
            is_left_to_the_shell = types_of(one) <= {Path} or is_number(one)
            assert is_left_to_the_shell != ((command, name) in FREE), f"{told} offers nothing"
            assert answers(*words, "") == [], told


def is_number(one: object) -> bool:
    """Whether a parameter's value is a number, or some of them."""
    return types_of(one) <= {int, float}


def types_of(one: object) -> set[type]:
    """Types of a parameter's value, or of the values of a list or tuple."""
    annotation = one.type_descriptor.annotation
    return set(get_args(annotation) or (annotation,))


def test_every_number_of_an_option_has_a_least_value() -> None:
    numbers = {
        f"{command} {name}": one.type_descriptor for (command, name), one in parameters() if is_number(one)
    }
    without = {name for name, of in numbers.items() if of.parameter_info.min is None}
    assert without == set(WITHOUT_LEAST.split(", "))


def test_all_commands_and_their_options_are_offered() -> None:
    groups = {name.split()[0] for name in COMMANDS}
    assert set(answers("")) == groups
    for name in COMMANDS:
        *before, last = name.split()
        assert last in answers(*before, last[:2])
    for name, one in parameters():
        if name[1].startswith("--"):
            assert name[1] in answers(*name[0].split(), name[1][:4]), one


def test_settings_of_a_scenario_are_offered_with_their_values() -> None:
    assert answers("simulate", "mini", "out", "--set", "strips.c") == ["strips.count=3"]
    assert "line_camera.focal_m=10.0" in answers("simulate", "mini", "out", "--set", "line_camera.")
    assert answers("simulate", "mini", "out", "--set", "ep") == ["epoch_utc=2024-11-20T03:40:00"]
    assert answers("simulate", "own.toml", "out", "--set", "strips.c") == []


def test_formats_after_a_comma_and_experiments_from_pixels() -> None:
    assert answers("export", "r", "--format", "spice,r") == ["spice,rpc"]
    assert answers("export", "r", "--format", "geo") == ["geojson"]
    assert answers("experiment", "--pixels", "") == ["grid", "table4"]
    assert answers("match", "no-such-folder", "--strip", "s0") == []


def test_the_program_itself_answers_a_shell() -> None:
    assert offered("match", "fixtures/mini", "--strip", "s0") == STRIPS
