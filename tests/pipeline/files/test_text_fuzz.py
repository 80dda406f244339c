"""Text files with anything in them: a complaint that names the file, or a dump; never another error."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from handmade import write_handmade_dump
from hypothesis import given, seed, settings
from hypothesis import strategies as st

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.text_files import path_inside
from boresight.pipeline.run.settings import read_settings

FILES = (
    "dump.toml",
    "star_camera.toml",
    "remote_camera.toml",
    "installation.toml",
    "orbit.oem",
    "exposures.csv",
    "strips.csv",
    "targets.csv",
)
PIECES = [
    "nan",
    "inf",
    "-1",
    "1e999",
    "0",
    "",
    "..",
    "/etc/passwd",
    "\x00",
    "[",
    '"',
    "=",
    ",",
    "\n",
    "é",
    "9" * 400,
]
PIECES += [
    "2024-13-45T99:99:99",
    "{}",
    "__import__('os')",
    "!!python/object",
    "=cmd|' /C calc'!A0",
    "\ufeff",
    "\\",
]
HOSTILE = st.sampled_from(PIECES)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_handmade_dump(tmp_path_factory.mktemp("fuzz") / "dump")


@seed(20261120)
@settings(max_examples=120, deadline=None, database=None)
@given(
    name=st.sampled_from(FILES),
    edits=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 12), HOSTILE | st.text(max_size=5)), max_size=4),
)
def test_text_changed_at_random_is_read_or_refused(base: Path, name: str, edits: list) -> None:
    original = (base / name).read_bytes()
    text = original.decode()
    for place, length, new in edits:
        at = int(place * len(text))
        text = text[:at] + new + text[at + length :]
    try:
        (base / name).write_bytes(text.encode("utf-8", "surrogatepass"))
        try:
            open_dump(base)
        except RawDataError as error:
            assert all((error.file, error.field, error.found is not None, error.expected))
            assert "\n" not in str(error)
    finally:
        (base / name).write_bytes(original)


@seed(20261120)
@settings(max_examples=300, deadline=None, database=None)
@given(st.text(max_size=40) | st.lists(st.sampled_from(["..", ".", "a", "", "\\", "C:", "~"])).map("/".join))
def test_path_of_a_manifest_stays_inside_or_is_refused(name: str) -> None:
    root = Path("/nonexistent/dump")
    try:
        path = path_inside(root, name, file="f", field="g")
    except RawDataError:
        return
    assert path.resolve().is_relative_to(root)
    assert ".." not in path.parts


def test_settings_refuse_what_does_not_exist(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    for text, where in (
        ("[match]\ntemplate = 3\n", "match.template"),
        ("[colour]\n", "colour"),
        ("[run]\nrounds = 'two'\n", "run.rounds"),
        ("[run]\nrounds = 0\n", "run"),
        ("[calibration]\nsigma_clock_s = -1.0\n", "calibration"),
    ):
        path.write_text(text)
        with pytest.raises(RawDataError) as caught:
            read_settings(path)
        assert caught.value.field == where
    path.write_text("[match]\ntemplate_px = 96\n[run]\nrounds = 3\n[calibration]\nsigma_clock_s = 2e-4\n")
    chosen = read_settings(path)
    assert (chosen.match.template_px, chosen.run.rounds) == (96, 3)
    path.write_text("[run]\npasses = 4\n")  # its name of before
    with pytest.warns(UserWarning, match=r"run\.passes is called run\.rounds now"):
        assert read_settings(path).run.rounds == 4
    assert dict(chosen.calibration) == {"sigma_clock_s": 2e-4}
    shutil.rmtree(tmp_path)
