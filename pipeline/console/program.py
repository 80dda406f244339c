"""The program of the command line, put together from features; a command is imported when it is called."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from typer.core import TyperCommand, TyperGroup

from boresight.pipeline.console.feature import Command, Feature, Job, function_at
from boresight.pipeline.console.messages import DATA_DID_NOT_ALLOW, DONE, log, print_data, with_messages
from boresight.pipeline.errors import DataNotSufficientError, RawDataError, WorkerError, printable
from boresight.version import version_text

__all__ = ["SPINE", "errors_reported", "program"]

HELP = ["--help", "-h"]  # the first is what an error refers to
NO_THREAD = "can't start new thread"  # what Python says
# Types of values, or None, that are converted without pydantic.
SIMPLE: dict[Any, Callable[[Any], Any]] = {list[Path]: lambda paths: [Path(one) for one in paths]}
SIMPLE |= {kind: one for one in (Path, str, float, int) for kind in (one, one | None)}
# The message where the system refuses a thread or process; the command ends with it.
NO_PROCESS = "error: the system starts no further thread or process; use --workers 1, or raise `ulimit -u`"


def program(features: Iterable[Feature], words: Sequence[str] | None = None) -> typer.Typer:
    """The command line of these features, in the order of the help. `words` follow the program's name on the
    command line: only the command that they name is imported, the others are listed; None: all are imported.
    """
    features = tuple(features)
    app = typer.Typer(
        name="boresight",
        help="On-orbit calibration of the installation matrix between star camera and remote-sensing camera.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        cls=_ByJob,
        context_settings={"max_content_width": 110, "obj": features, "help_option_names": HELP},
        rich_markup_mode=None,  # plain help: 0.3 s of CPU less
    )
    app.callback(invoke_without_command=True)(_program_options)
    groups: dict[str, typer.Typer] = {}
    for feature in features:
        for command in feature.commands:
            group, _, name = command.name.rpartition(" ")
            if group and group not in groups:
                form: dict[str, Any] = {"no_args_is_help": True, "cls": _ByJob, "rich_markup_mode": None}
                groups[group] = typer.Typer(help=feature.groups[group], **form)
                app.add_typer(groups[group], name=group)
            place = feature.place_of(command) if words is None or _named(command, words) else ""
            _add(groups.get(group, app), name, command, place)
    return app


@contextmanager
def errors_reported() -> Iterator[None]:
    """Report errors that a user can act on as one line; anything else is a fault of the program."""
    try:
        yield
    except Exception as error:
        if not (text := _words(error)):
            raise
        log.error("%s", text)
        sys.exit(DATA_DID_NOT_ALLOW)


def _words(error: Exception) -> str:
    """An error for the user, who can act on it; empty for a fault of the program."""
    match error:
        case RawDataError() | DataNotSufficientError() | WorkerError():
            return f"error: {error}"
        case UnicodeEncodeError() if "surrogates" in error.reason:
            name = printable(str(error.object))
            return f"error: {name}: a name that is not text in UTF-8; rename the file or folder"
        case MemoryError():
            return f"error: memory: {str(error) or 'no more of it; what is finished is on disk'}"
        case RuntimeError():
            return NO_PROCESS if str(error) == NO_THREAD else ""
        case BlockingIOError():
            return NO_PROCESS if error.filename is None else ""
        case OSError():  # disk full, no permission: what is finished is on disk
            return f"error: {error.filename or 'file'}: {error.strerror or error}"
    return ""


def _program_options(
    version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
) -> None:
    if version:
        print_data(version_text())
        raise typer.Exit(DONE)


def _named(command: Command, words: Sequence[str]) -> bool:
    """Whether the words of a command line begin with those of a command."""
    named = command.name.split()
    return [word for word in words if not word.startswith("-")][: len(named)] == named


def _add(app: typer.Typer, name: str, command: Command, place: str) -> None:
    if place:  # else it is only listed
        function = with_messages(function_at(place), command.name, with_json=command.with_json)
        form: dict[str, Any] = {"short_help": command.summary, "rich_help_panel": command.job}
        app.command(name, cls=_Command, **form)(function)
    else:
        app.command(name, help=command.summary, rich_help_panel=command.job)(_listed)


class _Simple:
    """A command or group that converts simple values itself: for any, given or not, Typer loads pydantic."""

    callback: Any

    def get_params(self, ctx: Any) -> list[Any]:
        """The parameters."""
        parameters: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        hints = getattr(self.callback, "__annotations__", {})
        for one in parameters:
            if "process_value" not in vars(one):
                one.process_value = partial(_converted, one, hints.get(one.name), one.process_value)
        return parameters


def _converted(one: Any, hint: Any, by_typer: Callable[..., Any], context: Any, value: Any) -> Any:
    """The value of a parameter annotated `hint`; `by_typer` that of one with a parser or limits."""
    if value is None and not one.required:
        return () if one.multiple or one.nargs == -1 else None
    kind, info = get_args(hint)[:2] or (None, None)
    is_free = kind in SIMPLE and not (info.parser or info.exists) and value not in (None, ())
    if is_free and (not isinstance(value, str) or info.min is info.max is None):
        with suppress(ValueError, TypeError):  # Typer has the words for it
            return SIMPLE[kind](value)
    return by_typer(context, value)


class _Command(_Simple, TyperCommand):
    """A command of simple values."""


class _ByJob(_Simple, TyperGroup):
    """Help that lists commands under their jobs, those of groups too, with their whole summaries."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the lists of commands."""
        rows: dict[Job, list[tuple[str, str]]] = {job: [] for job in Job}
        for name, command in self.commands.items():
            inner = command.commands.items() if isinstance(command, TyperGroup) else [("", command)]
            for last, one in inner:
                job = Job(getattr(one, "rich_help_panel", Job.CALIBRATE))
                rows[job].append((f"{name} {last}".rstrip(), str(one.short_help or one.help)))
        for job, listed in rows.items():
            if listed:
                with formatter.section(job.value):
                    formatter.write_dl(listed)


def _listed() -> None:
    """A command of which only the summary is shown."""


# The commands of the spine, in the form of a feature, each with a line of help.
SPINE = Feature(
    "pipeline.console",
    commands=(
        Command(
            "calibrate", Job.CALIBRATE, "Estimate the installation matrix from raw images.", with_json=True
        ),
        Command("validate", Job.CALIBRATE, "Compare a result with a simulated dump's truth.", with_json=True),
        Command(
            "status", Job.CALIBRATE, "Show what of a run is finished, and what is unused.", with_json=True
        ),
        Command("report", Job.CALIBRATE, "Draw one HTML page about a result."),
    ),
)
