"""From dumps to finished result folders: what `boresight calibrate` does once everything has been opened.

One dump fills the folder. Of several, or of several cameras of one dump, each fills a folder of its own in
it, by its name, and the folder itself gets what is joint: the matrix from all of them, a matrix for each
camera, and the drift between dumps.
"""

from __future__ import annotations

import logging
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from boresight.calib.verdict import Outcome
from boresight.pipeline.calibration.calibrate import DumpCalibration, calibrate_dump
from boresight.pipeline.calibration.joint import calibrate_jointly
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.record_tables import plain
from boresight.pipeline.files.text_files import read_json
from boresight.pipeline.files.whole_file import make_own_folder, write_json
from boresight.pipeline.report.dumps_page import write_dumps_report
from boresight.pipeline.report.evidence import write_evidence, write_joint_evidence
from boresight.pipeline.report.page import write_no_result, write_report
from boresight.pipeline.results import summary, writing
from boresight.pipeline.results.folder import DUMPS, begin_result, results_in, store_of
from boresight.pipeline.results.identity import write_about
from boresight.pipeline.results.ownership import claimed
from boresight.pipeline.results.reading import read_findings, read_installation
from boresight.pipeline.results.requirement import (
    Requirement,
    is_met,
    requirement_lines,
    saved_requirement,
    write_requirement,
)
from boresight.pipeline.results.status import kept_units, saved_omissions
from boresight.pipeline.run.cached import Progress
from boresight.pipeline.run.executor import Executor, InOrder
from boresight.pipeline.run.run_inputs import RunInputs, inputs_of
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.run.several_dumps import NamedDump
from boresight.pipeline.run.unit_store import UnitStore
from boresight.records.ledger import Entry, Kind, Reason, Subject
from boresight.records.record import record, scalar

log = logging.getLogger("boresight.commands")

__all__ = ["RunOutcome", "RunRequest", "going_on", "run_dump", "run_dumps", "saved_content"]


@record(kw_only=True)
class RunRequest:
    """How a run is to be done, and what run.json is to say of it."""

    settings: Settings = scalar("of all stages")
    report: bool = scalar("write evidence and report.html", default=True)
    begun_s: float = scalar("time.perf_counter() at its start")
    overwrite: bool = scalar("replace a result of another dump or of other settings", default=False)
    requirement: Requirement = scalar("accuracy that the report compares with", default=Requirement())
    about: Path | None = scalar("TOML file of what the operator says of the result", default=None)
    facts: dict[str, Any] = scalar("for run.json: workers, machine, versions")
    executor: Executor = scalar("computes exposures and strips", default=InOrder())
    progress: Progress = scalar("told stage, tasks done, all tasks", default=lambda stage, done, total: None)
    after_joint: tuple[Callable[[Path, list[str]], str], ...] = scalar(
        "called with the folder and the names of several dumps, returns lines to print", default=()
    )


@record
class RunOutcome:
    """Outcome of a run, for the terminal and the exit status."""

    text: str = scalar("summary for the terminal")
    outcomes: frozenset[Outcome] = scalar("verdicts of the result and of its dumps")
    is_met: bool = scalar("whether the required accuracy is reached, or none is required")


@contextmanager
def going_on(out: Path) -> Iterator[None]:
    """When the run is interrupted, say what is kept and how to go on."""
    try:
        yield
    except KeyboardInterrupt:
        command, folder = shlex.join(["boresight", *sys.argv[1:]]), shlex.quote(str(out))
        look = f"look at it with: boresight status {folder}"
        log.info("%s", f"{kept_units(out)}\ngo on with: {command}\n{look}")
        raise


def saved_content(out: Path) -> dict[str, Any]:
    """What a finished result holds, for --json: installation.json, what to look at, what is not used."""
    return {
        "installation": read_json(out / "installation.json"),
        "findings": read_findings(out),
        "omitted": [plain(omission) for omission in saved_omissions(out) or ()],
    }


def run_dump(out: Path, dump: Dump, named: str, request: RunRequest) -> RunOutcome:
    """Calibrate one dump, `named` so by the user, into `out`."""
    with claimed(out, [dump.root], request.settings, overwrite=request.overwrite):
        inputs = inputs_of([dump], request.settings)
        if (kept := _kept(out, inputs, request, write_report)) is not None:
            return kept
        found = _calibrated(out, dump, named, inputs, request)
        log.debug("%s", "\n".join(summary.omission_lines([entry.row for entry in found.omissions], None)))
        return _outcome(out, summary.calibration_summary(found, read_findings(out)), [found.verdict.outcome])


def run_dumps(out: Path, dumps: Sequence[NamedDump], request: RunRequest) -> RunOutcome:
    """Calibrate dumps of one mission, each and jointly; one whose data do not suffice is only counted."""
    roots = list(dict.fromkeys(one.dump.root for one in dumps))
    with claimed(out, roots, request.settings, overwrite=request.overwrite):
        inputs = inputs_of([named.dump for named in dumps], request.settings)
        if (kept := _kept(out, inputs, request, write_dumps_report)) is not None:
            return kept
        begin_result(out)
        write_json(out / DUMPS, {"dumps": [named.name for named in dumps]})
        calibrated: list[tuple[NamedDump, DumpCalibration]] = []
        failed: list[Entry] = []
        stores: dict[Path, Path] = {}  # folder of the first camera of each dump: all share its star exposures
        for named in dumps:

            def report_progress(stage: str, done: int, total: int, name: str = named.name) -> None:
                request.progress(f"{name}: {stage}", done, total)

            try:
                folder, root = out / named.name, named.dump.root
                make_own_folder(folder)
                with claimed(folder, [root], request.settings, overwrite=request.overwrite):
                    own = inputs_of([named.dump], request.settings)
                    store = store_of(stores.setdefault(root, folder).resolve())
                    of_dump = replace(request, progress=report_progress)
                    found = _calibrated(folder, named.dump, str(root), own, of_dump, store)
            except DataNotSufficientError as error:
                subject = Subject(Kind.DUMP, dump=named.name)
                failed.append(Entry(subject, Reason.NOT_CALIBRATED, str(error)))
            else:
                calibrated.append((named, found))
        joint = calibrate_jointly(calibrated, failed, request.settings)
        of_dumps = {named.name: found for named, found in calibrated}
        text = summary.joint_summary(of_dumps, joint)
        if len({named.dump.root for named, _ in calibrated}) > 1 and len(joint.estimate.cameras) == 1:
            text = "\n".join([text, *(further(out, list(of_dumps)) for further in request.after_joint)])
        writing.write_joint_result(out, joint, of_dumps, request.settings)
        places = {named.name: str(named.dump.root) for named in dumps}
        _note(out, request, {"dumps": places, "inputs": inputs.digest()})
        if request.report:
            write_joint_evidence(out, joint)
            write_dumps_report(out)
        outcomes = [joint.verdict.outcome, *(found.verdict.outcome for _, found in calibrated)]
        return _outcome(out, text, outcomes)


def _calibrated(
    out: Path, dump: Dump, named: str, inputs: RunInputs, request: RunRequest, store: UnitStore | None = None
) -> DumpCalibration:
    begin_result(out)
    make_own_folder(out / "work")
    store = store or store_of(out.resolve())
    try:
        found = calibrate_dump(dump, request.settings, store, request.executor, request.progress)
    except DataNotSufficientError as error:
        if request.report:
            write_no_result(out, dump, error)
        raise
    write = partial(writing.write_sightings, out, found)
    if request.report:
        write_evidence(out, dump, found, request.settings, request.executor, [write])
    else:
        write()
    writing.write_installation(out, found, request.settings)
    counts = {"units_made": found.n_computed, "units_found": found.n_reused}
    _note(out, request, {"dump": named, "inputs": inputs.digest()}, counts)
    if request.report:
        write_report(out)
    return found


def _outcome(out: Path, text: str, outcomes: Iterable[Outcome]) -> RunOutcome:
    """The outcome of a run, and whether the matrix in its folder meets the accuracy required of it."""
    required = saved_requirement(out), read_installation(out)
    return RunOutcome(
        "\n".join([text, *requirement_lines(*required)]), frozenset(outcomes), is_met(*required)
    )


def _kept(
    out: Path, inputs: RunInputs, request: RunRequest, draw: Callable[[Path], Path]
) -> RunOutcome | None:
    """The outcome of a finished result of the same inputs, drawn anew where more is stated of it; None where
    there is none. Requirement and operator's words are kept beside the result.
    """
    stated = write_about(out, request.about) | write_requirement(out, request.requirement)
    needed = ("installation.json", "run.json", *(("report.html",) if request.report else ()))
    digest = None
    if all((out / name).is_file() for name in needed):
        with suppress(RawDataError):
            digest = read_json(out / "run.json", "run.json").get("inputs")
    if not digest or digest != inputs.digest():
        return None
    if stated and request.report:
        draw(out)
    return _finished(out)


def _finished(out: Path) -> RunOutcome:
    """The outcome of the run that made a finished result."""
    lines = [f"nothing to do: {out} holds the finished result of these inputs and settings"]
    outcomes = set()
    for result in {out, *results_in(out)}:
        verdict = read_installation(result)["verdict"]
        outcomes.add(outcome := Outcome(verdict["outcome"]))
        lines += summary.verdict_lines(verdict) if outcome is not Outcome.CONSISTENT else []
        lines += summary.finding_lines(read_findings(result))
    return _outcome(out, "\n".join(lines), outcomes)


def _note(
    out: Path, request: RunRequest, dumps: dict[str, Any], counts: dict[str, int] | None = None
) -> None:
    times = {
        "finished_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "elapsed_s": time.perf_counter() - request.begun_s,
    }
    writing.write_run(out, dumps | times | (counts or {}) | request.facts)
