"""What the program finds around it: closed streams, names that are no text, exhausted limits."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from command_line import ended
from fixture_strips import begun

from boresight.console import begin
from boresight.pipeline.console.messages import say, tell
from boresight.pipeline.console.program import errors_reported
from boresight.pipeline.console.progress import progress_bars
from boresight.version import __version__

NO_TEXT = os.fsdecode(b"n\xf6t text")


@pytest.mark.parametrize(
    ("words", "told"), [("trends none --out", "no such file"), ("dump init --ask", "Aborted!")]
)
def test_closed_streams_and_a_backend_that_is_none_are_no_obstacle(words, told, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "boresight", *words.split(), str(tmp_path / "out")]
    done = subprocess.run(
        ["bash", "-c", 'exec "$@" <&- >&-', "bash", *command],
        env=os.environ | {"MPLBACKEND": "nonsense"},
        stderr=subprocess.PIPE,
        text=True,
    )
    assert done.returncode == 1 and told in done.stderr, done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("words", "is_terminal", "is_told"),
    [
        ("status out", True, True),
        ("status out", False, False),
        *((f"status out {word}", True, False) for word in ("--quiet", "-q", "--json", "--help", "-h")),
        ("--version", True, False),
        ("", True, False),
    ],
)
def test_a_terminal_alone_is_told_at_once_what_begins(words, is_terminal, is_told, monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: is_terminal)
    begin(words.split())
    told = capsys.readouterr()
    assert told.out == "" and told.err == f"boresight {__version__}: status ...\n" * is_told


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_message_for_a_closed_stream_goes_nowhere(name, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        patch.setattr(sys, name, None)
        tell("a result")
        say("a remark")
        with progress_bars() as progress:
            progress("exposures", 1, 10)
    told = capsys.readouterr()
    assert told.out == ("" if name == "stdout" else "a result\n")
    assert ("a remark" in told.err) == (name == "stdout")


def test_result_folder_of_a_name_that_is_no_text_is_refused(one_strip, tmp_path, capsys):
    out = tmp_path / NO_TEXT
    told = ended(capsys, "calibrate", one_strip, "--out", out, "--workers", 1)
    assert told[0] == 1 and "found a name that is not text in UTF-8" in told[1] and not out.exists()


def test_name_that_a_library_cannot_take_is_one_line(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as left, errors_reported():
        NO_TEXT.encode()
    says = "n\\udcf6t text: a name that is not text in UTF-8"
    assert left.value.code == 1 and says in capsys.readouterr().err
    with pytest.raises(UnicodeEncodeError), errors_reported():  # a fault of the program
        "ö".encode("ascii")


def test_limit_on_processes_is_named_with_the_remedy(one_strip, tmp_path, monkeypatch, capsys):
    def refused(*given: object, **named: object) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", refused)
    code, told = ended(capsys, "calibrate", one_strip, "--out", tmp_path / "out", "--workers", 2)
    assert code == 1 and "no further thread or process; use --workers 1" in told, told
    assert not (tmp_path / "out/installation.json").exists()


def test_a_calibration_needs_no_thread_of_its_own(finished, tmp_path, monkeypatch, capsys):
    def refused(*given: object, **named: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refused)
    begun(tmp_path / "out", finished, exposures=12)
    code, told = ended(capsys, "calibrate", finished[0], "--out", tmp_path / "out", "--workers", 2)
    assert code == 0 and (tmp_path / "out/installation.json").is_file(), told
