"""Hostile text: paths that lead out, files without end, nesting, formulas, code; and times that cannot be."""

import ast
import gzip
import json
import os
import time
from pathlib import Path

import pytest
from edits import replaced

from boresight.features.planning.campaign_plan import read_plan
from boresight.features.sky_images.centroid_report import _read_truth
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.orbit_file import read_oem
from boresight.pipeline.files.scenario_file import named_scenario
from boresight.pipeline.files.text_files import read_json, toml_tables
from boresight.pipeline.run.settings import read_settings
from boresight.simulator.scenario import ScenarioError

ROOT = Path(__file__).parents[3]
PACKAGES = ("records", "geometry", "star_id", "gct_match", "calib", "simulator", "pipeline")
READ_TOML = {
    "settings": read_settings,
    "plan": read_plan,
    "scenario": lambda path: named_scenario(str(path), []),
    "any": lambda path: toml_tables(path, path.name),
}


@pytest.mark.parametrize(
    "name",
    [
        *("../secret", "a/../../secret", "/etc/passwd", "//etc/passwd", "./0.png", "a//b", "a/", ""),
        *("C:/x", "C:x", "c:", r"\\server\x", r"..\x", "a\x00b", "a\nb", "a\x1b[2Jb", "\u202eb"),
    ],
)
def test_path_that_could_leave_the_dump_is_refused_in_every_table(name: str, handmade: Path) -> None:
    for file, old, field in (
        ("dump.toml", '"orbit.oem"', "files.orbit"),
        ("exposures.csv", "exposures/0.png", "line 2, file"),
        ("strips.csv", "strips/0.tif", "line 2, file"),
        ("targets.csv", "chips/0.tif", "line 2, chip"),
    ):
        if (file, name) == ("strips.csv", ""):  # a strip without image, of which points are measured
            continue
        sound = (handmade / file).read_text()
        new = json.dumps(name) if file.endswith(".toml") else f'"{name}"'
        (handmade / file).write_text(sound.replace(old, new, 1), newline="")
        with pytest.raises(RawDataError) as caught:
            open_dump(handmade)
        assert caught.value.file == file
        assert caught.value.field == field or "\n" in name  # a cell of two lines ends one line later
        assert str(caught.value).isprintable()
        (handmade / file).write_text(sound)


@pytest.mark.parametrize(
    "name",
    ["%2e%2e/secret", "~", "~root/x", "file:///etc/passwd", "zip://a.zip!b.tif", "$HOME", "=1+1", "-rf"],
)
def test_name_that_other_programs_would_interpret_is_a_name(name: str, handmade: Path) -> None:
    """Nothing is unescaped, expanded or fetched: there is no such file, or the path is none."""
    replaced(handmade / "strips.csv", "strips/0.tif", name)
    if "//" in name:
        with pytest.raises(RawDataError, match=r"strips.csv: line 2, file: found .*, expected a path inside"):
            open_dump(handmade)
        return
    (omission,) = open_dump(handmade).omissions
    assert (omission.subject.name, omission.file) == ("s1/0", name)
    assert omission.text == f"{name}: file: found no such file, expected an image"


@pytest.mark.parametrize("file", ["exposures/0.png", "strips/0.tif", "chips/0.tif", "targets.csv"])
def test_link_that_leads_out_is_refused(file: str, handmade: Path) -> None:
    (handmade.parent / "outside").write_bytes((handmade / file).read_bytes())
    (handmade / file).unlink()
    os.symlink(handmade.parent / "outside", handmade / file)
    with pytest.raises(RawDataError, match="a link to a place outside"):
        open_dump(handmade)


@pytest.mark.parametrize("kind", READ_TOML)
@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a." * 30_000 + "a = 1", "found a key of 30001 parts, expected at most 32 parts"),
        ('"a b".' * 30_000 + "a = 1", "found a key of 30001 parts, expected at most 32 parts"),
        ("x = {" + "a." * 30_000 + "a = 1}", "found a key of 30001 parts, expected at most 32 parts"),
        ("a = " + "[" * 50_000, "recursion"),
        ("a = " + "{a = " * 50_000, "recursion"),
        ("a = " + "9" * 5000, "4300 digits"),
        ("a = 0x" + "f" * 5000, "a int too long to be shown|unknown|expected"),
        ("a = 1\na = 2", "Cannot overwrite a value"),
        ("a = \x00", "invalid value"),
    ],
    ids="deep_key quoted_deep_key inline_deep_key arrays tables digits hex twice NUL".split(),
)
def test_toml_that_is_made_to_harm_is_refused_at_once(kind, text, says, tmp_path):
    path, begin = tmp_path / "hostile.toml", time.process_time()
    path.write_text(text)
    if kind == "any" and says.startswith("a int"):
        assert toml_tables(path, "hostile.toml")["a"].bit_length() == 20_000
        return
    with pytest.raises((RawDataError, ValueError), match=says) as caught:
        READ_TOML[kind](path)
    assert len(str(caught.value)) < 600
    assert time.process_time() - begin < 2.0  # s


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[orbit]\naltitude_km = 0x" + "f" * 400,
            "orbit.altitude_km: expected a number up to 1e.15, found 44462"),
        ("[orbit]\naltitude_km = 0x" + "f" * 5000,
            "altitude_km: expected a number up to 1e.15, found a int too long"),
        ("[orbit]\naltitude_km = nan", "orbit.altitude_km: expected a number up to 1e.15, found nan"),
        ("[strips]\ncount = 0x" + "f" * 400, "strips.count: expected a number up to 1e.15, found 44462"),
        ("[strips]\ncount = true", "strips.count: expected a valid integer, found True"),
    ],
)  # fmt: skip
def test_number_that_no_scenario_has_is_told_with_its_key(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(ScenarioError, match=says):
        named_scenario(str(tmp_path / "s.toml"), [])


def test_truth_of_centroids_is_a_plain_table(tmp_path: Path) -> None:
    """An address is no file, a packed table is not unpacked, numbers that are none are named."""
    with pytest.raises(RawDataError, match="no such file"):
        _read_truth(Path("http://localhost:9/truth.csv"))
    packed = tmp_path / "truth.csv.gz"
    packed.write_bytes(gzip.compress(b"x_px,y_px,flux_dn\n1,2,3\n"))
    with pytest.raises(RawDataError, match="byte 0x8b, expected text in UTF-8"):
        _read_truth(packed)
    (tmp_path / "truth.csv").write_text("x_px,y_px,flux_dn\n1,2,many\n")
    with pytest.raises(RawDataError, match="column flux_dn"):
        _read_truth(tmp_path / "truth.csv")


def test_json_of_a_result_may_be_anything_but_an_error_of_the_program(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    hostile = {"[" * 100_000: "recursion", "[1]": "an object", "{": "JSON", "9" * 5000: "digits"}
    for text, says in hostile.items():
        path.write_text(text)
        with pytest.raises(RawDataError, match=says):
            read_json(path, "run.json")


def test_strip_without_image_needs_measured_points(handmade: Path) -> None:
    for n in range(2):
        replaced(handmade / "strips.csv", f"strips/{n}.tif", "")
    with pytest.raises(RawDataError, match=r"strips.csv: file: found no image of strip s1, .*files.points"):
        open_dump(handmade)


def test_orbit_is_text_and_nothing_else(handmade: Path) -> None:
    for raw in (b"BZh91AY&SY", b"\x1f\x8b\x08\x00", b"<?xml version='1.0'?><oem/>"):
        (handmade / "orbit.oem").write_bytes(raw)
        where = r"orbit.oem: (line 1|byte [0-9]+|body|gzip|CCSDS_OEM_VERS): found"
        with pytest.raises(RawDataError, match=where):
            read_oem(handmade / "orbit.oem", "orbit.oem")


def test_nothing_that_is_read_can_be_run_or_unpacked() -> None:
    """No module calls what would run code out of data, unpack an archive or start a program, but the browser
    that prints our own page at the user's request, and the reader of archives of GIPP files in memory."""
    allowed = {"pipeline/report/pdf.py": {"subprocess"}, "features/operators/gipp_files.py": {"tarfile"}}
    forbidden = {"pickle", "marshal", "shelve", "joblib", "dill", "yaml", "tarfile", "subprocess"}
    calls = set("eval exec compile unpack_archive extractall ZipFile system popen __import__".split())
    seen = 0
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Import):
                    names = {alias.name.split(".")[0] for alias in node.names}
                    assert not names & forbidden - allowed.get(path.relative_to(ROOT).as_posix(), set()), path
                elif isinstance(node, ast.ImportFrom):
                    assert (node.module or "").split(".")[0] not in forbidden, path
                elif isinstance(node, ast.Call):
                    seen += 1
                    name = getattr(node.func, "attr", getattr(node.func, "id", ""))
                    owner = getattr(getattr(node.func, "value", None), "id", "")
                    assert name not in calls or owner in ("re", "platform"), f"{path}:{node.lineno}"
                    pickled = [k.value for k in node.keywords if k.arg == "allow_pickle"]
                    assert all(isinstance(value, ast.Constant) and not value.value for value in pickled), path
    assert seen > 1000
