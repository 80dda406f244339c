"""Thirty common mistakes: each message names the file or option, the cause, and what to write instead."""

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from handmade import write_handmade_dump

from boresight.console import run_command_line

TARGETS = "id,lat_deg,lon_deg,height_m,height_kind,sigma_east_m,sigma_north_m,sigma_up_m,chip\n"
Change = Callable[[Path], object]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_handmade_dump(tmp_path_factory.mktemp("mistakes") / "sound")


def printed(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Exit status and output of a command as the program itself runs it."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as ended:
        patch.setattr(sys, "argv", ["boresight", *arguments])
        run_command_line()
    return int(ended.value.code or 0), "".join(capsys.readouterr())


def swap(file: str, before: str, after: str) -> Change:
    def change(dump: Path) -> None:
        text = (dump / file).read_text()
        assert before in text
        (dump / file).write_text(text.replace(before, after, 1))

    return change


def targets(row: str, **options: str) -> Change:
    return lambda dump: (dump / "targets.csv").write_text(TARGETS + row + "\n", **options)


# What is wrong in the dump; the file that the message names; the cause and the remedy in it.
IN_A_DUMP: dict[str, tuple[Change, str, str, str]] = {
    "no dump.toml": (
        lambda dump: (dump / "dump.toml").unlink(),
        "dump.toml",
        "no such file",
        "boresight dump init",
    ),
    "a key misspelt": (
        swap("star_camera.toml", "bit_depth", "bitdepth"),
        "star_camera.toml",
        "bitdepth: found an unknown key",
        "expected bit_depth",
    ),
    "a focal length in metres": (
        swap("star_camera.toml", "focal_length_mm = 100.0", "focal_length_mm = 0.1"),
        "star_camera.toml",
        "focal_length_mm: found 0.1",
        "at least 1 (focal length, mm",
    ),
    "a number with its unit": (
        swap("star_camera.toml", "focal_length_mm = 100.0", 'focal_length_mm = "100 mm"'),
        "star_camera.toml",
        "found 100 mm",
        "a number without quotes and unit",
    ),
    "YAML for TOML": (
        swap("star_camera.toml", "focal_length_mm = 100.0", "focal_length_mm: 100.0"),
        "star_camera.toml",
        "line 2: found focal_length_mm: 100.0",
        "KEY = VALUE",
    ),
    "half a pixel": (
        swap("star_camera.toml", "width_px = 64", "width_px = 64.5"),
        "star_camera.toml",
        "width_px: found 64.5",
        "an integer",
    ),
    "a quaternion without unit length": (
        swap("installation.toml", "[0.5, -0.5, 0.5, 0.5]", "[1, 0, 0, 0.5]"),
        "installation.toml",
        "it has 1.118",
        "quaternion_cs must have length 1",
    ),
    "three Euler angles as a quaternion": (
        swap("installation.toml", "[0.5, -0.5, 0.5, 0.5]", "[1, 0, 0]"),
        "installation.toml",
        "found [1, 0, 0]",
        "at least 4 values, not 3 (R_cs measured before launch, scalar last)",
    ),
    "a sigma in degrees": (
        swap("installation.toml", "0.003, 0.003, 0.003", "10, 10, 10"),
        "installation.toml",
        "sigma_rad.0: found 10",
        "at most 3.15 (1-sigma rotation about the axes of c, at most 180°)",
    ),
    "another frame's name": (
        swap("dump.toml", '"GCRS"', '"J2000"'),
        "dump.toml",
        "conventions.inertial_frame: found J2000",
        'expected "GCRS"',
    ),
    "an orbit in GTOD": (
        swap("orbit.oem", "REF_FRAME = GCRF", "REF_FRAME = GTOD"),
        "orbit.oem",
        "REF_FRAME: found GTOD",
        "GCRF, ICRF, EME2000, TEME, TOD or ITRF",
    ),
    "a terrain model without its description": (
        swap("dump.toml", 'targets = "targets.csv"', 'targets = "targets.csv"\nterrain = "dem.tif"'),
        "dump.toml",
        "files.terrain and the table [terrain]",
        "come together or not at all",
    ),
    "a table that is not there": (
        lambda dump: (dump / "strips.csv").unlink(),
        "strips.csv",
        "no such file",
        "a readable file",
    ),
    "semicolons for commas": (
        lambda dump: (dump / "targets.csv").write_text(TARGETS.replace(",", ";")),
        "targets.csv",
        "columns separated by ';'",
        "separated by commas",
    ),
    "a table in UTF-16": (
        targets("t1,40,116,0,ellipsoidal,1,1,1,chips/0.tif", encoding="utf-16"),
        "targets.csv",
        "byte 0xff",
        "CSV UTF-8",
    ),
    "a height left empty": (
        targets("t1,40,116,,ellipsoidal,1,1,1,chips/0.tif"),
        "targets.csv",
        "line 2, height_m: found nothing",
        "a finite number",
    ),
    "latitude and longitude exchanged": (
        targets("t1,116,40,0,ellipsoidal,1,1,1,chips/0.tif"),
        "targets.csv",
        "lat_deg: found 116",
        "at most 90 (geodetic latitude, degrees)",
    ),
    "an unknown kind of height": (
        targets("t1,40,116,0,msl,1,1,1,chips/0.tif"),
        "targets.csv",
        "height_kind: found msl",
        '"ellipsoidal", "egm96"',
    ),
    "a local date": (
        swap("exposures.csv", "2024-11-20T03:40:19.600", "20/11/2024 03:40:19.6"),
        "exposures.csv",
        "utc_mid: found 20/11/2024",
        "UTC as 2026-03-20T10:15:30.5Z",
    ),
    "exposures out of order": (
        swap("exposures.csv", "03:40:19.800", "03:40:19.100"),
        "exposures.csv",
        "line 3, utc_mid: found 2024-11-20T03:40:19.100 (0001) after",
        "strictly increasing times",
    ),
    "an id given twice": (
        swap("exposures.csv", "0001,", "0000,"),
        "exposures.csv",
        "id: found 0000 2 times",
        "each id once",
    ),
    "an absolute path": (
        swap("strips.csv", "strips/0.tif", "/data/strips/0.tif"),
        "strips.csv",
        "line 2, file: found /data/strips/0.tif",
        "a path inside the dump, relative to it",
    ),
    "CCDs counted from 1": (
        swap("strips.csv", "s1,1,", "s1,2,"),
        "strips.csv",
        "line 3, ccd: found 2",
        "0 to 1",
    ),
}
# Arguments, with {dump}, {here} for folders; exit status; the option or file; cause; remedy.
ON_THE_COMMAND_LINE: dict[str, tuple[str, int, str, str, str]] = {
    "a folder that is not there": (
        "calibrate {here}/nowhere --out {here}/r",
        1,
        "nowhere",
        "no such folder",
        "a folder with a dump.toml",
    ),
    "no --out": ("calibrate {dump}", 2, "--out", "Missing option", "boresight calibrate --help"),
    "a misspelt command": ("calibrat {dump}", 2, "calibrat", "No such command", "Did you mean 'calibrate'"),
    "the result inside the dump": (
        "calibrate {dump} --out {dump}/r",
        1,
        "--out",
        "a folder of the dump",
        "a folder outside of it",
    ),
    "a folder with other files": (
        "calibrate {dump} --out {here}/full",
        1,
        "--out",
        "found notes.txt",
        "a new or empty folder",
    ),
    "a setting that does not exist": (
        "calibrate {dump} --out {here}/r --settings {here}/settings.toml",
        1,
        "settings.toml",
        "match.correlation: found an unknown key",
        "least_correlation",
    ),
    "a result that is not finished": (
        "validate {here}/full --dump {dump}",
        1,
        "installation.json",
        "no such file",
        "boresight status",
    ),
    "an unknown format": ("export {here} --format kml2", 2, "kml2", "there is no format", "geojson"),
    "a strip that is not there": (
        "match {dump} --out {here}/m.csv --strip s9",
        1,
        "s9",
        "no strip",
        "only s1",
    ),
    "text in the place of an image": (
        "identify {here}/full/notes.txt",
        1,
        "notes.txt",
        "byte 0: found 78",
        "a PNG, TIFF or FITS image",
    ),
    "--workers and --scheduler": (
        "calibrate {dump} --out {here}/r --workers 2 --scheduler tcp://h:1",
        2,
        "--workers",
        "--scheduler",
        "exclude one another",
    ),
}


@pytest.mark.parametrize("mistake", IN_A_DUMP)
def test_mistake_in_a_dump_is_explained(
    mistake: str, sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, *says = IN_A_DUMP[mistake]
    dump = shutil.copytree(sound, tmp_path / "dump")
    change(dump)
    status, text = printed(["calibrate", str(dump), "--out", str(tmp_path / "result")], capsys)
    assert status == 1 and text.count("\n") == 1 and [part for part in says if part not in text] == [], text


@pytest.mark.parametrize("mistake", ON_THE_COMMAND_LINE)
def test_mistake_on_the_command_line_is_explained(
    mistake: str, sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command, expected, *says = ON_THE_COMMAND_LINE[mistake]
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("x")
    (tmp_path / "settings.toml").write_text("[match]\ncorrelation = 0.5\n")
    status, text = printed(command.format(dump=sound, here=tmp_path).split(" "), capsys)
    assert status == expected and "Traceback" not in text, text
    assert [part for part in says if part not in text] == [], text
