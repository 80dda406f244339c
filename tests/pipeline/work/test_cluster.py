"""Real `dask scheduler` and `dask worker` processes: killed, late, blind, of another version."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from boresight.pipeline.errors import WorkerError
from boresight.pipeline.work import cluster
from boresight.pipeline.work.cluster import Fingerprint, OnCluster, fingerprint, on_cluster

distributed = pytest.importorskip("distributed", reason="dask is in the extra `cluster`")

ROOT = Path(__file__).parents[3]
READY_S = 240.0  # s; a worker loads its libraries in 2 s on a machine that has nothing else to do


class Processes:
    """A scheduler and its workers, started by their own command lines."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.started = folder, []
        self.file = folder / "scheduler.json"
        options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(self.file)]
        self.scheduler = self._start("dask_scheduler", options, folder, ROOT)
        wait_until(self.file.exists)
        time.sleep(0.2)
        self.address = json.loads(self.file.read_text())["address"]

    def worker(self, code: Path = ROOT, folder: Path | None = None, threads: int = 1) -> subprocess.Popen:
        options = [self.address, "--no-nanny", "--nthreads", str(threads), "--no-dashboard"]
        options += ["--host", "127.0.0.1", "--death-timeout", "60"]
        return self._start("dask_worker", options, folder or self.folder, code)

    def _start(self, module: str, options: list[str], folder: Path, code: Path) -> subprocess.Popen:
        environment = os.environ | {"PYTHONPATH": str(code)}
        command = [sys.executable, "-m", f"distributed.cli.{module}", *options]
        log = (self.folder / f"{module}-{len(self.started)}.log").open("w")
        self.started.append(
            subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=subprocess.STDOUT)
        )
        return self.started[-1]

    def stop_workers(self) -> None:
        for process in self.started[1:]:
            process.kill()
            process.wait()
        del self.started[1:]

    def stop(self) -> None:
        self.stop_workers()
        self.scheduler.kill()
        self.scheduler.wait()


def wait_until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + READY_S
    while not condition():
        assert time.monotonic() < end, "not ready in time"
        time.sleep(0.05)


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    started = Processes(tmp_path_factory.mktemp("cluster"))
    yield started
    started.stop()


@pytest.fixture
def scheduler(processes: Processes) -> Iterator[Processes]:
    """The scheduler, without workers before and after."""
    yield processes
    processes.stop_workers()


@contextmanager
def executor(address: str, remarks: list[str], wait_s: float | None = READY_S) -> Iterator[OnCluster]:
    with on_cluster(address, [ROOT / "pyproject.toml"], wait_s, remarks.append) as ready:
        yield ready


def test_workers_that_differ_are_refused_by_name_and_late_ones_are_used(
    scheduler: Processes, tmp_path: Path
) -> None:
    """First no worker at all; then one of other code and a blind one; then two that can do the work."""
    other = tmp_path / "other"
    for room in ("boresight", "calib", "gct_match", "geometry", "pipeline", "simulator", "star_id"):
        shutil.copytree(
            ROOT / room, other / room, symlinks=True, ignore=shutil.ignore_patterns("__pycache__")
        )
    with (other / "geometry" / "constants.py").open("a") as source:
        source.write("\n# another version\n")
    sighted, blind = tmp_path / "sighted", tmp_path / "blind"
    for folder in (sighted, blind):
        folder.mkdir()
    (sighted / "dump.toml").write_text("the dump")
    expected = fingerprint(["/proc/self/cwd/dump.toml"])  # a path that each process sees in its own way
    with_dump = dict.fromkeys(expected.files, cluster.content_digest(sighted / "dump.toml"))
    remarks: list[str] = []
    outcomes: list[Any] = []

    def patient(number: int) -> tuple[int, int]:
        """From the fourth on, a unit waits until two workers have begun one."""
        (tmp_path / "begun").mkdir(exist_ok=True)
        (tmp_path / "begun" / str(os.getpid())).touch()
        while number >= 4 and len(list((tmp_path / "begun").iterdir())) < 2:
            time.sleep(0.05)
        return number * number, os.getpid()

    def run() -> None:
        with distributed.Client(scheduler.address) as client:
            wanted = Fingerprint(expected.versions, expected.code, with_dump)
            on = OnCluster(client, scheduler.address, wanted, READY_S, remarks.append, {})
            outcomes.extend(on.map(patient, range(12), done.append))

    done: list[int] = []
    thread = threading.Thread(target=run)
    thread.start()
    wait_until(lambda: bool(remarks))
    assert remarks == [f"waiting for workers at {scheduler.address}: none is connected"]
    scheduler.worker(code=other, folder=sighted)
    scheduler.worker(folder=blind)
    wait_until(lambda: sum("is not used" in remark for remark in remarks) == 2)
    first = scheduler.worker(folder=sighted)
    wait_until(lambda: bool(done))
    second = scheduler.worker(folder=sighted)
    thread.join(READY_S)
    assert [square for square, _ in outcomes] == [n * n for n in range(12)]
    assert {worker for _, worker in outcomes} == {first.pid, second.pid}
    told = "\n".join(remarks)
    assert "is not used: it has other code of boresight" in told
    assert "is not used: it reads /proc/self/cwd/dump.toml differently: No such file or directory" in told
    assert f"waiting for workers at {scheduler.address}: refused: " in told


def test_unit_of_a_killed_worker_is_done_by_another_and_a_deadly_one_is_named(
    scheduler: Processes, tmp_path: Path
) -> None:
    for _ in range(2):
        scheduler.worker()
    marker = tmp_path / "died once"

    def fragile(number: int) -> int:
        if number == 2 and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return number * number

    def full(number: int) -> int:
        raise OSError(28, "no space left", "unit")

    counts: list[int] = []
    with executor(scheduler.address, []) as on:
        wait_until(lambda: len(on.client.nthreads()) == 2)
        assert on.map(fragile, range(6), counts.append) == [0, 1, 4, 9, 16, 25]
        assert marker.exists() and counts == [1, 2, 3, 4, 5, 6]
        with pytest.raises(OSError, match="no space left"):  # an error of the unit itself is raised unchanged
            on.map(full, [0], counts.append)


def test_dump_that_disappears_stops_the_run_by_name(scheduler: Processes, tmp_path: Path) -> None:
    """A file system that is unmounted must not look like images that are missing."""
    probe = tmp_path / "dump.toml"
    probe.write_text("the dump")

    def unmounted(number: int) -> str:
        probe.unlink(missing_ok=True)
        return "omitted"

    scheduler.worker()
    remarks: list[str] = []
    with on_cluster(scheduler.address, [probe], 3.0, remarks.append) as on:
        wait_until(lambda: len(on.client.nthreads()) == 1)
        with pytest.raises(
            WorkerError, match=r"no usable worker .*reads .*dump.toml differently: No such file"
        ):
            on.map(unmounted, [0, 1], lambda n: None)


def test_no_worker_within_the_time_is_an_error(scheduler: Processes) -> None:
    remarks: list[str] = []
    with executor(scheduler.address, remarks, 0.5) as on:
        with pytest.raises(WorkerError, match=r"no usable worker at tcp://.* for 0.5 s: none is connected"):
            on.map(abs, [1], lambda n: None)


def test_in_flight_are_two_units_a_thread(scheduler: Processes, tmp_path: Path) -> None:
    scheduler.worker(threads=3)
    with executor(scheduler.address, []) as on:
        wait_until(lambda: sum(on.client.nthreads().values()) == 3)
        run = cluster._Run(on, abs, range(20), lambda n: None)
        while not run.threads:
            run._look_at_workers()
            time.sleep(0.05)
        run._submit()
        assert len(run.running) == 6
        on.client.cancel(list(run.running))


def test_lost_scheduler_is_an_error_that_says_what_to_do(tmp_path: Path) -> None:
    lost = Processes(tmp_path)
    lost.worker()

    def slow(number: int) -> int:
        time.sleep(0.2)
        return number

    try:
        with pytest.raises(WorkerError, match=r"lost the scheduler at tcp://.*the same command resumes"):
            with executor(lost.address, []) as on:
                on.map(slow, range(1000), lambda n: lost.scheduler.kill() if n == 2 else None)
    finally:
        lost.stop()


def test_without_dask_the_message_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(WorkerError, match=r"pip install 'boresight\[cluster\]'"):
        with on_cluster("tcp://127.0.0.1:1", [], None, lambda text: None):
            pass


def test_difference_names_library_code_or_file() -> None:
    here = fingerprint([str(ROOT / "pyproject.toml")])
    assert here.difference(fingerprint(list(here.files))) == ""
    old = Fingerprint(here.versions | {"numpy": "1.0"}, here.code, here.files)
    assert here.difference(old) == f"it has numpy 1.0, this process {here.versions['numpy']}"
    assert here.difference(Fingerprint(here.versions, "x", here.files)) == "it has other code of boresight"
    assert "pyproject.toml differently" in here.difference(Fingerprint(here.versions, here.code, {}))
