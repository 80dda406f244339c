"""What commands print: results, remarks, progress, JSON, help; on a terminal, in a pipe, in a log file."""

import fcntl
import json
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from dataclasses import dataclass
from pathlib import Path

import pytest
import typer
from command_line import app
from talking import worker
from typer.testing import CliRunner

from boresight.calib.verdict import Outcome
from boresight.features.table import features
from boresight.pipeline.console.feature import Job
from boresight.pipeline.console.messages import COLOURS, Answer, coloured, fitted, with_messages
from boresight.pipeline.console.program import SPINE
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.run.cached import StageRunner, log_unit
from boresight.records.ledger import Entry, Kind, Reason, Subject

runner = CliRunner()
COMMANDS = [[str(c.name or c.callback.__name__)] for c in app.registered_commands if c.callback] + [
    [str(group.name), str(c.name or c.callback.__name__)]
    for group in app.registered_groups
    for c in group.typer_instance.registered_commands
    if c.callback
]


def test_results_go_to_stdout_and_a_line_a_tenth_to_stderr() -> None:
    ran = runner.invoke(worker, ["--status", "4"])
    assert ran.exit_code == 4 and ran.stdout == "a result \\x1b[2J\nthe end\n"
    lines = ran.stderr.splitlines()
    assert lines == [f"units: {n} of 100" for n in range(0, 101, 10)] + ["a remark"]


def test_quiet_leaves_results_and_verbose_adds_times() -> None:
    quiet, verbose = runner.invoke(worker, ["-q"]), runner.invoke(worker, ["-v"])
    assert quiet.stderr == "" and quiet.stdout == verbose.stdout
    assert re.fullmatch(r"\d+\.\d s, exit status 0", verbose.stderr.splitlines()[-1])


def test_quiet_leaves_one_line_of_an_answer_that_has_one() -> None:
    program = typer.Typer()
    program.command()(with_messages(lambda: Answer(text="many\nlines", line="refuted -> place"), "many"))
    assert runner.invoke(program, ["-q"]).stdout == "refuted -> place\n"
    assert runner.invoke(program, []).stdout == "many\nlines\n"


def test_the_outcome_of_a_verdict_has_its_colour_and_no_other_word_has_one() -> None:
    assert {one.value for one in Outcome} == set(COLOURS)
    plain = "verdict                   {}: 1 input looks wrong\nnot consistent: a remark"
    outcome = "consistent, findings"
    assert coloured(plain.format(outcome)) == plain.format(f"\x1b[33m\x1b[1m{outcome}\x1b[0m")
    assert coloured("refuted -> out") == "\x1b[31m\x1b[1mrefuted\x1b[0m -> out"


@pytest.mark.parametrize("width", [80, 120])
def test_help_lists_every_command_under_its_job_with_its_whole_summary(width: int) -> None:
    ran = runner.invoke(app, ["-h"], env={"COLUMNS": str(width)}, terminal_width=width)
    lines = ran.stdout.splitlines()
    assert max(map(len, lines)) <= width and "..." not in ran.stdout.replace("COMMAND [ARGS]...", "")
    listed = {command.name: command for one in (SPINE, *features()) for command in one.commands}
    assert len(listed) == len(COMMANDS)
    heading = ""
    for line in lines[lines.index(f"{Job.CALIBRATE}:") :]:
        if line.endswith(":"):
            heading = line[:-1]
        elif line:
            name, _, summary = line.strip().partition("  ")
            command = listed.pop(name)
            assert (command.job, command.summary) == (heading, summary.strip())
    assert not listed


def exposure(name: str) -> Entry:
    return Entry(Subject(Kind.EXPOSURE, exposure=name))


def test_verbose_says_what_became_of_each_unit_and_why() -> None:
    def units() -> Answer:
        """Work.

        Example: boresight units
        """
        StageRunner().run(named, [Named("e1"), Named("e2\x1b[2J")], folder="exposures")
        log_unit("exposures", exposure("e3").because(Reason.UNREADABLE, "cut"), False)
        return Answer()

    program = typer.Typer()
    program.command()(with_messages(units, "units"))
    lines = runner.invoke(program, ["-v"]).stderr.splitlines()
    assert lines[:3] == [
        "exposures e1: not used, too dark",
        "exposures e2\\x1b[2J: not used, too dark",
        "exposures e3: not used, cut (from an earlier run)",
    ]
    assert runner.invoke(program, []).stderr == ""


@dataclass
class Named:
    """A task of a stage."""

    name: str

    @property
    def item(self) -> Entry:
        return exposure(self.name)


def named(task: Named) -> Entry:
    return task.item.because(Reason.UNREADABLE, "too dark")


def test_a_log_file_has_everything_with_its_time_and_is_appended_to(tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    runner.invoke(worker, ["-q", "--log-file", str(path)])
    failed = runner.invoke(worker, ["--status", "9", "--json", "--log-file", str(path)])
    assert isinstance(failed.exception, RawDataError)
    lines = path.read_text().splitlines()
    assert all(re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ ", line) for line in lines)
    texts = [line[21:] for line in lines]
    assert texts.count("units: 50 of 100") == texts.count("a remark") == texts.count("a result \\x1b[2J") == 2
    assert "the end" in texts and "RawDataError: a.csv: line 2: found x, expected a number" in texts


def test_json_is_one_object_and_nothing_else_on_stdout() -> None:
    ran = runner.invoke(worker, ["--json", "--status", "1"])
    answer = json.loads(ran.stdout)
    assert answer["format"] == "boresight-answer" and answer["format_version"] == 1
    assert (answer["command"], answer["exit_status"], answer["files"]) == ("work", 1, ["a.csv"])
    assert answer["result"] == {"n": None} and answer["error"] is None
    error = json.loads(runner.invoke(worker, ["--json", "--status", "9"]).stdout)["error"]
    parts = {"file": "a.csv", "field": "line 2", "found": "x", "expected": "a number"}
    assert error == parts | {"message": "a.csv: line 2: found x, expected a number"}


@pytest.mark.parametrize("name", ["status", "dump check", "remote-camera-calibrate"])
def test_an_answer_names_its_command_as_it_is_called(name: str, tmp_path: Path) -> None:
    more = ["--out", str(tmp_path / "out")] if name.startswith("remote") else []
    ran = runner.invoke(app, [*name.split(), str(tmp_path / "nothing"), *more, "--json"])
    assert json.loads(ran.stdout)["command"] == name


@pytest.mark.parametrize("name", ["calibrate", "validate", "status", "plan", "match", "compare", "trends"])
def test_commands_with_json(name: str) -> None:
    assert "--json" in runner.invoke(app, [name, "--help"]).stdout


@pytest.mark.parametrize("width", [80, 200])
@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_has_an_example_and_no_line_is_broken(command: list[str], width: int) -> None:
    name = [part.replace("_", "-") for part in command]
    ran = runner.invoke(app, [*name, "--help"], env={"COLUMNS": str(width)}, terminal_width=width)
    assert ran.exit_code == 0
    assert f"Example:\n    boresight {' '.join(name)}" in ran.stdout
    assert max(map(len, ran.stdout.splitlines())) <= width
    for option in ("--quiet", "--log-file"):
        assert f"  {option}" in ran.stdout or f", {option}" in ran.stdout


def test_long_lines_are_broken_between_words_on_a_terminal_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = "short\n  " + "word-with-hyphens " * 12 + "/a/path/that/is/longer/" + "x" * 80
    assert fitted(text, terminal=False) == text
    lines = fitted(text, terminal=True).split("\n")
    assert lines[0] == "short" and all(line.startswith("      ") for line in lines[2:])
    assert [len(line) > 80 for line in lines] == [False] * (len(lines) - 1) + [True]
    assert "".join(lines).split() == text.split()


def on_a_terminal(program: str, columns: int, **environment: str) -> str:
    """What a Python program prints on a terminal of so many columns."""
    mine, its = pty.openpty()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    given = {key: value for key, value in os.environ.items() if key not in ("COLUMNS", "NO_COLOR")}
    given |= {"TERM": "xterm-256color"} | environment
    run = subprocess.Popen([sys.executable, "-c", program], stdout=its, stderr=its, stdin=its, env=given)
    os.close(its)
    read = b""
    try:
        while part := os.read(mine, 65536):
            read += part
    except OSError:  # the other end is closed
        pass
    os.close(mine)
    assert run.wait() == 0
    return read.decode()


SHOWN = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from talking import say, worker
say("a sentence of many words " * 20)
worker(["--status", "0"])
"""


@pytest.mark.parametrize("columns", [80, 200])
def test_a_terminal_gets_bars_and_lines_of_its_width(columns: int) -> None:
    shown = on_a_terminal(SHOWN, columns, NO_COLOR="1")
    assert not re.search(r"\x1b\[[0-9;]*3[0-9]", shown), "colours in spite of NO_COLOR"
    assert "units: 50 of 100" not in shown and "100/100" in shown  # the bar
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown).replace("\r", "\n")
    lines = [line for line in plain.split("\n") if line.strip()]
    assert max(map(len, lines)) <= columns
    assert " ".join(plain.split()).count("a sentence of many words") == 20
