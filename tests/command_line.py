"""The program with all its commands, for tests that call it within their process."""

import sys
from functools import cache

import pytest
from click.testing import Result
from typer import testing
from typer.testing import CliRunner

from boresight.console import command_line, run_command_line

app = command_line()
testing._get_command = cache(testing._get_command)  # else every run makes all commands anew, for 20 ms


def invoked(*words: object) -> Result:
    """What the program does with these words."""
    return CliRunner().invoke(app, [str(word) for word in words])


def ran(*words: object, status: int = 0) -> Result:
    """The same, where it must end with this exit status."""
    done = invoked(*words)
    assert done.exit_code == status, (done.output, done.exception)
    return done


def ended(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str]:
    """Exit status of the program as a user starts it with these words; its output and then its messages."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as left:
        patch.setattr(sys, "argv", ["boresight", *map(str, words)])
        run_command_line()
    return int(left.value.code or 0), "".join(capsys.readouterr())
