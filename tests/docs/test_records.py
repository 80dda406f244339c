"""Benchmark records state the digest of the code that they are of; those of other code are listed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "scripts"), str(ROOT / "benchmarks")]
import records  # noqa: E402
from code_digest import Commit, WorkingTree, code_of  # noqa: E402

SCRIPT = "import numpy\nfrom boresight.geometry.angle import turn\nprint(turn(1.0))\n"
ANGLE = "from boresight.geometry.constants import FULL\n\n\ndef turn(x):\n    return FULL * x\n"
COMMAND = "python benchmarks/tiny.py --runs 3"


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout of one benchmark, which depends on two modules of a room, and of one more module."""
    for path, text in {
        "benchmarks/tiny.py": SCRIPT,
        "geometry/__init__.py": "",
        "geometry/angle.py": ANGLE,
        "geometry/constants.py": "FULL = 360.0\n",
        "geometry/other.py": "X = 1\n",
        "boresight/__init__.py": "",
    }.items():
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text(text)
    return tmp_path


def digest(root: Path, command: str = COMMAND) -> str:
    return code_of(command, WorkingTree(root)).digest


def rewritten(root: Path, path: str, text: str) -> str:
    (root / path).write_text(text)
    return digest(root)


def test_a_number_in_a_module_that_is_imported_by_an_import_changes_the_digest(checkout):
    assert digest(checkout) != rewritten(checkout, "geometry/constants.py", "FULL = 400.0\n")


def test_a_module_that_is_not_imported_does_not(checkout):
    assert digest(checkout) == rewritten(checkout, "geometry/other.py", "X = 2\n")


def test_words_imports_and_places_do_not(checkout):
    before = digest(checkout)
    assert before == rewritten(
        checkout,
        "geometry/angle.py",
        '"""Angles."""\nfrom boresight.geometry.constants import FULL\nimport math\n__all__ = ["turn"]\n'
        'def turn(x):\n    """Degrees."""\n    return FULL * x  # all round\n',
    )
    (checkout / "geometry" / "angle.py").rename(checkout / "geometry" / "degrees.py")
    moved = SCRIPT.replace("geometry.angle", "geometry.degrees")
    assert before == rewritten(checkout, "benchmarks/tiny.py", moved)


def test_a_module_that_is_imported_within_a_function_counts(checkout):
    inside = SCRIPT + "def more():\n    from boresight.geometry import other\n    return other.X\n"
    before = rewritten(checkout, "benchmarks/tiny.py", inside)
    assert before != rewritten(checkout, "geometry/other.py", "X = 2\n")


def test_a_benchmark_that_runs_the_program_depends_on_the_commands_that_it_names(checkout):
    (checkout / "features").mkdir()
    (checkout / "features" / "__init__.py").write_text("")
    (checkout / "features" / "drift_command.py").write_text("A = 1\n")
    asked = 'import subprocess\nsubprocess.run(["boresight", "drift"])\n'
    before = rewritten(checkout, "benchmarks/tiny.py", asked)
    assert before != rewritten(checkout, "features/drift_command.py", "A = 2\n")
    assert (
        digest(checkout, "boresight drift --out x")
        == code_of("boresight drift", WorkingTree(checkout)).digest
    )
    with pytest.raises(ValueError, match="no command of the program in: boresight fly"):
        digest(checkout, "boresight fly")


def test_a_commit_has_the_digest_of_its_files(checkout):
    def git(*arguments: str) -> None:
        who = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        subprocess.run(["git", *who, *arguments], cwd=checkout, check=True, capture_output=True)

    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "all")
    before = digest(checkout)
    assert rewritten(checkout, "geometry/constants.py", "FULL = 400.0\n") != before
    assert code_of(COMMAND, Commit("HEAD", checkout)).digest == before
    with pytest.raises(ValueError, match="0000000"):
        Commit("0000000", checkout)


def record_of(checkout: Path, text: str, name: str = "tiny.txt") -> records.BenchmarkRecord:
    (checkout / name).write_text(text)
    return records.BenchmarkRecord(checkout / name, text)


def test_a_record_is_of_the_present_code_until_the_code_changes(checkout):
    record = record_of(checkout, f"Tiny\ncommit    1234567\ncommand   {COMMAND}\n\n1\n")
    assert record.state(WorkingTree(checkout)) == "states no digest of its code"
    stamped = record_of(checkout, records.stamped(record, WorkingTree(checkout)))
    assert stamped.text.splitlines()[2] == f"code      {digest(checkout)}, 4 modules"
    assert stamped.state(WorkingTree(checkout)) == "present"
    (checkout / "geometry" / "constants.py").write_text("FULL = 400.0\n")
    assert stamped.state(WorkingTree(checkout)).startswith(f"of other code: {stamped.code}, now ")
    again = record_of(checkout, records.stamped(stamped, WorkingTree(checkout)))
    assert again.text.count("code ") == 1 and again.state(WorkingTree(checkout)) == "present"


def test_a_record_in_prose_is_stamped_behind_its_commit(checkout):
    text = f"# Tiny\n\nCommit 1234567, 2026-11-24\n\n    {COMMAND}\n"
    stamped = records.stamped(record_of(checkout, text, "tiny.md"), WorkingTree(checkout))
    assert f"Commit 1234567, code {digest(checkout)}, 4 modules, 2026-11-24" in stamped


def test_what_a_command_leaves_open_has_to_be_given(checkout):
    open_text = f"Tiny\ncommit    1234567\ncommand   {COMMAND} --old OLDER\n"
    record = record_of(checkout, open_text)
    with pytest.raises(ValueError, match="needs --with OLDER="):
        records.arguments_of(record, {})
    assert records.arguments_of(record, {"OLDER": "../x"})[-2:] == ["--old", "../x"]


def test_a_record_of_several_runs_is_not_run(checkout):
    record = record_of(checkout, f"Tiny\ncommand   {COMMAND}\ncommand   {COMMAND} --more\n")
    with pytest.raises(ValueError, match="joins runs"):
        records.arguments_of(record, {})


def test_a_record_is_run_anew_only_if_a_record_comes_out(checkout, monkeypatch):
    monkeypatch.setattr(records, "ROOT", checkout)
    record = record_of(checkout, f"Tiny\ncommit    1234567\ncommand   {COMMAND}\n\nold\n")
    (checkout / "benchmarks" / "tiny.py").write_text("raise SystemExit(1)\n")
    with pytest.raises(ValueError, match="exit status 1, no record"):
        records.run(record, {})
    assert "old" in record.path.read_text()
    made = "Tiny\ncommit    7654321\ncode      0123456789abcdef, 4 modules\n"
    (checkout / "benchmarks" / "tiny.py").write_text(f"import sys\nprint({made!r}, sys.argv[1:])\n")
    records.run(record, {})
    assert record.path.read_text() == f"{made} ['--runs', '3']\n"


@pytest.mark.parametrize("record", list(records.records()), ids=lambda record: record.name)
def test_every_record_names_commit_command_and_code(record):
    assert record.commit and record.commands and record.code


def test_the_head_of_a_record_states_the_code_of_its_script(capsys, monkeypatch):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")  # else `record` starts the process anew
    monkeypatch.setattr(sys, "argv", ["benchmarks/cluster_latency.py", "--workers", "2"])
    import record

    record.head("Latency")
    head = records.BenchmarkRecord(Path("x.txt"), capsys.readouterr().out)
    assert head.commands == ["python benchmarks/cluster_latency.py --workers 2"]
    assert head.state(WorkingTree()) == "present"


@pytest.mark.parametrize("folder", ["benchmarks", "scripts"])
def test_the_readme_of_a_folder_names_every_file(folder):
    text = (ROOT / folder / "README.md").read_text(encoding="utf-8")
    assert [path.name for path in (ROOT / folder).glob("*.py") if f"`{path.name}`" not in text] == []
