"""Tasks that people bring are done at first try, in few lines, from the names of the door alone."""

import ast
import inspect
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tasks
from fixture_strips import strip_of_fixture
from outside import run

import boresight as bs

MINI = bs.example("mini")
FEW_LINES = 5
pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.fixture(scope="module")
def june(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return strip_of_fixture(tmp_path_factory.mktemp("two") / "june", 2)


@pytest.fixture(scope="module")
def may(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return strip_of_fixture(tmp_path_factory.mktemp("one") / "may", 1)


@pytest.fixture(scope="module")
def done(installed: Path, may: Path, june: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """What `tasks.py` prints with the wheel, outside the repository."""
    folder = tmp_path_factory.mktemp("tasks")
    for module in (Path(tasks.__file__), Path(inspect.getfile(tasks.drawn_vectors))):
        shutil.copy(module, folder)
    (folder / "out").mkdir()
    strict = ("-W", "error::RuntimeWarning")
    told = run(installed, *strict, "tasks.py", MINI, may, june, folder / "out", cwd=folder).splitlines()
    assert told[0].startswith(str(installed.parents[1]))  # where boresight is
    return told


@pytest.mark.parametrize("task", [task.__name__ for task in tasks.TASKS])
def test_a_task_is_done_at_first_try_with_the_wheel(task: str, done: list[str]) -> None:
    assert task in done, [line for line in done if line.startswith(task)]


def test_a_task_takes_few_lines_of_public_names() -> None:
    for task in tasks.TASKS:
        tree = ast.parse(inspect.getsource(task)).body[0]
        assert isinstance(tree, ast.FunctionDef) and len(tree.body) <= FEW_LINES, task.__name__
    tree = ast.parse(inspect.getsource(tasks))
    imported = [one.module or "" for one in ast.walk(tree) if isinstance(one, ast.ImportFrom)]
    used = {
        one.attr
        for one in ast.walk(tree)
        if isinstance(one, ast.Attribute) and isinstance(one.value, ast.Name) and one.value.id == "bs"
    }
    assert not [name for name in imported if name.startswith("boresight")]
    assert used - {"__file__"} <= set(bs.__all__)


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("errors", 5, "errors: found 5, expected a mapping"),
        ("strips", [{"id": "s"}], "strips, row 0: found columns id, expected also ccd"),
        ("orbit_frame", "TEME", "orbit_frame: found 'TEME', expected ITRF or GCRF or EME2000"),
        ("exposures", [], "exposures: found no rows, expected at least one"),
        ("sigma_R_cs0_rad", -1.0, "sigma_R_cs0_rad: found -1.0"),
        ("targets", None, "targets, points: found neither"),
        ("star_bits", "8", "star_bits: found '8', expected a whole number from 8 to 16"),
        ("remote_bits", [12], "remote_bits: found .12., expected a whole number from 8 to 16"),
        (
            "exposures",
            [{"time": "2024-11-20T03:40:00", "exposure_s": 0.1, "image": lambda: 1 / 0}],
            r"exposures, row 0, image: found .*\(ZeroDivisionError\('division by zero'\)\)",
        ),
    ],
)
def test_wrong_arrays_are_named(name: str, value: object, message: str) -> None:
    image = np.zeros((64, 64), dtype=np.uint8)
    dump = bs.open_dump(MINI)
    few = {
        "star_camera": dump.star_camera,
        "remote_camera": dump.line_camera,
        "R_cs0": dump.R_cs0,
        "sigma_R_cs0_rad": 1e-3,
        "orbit": [],
        "exposures": [{"time": "2024-11-20T03:40:00", "exposure_s": 0.1, "image": image}],
        "strips": pd.DataFrame({"id": ["s"]}),
        "targets": [],
        "errors": {},
    }
    with pytest.raises(ValueError, match=message):
        bs.dump_from_arrays(**few | {name: value})
