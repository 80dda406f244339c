"""The program with all its commands, for tests that call it within their process."""

import sys

import pytest
from click.testing import CliRunner, Result
from typer.main import get_command

from boresight.console import command_line, run_command_line

app = command_line()
PROGRAM = get_command(app)  # made once; Typer's own runner makes all commands anew, in 20 ms


def invoked(*words: object, given: str | None = None) -> Result:
    """What the program does with these words, and with what is `given` to it."""
    return CliRunner().invoke(PROGRAM, [str(word) for word in words], input=given)


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
