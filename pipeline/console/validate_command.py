"""`boresight validate`: a result against the truth of a simulated dump."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from boresight.pipeline.console.arguments import CameraOption, option
from boresight.pipeline.console.limit_options import JunitFile, held
from boresight.pipeline.console.messages import Answer, say
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.object_store import dump_folder
from boresight.pipeline.files.record_tables import plain
from boresight.pipeline.report.check_points import write_validation
from boresight.pipeline.report.page import write_report
from boresight.pipeline.results.limits import validation_limits
from boresight.pipeline.results.reading import read_for_dump
from boresight.pipeline.results.summary import validation_summary
from boresight.pipeline.results.validate import TruthErrors, validation_of

__all__ = ["validate_command"]


def validate_command(
    result: Annotated[Path, typer.Argument(help="Folder that `calibrate` wrote.")],
    dump: Path = option(
        "The simulated dump it was made from, with its truth/ folder.",
        ...,
        parser=dump_folder,
        metavar="PATH",
    ),
    camera: CameraOption = "",
    max_error_sigma: float | None = option(
        "Limit: error of each axis over its stated sigma, at most.", min=0.0
    ),
    max_nees: float | None = option("Limit: squared error in the stated covariance, at most.", min=0.0),
    max_ground_m: float | None = option("Limit: rms error on the ground, each direction, at most.", min=0.0),
    junit: JunitFile = None,
) -> Answer:
    """Compare a result with the truth of a simulated dump. Exit status 4 if a limit is missed.

    The errors are kept in RESULT/validation.json, and drawn into its report where it has one.

    Example: boresight validate result --dump dump --max-error-sigma 4 --max-nees 16 --max-ground-m 6
    """
    begun_s = time.perf_counter()
    _, saved = read_for_dump(result, dump, camera)
    found = validation_of(saved, open_dump(dump, camera=camera or None))
    files = _kept(result, found)
    limits = validation_limits(found, max_error_sigma, max_nees, max_ground_m)
    return held(
        "validate",
        limits,
        junit,
        begun_s,
        Answer(text=validation_summary(found), content=plain(found), files=files),
    )


def _kept(result: Path, found: TruthErrors) -> tuple[Path, ...]:
    """Keep the errors in the folder of the result and draw its report again; the files written. A folder
    that cannot be written is left as it is, with a remark.
    """
    try:
        kept = write_validation(result, found)
        drawn = (write_report(result),) if (result / "evidence" / "context.json").is_file() else ()
    except OSError as error:
        say(f"{result}: {error.strerror}; the report does not show the check points")
        return ()
    return (kept, *drawn)
