"""Whatever a program hands to the public functions: a result, or an error that docs/python.md lists."""

import inspect
import re
import warnings
from pathlib import Path

import pytest
from hostile_calls import door, hostile_calls

import boresight as bs

CALLS = 300


@pytest.mark.filterwarnings("ignore")
def test_no_hostile_argument_raises_an_undocumented_error(
    finished: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    dump, result = finished
    image = dump / "exposures" / "e0001.png"
    solution = bs.identify(image, camera=bs.open_dump(dump).star_camera)
    assert solution
    doors = door(solution, bs.read_result(result), dump, tmp_path)
    for one, arguments in hostile_calls(doors, CALLS, seed=20261125):
        said = None
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            try:
                one.call(**arguments)
            except one.documented as error:
                said = str(error)
        assert said is None or (said and "\n" not in said and "\x1b" not in said), (one.name, said)


def test_every_error_is_documented_where_it_is_raised() -> None:
    for name in bs.__all__:
        function = getattr(bs, name)
        if inspect.isfunction(function):
            section = (inspect.getdoc(function) or "").split("Raises\n------\n")[1].split("\nExamples\n")[0]
            named = set(re.findall(r"(?m)^(\w+)$", section))
            assert named <= {"ValueError", "RawDataError", "DataNotSufficientError", "WorkerError"}, name
            assert "ValueError" in named, name
