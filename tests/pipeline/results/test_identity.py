"""Which result it is: its id, its date and command, and what its operator says of it."""

import datetime
import hashlib
import json
from pathlib import Path

import pytest
from command_line import ran
from report_page import report_html

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.report.saved import read_saved
from boresight.pipeline.results.identity import identity_of_result, saved_about, write_about

SAID = 'mission = "Gallus"\ndocument = "GA-CAL-12"\nreviewer = "R. <b>Viewer</b>"\n'


def test_the_id_is_the_digest_of_the_matrix_file(finished: tuple[Path, Path]) -> None:
    result = finished[1]
    found = identity_of_result(result)
    assert found.result == hashlib.sha256((result / "installation.json").read_bytes()).hexdigest()[:16]
    run = json.loads((result / "run.json").read_text())
    ended = datetime.datetime.fromisoformat(run["finished_utc"])
    made = datetime.datetime.fromtimestamp((result / "installation.json").stat().st_mtime, datetime.UTC)
    assert abs((ended - made).total_seconds()) <= 2.0  # both are whole seconds of the same moment
    assert found.inputs == run["inputs"] and found.dump == run["dump"]


def test_a_result_of_an_older_version_is_known_by_its_id_alone(tmp_path: Path) -> None:
    (tmp_path / "installation.json").write_text("{}")
    found = identity_of_result(tmp_path)
    assert found.result == hashlib.sha256(b"{}").hexdigest()[:16]
    assert (found.finished, found.command, found.inputs) == ("not known",) * 3


@pytest.mark.parametrize(
    ("text", "field", "found"),
    [
        ('autor = "me"\n', "autor", ""),
        ("author = 7\n", "author", "7"),
        ('remark = "two\\nlines"\n', "remark", ""),
        (f'remark = "{"x" * 201}"\n', "remark", ""),
    ],
)
def test_what_an_operator_may_not_say_is_refused_by_its_key(text, field, found, tmp_path):
    (tmp_path / "about.toml").write_text(text)
    with pytest.raises(RawDataError) as error:
        write_about(tmp_path, tmp_path / "about.toml")
    assert field in str(error.value) and found in str(error.value) and "about.toml" in str(error.value)
    assert saved_about(tmp_path) == {}


def test_page_and_exports_carry_the_identity_and_what_the_operator_says(finished, result, tmp_path):
    about = tmp_path / "about.toml"
    about.write_text(SAID)
    ran("report", result, "--about", about)
    own = identity_of_result(result)
    page = report_html(read_saved(result))
    for text in (own.result, own.inputs, own.finished, "GA-CAL-12", "R. &lt;b&gt;Viewer&lt;/b&gt;"):
        assert page.count(text) >= 2, text  # on the sheet that is signed, and among settings and inputs
    out = tmp_path / "exports"
    ran("export", result, "--format", "spice,kml", "--dump", finished[0], "--out", out)
    for path in out.iterdir():
        written = path.read_text()
        for text in (own.result, own.inputs, "GA-CAL-12", "Gallus"):
            assert text in written, path
    same = (result / "installation.json").read_bytes() == (finished[1] / "installation.json").read_bytes()
    assert same  # what is said of a matrix is not in its file
