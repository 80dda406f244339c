"""Real `dask scheduler` and `dask worker` processes: killed, late, blind, of another version."""

import ctypes
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fixture_strips import begun

from boresight.pipeline.errors import WorkerError
from boresight.pipeline.run import cluster
from boresight.pipeline.run.cluster import Fingerprint, OnCluster, fingerprint, on_cluster
from boresight.pipeline.run.executor import executor_for

dask = pytest.importorskip("dask", reason="dask is in the extra `cluster`")
distributed = pytest.importorskip("distributed", reason="dask is in the extra `cluster`")

ROOT = Path(__file__).parents[3]
READY_S = 240.0  # s; a worker loads its libraries in 2 s on a machine that has nothing else to do


def end_with_parent() -> None:
    """Have this process killed when the one that started it ends, in whatever way (Linux)."""
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


class Processes:
    """A scheduler and its workers, started by their own command lines; `tls` are options of all of them."""

    def __init__(self, folder: Path, *tls: str) -> None:
        self.folder, self.tls, self.workers = folder, tls, []
        file = folder / "scheduler.json"
        options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
        if tls:
            options += ["--protocol", "tls"]
        self.scheduler = self._start("dask_scheduler", options, folder, ROOT)
        wait_until(lambda: file.exists() and file.read_text().endswith("}"))
        self.address = json.loads(file.read_text())["address"]

    def worker(self, code: Path = ROOT, folder: Path | None = None) -> subprocess.Popen:
        options = [self.address, "--no-nanny", "--nthreads", "2", "--no-dashboard"]
        options += ["--host", "127.0.0.1", "--death-timeout", "60"]
        self.workers.append(self._start("dask_worker", options, folder or self.folder, code))
        return self.workers[-1]

    def _start(self, module: str, options: list[str], folder: Path, code: Path) -> subprocess.Popen:
        environment = os.environ | {"PYTHONPATH": str(code)}
        command = [sys.executable, "-m", f"distributed.cli.{module}", *options, *self.tls]
        log = (self.folder / f"{module}-{len(self.workers)}.log").open("w")
        streams = {"stdout": log, "stderr": subprocess.STDOUT}
        return subprocess.Popen(command, cwd=folder, env=environment, **streams, preexec_fn=end_with_parent)

    def stop_workers(self) -> None:
        for process in self.workers:
            process.kill()
            process.wait()
        self.workers.clear()

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
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    started = Processes(tmp_path_factory.mktemp("cluster"))
    yield started
    started.stop()


@pytest.fixture(autouse=True)
def nothing_of_a_cluster_is_left() -> Iterator[None]:
    """Whether a cluster is found or not, what else this process computes with dask is computed as before, and
    no client is left."""
    before = of_dask()
    yield
    assert of_dask() == before


def of_dask() -> tuple[Any, int]:
    """What computes where nothing else is asked for, and the number of threads that serve clients."""
    loops = [thread for thread in threading.enumerate() if thread.name == "IO loop"]
    return dask.config.get("scheduler", None), len(loops)


@pytest.fixture
def two_workers(scheduler: Processes) -> Processes:
    """The scheduler with two fit workers; those that earlier tests left are used again."""
    scheduler.workers = [process for process in scheduler.workers if process.poll() is None]
    while len(scheduler.workers) < 2:
        scheduler.worker()
    return scheduler


@contextmanager
def executor(
    address: str, remarks: list[str], wait_s: float | None = READY_S, workers: int = 0
) -> Iterator[OnCluster]:
    """The executor, once so many workers are connected."""
    with on_cluster(address, [ROOT / "pyproject.toml"], wait_s, remarks.append) as ready:
        wait_until(lambda: len(ready.client.nthreads()) == workers)
        yield ready


def test_no_worker_within_the_time_is_an_error(scheduler: Processes) -> None:
    scheduler.stop_workers()
    with executor(scheduler.address, [], 0.5) as on:
        with pytest.raises(WorkerError, match=r"no usable worker at tcp://.* for 0.5 s: none is connected"):
            on.map(abs, [1], lambda n, outcome: None)


def test_workers_that_differ_are_refused_by_name_and_late_ones_are_used(scheduler, tmp_path):
    """First no worker at all; then one of other code, one with another library and a blind one; then two
    that can do the work."""
    scheduler.stop_workers()
    other, libraries = tmp_path / "code", tmp_path / "libraries"
    ours = "boresight calib gct_match geometry pipeline records simulator star_id"
    for room in ours.split():
        shutil.copytree(
            ROOT / room, other / room, symlinks=True, ignore=shutil.ignore_patterns("__pycache__")
        )
    with (other / "geometry" / "constants.py").open("a") as source:
        source.write("\n# another version\n")
    libraries.mkdir()
    (libraries / "boresight").symlink_to(ROOT / "boresight")
    (libraries / "scikit_image-0.9.dist-info").mkdir()
    (libraries / "scikit_image-0.9.dist-info" / "METADATA").write_text("Name: scikit-image\nVersion: 0.9\n")
    sighted, blind = tmp_path / "sighted", tmp_path / "blind"
    for folder in (sighted, blind):
        folder.mkdir()
    (sighted / "dump.toml").write_text("the dump")
    expected = fingerprint(["/proc/self/cwd/dump.toml"])  # a path that each process sees in its own way
    with_dump = dict.fromkeys(expected.files, cluster.content_digest(sighted / "dump.toml"))
    remarks: list[str] = []
    outcomes: list[Any] = []

    def patient(number: int) -> tuple[int, int]:
        """From the seventh on, a unit waits until two workers have begun one."""
        (tmp_path / "begun").mkdir(exist_ok=True)
        (tmp_path / "begun" / str(os.getpid())).touch()
        while number >= 6 and len(list((tmp_path / "begun").iterdir())) < 2:
            time.sleep(0.05)
        return number * number, os.getpid()

    def run() -> None:
        with distributed.Client(scheduler.address) as client:
            wanted = Fingerprint(expected.versions, expected.code, with_dump)
            on = OnCluster(client, scheduler.address, wanted, READY_S, remarks.append, {})
            outcomes.extend(on.map(patient, range(40), lambda n, outcome: done.append(n)))

    done: list[int] = []
    thread = threading.Thread(target=run)
    thread.start()
    wait_until(lambda: bool(remarks))
    assert remarks == [f"waiting for workers at {scheduler.address}: none is connected"]
    unfit = [scheduler.worker(*of) for of in ((other, sighted), (libraries, sighted), (ROOT, blind))]
    wait_until(lambda: sum("is not used" in remark for remark in remarks) == 3)
    first = scheduler.worker(folder=sighted)
    wait_until(lambda: bool(done))
    second = scheduler.worker(folder=sighted)
    thread.join(READY_S)
    assert [square for square, _ in outcomes] == [n * n for n in range(40)]
    assert {worker for _, worker in outcomes} == {first.pid, second.pid}
    told = "\n".join(remarks)
    assert "is not used: it has other code of boresight" in told
    assert f"is not used: it has scikit-image 0.9, this process {expected.versions['scikit-image']}" in told
    assert "is not used: it reads /proc/self/cwd/dump.toml differently: No such file or directory" in told
    assert f"waiting for workers at {scheduler.address}: refused: " in told
    for process in unfit:
        scheduler.workers.remove(process)
        process.kill()
        process.wait()


def test_dump_that_disappears_stops_the_run_by_name(two_workers: Processes, tmp_path: Path) -> None:
    """A file system that is unmounted must not look like images that are missing."""
    probe = tmp_path / "dump.toml"
    probe.write_text("the dump")

    def unmounted(number: int) -> str:
        probe.unlink(missing_ok=True)
        return "omitted"

    with on_cluster(two_workers.address, [probe], 1.0, lambda remark: None) as on:
        wait_until(lambda: len(on.client.nthreads()) == 2)
        with pytest.raises(WorkerError, match=r"reads .*dump.toml differently: No such file"):
            on.map(unmounted, [0, 1], lambda n, outcome: None)


def test_in_flight_are_eight_units_a_thread(two_workers: Processes) -> None:
    with executor(two_workers.address, [], workers=2) as on:
        run = cluster._Run(on, abs, range(40), lambda n, outcome: None)
        while len(run.threads) < 2:
            run._look_at_workers()
            time.sleep(0.05)
        run._submit()
        assert len(run.running) == 32  # of two workers with two threads each
        on.client.cancel(list(run.running))


def test_unit_of_a_killed_worker_is_done_by_another_and_errors_of_units_are_raised(two_workers, tmp_path):
    marker = tmp_path / "died once"

    def fragile(number: int) -> int:
        if number == 2 and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return number * number

    def full(number: int) -> int:
        raise OSError(28, "no space left", "unit")

    counts: list[int] = []
    with executor(two_workers.address, [], workers=2) as on:
        assert on.map(fragile, range(6), lambda n, outcome: counts.append(n)) == [0, 1, 4, 9, 16, 25]
        assert marker.exists() and counts == [1, 2, 3, 4, 5, 6]
        with pytest.raises(OSError, match="no space left"):  # an error of the unit itself is raised unchanged
            on.map(full, [0], lambda n, outcome: counts.append(n))


def test_outcomes_that_are_lost_with_their_worker_are_computed_by_another(two_workers: Processes) -> None:
    """The worker ends after its units and before their outcomes are fetched, and they were bound to it."""
    with executor(two_workers.address, [], workers=2) as on:
        run = cluster._Run(on, lambda n: (n, os.getpid()), range(6), lambda n, outcome: None)
        while len(run.threads) < 2:
            run._look_at_workers()
            time.sleep(0.05)
        doomed, other = two_workers.workers
        address = next(a for a, pid in on.client.run(os.getpid).items() if pid == doomed.pid)
        run.threads, run.all_accepted, run.fetch_s = {address: 2}, False, 0.5
        run._submit()
        with on.client.as_current():
            distributed.wait(list(run.running))
        doomed.kill()
        doomed.wait()
        run.look_at_s = time.monotonic() + 0.2
        end = time.monotonic() + READY_S
        while len(run.outcomes) < 6 and time.monotonic() < end:
            run.step()
        assert run.outcomes == {n: (n, other.pid) for n in range(6)}


def test_adaptive_cluster_starts_workers_for_a_run_and_more_while_it_lasts(tmp_path: Path) -> None:
    (begun := tmp_path / "begun").mkdir()

    def patient(number: int) -> int:
        (begun / str(os.getpid())).touch()
        end = time.monotonic() + READY_S
        while len(list(begun.iterdir())) < 2 and time.monotonic() < end:
            time.sleep(0.05)
        return number * number

    local = {"host": "127.0.0.1", "dashboard_address": ":0", "threads_per_worker": 1}
    with distributed.LocalCluster(n_workers=0, **local, local_directory=str(tmp_path)) as adaptive:
        adaptive.adapt(minimum=0, maximum=2, interval="100ms", target_duration="100ms")
        with executor(adaptive.scheduler_address, []) as on:
            assert on.map(patient, range(6), lambda n, outcome: None) == [0, 1, 4, 9, 16, 25]
    assert len(list(begun.iterdir())) == 2


def test_the_page_followed_by_the_letter_gives_the_result_of_one_machine(finished, tmp_path):
    """Of 14 exposures 13 are finished: the workers make an exposure and match the strip."""
    commands = (ROOT / "docs" / "cluster.md").read_text().split("```bash\n")[1].split("```")[0]
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    here = {"10.0.0.1": "127.0.0.1", "8786": port, "--nworkers 8": "--nworkers 2"}
    here |= {"/shared/dump": str(finished[0]), "/shared/result": "result"}
    for of_page, of_machine in here.items():
        commands = commands.replace(of_page, of_machine)
    scheduler, workers, command = (line.partition("#")[0].split() for line in commands.splitlines())
    assert (scheduler[:2], workers[:2]) == (["dask", "scheduler"], ["dask", "worker"])
    assert command[:2] == ["boresight", "calibrate"]
    begun(tmp_path / "result", finished, exposures=13)
    programs, started = Path(sys.executable).parent, []
    try:
        for first, *rest in (scheduler, workers):
            streams = {"stdout": (tmp_path / f"{rest[0]}.log").open("w"), "stderr": subprocess.STDOUT}
            of_dask = [programs / first, *rest]
            started.append(subprocess.Popen(of_dask, cwd=tmp_path, **streams, preexec_fn=end_with_parent))
        boresight = [programs / command[0], *command[1:], "--no-report"]
        ran = subprocess.run(boresight, cwd=tmp_path, timeout=READY_S)
    finally:
        for process in started:
            process.terminate()
            process.wait()
    assert ran.returncode == 0
    for name in ("installation.json", "sightings/targets.parquet", "sightings/stars.parquet"):
        assert (tmp_path / "result" / name).read_bytes() == (finished[1] / name).read_bytes(), name


def test_scheduler_with_certificates_deadly_units_and_lost_schedulers(tmp_path, monkeypatch):
    """Each needs a scheduler of its own: TLS, few deaths that are allowed, a scheduler that dies."""
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "0")  # workers killed by one unit
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed: no certificate for a scheduler with TLS")
    key, certificate = tmp_path / "key.pem", tmp_path / "cert.pem"
    make = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 1 -subj /CN=test"
    files = ["-keyout", str(key), "-out", str(certificate)]
    subprocess.run([*make.split(), *files], check=True, capture_output=True)
    secured = Processes(
        tmp_path, "--tls-ca-file", str(certificate), "--tls-cert", str(certificate), "--tls-key", str(key)
    )
    secured.worker()

    def deadly(number: int) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def slow(number: int) -> int:
        time.sleep(0.1)
        return number

    try:
        before = of_dask()
        with pytest.raises(WorkerError, match=r"no scheduler at tls://.*TLS") as refused:
            with executor(secured.address, []):
                pass
        assert of_dask() == before, refused  # whose frames hold the client that was refused
        comm = {"require-encryption": True, "tls.ca-file": str(certificate)}
        comm |= {"tls.client.cert": str(certificate), "tls.client.key": str(key)}
        with dask.config.set({f"distributed.comm.{name}": value for name, value in comm.items()}):
            with pytest.raises(WorkerError, match=r"unit 1 of 1: .*all those workers died"):
                with executor(secured.address, [], workers=1) as on:
                    on.map(deadly, [0], lambda n, outcome: None)
            secured.worker()
            with pytest.raises(WorkerError, match=r"lost the scheduler at tls://.*the same command resumes"):
                with executor(secured.address, [], workers=1) as on:
                    on.map(slow, range(1000), lambda n, outcome: secured.scheduler.kill() if n == 2 else None)
    finally:
        secured.stop()


def test_without_dask_the_message_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.delitem(sys.modules, "boresight.pipeline.run.cluster")
    with pytest.raises(WorkerError, match=r"pip install 'boresight\[cluster\]'"):
        with executor_for(None, "tcp://127.0.0.1:1", 0):
            pass


def test_difference_names_library_code_or_file() -> None:
    here = fingerprint([str(ROOT / "pyproject.toml")])
    assert here.difference(fingerprint(list(here.files))) == ""
    old = Fingerprint(here.versions | {"numpy": "1.0"}, here.code, here.files)
    assert here.difference(old) == f"it has numpy 1.0, this process {here.versions['numpy']}"
    assert here.difference(Fingerprint(here.versions, "x", here.files)) == "it has other code of boresight"
    assert "pyproject.toml differently" in here.difference(Fingerprint(here.versions, here.code, {}))
