"""Constants of all modules, and what functions and records take where nothing is given: most tests allow for
noise, and a limit of twice the size passes them. A record is written as `recorded_numbers.py` says."""

import ast
import dataclasses
import importlib
import inspect
import json
import os
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from recorded_numbers import RECORDS, summary

ROOT = Path(__file__).parents[1]
ROOMS = "boresight records geometry star_id gct_match calib simulator pipeline features".split()


def numbers_of(value: object) -> list[float]:
    """The finite numbers of a constant: of a table those that it holds, of a record those of its fields."""
    if isinstance(value, int | float | np.number):
        return [float(value)] if np.isfinite(value) and not isinstance(value, bool) else []
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = [getattr(value, field.name) for field in dataclasses.fields(value)]
    value = [*value, *value.values()] if isinstance(value, Mapping) else value
    return [*chain(*map(numbers_of, value))] if isinstance(value, list | tuple | np.ndarray) else []


def stated_in(module: ModuleType) -> Iterator[tuple[str, object]]:
    """Constants that a module itself assigns, and defaults of its functions and methods."""
    for node in ast.parse(inspect.getsource(module)).body:
        targets = getattr(node, "targets", [getattr(node, "target", ast.Pass())])
        names = [one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)]
        yield from ((name, getattr(module, name)) for name in names if name.isupper())
    for owner in (module, *(one for one in vars(module).values() if isinstance(one, type))):
        for one in list(vars(owner).values()):
            if inspect.isfunction(of := getattr(one, "__func__", one)) and of.__module__ == module.__name__:
                parameters = inspect.signature(of).parameters.items()
                yield from ((f"{of.__qualname__}({key})", parameter.default) for key, parameter in parameters)


@pytest.mark.parametrize("room", ROOMS)
def test_constants_are_the_recorded_ones(room):
    found, path = {}, RECORDS / f"constants_{room}.json"
    for source in sorted((ROOT / room).rglob("[!_]*.py")):
        place = source.relative_to(ROOT).with_suffix("")
        module = importlib.import_module(".".join(("boresight", *place.parts)[room == "boresight" :]))
        stated = ((name, numbers_of(value)) for name, value in stated_in(module))
        found |= {f"{place} {name}": few if len(few) <= 8 else summary(few) for name, few in stated if few}
    if os.environ.get("RECORD_NUMBERS"):
        lines = (f"{json.dumps(name)}: {numbers}" for name, numbers in found.items())
        path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    known = json.loads(path.read_text(encoding="utf-8"))
    alike = {name: pytest.approx(numbers, rel=1e-5) for name, numbers in found.items()}  # of six digits
    told = [name for name in sorted(known.keys() | found) if known.get(name) != alike.get(name)]
    assert not told, [f"{name}: {known.get(name)} recorded, {found.get(name)} found" for name in told]
