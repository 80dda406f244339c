"""`boresight calibrate`: the installation matrix from raw images."""

from __future__ import annotations

import platform
import shlex
import sys
import time
import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import typer

from boresight.calib.verdict import Outcome
from boresight.pipeline import __version__, calibration_run
from boresight.pipeline.console import arguments, messages
from boresight.pipeline.console.arguments import option
from boresight.pipeline.console.feature import hooks_of
from boresight.pipeline.console.progress import progress_bars
from boresight.pipeline.results.requirement import Requirement
from boresight.pipeline.run.executor import executor_for
from boresight.pipeline.run.settings import read_settings
from boresight.pipeline.run.several_dumps import open_dumps
from boresight.version import commit

__all__ = ["calibrate_command"]

# Distributions whose versions run.json states.
REPORTED_PACKAGES = "numpy scipy opencv-python-headless astropy astropy-iers-data pyerfa pyproj".split()


def _folder(text: str) -> Path:
    if not text.strip():
        raise typer.BadParameter("is empty; name a folder")
    return Path(text)


def calibrate_command(
    context: typer.Context,
    dumps: arguments.DumpsArgument,
    out: Path = option(
        "Folder of the result: new, empty, or that of a run to be resumed.",
        ...,
        parser=_folder,
        metavar="PATH",
    ),
    settings: arguments.SettingsFile = None,
    workers: int | None = option(
        "Processes on this machine; default: one a core, one for a small dump.", min=1
    ),
    scheduler: str | None = option("Address of a dask scheduler instead (docs/cluster.md)."),
    worker_timeout: float | None = option("Longest wait for a usable worker of the scheduler, s.", min=0.0),
    allow_stale_eop: arguments.StaleEop = False,
    report: bool = option("Write report.html at the end.", True),
    require_arcsec: arguments.RequireArcsec = None,
    require_m: arguments.RequireMetres = None,
    about: arguments.AboutFile = None,
    accept: list[messages.Accepted] | None = option(
        "Do not fail for this: exit with 0. May be given several times."
    ),
    overwrite: bool = option("Replace a result of another dump or of other settings.", False, "--overwrite"),
    archive: Path | None = option("Add the result to the archive of a mission in this folder (`trends`)."),
) -> messages.Answer:
    """Estimate the installation matrix of a dump from raw images; of several dumps, of each and of all; of
    several cameras, of each.

    Example: boresight calibrate dump --out result
    """
    if workers is not None and scheduler is not None:
        raise messages.wrong_usage("--workers and --scheduler exclude one another")
    begun_s = time.perf_counter()
    request = calibration_run.RunRequest(
        settings=read_settings(settings),
        report=report,
        begun_s=begun_s,
        overwrite=overwrite,
        requirement=Requirement(require_arcsec, require_m),
        about=about,
        after_joint=hooks_of(context.obj, "after_joint") if len(dumps) > 1 else (),
        facts={"workers": workers, "scheduler": scheduler} | _machine(),
    )
    to_archive = () if archive is None else hooks_of(context.obj, "to_archive")
    if archive is not None and not to_archive:
        raise messages.wrong_usage("--archive: this installation has no feature that keeps an archive")
    with _warnings_reported():
        several = open_dumps(dumps, request.settings, allow_stale_eop=allow_stale_eop)
    opened = [named.dump for named in several]
    probes, pixels = [dump.root / "dump.toml" for dump in opened], sum(dump.pixels for dump in opened)
    machine = executor_for(workers, scheduler, pixels, probes=probes, wait_s=worker_timeout, say=messages.say)
    with calibration_run.going_on(out), progress_bars() as progress, machine as executor:
        request = replace(request, executor=executor, progress=progress)
        if len(several) == 1:
            outcome = calibration_run.run_dump(out, opened[0], str(dumps[0]), request)
        else:
            outcome = calibration_run.run_dumps(out, several, request)
    for add in to_archive:
        add([out], archive)
    files = (out / "installation.json", *([out / "report.html"] if report else []))
    took = f"{time.perf_counter() - begun_s:.1f} s -> {files[0]}{', report.html' if report else ''}"
    return messages.Answer(
        text=f"{outcome.text}\n{took}",
        line=f"{_gravest(outcome)} -> {files[0]}",
        content=calibration_run.saved_content(out),
        files=files,
        exit_status=_exit_status(outcome, accept or ()),
    )


def _gravest(outcome: calibration_run.RunOutcome) -> str:
    """The gravest of a run's verdicts, and whether the required accuracy is missed."""
    order = (Outcome.REFUTED, Outcome.NOT_CHECKABLE, Outcome.FINDINGS, Outcome.CONSISTENT)
    worst = next(one for one in order if one in outcome.outcomes)
    return worst.value if outcome.is_met else f"{worst.value}, required accuracy not reached"


def _exit_status(outcome: calibration_run.RunOutcome, accepted: Collection[messages.Accepted]) -> int:
    """The exit status of a run, the gravest thing that is not accepted; 0 if there is none."""
    cases = (
        (messages.Accepted.REFUTED, Outcome.REFUTED in outcome.outcomes, messages.REFUTED),
        (messages.Accepted.NOT_CHECKABLE, Outcome.NOT_CHECKABLE in outcome.outcomes, messages.NOT_CHECKABLE),
        (messages.Accepted.UNMET, not outcome.is_met, messages.LIMIT_MISSED),
        (messages.Accepted.FINDINGS, Outcome.FINDINGS in outcome.outcomes, messages.WITH_FINDINGS),
    )
    return next((status for what, found, status in cases if found and what not in accepted), messages.DONE)


def _machine() -> dict[str, object]:
    """What run.json says of machine and versions."""
    return {
        "python": platform.python_version(),
        "machine": platform.platform(),
        "version": __version__,
        "commit": commit(),
        "command": shlex.join(["boresight", *sys.argv[1:]]),
        "packages": {name: metadata.version(name) for name in REPORTED_PACKAGES},
    }


@contextmanager
def _warnings_reported() -> Iterator[None]:
    """Warnings of the library as one line each on stderr."""
    with warnings.catch_warnings(record=True, action="always") as caught:
        yield
    for text in dict.fromkeys(str(warning.message) for warning in caught):
        messages.log.warning("warning: %s", text)
