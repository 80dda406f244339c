"""`boresight sky-strip-plan`: scans of the sky to take."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from boresight.features.planning.scan_files import scan_lines, scan_table, write_scans
from boresight.features.planning.scan_plan import ScanCameras, ScanSettings, choose_scans
from boresight.pipeline.console.arguments import DumpArgument, option
from boresight.pipeline.console.messages import Answer
from boresight.pipeline.console.progress import progress_bars
from boresight.pipeline.errors import DataNotSufficientError, refusing
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.star_side import SolvedAttitudes
from boresight.pipeline.files.star_tables import survey_of
from boresight.pipeline.run.settings import Settings, calibration_settings

__all__ = ["sky_strip_plan_command"]


def sky_strip_plan_command(
    dump: DumpArgument,
    out: Path | None = option("Folder for scans.csv and scans.png."),
    utc: str | None = option("Beginning, such as 2026-11-22T18:00:00Z; default: the orbit's."),
    *,
    asked: ScanSettings,
) -> Answer:
    """Which scans of the sky tell most about the installation matrix, away from Sun, Moon and Earth.

    Example: boresight sky-strip-plan dump --scans 2 --hours 12 --out scans
    """
    opened = open_dump(dump.resolve())
    with refusing("--utc", "value", "a time such as 2026-11-22T18:00:00Z", found=utc):
        start = opened.orbit.span_s[0] if utc is None else float(opened.epoch.seconds_from_utc([utc])[0])
    errors = calibration_settings(Settings(), opened.errors, opened.line_camera)
    try:
        with progress_bars() as told:
            found = choose_scans(
                _scan_cameras(opened),
                survey_of(opened.star_catalogue),
                start,
                errors,
                asked,
                partial(told, "scans looked at"),
            )
    except ValueError as error:
        raise DataNotSufficientError(str(error)) from error
    lines, files = scan_lines(found, opened.epoch), tuple[Path, ...]()
    if out is not None:
        files = write_scans(found, opened.epoch, out)
        lines.append(f"-> {', '.join(map(str, files))}")
    table = scan_table(found, opened.epoch)
    return Answer(text="\n".join(lines), content={"scans": table.to_dict("records")}, files=files)


def _scan_cameras(dump: Dump) -> ScanCameras:
    """Both cameras of a dump; of a head that delivers attitudes, their usual covariance."""
    head = dump.heads[0]
    source = head.source
    return ScanCameras(
        line=dump.line_camera,
        star=source.usual_covariance_s(head.noise) if isinstance(source, SolvedAttitudes) else source.camera,
        R_cs=dump.R_cs0,
        orbit=dump.orbit,
        noise=head.noise,
    )
