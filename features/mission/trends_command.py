"""`boresight trends`: the mounting over years, from an archive, as a page and for programs."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Annotated

import typer

from boresight.features.mission.archive import series_of
from boresight.features.mission.mounting_course import CourseSettings
from boresight.features.mission.saved_mounting import instant_s, utc_at
from boresight.features.mission.trends import Trend, trend_of
from boresight.features.mission.trends_page import trends_html
from boresight.pipeline.console.arguments import RequireArcsec, RequireMetres, option
from boresight.pipeline.console.messages import DONE, LIMIT_MISSED, Answer
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.whole_file import write_json, write_text
from boresight.pipeline.results.calibration_file import calibration_text
from boresight.pipeline.results.requirement import Requirement

__all__ = ["trends_command"]


def trends_command(
    archive: Annotated[Path, typer.Argument(help="Folder of an archive, of `archive add`.")],
    out: Annotated[Path, typer.Option(help="Folder for trends.html, trends.json and calibration files.")],
    at: str | None = option("Date of the matrix wanted, UTC; default: today."),
    require_arcsec: RequireArcsec = None,
    require_m: RequireMetres = None,
    false_steps: float = option("Steps that may be accepted without cause, a year.", 0.01, min=1e-9, max=0.5),
) -> Answer:
    """Model each mounting of an archive over time: seasons, orbit, temperature, steps, random walk.

    Writes a page, the same for programs, and the matrix for a date as a calibration file of each series. An
    alarm is exit status 4.

    Example: boresight trends archive --out trends --require-arcsec 1
    """
    try:
        at_s = instant_s(at or datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ"))
    except ValueError as error:
        raise typer.BadParameter(f"--at {at}: {error}") from error
    settings = CourseSettings(false_steps_per_year=false_steps)
    wanted = Requirement(require_arcsec, require_m)
    found = [trend_of(one, at_s, wanted, settings) for one in series_of(archive)]
    trends = [trend for trend in found if trend is not None]
    if not trends:
        raise DataNotSufficientError("no series of the archive has two results; add more by `archive add`")
    out.mkdir(parents=True, exist_ok=True)
    alarm = any(trend.alarms for trend in trends)
    content = {"at": utc_at(at_s), "alarm": alarm, "series": [trend.content() for trend in trends]}
    write_json(out / "trends.json", content)
    write_text(out / "trends.html", trends_html(trends, out))
    files = [out / "trends.html", out / "trends.json"]
    for n, trend in enumerate(trends):
        files.append(out / f"calibration{n + 1 if len(trends) > 1 else ''}.json")
        write_text(files[-1], _calibration(trend))
    return Answer(
        text="\n".join([*(trend.summary() for trend in trends), f"-> {', '.join(map(str, files))}"]),
        content=content,
        files=tuple(files),
        exit_status=LIMIT_MISSED if alarm else DONE,
    )


def _calibration(trend: Trend) -> str:
    now = trend.now
    of = dict(zip(("mission", "satellite", "camera", "star_camera"), trend.archived.key))
    valid = (None, None) if now.valid_s is None else (utc_at(now.valid_s[0]), utc_at(now.valid_s[1]))
    more = {"utc": utc_at(now.t_s), "results": len(trend.archived.rows), "terms": list(trend.course.terms)}
    return calibration_text(now.R_cs, now.covariance, of, valid, more)
