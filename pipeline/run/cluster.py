"""Units of work spread over a dask cluster that is known by the address of its scheduler (docs/cluster.md).

A worker gets units only if it has the code and library versions of this process and reads the same probe
files (the dump's head). Eight units for each of their threads are in flight; later workers are used.
A unit whose worker fails is given to another one; what no worker can do ends the run by name.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from distributed import Client, KilledWorker, get_worker, wait

from boresight.pipeline.errors import WorkerError
from boresight.pipeline.files.content import content_digest
from boresight.pipeline.files.object_store import dump_folder
from boresight.pipeline.run.executor import InOrder
from boresight.pipeline.run.program_key import library_versions, program_digest
from boresight.records.record import record, scalar

__all__ = ["Fingerprint", "OnCluster", "fingerprint", "on_cluster"]

PER_THREAD = 8  # units in flight for each thread of the workers: enough while answers travel
# Time between two looks at the state of the cluster's workers, s.
POLL_S = 0.5
FETCH_S = 5.0  # for outcomes that a worker says it has; doubled each time it is too short
MAX_FAILURES = 3  # of one unit: workers that died under it or could not do it

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


class UnfitWorkerError(Exception):
    """A worker differs from the process that gave it a unit. Arguments: its address, and in what."""


@record
class Fingerprint:
    """What must be the same on every worker."""

    versions: dict[str, str] = scalar("of Python and of the libraries")
    code: str = scalar("digest of the program's source and data files")
    files: dict[str, str] = scalar("SHA-256 of the probe files by path; a sentence for unreadable ones")

    def difference(self, other: Fingerprint) -> str:
        """In what `other` differs, as one sentence; empty if in nothing."""
        names = [*self.versions, *(name for name in other.versions if name not in self.versions)]
        for name in names:
            if (here := self.versions.get(name)) != (there := other.versions.get(name)):
                return f"it has {name} {there}, this process {here}"
        if self.code != other.code:
            return "it has other code of boresight"
        for path, content in self.files.items():
            if (there := other.files.get(path)) != content:
                return f"it reads {path} differently: {there}"
        return ""


def fingerprint(probes: Sequence[str]) -> Fingerprint:
    """The fingerprint of this process with the content of the files `probes`."""
    files = {}
    for path in probes:
        try:
            files[path] = content_digest(dump_folder(path))
        except OSError as error:
            files[path] = f"{error.strerror or error}"
    return Fingerprint(library_versions(), program_digest("boresight.pipeline"), files)


def guarded(expected: Fingerprint, function: Callable[[Item], Outcome], item: Item) -> Outcome:
    """`function(item)` on a worker; `UnfitWorkerError` if its fingerprint differs before or after."""
    _require(expected)
    outcome = function(item)
    _require(expected)  # a file system that was unmounted meanwhile looks like missing images
    return outcome


def _require(expected: Fingerprint) -> None:
    if difference := expected.difference(fingerprint(list(expected.files))):
        raise UnfitWorkerError(get_worker().address, difference)


@record
class OnCluster:
    """An executor with a dask client. Outcomes come back in the order of the items."""

    client: Any = scalar("a `distributed.Client`")
    address: str = scalar("address of the scheduler")
    expected: Fingerprint = scalar("fingerprint that a worker must have")
    wait_s: float | None = scalar("longest time without a usable worker, s; None: no limit")
    say: Callable[[str], None] = scalar("called with remarks: waiting for workers, workers that are refused")
    refused: dict[str, str] = scalar("refused workers by address, with the reason")

    def map(
        self, function: Callable[[Item], Outcome], items: Sequence[Item], done: Callable[[int, Outcome], None]
    ) -> list[Outcome]:
        """Outcomes in the order of the items; `WorkerError` names a unit that no worker can compute."""
        run = _Run(self, partial(guarded, self.expected, function), items, done)
        try:
            while len(run.outcomes) < len(items):
                run.step()
        finally:
            run.checker.shutdown(wait=False, cancel_futures=True)
            with suppress(Exception):  # of a scheduler that is gone
                self.client.cancel(list(run.running), force=True)
        return [run.outcomes[n] for n in range(len(items))]

    def share(self, count: int) -> InOrder:
        """The worker's own process."""
        return InOrder()


class _Run:
    """One list of units on its way through the cluster."""

    def __init__(
        self,
        cluster: OnCluster,
        call: Callable[[Any], Any],
        items: Sequence[Any],
        done: Callable[[int, Any], None],
    ) -> None:
        self.cluster, self.call, self.items, self.done = cluster, call, items, done
        self.checker = ThreadPoolExecutor(max_workers=8)  # a worker may take seconds to load the libraries
        self.waiting = deque(range(len(items)))
        self.running: dict[Any, tuple[int, frozenset[str] | None]] = {}  # unit, workers it is bound to
        self.outcomes: dict[int, Any] = {}
        self.failures: Counter[int] = Counter()
        self.checks: dict[str, Any] = {}  # of workers that have joined: futures of the reason to refuse them
        self.threads: dict[str, int] = {}  # of accepted workers
        self.all_accepted = True
        self.look_at_s = 0.0  # when to ask for the workers again: the answer takes as long as a small unit
        self.idle_since: float | None = None
        self.request: Any = None  # a task that an adaptive cluster starts its first worker for
        self.said = ""
        self.fetch_s = FETCH_S

    def step(self) -> None:
        """Look at the workers, give them units, take what is finished."""
        with _scheduler_needed(self.cluster.address):
            if time.monotonic() >= self.look_at_s or not self.threads:
                self._look_at_workers()
                self.look_at_s = time.monotonic() + POLL_S
            self._submit()
            finished = self._finished()
            answers = self._fetched(finished)
        for future in finished:
            if future in answers or future.status in ("error", "cancelled"):  # else to be computed again
                self._take(future, answers)

    def _look_at_workers(self) -> None:
        client, refused = self.cluster.client, self.cluster.refused
        present: dict[str, int] = client.nthreads()
        for address in present.keys() - self.checks.keys() - refused.keys():
            self.checks[address] = self.checker.submit(_unfit, client, address, self.cluster.expected)
        for address, check in self.checks.items():
            if check.done() and (reason := check.result()):
                self._refuse(address, reason)
        self.threads = {
            address: threads
            for address, threads in present.items()
            if address not in refused and self.checks[address].done()
        }
        self.all_accepted = len(self.threads) == len(present)
        for future, (n, bound) in list(self.running.items()):
            if bound is not None and not bound & self.threads.keys():
                future.cancel()
                del self.running[future]
                self._again(n, f"its workers are gone ({', '.join(sorted(bound))})")
        self._wait_for_workers(present)

    def _wait_for_workers(self, present: dict[str, int]) -> None:
        """Say what is missing while there is no worker; `WorkerError` when that takes too long."""
        if self.threads:
            self.idle_since, self.request, self.said = None, None, ""
            return
        if not present and self.request is None:
            self.request = self.cluster.client.submit(abs, 0, pure=False)
        refused = [f"{a} ({reason})" for a, reason in self.cluster.refused.items() if a in present]
        missing = f"refused: {'; '.join(refused)}" if refused else "none is connected"
        self.idle_since = self.idle_since or time.monotonic()
        if len(refused) < len(present):  # some are being checked
            return
        if missing != self.said:
            self.cluster.say(f"waiting for workers at {self.cluster.address}: {missing}")
            self.said = missing
        if self.cluster.wait_s is not None and time.monotonic() - self.idle_since > self.cluster.wait_s:
            waited = f"no usable worker at {self.cluster.address} for {self.cluster.wait_s:g} s"
            raise WorkerError(f"{waited}: {missing}")

    def _submit(self) -> None:
        bound = None if self.all_accepted else frozenset(self.threads)
        while self.waiting and len(self.running) < PER_THREAD * sum(self.threads.values()):
            n = self.waiting.popleft()
            only = {"workers": sorted(bound), "allow_other_workers": False} if bound else {}
            future = self.cluster.client.submit(self.call, self.items[n], pure=False, retries=0, **only)
            self.running[future] = (n, bound)

    def _finished(self) -> list[Any]:
        if not self.running:
            time.sleep(POLL_S)
            return []
        with self.cluster.client.as_current(), suppress(TimeoutError):
            return list(wait(list(self.running), timeout=POLL_S, return_when="FIRST_COMPLETED").done)
        return []

    def _fetched(self, finished: Sequence[Any]) -> dict[Any, Any]:
        """Outcomes of computed units, fetched at once: one by one each waits for an answer of its own. Empty
        if they do not come: a worker was lost with them, whose units the scheduler or `step` gives to others.
        """
        client, good = self.cluster.client, [future for future in finished if future.status == "finished"]

        async def together() -> Any:
            return await client.gather(good, asynchronous=True)

        try:
            answers = dict(zip(good, client.sync(together, callback_timeout=self.fetch_s)))
        except TimeoutError:
            self.fetch_s *= 2.0  # they may only be large
            return {}
        except Exception:  # of a unit or of the scheduler; both say it themselves
            return {}
        self.fetch_s = FETCH_S
        return answers

    def _take(self, future: Any, answers: Mapping[Any, Any]) -> None:
        n, _ = self.running.pop(future)
        try:
            self.outcomes[n] = answers[future] if future in answers else future.result()  # its error
        except UnfitWorkerError as error:
            address, reason = error.args
            self._refuse(address, reason)
            self._again(n, f"worker {address} cannot do it: {reason}")
        except KilledWorker as error:
            raise WorkerError(f"unit {n + 1} of {len(self.items)}: {error}") from error
        except (ImportError, CancelledError) as error:  # a worker without boresight; a restarted scheduler
            self._again(n, f"{type(error).__name__}: {error}")
        else:
            future.release()
            self.done(len(self.outcomes), self.outcomes[n])

    def _refuse(self, address: str, reason: str) -> None:
        if address not in self.cluster.refused:
            self.cluster.refused[address] = reason
            self.cluster.say(f"worker {address} is not used: {reason}")
        self.threads.pop(address, None)

    def _again(self, n: int, reason: str) -> None:
        self.failures[n] += 1
        if self.failures[n] == MAX_FAILURES:
            unit = f"unit {n + 1} of {len(self.items)}"
            raise WorkerError(f"{unit} failed {MAX_FAILURES} times; last: {reason}")
        self.waiting.appendleft(n)


def _unfit(client: Any, address: str, expected: Fingerprint) -> str:
    """Why a worker cannot be used; empty if it can."""
    try:
        answers = client.run(fingerprint, list(expected.files), workers=[address], on_error="return")
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    answer = answers.get(address)
    if isinstance(answer, Fingerprint):
        return expected.difference(answer)
    return f"{type(answer).__name__}: {answer}"


@contextmanager
def _scheduler_needed(address: str) -> Iterator[None]:
    """`WorkerError` if the scheduler cannot be reached."""
    try:
        yield
    except (OSError, TimeoutError, CancelledError, RuntimeError) as error:
        said = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise WorkerError(
            f"lost the scheduler at {address} ({said}); finished units are kept, the same command resumes"
        ) from error


class _Client(Client):
    """A client that is closed where it finds no scheduler. One that is left half made is closed when it is
    collected; if that happens while another one starts, both wait for each other for ever.
    """

    def start(self, **options: Any) -> None:
        """Connect; the errors are those of dask."""
        try:
            super().start(**options)
        except BaseException:
            self.close()
            raise


@contextmanager
def on_cluster(
    address: str, probes: Sequence[Path], wait_s: float | None, say: Callable[[str], None]
) -> Iterator[OnCluster]:
    """The executor on the cluster of the scheduler at `address`; `WorkerError` if there is none."""
    try:
        client = _Client(address, timeout=30, set_as_default=False)  # the process may have one of its own
    except (OSError, TimeoutError, ValueError, TypeError) as error:  # TypeError: TLS is not configured
        raise WorkerError(f"no scheduler at {address}: {error}") from error
    try:
        expected = fingerprint([str(path.resolve()) for path in probes])
        yield OnCluster(client, address, expected, wait_s, say, {})
    finally:
        # of a lost scheduler, whose connection is just being secured once more, it fails with a ValueError
        with suppress(OSError, TimeoutError, CancelledError, RuntimeError, ValueError):
            client.close()
