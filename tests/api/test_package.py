"""The distribution: what wheel and sdist hold, what an installation adds, how soon the command answers."""

import json
import shutil
import sys
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
from outside import DEMO, ROOT, run
from pytest import approx

from boresight.version import __version__

MINI = ROOT / "fixtures" / "mini"
RESOURCE_USE = """
import resource, subprocess, sys
subprocess.run(sys.argv[1:], check=True, capture_output=True)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_utime + used.ru_stime)
"""


def site_packages(environment: Path) -> Path:
    return next((environment / "lib").glob("python*/site-packages"))


def names_in(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def test_installation_adds_one_name_to_site_packages(installed: Path) -> None:
    entries = {path.name for path in site_packages(installed.parents[1]).iterdir()} - {"dependencies.pth"}
    assert {name for name in entries if not name.endswith(".dist-info")} == {"boresight"}
    assert len(entries) == 2


def test_wheel_holds_every_tracked_source_and_the_notices(built: tuple[Path, Path]) -> None:
    tracked = run("git", "ls-files", *(f"{path.name}/" for path in (ROOT / "boresight").iterdir()), cwd=ROOT)
    rooms = {path.name for path in (ROOT / "boresight").iterdir() if path.is_symlink()}
    sources = {f"boresight/{name}" for name in tracked.split() if name.split("/")[0] in rooms}
    names = names_in(built[0])
    assert len(sources) > 150
    assert not sources - names
    assert {name.rsplit("/", 1)[-1] for name in names if "/licenses/" in name} == {"LICENSE", "NOTICE"}
    assert "boresight/py.typed" in names


@pytest.mark.parametrize("name", ["mini", "sky"])
def test_examples_of_the_wheel_are_the_fixtures_byte_for_byte(built: tuple[Path, Path], name: str) -> None:
    fixture, folder = ROOT / "fixtures" / name, f"boresight/examples/{name}/"
    with zipfile.ZipFile(built[0]) as archive:
        held = {file: archive.read(file) for file in archive.namelist() if file.startswith(folder)}
    files = {f"{folder}{path.relative_to(fixture)}": path for path in fixture.rglob("*") if path.is_file()}
    assert held == {file: path.read_bytes() for file, path in files.items()}


def test_notice_names_every_data_file_of_the_wheel(built: tuple[Path, Path]) -> None:
    notice = (ROOT / "NOTICE").read_text(encoding="utf-8")
    data = [name for name in names_in(built[0]) if "/data/" in name and not name.endswith(".md")]
    assert data
    assert not [name for name in data if name not in notice]


def test_wheel_from_the_sdist_is_the_same(built: tuple[Path, Path], tmp_path: Path) -> None:
    wheel, sdist = built
    with tarfile.open(sdist) as archive:
        archive.extraction_filter = getattr(tarfile, "data_filter", lambda member, path: member)  # 3.11.4
        archive.extractall(tmp_path)
    source = next(path for path in tmp_path.iterdir() if path.is_dir())
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path, cwd=source)
    again = next(tmp_path.glob("*.whl"))
    with zipfile.ZipFile(wheel) as first, zipfile.ZipFile(again) as second:
        assert set(first.namelist()) == set(second.namelist())
        assert not [
            name
            for name in first.namelist()
            if "RECORD" not in name and first.read(name) != second.read(name)
        ]


def test_version_names_the_commit(installed: Path, tmp_path: Path) -> None:
    commit = run("git", "rev-parse", "HEAD", cwd=ROOT)[:12]
    for command in ([installed, "-m", "boresight"], [installed.with_name("boresight")]):
        assert f"(commit {commit}" in run(*command, "--version", cwd=tmp_path)


def test_version_needs_neither_git_nor_an_installation(tmp_path: Path) -> None:
    for name in ("__init__.py", "__main__.py", "version.py"):
        (tmp_path / "boresight").mkdir(exist_ok=True)
        shutil.copy(ROOT / "boresight" / name, tmp_path / "boresight" / name)
    told = run(sys.executable, "-S", "-m", "boresight", "--version", cwd=tmp_path)
    assert told == f"boresight {__version__}\n"


def test_installed_wheel_runs_the_demo_outside_the_repository(
    installed: Path, demo: Path, tmp_path: Path
) -> None:
    shutil.copytree(demo, tmp_path, dirs_exist_ok=True)
    for unit in sorted((tmp_path / "demo-result" / "work" / "exposures").iterdir())[::4]:
        unit.unlink()  # these exposures and the first strip are the wheel's, the others the checkout's
    for matching in (tmp_path / "demo-result" / "work").glob("matching-*"):
        min(matching.iterdir()).unlink()
    run(installed, "-m", "boresight", *DEMO, "--workers", "1", cwd=tmp_path)
    validation = (installed, "-m", "boresight", "validate", "demo-result", "--dump", MINI)
    told = run(*validation, cwd=tmp_path)
    nees = next(float(line.split()[-1]) for line in told.splitlines() if line.startswith("NEES"))
    assert nees < 11.3  # chi-square, 3 degrees of freedom, 99 %
    result, made = (
        json.loads((folder / "demo-result" / "installation.json").read_text()) for folder in (tmp_path, demo)
    )
    assert result["covariance_rad2"] == made["covariance_rad2"]
    finished = "bs.calibrate('fixtures/mini', out='demo-result').R_cs.as_quat(canonical=True).tolist()"
    code = f"import boresight as bs; print(bs.__file__); print({finished})"
    where, quaternion = run(installed, "-c", code, cwd=tmp_path).splitlines()
    assert Path(where).is_relative_to(installed.parents[1])
    # a rotation made of the four numbers is normalised once more: one rounding of each
    assert json.loads(quaternion) == approx(result["quaternion"], rel=0.0, abs=np.spacing(1.0))
    variance = [row[n] for n, row in enumerate(result["covariance_rad2"])]
    assert max(variance) ** 0.5 < 10.0 / 206265.0  # rad: 10 arcsec bound the weakest axis of the demo


@pytest.mark.parametrize(
    ("arguments", "limit_s"),
    [
        (["-c", "import boresight"], 0.2),
        (["-m", "boresight", "--version"], 0.25),
        (["-m", "boresight", "--help"], 0.35),
    ],
)
def test_start_costs_little_cpu(
    installed: Path, tmp_path: Path, arguments: list[str], limit_s: float
) -> None:
    measure = [sys.executable, "-c", RESOURCE_USE, str(installed), *arguments]
    spent_s: list[float] = []
    while len(spent_s) < 4 and min(spent_s, default=np.inf) > limit_s:  # the first run compiles
        spent_s.append(float(run(*measure, cwd=tmp_path)))
    assert min(spent_s) <= limit_s
