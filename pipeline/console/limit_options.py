"""Limits given on the command line: kept or missed on the console, in a JUnit file, in the exit status."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boresight.pipeline.console.messages import DONE, LIMIT_MISSED, Answer
from boresight.pipeline.files.whole_file import write_text
from boresight.pipeline.results.limits import junit_xml, limit_lines

if TYPE_CHECKING:
    from boresight.pipeline.results.limits import Limit

__all__ = ["JunitFile", "held"]

JunitFile = Annotated[Path | None, typer.Option("--junit", help="JUnit XML file of the limits.")]


def held(
    command: str, limits: Sequence[Limit], junit: Path | None, begun_s: float, answer: Answer | None = None
) -> Answer:
    """`answer` of a command with its limits: a line each, and exit status 4 if one is missed. The JUnit file
    states the time since `begun_s` (`time.perf_counter`).
    """
    told = answer if answer is not None else Answer()
    if junit is not None:
        text = junit_xml(command, limits, time.perf_counter() - begun_s)
        write_text(junit, text)
    rows = [{"name": one.name, "found": one.found, "limit": one.limit, "holds": one.holds} for one in limits]
    return Answer(
        text="\n".join([*([told.text] if told.text else []), *limit_lines(limits)]),
        content={**told.content, "limits": rows},
        files=(*told.files, *([junit] if junit is not None else [])),
        exit_status=DONE if all(one.holds for one in limits) else LIMIT_MISSED,
    )
