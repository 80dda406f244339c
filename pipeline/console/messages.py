"""What commands print: results on stdout, remarks and progress on stderr, and all of it in a log file.

A command returns an `Answer`. `with_messages` gives it the options --verbose, --quiet, --log-file and, where
the answer has content for programs, --json; prints the answer; and turns its exit status into the program's.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import logging
import os
import re
import shlex
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, get_origin, get_type_hints

import typer

from boresight.pipeline import __version__
from boresight.pipeline.console.arguments import option
from boresight.pipeline.errors import RawDataError, printable
from boresight.pipeline.files.whole_file import json_text
from boresight.records.record import record, scalar

__all__ = ["DATA_DID_NOT_ALLOW", "DONE", "LIMIT_MISSED", "NOT_CHECKABLE", "REFUTED", "WITH_FINDINGS"]
__all__ += [
    "WRONG_USAGE",
    "Accepted",
    "Answer",
    "log",
    "print_data",
    "say",
    "shows_bars",
    "tell",
    "with_messages",
    "wrong_usage",
]

# Exit statuses of the program (docs/json.md), in this order from 0.
DONE, DATA_DID_NOT_ALLOW, WRONG_USAGE, REFUTED, LIMIT_MISSED, WITH_FINDINGS, NOT_CHECKABLE = range(7)
# Exit status after Ctrl-C: 128 and the number of the signal, as shells count.
INTERRUPTED = 130
RESULT = logging.INFO + 5  # of lines on stdout
log = logging.getLogger("boresight.commands")
log.setLevel(logging.DEBUG)
log.propagate = False


class Accepted(StrEnum):
    """What a user may accept of a calibration, so that it does not fail."""

    REFUTED = "refuted"
    NOT_CHECKABLE = "not-checkable"
    UNMET = "unmet"
    FINDINGS = "findings"


@record(kw_only=True)
class Answer:
    """What a command found."""

    text: str = scalar("for the reader; empty: nothing more to print", default="")
    line: str = scalar("what --quiet leaves of the text; empty: all of it", default="")
    content: Mapping[str, Any] = scalar("for programs: the key `result` of --json", default_factory=dict)
    files: tuple[Path, ...] = scalar("files written", default=())
    exit_status: int = scalar("0, or why the command did not succeed", default=DONE)


OF_REASONS = "A line for each exposure and strip as it ends, every reason, and times."
# Options of messages by their parameters, with the types of these; the last where an answer has content.
OPTIONS: dict[str, tuple[Any, Any]] = {
    "verbose": (bool, option(OF_REASONS, False, "--verbose", "-v")),
    "quiet": (bool, option("No progress, no remarks; of a calibration one line.", False, "--quiet", "-q")),
    "log_file": (Path | None, option("Append progress, remarks and results to this file, with times.")),
    "as_json": (bool, option("One JSON object on stdout instead of text.", False, "--json")),
}


def with_messages(
    command: Callable[..., Answer | None], name: str, *, with_json: bool = False
) -> Callable[..., None]:
    """`command`, called `name` on the command line, with the options of messages; its answer is printed.

    A parameter that is a record stands for its fields that are options (`console.arguments.option`); the
    default of any other may be such an option.
    """
    hints = get_type_hints(command, include_extras=True) | {"return": None}
    records: dict[str, Any] = {one: kind for one, kind in hints.items() if dataclasses.is_dataclass(kind)}

    @functools.wraps(command)
    def run_and_print(
        *arguments: Any,
        verbose: bool = False,
        quiet: bool = False,
        log_file: Path | None = None,
        **named: Any,
    ) -> None:
        as_json = with_json and named.pop("as_json")  # some commands have an option --json of their own
        begun_s = time.perf_counter()
        with _messages(verbose, quiet, log_file, as_json):
            try:
                made = {one: _made(kind, named) for one, kind in records.items()}
                answer = command(*arguments, **named, **made) or Answer()
            except KeyboardInterrupt:
                log.error("interrupted")
                raise typer.Exit(INTERRUPTED) from None
            except Exception as error:
                if as_json and not isinstance(error, (typer.Exit, typer.Abort)):
                    typer.echo(_document(name, Answer(exit_status=DATA_DID_NOT_ALLOW), error))
                raise
            tell(answer.line if quiet and answer.line else answer.text)
            if as_json:
                typer.echo(_document(name, answer))
            log.debug("%.1f s, exit status %d", time.perf_counter() - begun_s, answer.exit_status)
        if answer.exit_status:
            raise typer.Exit(answer.exit_status)

    parameters = list[inspect.Parameter]()
    for one in inspect.signature(command).parameters.values():
        own = _parameter(one.name, hints[one.name], one.default)
        parameters += _options_of(records[one.name]) if one.name in records else [own]
    parameters += [_parameter(one, *of) for one, of in OPTIONS.items() if with_json or one != "as_json"]
    run_and_print.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run_and_print.__annotations__ = {one.name: one.annotation for one in parameters}
    run_and_print.__doc__ = _with_example(inspect.getdoc(command) or "")
    return run_and_print


def _options_of(kind: Any) -> list[inspect.Parameter]:
    """The fields of a record that are options of a command, as its parameters."""
    hints = get_type_hints(kind, include_extras=True)
    every = [_parameter(one.name, hints[one.name], one) for one in dataclasses.fields(kind)]
    return [one for one in every if get_origin(one.annotation) is Annotated]


def _parameter(name: str, hint: Any, default: Any) -> inspect.Parameter:
    """A parameter of a command, with the option that its default or its annotation states."""
    if isinstance(default, dataclasses.Field):
        option, default = default.metadata.get("option"), default.default
        hint = hint if option is None else Annotated[hint, option]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hint)


def _made(kind: Any, named: dict[str, Any]) -> Any:
    """The record of options, which are taken from the arguments `named`."""
    return kind(**{one.name: named.pop(one.name) for one in _options_of(kind)})


def _with_example(text: str) -> str:
    """The help text of a command with its example on lines of its own, which help does not fill anew."""
    head, _, example = text.partition("Example: ")
    glued = re.sub(r"(-[\w-]+) (?=[^-])", "\\1\xa0", example)  # an option stays with its value
    wrapped = textwrap.wrap(glued, 70, break_long_words=False, break_on_hyphens=False)
    lines = [line.replace("\xa0", " ") for line in wrapped]
    return head + "\b\nExample:\n  " + " \\\n    ".join(lines) if lines else head


def tell(text: str) -> None:
    """A line or lines of the result, on stdout (not with --json) and in the log file."""
    if text:
        log.log(RESULT, "%s", text)


def print_data(text: str) -> None:
    """Lines for programs (CSV, JSON) on stdout, as they are but for characters that a terminal would obey."""
    typer.echo(_printable(text), nl=not text.endswith("\n"))


def say(text: str) -> None:
    """A remark, on stderr and in the log file."""
    log.info("%s", text)


def shows_bars() -> bool:
    """Whether a terminal shows progress as bars: not with --quiet, nor beside the lines of --verbose."""
    return any(isinstance(handler, _Console) and handler.remarks == logging.INFO for handler in log.handlers)


def wrong_usage(text: str) -> typer.Exit:
    """The exit of a command that was called wrongly; `text` goes to stderr."""
    log.error("error: %s", text)
    return typer.Exit(WRONG_USAGE)


@contextmanager
def _messages(verbose: bool, quiet: bool, log_file: Path | None, as_json: bool) -> Iterator[None]:
    """Send messages where the options want them; a failure is in the log file as well."""
    level = logging.ERROR if quiet else logging.DEBUG if verbose else logging.INFO
    handlers: list[logging.Handler] = [_Console(level, results=not as_json)]
    if log_file is not None:
        handlers.append(_log_file(log_file))
    before, log.handlers[:] = list(log.handlers), handlers
    try:
        if log_file is not None:
            handlers[1].handle(_record("boresight %s: %s", __version__, shlex.join(sys.argv)))
        yield
    except BaseException as error:
        if log_file is not None and not isinstance(error, (typer.Exit, typer.Abort)):
            handlers[1].handle(_record("%s: %s", type(error).__name__, error))
        raise
    finally:
        log.handlers[:] = before
        for handler in handlers:
            handler.close()


def _record(text: str, *arguments: object) -> logging.LogRecord:
    record = log.makeRecord(log.name, logging.INFO, "", 0, text, arguments, None)
    _made_printable(record)
    return record


def _log_file(path: Path) -> logging.Handler:
    try:
        handler = logging.FileHandler(path, encoding="utf-8")
    except OSError as error:
        found = error.strerror or str(error)
        raise RawDataError(str(path), "--log-file", found, "a file that can be written") from error
    handler.setFormatter(_LogFormat())
    return handler


class _LogFormat(logging.Formatter):
    """Every line with its UTC time."""

    def format(self, record: logging.LogRecord) -> str:
        stamp = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(record.created))
        return "\n".join(f"{stamp} {line}" for line in record.getMessage().split("\n"))


class _Console(logging.Handler):
    """Results to stdout, everything else to stderr: on a terminal broken between words, at its width."""

    def __init__(self, remarks: int = logging.INFO, *, results: bool = True) -> None:
        super().__init__()
        self.remarks, self.results = remarks, results

    def emit(self, record: logging.LogRecord) -> None:
        """Print one message."""
        is_result = record.levelno == RESULT
        if (is_result and not self.results) or (not is_result and record.levelno < self.remarks):
            return
        stream = sys.stdout if is_result else sys.stderr
        if stream is None:  # closed by whoever called
            return
        if getattr(record, "progress", False) and stream.isatty() and shows_bars():
            return  # bars are shown
        text = fitted(record.getMessage(), stream.isatty())
        shows_colour = stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"
        typer.echo(coloured(text) if is_result and shows_colour else text, err=not is_result)


# Words of `calib.verdict.Outcome`, which is not imported for every command; the longer before its beginning.
COLOURS = {
    "consistent, findings": "yellow",
    "consistent": "green",
    "refuted": "red",
    "not checkable": "yellow",
}
# The verdict at the beginning of a line, or after that word.
_VERDICT = re.compile(rf"^(verdict +|)({'|'.join(COLOURS)})(?= |:|$)", re.MULTILINE)


def coloured(text: str) -> str:
    """`text` with the outcome of a verdict in its colour, as a terminal shows it."""
    return _VERDICT.sub(lambda found: found[1] + typer.style(found[2], fg=COLOURS[found[2]], bold=True), text)


def _made_printable(record: logging.LogRecord) -> bool:
    """Always true; control characters of the message are escaped before anything prints or keeps it."""
    record.msg, record.args = _printable(record.getMessage()), ()
    return True


def _printable(text: str) -> str:
    return "\n".join(printable(line) for line in text.split("\n"))


def fitted(text: str, terminal: bool) -> str:
    """`text` with lines longer than a terminal broken between words, and what follows indented."""
    if not terminal:
        return text
    lines, width = list[str](), shutil.get_terminal_size().columns
    wrap = textwrap.TextWrapper(
        width, replace_whitespace=False, break_long_words=False, break_on_hyphens=False
    )
    for line in text.split("\n"):
        wrap.subsequent_indent = " " * (len(line) - len(line.lstrip()) + 4)
        lines += wrap.wrap(line) if len(line) > width else [line]
    return "\n".join(lines)


log.addFilter(_made_printable)
log.addHandler(_Console())


def _document(command: str, answer: Answer, error: Exception | None = None) -> str:
    """The JSON object of docs/json.md."""

    content: dict[str, Any] = {
        "format": "boresight-answer",
        "format_version": 1,
        "version": __version__,
        "command": command,
        "exit_status": answer.exit_status,
        "result": dict(answer.content),
        "files": [str(path) for path in answer.files],
        "error": None,
    }
    if error is not None:
        fields = ("file", "field", "found", "expected")
        content["error"] = {name: getattr(error, name, None) for name in fields} | {"message": str(error)}
    return json_text(content)
