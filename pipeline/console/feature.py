"""What a feature says of itself: its commands, and what it adds to a calibration."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from importlib import import_module
from typing import Any

__all__ = ["Command", "Feature", "Job", "function_at", "hooks_of"]


class Job(StrEnum):
    """Headings under which the program's help lists its commands, in this order."""

    CALIBRATE = "Calibrate a mission"
    STARS = "Star images"
    PLAN = "Plan and simulate"
    LOOK = "Look at ground and targets"
    EXCHANGE = "Exchange with other programs"


@dataclass(frozen=True)
class Command:
    """A command of the program. Its module is imported when it is called."""

    name: str  # words on the command line, one or two: "plan", "dump check"
    job: Job  # where the help lists it
    summary: str  # one line of the program's help, uncut on a terminal of 80 columns
    with_json: bool = False  # offers --json by the rules of docs/json.md
    module: str = ""  # where its function is; empty: that of the function's name


@dataclass(frozen=True)
class Feature:
    """A job of the program. The function of its command "dump check" is `dump_check_command`."""

    folder: str  # of its modules, below `boresight`
    commands: tuple[Command, ...]
    groups: dict[str, str] = field(default_factory=dict)  # first word of two, and its line in the help
    # Functions, "module:function" below `boresight`: of a joint result's folder and the names of its dumps it
    # returns lines for the console; of finished results' folders and that of an archive, it adds them there.
    after_joint: str = ""
    to_archive: str = ""

    def place_of(self, command: Command) -> str:
        """Place of a command below `boresight`, "module:function"."""
        function = f"{re.sub('[ -]', '_', command.name)}_command"
        return f"{self.folder}.{command.module or function}:{function}"


def hooks_of(features: Iterable[Feature], hook: str) -> tuple[Callable[..., str], ...]:
    """What features have under one of the fields of `Feature` for functions."""
    return tuple(function_at(place) for feature in features if (place := getattr(feature, hook)))


def function_at(place: str) -> Any:
    """The function at "module:function" below `boresight`."""
    module, _, name = place.partition(":")
    return getattr(import_module(f"boresight.{module}"), name)
