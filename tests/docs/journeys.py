"""The journeys of docs/architecture.md, and which functions call one another while a dump is calibrated."""

import importlib
import inspect
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import CodeType, FrameType

from boresight.records.record import _assign

ROOT = Path(__file__).parents[2]
ROW = re.compile(r"^\| `boresight\.([\w.]+)` \| (?:`([\w.]+)`)? *\|", re.MULTILINE)


@dataclass(frozen=True)
class Stop:
    """A row of a journey: a function or a class, and who calls or makes it; "" for the first."""

    name: str
    by: str


def journeys(page: str) -> Mapping[str, list[Stop]]:
    """The stops of each journey of the page, in its order, by heading."""
    parts = re.split(r"^## (Journey \d)[^\n]*$", page, flags=re.MULTILINE)[1:]
    return {
        heading: [Stop(name, by) for name, by in ROW.findall(text)]
        for heading, text in zip(parts[::2], parts[1::2])
    }


def thing_of_name(name: str) -> object:
    """The object that a dotted name below `boresight` means: modules as far as they go, then attributes."""
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        path = ROOT.joinpath(*parts[:cut])
        if path.is_dir() or path.with_suffix(".py").is_file():
            thing = importlib.import_module(f"boresight.{'.'.join(parts[:cut])}")
            for part in parts[cut:]:
                assert hasattr(thing, part), f"boresight.{name}: {thing} has no {part}"
                thing = getattr(thing, part)
            return thing
    raise AssertionError(f"boresight.{name} is not there")


def code_of_name(name: str) -> CodeType | type:
    """The code that runs when a function is called; of a class its `__init__`, of a record the class, as all
    records have one.
    """
    thing = thing_of_name(name)
    made = thing.__init__ if inspect.isclass(thing) else thing
    return thing if made is _assign else inspect.unwrap(made).__code__


@dataclass(frozen=True)
class Call:
    """The first call of a function by another."""

    number: int
    by: str


def calls_of(codes: Mapping[CodeType | type, str], work: Callable[[], object]) -> dict[str, list[Call]]:
    """What calls each of some functions while `work` is done: the first call by each caller.

    The caller is the nearest public function of the program: private ones, functions within functions and
    those of libraries are a part of the one that calls them.
    """
    found: dict[str, list[Call]] = {}
    seen: set[tuple[CodeType | type, str]] = set()

    def profile(frame: FrameType, event: str, argument: object) -> None:
        if event != "call":
            return
        called = type(frame.f_locals["self"]) if frame.f_code is _assign.__code__ else frame.f_code
        if called not in codes:
            return
        by = public_caller(frame)
        if (called, by) not in seen:
            seen.add((called, by))
            found.setdefault(codes[called], []).append(Call(len(seen), by))

    sys.setprofile(profile)
    try:
        work()
    finally:
        sys.setprofile(None)
    return found


def public_caller(frame: FrameType) -> str:
    """Name, below `boresight`, of the nearest public function that called a frame; "" if there is none."""
    above = frame.f_back
    while above is not None:
        if name := public_name(above.f_code):
            return name
        above = above.f_back
    return ""


@cache
def public_name(code: CodeType) -> str:
    """Dotted name of a public function of the program; "" for other code."""
    path, name = Path(code.co_filename), code.co_qualname.split(".<locals>")[0]
    private = any(part.startswith(("_", "<")) for part in name.split(".") if part != "__call__")
    if private or not path.is_relative_to(ROOT) or {"tests", "site-packages"} & {*path.parts}:
        return ""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join([*parts[parts[0] == "boresight" :], name])
