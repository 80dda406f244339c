"""Names of files with anything in them, and keys of settings that are none: refused by name."""

import shutil
from pathlib import Path

import pytest
from hypothesis import given, seed, settings
from hypothesis import strategies as st

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.text_files import path_inside
from boresight.pipeline.run.settings import read_settings

ANY = st.integers(0, 0x10FFFF).map(chr).filter(lambda one: not "\ud800" <= one <= "\udfff")
CHARACTERS = st.sampled_from("a./\\:~ \0\n\x1b") | ANY  # without the table that `st.characters` makes


@seed(20261120)
@settings(max_examples=100, deadline=None, database=None)
@given(
    st.text(CHARACTERS, max_size=40)
    | st.lists(st.sampled_from(["..", ".", "a", "", "\\", "C:", "~"])).map("/".join)
)
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
