"""Values of a command line that the program converts itself: as Typer would."""

from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from boresight.pipeline.console.program import _Command

LINES = [
    "a",
    "a b --path c --ratio 2 --count 3 --word=-x",
    "a --ratio 1e-3 --limited 4 --pair 1 2.5 --more x --more y",
    "a --ratio nan --parsed p",
    "a --count 2.5",
    "a --ratio 2,5",
    "a --limited 11",
    "a --path",
    "a --pair 1",
    "",
    "--help",
]


def command(
    files: Annotated[list[Path], typer.Argument()],
    path: Annotated[Path | None, typer.Option()] = None,
    ratio: Annotated[float, typer.Option()] = 1,
    count: Annotated[int | None, typer.Option()] = None,
    word: Annotated[str, typer.Option()] = "word",
    limited: Annotated[int, typer.Option(min=0, max=10)] = 5,
    pair: Annotated[tuple[int, float] | None, typer.Option()] = None,
    more: Annotated[list[str] | None, typer.Option()] = None,
    parsed: Annotated[str | None, typer.Option(parser=str.upper)] = None,
    flag: Annotated[bool, typer.Option()] = False,
) -> None:
    """Print the values."""
    print([(type(one), one) for one in (files, path, ratio, count, word, limited, pair, more, parsed, flag)])


@pytest.mark.parametrize("line", LINES)
def test_values_and_errors_are_those_of_typer(line: str) -> None:
    answers = []
    for kind in (None, _Command):
        app = typer.Typer(pretty_exceptions_enable=False, rich_markup_mode=None)
        app.command(cls=kind)(command)
        answered = CliRunner().invoke(app, line.split())
        answers.append((answered.exit_code, answered.stdout, answered.stderr))
    assert answers[0] == answers[1]
