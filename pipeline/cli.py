"""The command line: each command loads, calls one function and saves.

Results go to the named folder, one line per input or a summary to stdout, progress and remarks to stderr.
Exit status 0: done; 1: the data do not allow it; 2: wrong usage; 3: the data contradict themselves; 4: a
limit that was given is missed; 5: consistent, but an input looks wrong; 6: too few data to check the result.
Of several the first of 3, 6, 4, 5; `--accept` makes each of these four 0.
"""

from __future__ import annotations

import itertools
import platform
import sys
import time
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boresight.calib.verdict import Outcome
from boresight.features.drift.command import add_drift_commands
from boresight.features.exports.command import RequireArcsec, RequireMetres, add_report_commands
from boresight.features.heads.command import add_heads_commands
from boresight.features.interior.command import add_sensor_commands
from boresight.features.operators.command import add_import_commands
from boresight.features.planning.command import add_plan_commands
from boresight.features.sky_images.command import add_star_commands
from boresight.features.targets.command import add_match_commands
from boresight.features.targets.dump_command import add_dump_commands
from boresight.pipeline import __version__
from boresight.pipeline.console.arguments import DumpsArgument, SettingsFile
from boresight.pipeline.console.limit_options import JunitFile, held
from boresight.pipeline.console.messages import (
    DATA_DID_NOT_ALLOW,
    DONE,
    LIMIT_MISSED,
    NOT_CHECKABLE,
    REFUTED,
    WITH_FINDINGS,
    Accepted,
    Answer,
    log,
    print_data,
    say,
    talks,
    wrong_usage,
)
from boresight.pipeline.console.progress import progress_bars
from boresight.pipeline.errors import DataNotSufficientError, RawDataError, WorkerError
from boresight.pipeline.files.object_store import dump_folder
from boresight.version import version_text

if TYPE_CHECKING:
    from boresight.features.paper.pixels import PixelSettings
    from boresight.features.paper.vectors import ExperimentSettings
    from boresight.pipeline.calibration_run import RunOutcome, RunRequest
    from boresight.pipeline.files.dump import Dump
    from boresight.pipeline.run.executor import Executor

__all__ = ["app", "main"]

app = typer.Typer(
    name="boresight",
    help="On-orbit calibration of the installation matrix between star camera and remote-sensing camera.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"max_content_width": 110},
    rich_markup_mode=None,  # plain help: 0.3 s of CPU less
)

REPORTED_PACKAGES = (
    "numpy",
    "scipy",
    "opencv-python-headless",
    "astropy",
    "astropy-iers-data",
    "pyerfa",
    "pyproj",
)


def main() -> None:
    """Entry point of the command `boresight`."""
    with _errors_reported():
        app(standalone_mode=True)


@contextmanager
def _errors_reported() -> Iterator[None]:
    """Report errors that a user can act on as one line; anything else is a fault of the program."""
    try:
        yield
    except (RawDataError, DataNotSufficientError, WorkerError) as error:
        log.error("error: %s", error)
        sys.exit(DATA_DID_NOT_ALLOW)
    except OSError as error:  # disk full, no permission: what is finished is on disk
        log.error("error: %s: %s", error.filename or "file", error.strerror or error)
        sys.exit(DATA_DID_NOT_ALLOW)


def _folder(text: str) -> Path:
    if not text.strip():
        raise typer.BadParameter("is empty; name a folder")
    return Path(text)


@app.callback(invoke_without_command=True)
def _global(
    version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
) -> None:
    if version:
        print_data(version_text())
        raise typer.Exit(DONE)


def simulate(
    scenario: Annotated[str, typer.Argument(help="mini, paper, sky, or the path of a TOML file.")],
    out: Annotated[Path, typer.Argument(help="Folder to be made; must not exist or be empty.")],
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.", min=0)] = 1,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Change one setting: strips.count=5. May be repeated.")
    ] = None,
) -> Answer:
    """Render a mission with known truth: raw star images and strips, written as a dump.

    Example: boresight simulate mini dump --seed 7 --set strips.count=5
    """
    from boresight.pipeline.files.dump_writer import images_in, write_dump
    from boresight.pipeline.files.scenario_file import fly, named_scenario
    from boresight.pipeline.files.whole_file import is_vacant
    from boresight.simulator.scenario import ScenarioError

    try:
        chosen = named_scenario(scenario, set_ or [])
    except ScenarioError as error:
        raise wrong_usage(str(error)) from error
    if not is_vacant(out):
        raise wrong_usage(f"{out} is there already and is not an empty folder")
    start = time.perf_counter()
    mission = fly(chosen, seed)
    changes = "".join(f" --set {item}" for item in set_ or [])
    command = f"boresight {__version__}: simulate {chosen.name} --seed {seed}{changes}"
    images, done = images_in(mission), itertools.count(1)
    with progress_bars() as progress:
        write_dump(
            mission,
            out,
            created_by=command[:500],
            on_image=lambda name: progress("rendering", next(done), images),
        )
    strips = len({strip.strip_id for strip in mission.strips})
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return Answer(
        text=f"{len(mission.exposures)} exposures, {strips} strips, {len(mission.targets)} targets, "
        f"{size / 1e6:.1f} MB in {time.perf_counter() - start:.1f} s -> {out}"
    )


ResultFolder = Annotated[
    Path,
    typer.Option(
        help="Folder of the result: new, empty, or that of a run to be resumed.",
        parser=_folder,
        metavar="PATH",
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(help="Processes on this machine; default: one a core, one for a small dump.", min=1),
]
Scheduler = Annotated[str | None, typer.Option(help="Address of a dask scheduler instead (docs/cluster.md).")]
WorkerTimeout = Annotated[
    float | None, typer.Option(help="Longest wait for a usable worker of the scheduler, s.", min=0.0)
]
StaleEop = Annotated[
    bool, typer.Option(help="Continue past the end of the Earth-orientation table, with a warning.")
]
WithReport = Annotated[bool, typer.Option(help="Write report.html at the end.")]
AcceptInconsistent = Annotated[
    bool, typer.Option("--accept-inconsistent", help="The same as --accept refuted.")
]
Accept = Annotated[
    list[Accepted] | None,
    typer.Option(help="Do not fail for this: exit with 0. May be given several times."),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace a result of another dump or of other settings.")
]


def calibrate(
    dumps: DumpsArgument,
    out: ResultFolder,
    settings: SettingsFile = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    worker_timeout: WorkerTimeout = None,
    allow_stale_eop: StaleEop = False,
    report: WithReport = True,
    require_arcsec: RequireArcsec = None,
    require_m: RequireMetres = None,
    accept_inconsistent: AcceptInconsistent = False,
    accept: Accept = None,
    overwrite: Overwrite = False,
) -> Answer:
    """Estimate the installation matrix of a dump from raw images; of several dumps, of each and of all.

    Example: boresight calibrate dump --out result
    """
    from boresight.pipeline.calibration_run import RunRequest, SavedContent
    from boresight.pipeline.results.requirement import Requirement
    from boresight.pipeline.run.settings import read_settings
    from boresight.pipeline.run.workers import executor_for, processors

    if workers is not None and scheduler is not None:
        raise wrong_usage("--workers and --scheduler exclude one another")

    def executor_on(opened: list[Dump]) -> AbstractContextManager[Executor]:
        probes = [dump.root / "dump.toml" for dump in opened]
        pixels = sum(dump.pixels for dump in opened)
        return executor_for(workers, scheduler, pixels, probes=probes, wait_s=worker_timeout, say=say)

    begun_s = time.perf_counter()
    request = RunRequest(
        settings=read_settings(settings),
        report=report,
        begun_s=begun_s,
        overwrite=overwrite,
        requirement=Requirement(require_arcsec, require_m),
        facts={"workers": workers, "scheduler": scheduler} | _machine(),
    )
    outcome = _run(dumps, out, request, executor_on, allow_stale_eop, processors(workers))
    files = (out / "installation.json", *([out / "report.html"] if report else []))
    took = f"{time.perf_counter() - begun_s:.1f} s -> {files[0]}{', report.html' if report else ''}"
    return Answer(
        text=f"{outcome.text}\n{took}",
        content=SavedContent(out),
        files=files,
        exit_status=_exit_status(outcome, {*(accept or ()), *([Accepted.REFUTED] * accept_inconsistent)}),
    )


def _exit_status(outcome: RunOutcome, accepted: Collection[Accepted]) -> int:
    """The exit status of a run, the gravest thing that is not accepted; 0 if there is none."""
    cases = (
        (Accepted.REFUTED, Outcome.REFUTED in outcome.outcomes, REFUTED),
        (Accepted.NOT_CHECKABLE, Outcome.NOT_CHECKABLE in outcome.outcomes, NOT_CHECKABLE),
        (Accepted.UNMET, not outcome.is_met, LIMIT_MISSED),
        (Accepted.FINDINGS, Outcome.FINDINGS in outcome.outcomes, WITH_FINDINGS),
    )
    return next((status for what, found, status in cases if found and what not in accepted), DONE)


def _machine() -> dict[str, object]:
    """What run.json says of machine and versions."""
    return {
        "python": platform.python_version(),
        "machine": platform.platform(),
        "version": __version__,
        "packages": {name: metadata.version(name) for name in REPORTED_PACKAGES},
    }


def _run(
    dumps: list[Path],
    out: Path,
    request: RunRequest,
    executor_on: Callable[[list[Dump]], AbstractContextManager[Executor]],
    allow_stale_eop: bool,
    threads: int,
) -> RunOutcome:
    """Open one dump or several, with so many threads, and carry them through."""
    from boresight.pipeline.calibration_run import going_on, run_dump, run_dumps
    from boresight.pipeline.files.dump import open_dump
    from boresight.pipeline.stages.joint import open_dumps

    if len(dumps) == 1:
        with _warnings_reported():
            one = open_dump(dumps[0].resolve(), allow_stale_eop=allow_stale_eop, threads=threads)
        with going_on(out), progress_bars() as progress, executor_on([one]) as executor:
            return run_dump(out, one, str(dumps[0]), request, executor, progress)
    with _warnings_reported():
        several = open_dumps(dumps, request.settings, allow_stale_eop=allow_stale_eop, threads=threads)
    opened = [named.dump for named in several]
    with going_on(out), progress_bars() as progress, executor_on(opened) as executor:
        return run_dumps(out, several, request, executor, progress)


@contextmanager
def _warnings_reported() -> Iterator[None]:
    """Warnings of the library as one line each on stderr."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    for text in dict.fromkeys(str(warning.message) for warning in caught):
        log.warning("warning: %s", text)


def validate(
    result: Annotated[Path, typer.Argument(help="Folder that `calibrate` wrote.")],
    dump: Annotated[
        Path,
        typer.Option(
            parser=dump_folder,
            metavar="PATH",
            help="The simulated dump it was made from, with its truth/ folder.",
        ),
    ],
    max_error_sigma: Annotated[
        float | None, typer.Option(help="Limit: error of each axis over its stated sigma, at most.", min=0.0)
    ] = None,
    max_nees: Annotated[
        float | None, typer.Option(help="Limit: squared error in the stated covariance, at most.", min=0.0)
    ] = None,
    max_ground_m: Annotated[
        float | None, typer.Option(help="Limit: rms error on the ground, each direction, at most.", min=0.0)
    ] = None,
    junit: JunitFile = None,
) -> Answer:
    """Compare a result with the truth of a simulated dump. Exit status 4 if a limit is missed.

    The errors are kept in RESULT/validation.json, and drawn into its report where it has one.

    Example: boresight validate result --dump dump --max-error-sigma 4 --max-nees 16 --max-ground-m 6
    """
    from boresight.pipeline.console.kept_validation import kept_validation
    from boresight.pipeline.files.dump import open_dump
    from boresight.pipeline.files.record_tables import plain
    from boresight.pipeline.results.limits import validation_limits
    from boresight.pipeline.results.reading import read_for_dump
    from boresight.pipeline.results.summary import validation_summary
    from boresight.pipeline.results.validate import validate as held_against_truth

    begun_s = time.perf_counter()
    _, saved = read_for_dump(result, dump)
    found = held_against_truth(saved, open_dump(dump))
    files = kept_validation(result, found)
    limits = validation_limits(found, max_error_sigma, max_nees, max_ground_m)
    return held(
        "validate",
        limits,
        junit,
        begun_s,
        Answer(text=validation_summary(found), content=plain(found), files=files),
    )


def status(result: Annotated[Path, typer.Argument(help="Folder of a run, finished or not.")]) -> Answer:
    """Show what of a run is finished, what it still needs, and everything that is not used and why.

    Example: boresight status result
    """
    from boresight.pipeline.files.record_tables import plain
    from boresight.pipeline.results.status import run_status, status_lines

    found = run_status(result)
    return Answer(text="\n".join(status_lines(found)), content=plain(found))


def experiment(
    name: Annotated[
        str,
        typer.Argument(
            help="inputs, figure4, convergence, grid, figure8, table4, table5, readings, geometry; or all."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for NAME.csv, .png and .txt; all: also paper.html.")],
    runs: Annotated[
        int | None,
        typer.Option(help="Runs per cell; default 200 (Wang 40, table5 20, pixels 2 or 20).", min=1),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.", min=0)] = 2020,
    star_from_zenith_deg: Annotated[
        float, typer.Option(help="Star camera's axis from the zenith in the Y-Z plane, degrees.")
    ] = 15.0,
    pixels: Annotated[
        bool, typer.Option("--pixels", help="From rendered images: grid, table4, table5.")
    ] = False,
) -> Answer:
    """Run a simulation of the paper from scratch, with its printed values beside ours.

    Example: boresight experiment geometry --out paper
    """
    from boresight.features.paper.pixels import PixelSettings
    from boresight.features.paper.tables import EXPERIMENTS, FROM_PIXELS
    from boresight.features.paper.vectors import ExperimentSettings

    known = FROM_PIXELS if pixels else (*EXPERIMENTS, "all")
    if name not in known:
        raise wrong_usage(f"there is no experiment {name!r} of this kind, only {', '.join(known)}")
    chosen = ExperimentSettings(seed=seed, from_zenith_deg=star_from_zenith_deg)
    if runs is not None:
        chosen = replace(chosen, runs=runs, wang_runs=runs, table5_runs=runs)
    rendered = PixelSettings(seed=seed, runs=runs or 2, table4_runs=runs or 20)
    with progress_bars() as told:
        given = rendered if pixels else chosen
        text = _experiment(name, out, given, lambda done, total: told(name, done, total))
    return Answer(text=text)


def _experiment(
    name: str, out: Path, settings: ExperimentSettings | PixelSettings, progress: Callable[[int, int], None]
) -> str:
    """Run one experiment or all; what to print."""
    from boresight.features.paper.comparison import COMPARISONS
    from boresight.features.paper.paper_page import run_all
    from boresight.features.paper.pixels import PixelSettings
    from boresight.features.paper.tables import run_experiment, run_from_pixels
    from boresight.pipeline.report.page import template

    if isinstance(settings, PixelSettings):
        table, written = run_from_pixels(name, out, settings, progress)
        lines = COMPARISONS[f"{name}-pixels"](table)
    elif name == "all":
        tables, page = run_all(out, settings, template("experiments.html.j2"), progress)
        return f"all: {len(tables)} experiments -> {page}"
    else:
        table, written = run_experiment(name, out, settings, progress)
        lines = COMPARISONS[name](table)
    files = ", ".join(str(path) for path in written)
    return "\n".join([*lines, f"{name}: {len(table)} rows -> {files}"])


app.command()(talks(simulate))
app.command()(talks(calibrate, with_json=True))
app.command()(talks(validate, with_json=True))
app.command()(talks(status, with_json=True))
app.command()(talks(experiment))
add_star_commands(app)
add_match_commands(app)
add_dump_commands(app)
add_report_commands(app)
add_drift_commands(app)
add_heads_commands(app)
add_plan_commands(app)
add_sensor_commands(app)
add_import_commands(app)
