"""Hostile files: devices and FIFOs, extreme numbers, escape characters, markup. Refused by name, at once."""

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import rasterio
from command_line import invoked, ran
from edits import replaced
from rasterio.transform import Affine
from rasters import write_raster

from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.console.messages import say, tell
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.images.rasters import read_grid
from boresight.pipeline.files.text_files import read_text

NUMBER = re.compile(r"(?<![\w.-])[+-]?\d+\.?\d*(?:[eE][+-]?\d+)?(?![\w.])")
TEXTS = ("dump.toml", "star_camera.toml", "remote_camera.toml", "installation.toml")
TABLES = ("exposures.csv", "strips.csv", "targets.csv")
IMAGES = ("exposures/0.png", "strips/0.tif", "chips/0.tif")
pytestmark = pytest.mark.usefixtures("ends_in_time")


def no_file(path: Path, kind: str) -> None:
    path.unlink()
    if kind == "fifo":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")


@pytest.mark.parametrize("kind", ["fifo", "device"])
@pytest.mark.parametrize("file", [*TEXTS, *TABLES, "orbit.oem", *IMAGES])
def test_fifo_or_device_in_the_place_of_a_file_is_named(file, kind, handmade, tmp_path):
    no_file(handmade / file, kind)
    told = ran("calibrate", handmade, "--out", tmp_path / "out", "--workers", 1, status=1)
    assert isinstance(told.exception, (RawDataError, DataNotSufficientError)), told.output
    if file not in IMAGES:
        assert file in str(told.exception)
        assert re.search("found .*(link to a place outside|device, FIFO)", str(told.exception))


@pytest.mark.parametrize("command", ["identify", "centroids", "star-camera-calibrate"])
def test_fifo_is_no_star_image(command: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "sky.png")
    options = ["--out", str(tmp_path / "camera.toml")] if command == "star-camera-calibrate" else []
    told = invoked(command, tmp_path / "sky.png", *options)
    assert told.exit_code != 0 and "FIFO" in told.output + str(told.exception)


EXTREME = ("1e308", "5e-324", "-1e308", "9223372036854775808", "9e15")


@pytest.mark.parametrize("file", [*TEXTS, *TABLES, "orbit.oem"])
def test_extreme_value_of_any_number_is_refused_by_name_or_calibrated(file, handmade):
    """Every number in turn, with two values. What is within range goes on until too few stars are found."""
    text = (handmade / file).read_text()
    spans = [match.span() for match in NUMBER.finditer(text)]
    if file == "orbit.oem":
        spans = spans[:24]  # metadata and the first states; the others are alike
    refused, others = 0, 0
    for n, (begin, end) in enumerate(spans):
        for value in (EXTREME[n % 5], EXTREME[(n + 2) % 5]):
            (handmade / file).write_text(text[:begin] + value + text[end:])
            others += value != "5e-324"  # which stands for zero, as many numbers may be
            try:
                calibrate_dump(open_dump(handmade))
            except RawDataError as error:
                refused += value != "5e-324"
                assert error.file == file and len(str(error)) < 700
            except DataNotSufficientError:
                pass
    assert refused >= 0.7 * others  # ids may be any digits


@pytest.mark.parametrize("number", ["2_0", "２", "٢", "0x10", "1e", "", "+", "1,5"])
def test_number_of_a_table_is_ascii_digits(number: str, handmade: Path) -> None:
    text = (handmade / "strips.csv").read_text()
    (handmade / "strips.csv").write_text(text.replace(",200", f',"{number}"', 1), encoding="utf-8")
    with pytest.raises(RawDataError, match=r"strips.csv: line 2, lines: found .*ASCII digits"):
        open_dump(handmade)


@pytest.mark.parametrize("mission", ["a\\nATTITUDE_TYPE = SPIN", "a\\u001b[2J", "\\u202eevil", "tab\\there"])
def test_name_of_a_mission_is_one_printable_line(mission: str, handmade: Path) -> None:
    text = (handmade / "dump.toml").read_text().replace('"by hand"', f'"{mission}"')
    (handmade / "dump.toml").write_text(text)
    with pytest.raises(RawDataError, match=r"mission: .*one line without control characters") as caught:
        open_dump(handmade)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("dump.toml", "[errors]", '[errors]\n"a\\u001b[2J\\nb" = 1'),
        ("dump.toml", "[files]", '["\\u001b]0;title\\u0007"]\na = 1\n[files]'),
        ("exposures.csv", "exposure_s", "exposure_s,\x1b[2J"),
        ("exposures.csv", "0000,", "\x1b[31m,"),
        ("targets.csv", "chips/0.tif", "chips/\x1b[2J.tif"),
    ],
)
def test_escape_character_never_reaches_the_terminal(file: str, old: str, new: str, handmade: Path) -> None:
    replaced(handmade / file, old, new, 1)
    with pytest.raises(RawDataError) as caught:
        open_dump(handmade)
    assert str(caught.value).isprintable(), repr(str(caught.value))


def test_remark_is_printed_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    for text in ("10:1234", "a :smile: b", "[red]x[/red]", "[/nothing]", "x" * 300):
        say(text)
        assert capsys.readouterr().err == text + "\n"
    for print_, stream in ((say, "err"), (tell, "out")):
        print_("a\x1b[2J\x07\u202e\udce9\nb")
        assert getattr(capsys.readouterr(), stream) == "a\\x1b[2J\\x07\\u202e\\udce9\nb\n"


def test_names_in_a_result_of_others_never_reach_the_terminal(finished, result):
    """A result folder that somebody sent, with escape characters in its tables and JSON."""
    path = result / "sightings" / "ledger.parquet"
    table = pq.read_table(path)
    hostile = "\x1b]0;title\x07 \u202e \x1b[2J"
    row = {field.name: hostile if pa.types.is_string(field.type) else 0 for field in table.schema}
    pq.write_table(pa.Table.from_pylist([row], table.schema).replace_schema_metadata(), path)
    verdict = {"outcome": "\x1b[31mconsistent", "checks": []}
    installation = json.loads((result / "installation.json").read_text())
    (result / "installation.json").write_text(json.dumps(installation | {"verdict": verdict}))
    for command in (("status", result), ("validate", result, "--dump", finished[0])):
        told = invoked(*command)
        assert told.exception is None or isinstance(told.exception, (SystemExit, RawDataError))
        shown = told.output + str(told.exception or "")
        assert shown and all(line.isprintable() for line in shown.split("\n")), repr(shown)


def test_image_names_of_a_table_on_stdout_are_escaped(tmp_path: Path) -> None:
    path = tmp_path / "a\x1b[2J.png"
    path.write_bytes(b"no image")
    for form in ("--csv", "--json"):
        shown = ran("identify", form, path, status=1).output
        assert "a\\" in shown and all(line.isprintable() for line in shown.split("\n")), repr(shown)


def test_scenario_key_with_escape_characters_is_escaped(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    (tmp_path / "s.toml").write_text('based_on = "mini"\n["\\u001b[2J"]\na = 1\n')
    told = ran("simulate", tmp_path / "s.toml", tmp_path / "out", status=2)
    assert "\x1b" not in told.output + capfd.readouterr().err


def test_chip_with_an_absurd_transform_loses_its_target_only(finished, tmp_path):
    dump, result = finished
    shutil.copytree(dump, tmp_path / "dump")
    chips = sorted((tmp_path / "dump" / "chips").iterdir())
    corners = ((1e-5, 277_000, 1000), (1e308, 277_000, 1000), (0.5, 9e15, 1e308))
    for path, (step, x, y) in zip(chips, corners):
        transform = Affine(step, 0, x, 0, -step, y)
        with rasterio.open(path) as image:
            profile, pixels = image.profile, image.read(1)
        with rasterio.open(path, "w", **(profile | {"transform": transform})) as image:
            image.write(pixels, 1)
    ran("calibrate", tmp_path / "dump", "--out", tmp_path / "out", "--workers", 1, "--no-report")
    content = json.loads((tmp_path / "out" / "installation.json").read_text())
    before = json.loads((result / "installation.json").read_text())
    assert before["targets"] - 3 <= content["targets"] <= before["targets"]
    status = ran("status", tmp_path / "out").output
    assert "pixels of 1e-05 m" in status and "pixels of inf m" in status and "below 1e+09" in status


def test_raster_with_values_beyond_single_precision_has_no_value_there(handmade: Path) -> None:
    path = handmade / "grid.tif"
    values = np.full((4, 4), 1e308)
    values[0, 0] = 5.0
    write_raster(path, values, crs="EPSG:32648", transform=Affine(1, 0, 0, 0, -1, 0))
    grid = read_grid(path, "grid.tif", max_pixels=100)
    assert grid.values[0, 0] == 5.0 and np.isnan(grid.values).sum() == 15


def test_text_that_is_a_folder_is_named(handmade: Path) -> None:
    with pytest.raises(RawDataError, match="exposures: file: found a folder, expected a readable file"):
        read_text(handmade / "exposures", "exposures")
