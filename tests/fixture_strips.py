"""Single strips of the committed `fixtures/mini` as dumps of their own."""

import csv
import datetime
import shutil
from pathlib import Path

from boresight.pipeline.results.ownership import claimed
from boresight.pipeline.run.settings import Settings

FIXTURE = Path(__file__).parents[1] / "fixtures" / "mini"


def stopped_run(out: Path, dumps: list[Path], finished: Path | None = None) -> None:
    """Make `out` the folder of a run over `dumps` that was stopped, with the units of a finished result."""
    with claimed(out, dumps, Settings()):
        pass
    if finished is not None:
        shutil.copytree(finished / "work", out / "work")


def begun(out: Path, finished: tuple[Path, Path], *, exposures: int) -> None:
    """Make `out` the folder of a run that was stopped after so many exposures of the finished one's 14."""
    stopped_run(out, [finished[0]], finished[1])
    for unit in sorted((out / "work" / "exposures").iterdir())[exposures:]:
        unit.unlink()
    for matching in (out / "work").glob("matching-*"):
        shutil.rmtree(matching)


def strip_of_fixture(root: Path, number: int) -> Path:
    """Copy of the fixture with one of its strips only, from 1."""
    root.mkdir()
    for name in ("dump.toml", "star_camera.toml", "remote_camera.toml", "installation.toml", "orbit.oem"):
        shutil.copy(FIXTURE / name, root / name)
    shutil.copytree(FIXTURE / "terrain", root / "terrain")
    strips = _rows("strips.csv")
    begins = {row[0]: row[3] for row in strips[1:]}
    chosen = sorted(begins)[number - 1]
    _write(root / "strips.csv", [strips[0], *(row for row in strips[1:] if row[0] == chosen)])
    targets = _rows("targets.csv")
    _write(root / "targets.csv", [targets[0], *(row for row in targets[1:] if row[0].startswith(chosen))])
    exposures = _rows("exposures.csv")
    since = _seconds_before(begins[chosen])
    until = min((_seconds_before(utc) for utc in begins.values() if utc > begins[chosen]), default="9")
    _write(root / "exposures.csv", [exposures[0], *(row for row in exposures[1:] if since < row[2] < until)])
    for table, column in (("strips.csv", 2), ("targets.csv", 8), ("exposures.csv", 1)):
        for row in _read(root / table)[1:]:
            (root / row[column]).parent.mkdir(exist_ok=True)
            shutil.copy(FIXTURE / row[column], root / row[column])
    return root


def _seconds_before(utc: str) -> str:
    """Text that sorts before the exposures of the strip that begins at `utc`."""
    before = datetime.datetime.fromisoformat(utc[:23]) - datetime.timedelta(seconds=5.0)
    return before.isoformat(timespec="milliseconds")


def _rows(name: str) -> list[list[str]]:
    return _read(FIXTURE / name)


def _read(path: Path) -> list[list[str]]:
    with path.open(newline="") as stream:
        return list(csv.reader(stream))


def _write(path: Path, rows: list[list[str]]) -> None:
    with path.open("w", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerows(rows)
