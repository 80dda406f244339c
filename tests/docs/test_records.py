"""The table of benchmarks is made of their verdicts; records that pages quote say what they are of."""

import pkgutil
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "benchmarks")]
RECORDS = ROOT / "benchmarks" / "results"
PAGES = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "features").rglob("*.py")]
HELPERS = {"hard_peers", "processes", "record", "rugged_peer", "run"}
COMMAND = re.compile(r"python (?:benchmarks|scripts)/\w+\.py|boresight (?:experiment|calibrate)")


@pytest.fixture
def record(monkeypatch):
    """`benchmarks/record.py`, without failed verdicts."""
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")  # else it starts the process anew
    import record

    monkeypatch.setattr(record, "_FAILED", [])
    return record


def test_what_the_benchmark_of_speed_leaves_out_of_a_calibration_exists(record) -> None:
    import speed

    assert all(callable(pkgutil.resolve_name(f"{speed.STAGE}{name}")) for name in speed.WITHOUT)


def named_records() -> set[str]:
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    names = set(re.findall(r"benchmarks/results/([\w-]+\.(?:txt|md))", text))
    alone = {path.name for path in RECORDS.glob("*") if f"`{path.name}`" in text}
    return (names | alone) - {"table.md"}


@pytest.mark.parametrize("name", sorted(named_records()))
def test_a_record_that_a_page_names_states_its_commit_and_its_command(name):
    text = (RECORDS / name).read_text(encoding="utf-8")
    assert re.search(r"\b[Cc]ommit:? +(?:boresight \S+ \(commit )?[0-9a-f]{7,40}\b", text), "no commit"
    assert COMMAND.search(text), "no command"


def test_every_record_is_named_by_a_page():
    records = {path.name for path in RECORDS.glob("*") if path.suffix in (".txt", ".md")}
    assert sorted(records - named_records() - {"table.md"}) == []


def test_one_command_runs_every_benchmark(record):
    from run import BENCHMARKS

    scripts = {path.stem for path in (ROOT / "benchmarks").glob("*.py")} - HELPERS
    assert {one.script for one in BENCHMARKS} == scripts
    assert len({one.name for one in BENCHMARKS}) == len(BENCHMARKS)


def test_the_benchmarks_hold_seven_thousand_lines_at_most():
    files = (ROOT / "benchmarks").glob("*.py")
    assert sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files) <= 7000


def test_a_share_fails_where_its_interval_excludes_the_limit(record, capsys):
    record.judge_share("few", 1, 40, most=0.01)  # 95 % interval 0.0006 to 0.13
    record.judge_share("many", 10, 40, most=0.01)
    record.judge_share("most", 36, 40, least=0.95)  # up to 0.972
    record.judge_share("half", 20, 40, least=0.95)
    lines = [line.split()[:2] for line in capsys.readouterr().out.splitlines()]
    assert lines == [["holds", "few:"], ["FAILS", "many:"], ["holds", "most:"], ["FAILS", "half:"]]
    assert record.exit_status() == 1


def test_a_mean_nees_fails_outside_its_band(record, capsys):
    record.judge_nees("right", [3.1] * 50)
    record.judge_nees("understated", [5.0] * 50)
    record.judge_nees("asked", [5.0] * 50, asked=(2.0, 5.5))
    assert [line[:5] for line in capsys.readouterr().out.splitlines()] == ["holds", "FAILS", "holds"]


def test_the_table_has_a_row_for_each_verdict_and_says_what_was_not_run(record, monkeypatch, tmp_path):
    import run

    (tmp_path / "benchmarks").mkdir()
    script = """
import sys
sys.path.insert(0, {here!r})
from record import exit_status, judge_largest, not_run
if "away" in sys.argv:
    not_run("no such data")
if "broken" in sys.argv:
    raise ValueError("broken")
judge_largest("error of a place", 0.5, 0.4, "px", 7)
sys.exit(exit_status())
"""
    (tmp_path / "benchmarks" / "tiny.py").write_text(script.format(here=str(ROOT / "benchmarks")))
    monkeypatch.setattr(run.record, "ROOT", tmp_path)
    monkeypatch.setattr(run, "KEPT", tmp_path)
    peers = {"peers": "", "rugged": ""}
    asked = [run.Benchmark(f"tiny {how}", how) for how in ("measured", "away", "broken")]
    asked.append(run.Benchmark("tiny beside", peer="rugged", peer_needed=True))
    outcomes = [run.run(one, full=False, peers=peers) for one in asked]
    assert [one.failed for one in outcomes] == [True, False, True, False]
    text = "\n".join(run.table(outcomes))
    assert re.search(r"^commit +\w+", text, re.MULTILINE) and "command   python" in text
    assert "| tiny measured | error of a place 0.5 px | at most 0.4 px | **no** | 7 |" in text
    assert "| tiny away | not run: no such data |" in text
    assert "| tiny broken | failed: ValueError: broken |" in text
    assert "| tiny beside | not run: no interpreter given with --rugged-python |" in text
    assert "1 figures of 4 benchmarks: 1 miss their limits, 2 benchmarks were not run, 1 failed" in text
