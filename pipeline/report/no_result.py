"""Page of a run whose data do not suffice: what is missing, and what was not used."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from boresight.pipeline import __version__
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.whole_file import write_text
from boresight.pipeline.report.page_template import template

__all__ = ["write_no_result"]

# Most rows of things that are not used on the page of a run without result.
MOST_ROWS = 300


def write_no_result(result: Path, dump: Dump, error: DataNotSufficientError) -> Path:
    """Write `report.html` of a run without a result; its path."""
    cause, *rest = str(error).split("; ")
    every = (*dump.strips, *dump.sky_strips)
    begin = min(strip.t_first_row_s for strip in every)
    end = max(strip.t_first_row_s + strip.lines * strip.row_period_s for strip in every)
    exposures = sum(head.n_exposures for head in dump.heads)
    rows = [entry.row for entry in error.omissions]
    text = template("no_result.html.j2").render(
        mission=dump.mission,
        satellite=dump.satellite,
        utc=[utc[:19].replace("T", " ") for utc in dump.epoch.utc_from_seconds([begin, end])],
        counts={"exposures": exposures, "strips": len(dump.strips), "targets": len(dump.targets)},
        cause=cause,
        rest=rest,
        kinds=sorted(Counter((row["kind"], row["cause"]) for row in rows).items()),
        omissions=rows[:MOST_ROWS],
        omissions_in_all=len(rows),
        version=__version__,
    )
    write_text(path := result / "report.html", text)
    return path
