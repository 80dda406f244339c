"""`--out` is the user's folder: what is refused, what is replaced, and that nothing of others is touched."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pytest
from command_line import ended, ran
from fixture_strips import FIXTURE, strip_of_fixture

from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.whole_file import make_own_folder, write_whole
from boresight.pipeline.results.folder import store_of
from boresight.pipeline.results.ownership import LOCK, MARKER, claimed
from boresight.pipeline.run.settings import RunSettings, Settings


def contents(folder: Path) -> dict[str, bytes]:
    """All files below a folder but the lock."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name != LOCK
    }


def claim(out: Path, dump: Path, settings: Settings | None = None) -> None:
    """Take a folder for a result, an earlier one overwritten."""
    with claimed(out, [dump], settings or Settings(), overwrite=True):
        pass


def assert_refused(out: Path, dump: Path, says: str, settings: Settings | None = None) -> None:
    with pytest.raises(RawDataError, match=says), claimed(out, [dump], settings or Settings()):
        pass


@pytest.fixture
def mine(finished: tuple[Path, Path], tmp_path: Path) -> tuple[Path, Path]:
    """A dump and its finished result, to be changed at will."""
    for source, name in zip(finished, ("dump", "result")):
        shutil.copytree(source, tmp_path / name)
    return tmp_path / "dump", tmp_path / "result"


def test_folder_with_files_of_others_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    out = tmp_path / "mine"
    (out / "notes").mkdir(parents=True)
    for name in ("installation.json", "draft.tmp", "notes/.letter.txt.tmp", "dumps.json"):
        (out / name).write_text("precious")
    before = everything(out)
    assert_refused(out, FIXTURE, "a new or empty folder")
    assert everything(out) == before  # not even a lock


def test_result_of_a_version_without_marker_is_refused_with_its_remedy_and_still_read(mine, capsys):
    dump, out = mine
    (out / MARKER).unlink()
    before = contents(out)
    status, text = ended(capsys, "calibrate", str(dump), "--out", str(out), "--overwrite")
    version = json.loads(before["installation.json"])["version"]
    assert status == 1 and f"a result of boresight {version} without {MARKER}" in text
    assert "another folder (report, validate and export still read this one), or delete it first" in text
    ran("status", out)
    ran("export", out, "--format", "spice", "--out", out.parent)
    assert contents(out) == before


def test_no_file_of_others_is_removed_from_a_result(mine: tuple[Path, Path]) -> None:
    dump, out = mine
    others = {"draft.tmp": b"a", "sightings/.letter.txt.tmp": b"b", "work/exposures/my.parquet": b"c"}
    for name, content in others.items():
        (out / name).write_bytes(content)
    shutil.rmtree(dump)
    strip_of_fixture(dump, 2)
    claim(out, dump)
    left = contents(out)
    assert {name: left[name] for name in others} == others
    assert set(left) == {*others, MARKER}


@pytest.mark.parametrize("place", ["", "exposures", "results/first"])
def test_dump_and_folders_in_it_are_refused(one_strip: Path, place: str) -> None:
    before = contents(one_strip)
    assert_refused(one_strip / place, one_strip, "outside of it")
    assert contents(one_strip) == before


def test_empty_name_is_wrong_usage() -> None:
    assert "empty" in ran("calibrate", FIXTURE, "--out", "", status=2).output


def test_another_dump_or_other_settings_need_overwrite(mine: tuple[Path, Path]) -> None:
    dump, out = mine
    before = contents(out)
    assert_refused(out, FIXTURE, r"a result of another dump.*--overwrite")
    other = Settings(run=RunSettings(rounds=3))
    assert_refused(out, dump, r"a result of other settings.*--overwrite", other)
    assert contents(out) == before
    claim(out, dump, other)
    after = contents(out)
    assert "installation.json" not in after and not any(name.startswith("sightings/") for name in after)
    assert any(name.startswith("work/exposures/") for name in after)  # the same dump's: may be used again


def test_finished_run_asked_again_says_so_at_once_and_changes_nothing(mine, monkeypatch, capsys):
    dump, out = mine
    before = contents(out)
    calibrating = "boresight.pipeline.calibration_run.calibrate_dump"
    monkeypatch.setattr(calibrating, None)
    status, said = ended(capsys, "calibrate", str(dump), "--out", str(out))
    assert (status, contents(out) == before) == (0, True) and "nothing to do" in said
    image = sorted((dump / "exposures").iterdir())[0]
    image.write_bytes(image.read_bytes() + b"\0")  # any change of an input is work again

    def begun(*arguments: object) -> None:
        raise DataNotSufficientError("it calibrates again")

    monkeypatch.setattr(calibrating, begun)
    status, said = ended(capsys, "calibrate", str(dump), "--out", str(out), "--workers", "1")
    assert status == 1 and "it calibrates again" in said
    assert not (out / "installation.json").exists()  # no longer the result of these inputs


def test_second_run_in_one_folder_is_refused_with_the_owner(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path\n"
        "from boresight.pipeline.results.ownership import claimed\n"
        "from boresight.pipeline.run.settings import Settings\n"
        "with claimed(Path(sys.argv[1]), [Path(sys.argv[2])], Settings()):\n"
        "    print('owned', flush=True); sys.stdin.readline()\n"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "out"), str(FIXTURE)]
    first = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert first.stdout is not None and first.stdout.readline() == "owned\n"
        assert_refused(tmp_path / "out", FIXTURE, rf"in use by process {first.pid} on \S+")
    finally:
        first.kill()
        first.wait()
    claim(tmp_path / "out", FIXTURE)  # the lock of a killed run is released


def everything(folder: Path) -> dict[str, bytes | str]:
    """All files and links below a folder, links by their target."""

    def content(path: Path) -> bytes | str:
        return f"-> {path.readlink()}" if path.is_symlink() else path.read_bytes() if path.is_file() else b""

    return {path.relative_to(folder).as_posix(): content(path) for path in folder.rglob("*")}


LINKED = [LOCK, MARKER, "sightings", "evidence", "interior", "work", "work/exposures"]


@pytest.mark.parametrize(("name", "hard"), [(LOCK, True), *((name, False) for name in LINKED)])
def test_link_inside_a_result_is_refused_and_its_target_left_as_it_is(name, hard, tmp_path):
    out, target = tmp_path / "out", tmp_path / "target"
    with claimed(out, [FIXTURE], Settings()):
        (out / Path(name).parent).mkdir(exist_ok=True)
    (out / name).unlink(missing_ok=True)
    if name in (LOCK, MARKER):
        target.write_text((out / MARKER).read_text() if name == LOCK else "{}")
    else:
        (target / "exposures").mkdir(parents=True)
        (target / "exposures" / f"a.{32 * '0'}.parquet").write_text("precious")
        (target / "stars.parquet").write_text("precious")
    if hard:
        (out / name).hardlink_to(target)
    else:
        (out / name).symlink_to(target)
    before = everything(tmp_path)
    for settings in (Settings(), Settings(run=RunSettings(rounds=3))):
        with pytest.raises(RawDataError, match=r"link.*remove"):
            with claimed(out, [FIXTURE], settings, overwrite=True):
                pass
    assert everything(tmp_path) == before


@pytest.mark.parametrize("name", ["sightings", "evidence", "work"])
def test_link_made_while_a_run_lasts_is_not_written_through(name: str, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "target").mkdir()
    (tmp_path / "out" / name).symlink_to(tmp_path / "target")
    with pytest.raises(RawDataError, match=rf"out/{name}: folder of the result: found a link"):
        if name == "work":
            store_of(tmp_path / "out").write("exposures", "e1", 32 * "0", pa.table({"a": [1]}), {})
        else:
            make_own_folder(tmp_path / "out" / name)
    assert everything(tmp_path / "target") == {}


@pytest.mark.parametrize("event", ["moved", "deleted", "replaced"])
def test_result_folder_that_is_moved_or_deleted_during_a_run_fails_it(
    event, one_strip, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"

    def taken_away(*arguments: object) -> None:
        if event == "deleted":
            shutil.rmtree(out)
        else:
            out.rename(tmp_path / "elsewhere")
        if event == "replaced":
            out.mkdir()
        write_whole(out / "sightings" / "stars.parquet", lambda path: path.write_text("x"))

    monkeypatch.setattr("boresight.pipeline.calibration_run.calibrate_dump", taken_away)
    status, said = ended(capsys, "calibrate", str(one_strip), "--out", str(out), "--workers", "1")
    assert status == 1 and "moved or deleted during the run" in said
    assert not out.exists() or everything(out) == {}


def test_overwrite_after_an_edited_table_keeps_the_units_that_do_not_depend_on_it(mine, tmp_path):
    dump, out = mine
    marker = json.loads((out / MARKER).read_text()) | {"folders": [str(dump)]}
    (out / MARKER).write_text(json.dumps(marker))
    units = {name for name in contents(out) if name.startswith("work/")}
    with (dump / "targets.csv").open("a") as file:
        file.write("\n")
    claim(out, dump)
    assert set(contents(out)) == {MARKER, *units} and len(units) > 10
    moved = shutil.copytree(dump, tmp_path / "another")
    (moved / "targets.csv").write_text((moved / "targets.csv").read_text() + "\n")
    claim(out, moved)
    assert set(contents(out)) == {MARKER}


@pytest.mark.parametrize("command", ["validate", "geolocate", "export"])
def test_result_is_not_used_with_another_dump(command, mine, monkeypatch, capsys):
    _, out = mine
    (out.parent / "pixels.csv").write_text("ccd,sample,line\n0,1,1\n")
    more = {
        "validate": [],
        "geolocate": ["--strip", "1", "--pixels", str(out.parent / "pixels.csv")],
        "export": ["--format", "csm-isd", "--out", str(out.parent / "exports")],
    }[command]
    status, said = ended(capsys, command, str(out), "--dump", str(FIXTURE), *more)
    assert status == 1 and "found another dump" in said


def test_json_of_a_result_is_json(finished: tuple[Path, Path]) -> None:
    def refuse(name: str) -> None:
        raise ValueError(name)

    texts = [path.read_text() for path in finished[1].rglob("*.json")]
    assert len(texts) >= 3  # installation.json, run.json, the marker
    assert all(isinstance(json.loads(text, parse_constant=refuse), dict) for text in texts)
