"""Common mistakes: each message names the file or option, the cause, and what to write instead."""

from pathlib import Path

import pytest
from command_line import ended
from handmade import write_handmade_dump


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_handmade_dump(tmp_path_factory.mktemp("mistakes") / "sound")


# Arguments, with {dump}, {here} for folders; exit status; the option or file; cause; remedy.
ON_THE_COMMAND_LINE: dict[str, tuple[str, int, str, str, str]] = {
    "a folder that is not there": ("calibrate {here}/nowhere --out {here}/r", 1, "nowhere", "no such folder",
        "a folder with a dump.toml"),
    "no --out": ("calibrate {dump}", 2, "--out", "Missing option", "boresight calibrate --help"),
    "a misspelt command": ("calibrat {dump}", 2, "calibrat", "No such command", "Did you mean 'calibrate'"),
    "the result inside the dump": ("calibrate {dump} --out {dump}/r", 1, "--out", "a folder of the dump",
        "a folder outside of it"),
    "a folder with other files": ("calibrate {dump} --out {here}/full", 1, "--out", "found notes.txt",
        "a new or empty folder"),
    "a setting that does not exist": ("calibrate {dump} --out {here}/r --settings {here}/settings.toml", 1,
        "settings.toml", "match.correlation: found an unknown key", "least_correlation"),
    "a result that is not finished": ("validate {here}/full --dump {dump}", 1, "installation.json",
        "no such file", "boresight status"),
    "an unknown format": ("export {here} --format kml2", 2, "kml2", "there is no format", "geojson"),
    "a strip that is not there": ("match {dump} --out {here}/m.csv --strip s9", 1, "s9", "no strip",
        "only s1"),
    "text in the place of an image": ("identify {here}/full/notes.txt", 1, "notes.txt", "byte 0: found 78",
        "a PNG, TIFF or FITS image"),
    "--workers and --scheduler": ("calibrate {dump} --out {here}/r --workers 2 --scheduler tcp://h:1", 2,
        "--workers", "--scheduler", "exclude one another"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", ON_THE_COMMAND_LINE)
def test_mistake_on_the_command_line_is_explained(mistake, sound, tmp_path, capsys):
    command, expected, *says = ON_THE_COMMAND_LINE[mistake]
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("x")
    (tmp_path / "settings.toml").write_text("[match]\ncorrelation = 0.5\n")
    status, text = ended(capsys, *command.format(dump=sound, here=tmp_path).split(" "))
    assert status == expected and "Traceback" not in text, text
    assert status == 2 or command.startswith("identify") or text.count("\n") == 1, text
    assert [part for part in says if part not in text] == [], text
