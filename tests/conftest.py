"""Where tests write, and what several rooms use: small dumps, one result, the demo, and the wheel in an
environment of its own.
"""

import contextlib
import fcntl
import gc
import os
import shutil
import sys
import sysconfig
import tempfile
import venv
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
from captured import wide_rows
from click.testing import CliRunner, Result
from fixture_strips import strip_of_fixture
from handmade import write_handmade_dump
from outside import DEMO, ROOT, run

IN_MEMORY = Path("/dev/shm")
ROOM_BYTES = 4 * 2**30  # some four times what a run of all tests writes


def pytest_configure() -> None:
    """Temporary files in memory where it has room: a disk takes milliseconds to flush or to remove each of
    some 15 000. No search for garbage while libraries and tests are loaded, or of them afterwards.
    """
    if "TMPDIR" not in os.environ and has_room(IN_MEMORY):
        os.environ["TMPDIR"], tempfile.tempdir = str(IN_MEMORY), None
    gc.disable()


def has_room(folder: Path) -> bool:
    """Whether a folder can hold what all tests write, programs among it."""
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        return False
    system = os.statvfs(folder)
    return system.f_bavail * system.f_frsize >= ROOM_BYTES and not system.f_flag & os.ST_NOEXEC


def pytest_collection_finish() -> None:
    """See `pytest_configure`."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with tests of what is built once come first: one process makes it and no other waits. A file
    stays whole, so that its fixtures are made once.
    """
    built = {item.path for item in items if {"demo", "installed"} & set(getattr(item, "fixturenames", ()))}
    items.sort(key=lambda item: item.path not in built)


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], object]], Path]:
    """Folder NAME, filled by a function: the first process of the test run makes it, the others wait."""
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent

    def folder_of(name: str, fill: Callable[[Path], object]) -> Path:
        folder = shared / name
        with (shared / f"{name}.lock").open("w") as lock:
            fcntl.lockf(lock, fcntl.LOCK_EX)
            if not folder.exists():
                folder.mkdir()
                fill(folder)
        return folder

    return folder_of


@pytest.fixture(scope="session")
def built(made_once) -> tuple[Path, Path]:
    """Wheel and sdist of the working tree."""
    build = (sys.executable, "-m", "hatchling", "build", "-d")
    folder = made_once("dist", lambda folder: run(*build, folder, cwd=ROOT))
    return next(folder.glob("*.whl")), next(folder.glob("*.tar.gz"))


@pytest.fixture(scope="session")
def installed(built: tuple[Path, Path], made_once) -> Path:
    """Python of an environment that holds the wheel alone; the dependencies come from the present one."""

    def fill(folder: Path) -> None:
        venv.create(folder, with_pip=False)
        python = folder / "bin" / "python"
        pip = (sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps")
        run(*pip, "--no-compile", "--no-index", built[0], cwd=folder)
        packages = next((folder / "lib").glob("python*/site-packages"))
        (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")

    return made_once("environment", fill) / "bin" / "python"


@pytest.fixture(scope="session")
def demo(made_once) -> Path:
    """Folder outside the repository with `fixtures/mini`, its truth not among it, `demo-result`, which the
    command has made from it, and `printed`, what it printed. Read only.
    """
    from command_line import ran  # loads all features, which the process that hands out tests never needs

    def fill(folder: Path) -> None:
        shutil.copytree(
            ROOT / "fixtures" / "mini", folder / "fixtures" / "mini", ignore=shutil.ignore_patterns("truth")
        )
        with contextlib.chdir(folder):
            (folder / "printed").write_text(ran(*DEMO, "--workers", 1).stdout)

    return made_once("demo", fill)


@pytest.fixture(autouse=True, scope="session")
def tables_keep_to_a_terminal() -> Iterator[None]:
    """Every command that any test or fixture runs to its end prints tables of 80 columns at most."""
    asked = CliRunner.invoke

    def invoke(self: CliRunner, *given: object, **named: object) -> Result:
        done = asked(self, *given, **named)
        assert not (wide := wide_rows(done.stdout)), wide
        return done

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CliRunner, "invoke", invoke)
        yield


@pytest.fixture
def handmade(tmp_path: Path) -> Path:
    """A fresh dump written by hand; a test may damage it as it likes."""
    return write_handmade_dump(tmp_path / "handmade")


@pytest.fixture
def one_strip(tmp_path: Path) -> Path:
    """The first strip of `fixtures/mini` and the exposures around it, without truth."""
    return strip_of_fixture(tmp_path / "one-strip", 1)


@pytest.fixture(scope="session")
def finished(made_once) -> tuple[Path, Path]:
    """One strip of the fixture, carried through by the command itself: the dump and its result. Read only."""
    from command_line import ran

    def fill(folder: Path) -> None:
        dump = strip_of_fixture(folder / "dump", 1)
        ran("calibrate", dump, "--out", folder / "result", "--workers", 1)

    folder = made_once("finished", fill)
    return folder / "dump", folder / "result"


@pytest.fixture
def few_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten example strips of each planned campaign, where only the order of their errors counts."""
    from boresight.features.planning import campaign_plan
    from boresight.pipeline.forecast import campaigns

    monkeypatch.setattr(campaign_plan, "DRAWS", 1)
    monkeypatch.setattr(campaign_plan, "PLAN_DRAWS", 10)
    monkeypatch.setattr(campaigns, "PLAN_DRAWS", 10)
    monkeypatch.setattr(campaign_plan, "forecast_of_plan", partial(campaigns.forecast_of_plan, draws=10))
