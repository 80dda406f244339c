"""The state of a run: what is finished, what it still needs, and what is not used, with reasons."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from boresight.geometry.sightings import StarSightings
from boresight.pipeline.calibration.rounds import is_settled
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.record_tables import record_from_table
from boresight.pipeline.files.text_files import json_if_there
from boresight.pipeline.results.folder import dumps_in
from boresight.pipeline.results.ownership import dump_folder_of
from boresight.pipeline.results.reading import read_findings
from boresight.pipeline.results.sightings_tables import COLUMNS, read_sightings
from boresight.pipeline.results.summary import finding_lines, omission_lines
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.run.stage_words import stage_words
from boresight.pipeline.run.unit_store import read_meta, read_unit
from boresight.pipeline.stages.coverage import covers
from boresight.pipeline.stages.exposure import star_tasks
from boresight.pipeline.stages.strip import MatchedTargets
from boresight.records.ledger import Entry
from boresight.records.record import record, scalar
from boresight.star_id.strip_stars.find import StripStars

__all__ = ["kept_units", "run_status", "saved_omissions", "status_lines"]

OUTCOMES = (StarSightings, MatchedTargets, StripStars, Entry)  # records that a finished unit may hold


@record
class StageStatus:
    """One stage of a run: its exposures or strips."""

    stage: str = scalar("exposures, matching-0 (searched widely), matching-1, matching-2")
    done: tuple[str, ...] = scalar("names of the finished units")
    damaged: int = scalar("files that will be made anew")
    not_used: int = scalar("exposures, strips and targets that its units could not use")
    missing: tuple[str, ...] = scalar("names of the units that the run still needs, as far as known")
    settled: tuple[str, ...] = scalar("strips that need no further matching", default=())


@record(kw_only=True)
class RunStatus:
    """A run, finished or not; of several dumps, what is joint and the run of each dump."""

    folder: str = scalar("folder of the run")
    begun: bool = scalar("whether the folder of the run is there")
    finished: bool = scalar("whether installation.json is there", default=False)
    outcome: str = scalar("outcome of the verdict; empty where there is none", default="")
    stages: tuple[StageStatus, ...] = scalar("in the order of the calculation", default=())
    omissions: tuple[dict[str, Any], ...] = scalar("what is not used so far, rows of the ledger", default=())
    findings: tuple[dict[str, Any], ...] = scalar("what the report asks to look at", default=())
    unknown: str = scalar("why it is not known what is missing; empty where it is known", default="")
    dumps: tuple[RunStatus, ...] = scalar("of a joint result: the runs of its dumps", default=())


def run_status(result: Path) -> RunStatus:
    """The state of the run in a folder; `RawDataError` for a folder that is not one of a run."""
    if names := dumps_in(result):
        folders = [result / name for name in names]
        dumps = tuple(
            run_status(one) if one.is_dir() else RunStatus(folder=str(one), begun=False) for one in folders
        )
        return _status(result, (), saved_omissions(result), dumps=dumps)
    work = result / "work"
    if not work.is_dir() and not (result / "installation.json").is_file():
        raise RawDataError(str(result), "folder", "no run", "a folder that `boresight calibrate` wrote")
    stages, omissions = [], list[dict[str, Any]]()
    for folder in sorted(path for path in work.iterdir() if path.is_dir()) if work.is_dir() else []:
        stage, failed = _stage(folder)
        stages.append(stage)
        omissions += failed
    if (result / "installation.json").is_file():
        return _status(result, stages, saved_omissions(result))
    try:
        dump = open_dump(dump_folder_of(result), allow_stale_eop=True)
        return _status(result, _with_missing(stages, dump), omissions)
    except (RawDataError, OSError) as error:
        return _status(result, stages, omissions, unknown=f"what is missing is not known: {error}")


def status_lines(status: RunStatus) -> list[str]:
    """The state as text: counts, every item that is not used with its reason, what is still needed."""
    lines = []
    for one in status.dumps:
        text = status_lines(one) if one.begun else ["not begun"]
        lines += [f"dump {Path(one.folder).name}", *("  " + line for line in text)]
    for stage in status.stages:
        damaged = f", {stage.damaged} damaged files" if stage.damaged else ""
        not_used = f", {stage.not_used} not used" if stage.not_used else ""
        lines.append(f"{stage_words(stage.stage):26s}{len(stage.done)} done{damaged}{not_used}")
    lines += finding_lines(status.findings)
    if status.omissions or not status.dumps:
        lines += omission_lines(status.omissions, None)
    for stage in status.stages:
        if stage.missing and not status.finished:
            names = ", ".join(stage.missing[:8]) + (" ..." if len(stage.missing) > 8 else "")
            lines.append(f"{'needs':26s}{stage_words(stage.stage)}: {len(stage.missing)} more: {names}")
    lines += [status.unknown] if status.unknown else []
    whole = "all dumps together: " if status.dumps else ""
    if not status.finished:
        unfinished = "not finished: no installation.json yet; the same `boresight calibrate` goes on"
        return [*lines, f"{whole}{unfinished}"]
    return [*lines, f"{whole}finished" + (f", verdict {status.outcome}" if status.outcome else "")]


def kept_units(result: Path) -> str:
    """What a run that is interrupted has finished, for a message."""
    stores = (result / "work", *(dump / "work" for dump in result.glob("*")))
    folders = sorted(path for store in stores for path in store.glob("*"))
    counts = [(path.name, len(list(path.glob("*.parquet")))) for path in folders if path.is_dir()]
    done = ", ".join(f"{n} of {stage_words(name)}" for name, n in counts if n)
    return f"finished units are kept in {result}: {done}" if done else f"no unit is finished yet in {result}"


def _status(
    result: Path,
    stages: list[StageStatus] | tuple[()],
    omissions: list[dict[str, Any]],
    *,
    unknown: str = "",
    dumps: tuple[RunStatus, ...] = (),
) -> RunStatus:
    path = result / "installation.json"
    verdict = json_if_there(path).get("verdict")
    return RunStatus(
        folder=str(result),
        begun=True,
        finished=path.is_file(),
        outcome=str(verdict.get("outcome", "")) if isinstance(verdict, dict) else "",
        stages=tuple(stages),
        omissions=tuple(omissions),
        findings=tuple(read_findings(result)) if path.is_file() else (),
        unknown=unknown,
        dumps=dumps,
    )


def _stage(folder: Path) -> tuple[StageStatus, list[dict[str, Any]]]:
    done, damaged, failed, settled = [], 0, list[dict[str, Any]](), []
    for path in sorted(folder.glob("*.parquet")):
        if (unit := read_unit(path)) is None:
            damaged += 1
            continue
        done.append(name := path.name.rsplit(".", 2)[0])
        outcome = record_from_table(OUTCOMES, unit, read_meta(unit))
        if isinstance(outcome, Entry):
            failed.append(outcome.row)
        elif isinstance(outcome, MatchedTargets):
            failed += [entry.row for entry in outcome.omissions]
            settled += [name] if is_settled(outcome, Settings().run.settled_px) else []
    return StageStatus(folder.name, tuple(done), damaged, len(failed), (), tuple(settled)), failed


def saved_omissions(result: Path) -> list[dict[str, Any]]:
    """What a finished result does not use, a row each (`Entry.row`)."""
    return read_sightings(result, "ledger", " ".join(COLUMNS["ledger"])).to_pylist()


def _with_missing(stages: list[StageStatus], dump: Dump) -> list[StageStatus]:
    """The stages with the units of the dump that are not finished; at least exposures and both matchings."""
    found = {stage.stage: stage for stage in stages}
    tasks = [task for images in dump.star_images for task in star_tasks(dump, images, Settings().stars)[0]]
    exposures = [task.item.subject.name for task in tasks]
    strips = [strip.strip_id for strip in dump.strips if covers(dump, strip)]
    wanted = {"exposures": exposures}
    if strips:
        searched = found["matching-0"].done if "matching-0" in found else ()
        wanted |= {"matching-0": list(searched)} if searched else {}
        settled = {strip for stage in stages for strip in stage.settled}
        again = [strip for strip in strips if strip not in settled]
        wanted |= {"matching-1": [s for s in strips if s not in searched], "matching-2": again}
    if sky := [strip.strip_id for strip in dump.sky_strips if covers(dump, strip)]:
        wanted["sky-stars"] = sky
    return [
        dataclasses.replace(stage, missing=tuple(one for one in names if one not in stage.done))
        for name, names in wanted.items()
        for stage in [found.get(name, StageStatus(name, (), 0, 0, ()))]
    ]
