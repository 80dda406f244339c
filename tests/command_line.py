"""The program with all its commands, for tests that call it within their process."""

from click.testing import Result
from typer.testing import CliRunner

from boresight.console import command_line

app = command_line()


def invoked(*words: object) -> Result:
    """What the program does with these words."""
    return CliRunner().invoke(app, [str(word) for word in words])


def ran(*words: object, status: int = 0) -> Result:
    """The same, where it must end with this exit status."""
    done = invoked(*words)
    assert done.exit_code == status, (done.output, done.exception)
    return done
