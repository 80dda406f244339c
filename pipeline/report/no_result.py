"""Page of a run whose data do not suffice: what is missing, and what was not used."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from boresight.pipeline import __version__
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.whole_file import write_whole
from boresight.pipeline.report.page import template

__all__ = ["write_no_result"]

MOST_ROWS = 300


def write_no_result(result: Path, dump: Dump, error: DataNotSufficientError) -> Path:
    """Write `report.html` of a run without a result; its path."""
    cause, *rest = str(error).split("; ")
    text = template("no_result.html.j2").render(
        mission=dump.mission,
        satellite=dump.satellite,
        utc=[
            utc[:19].replace("T", " ")
            for utc in dump.epoch.utc_from_seconds([dump.exposures[0].t_s, dump.exposures[-1].t_s])
        ],
        counts={"exposures": len(dump.exposures), "strips": len(dump.strips), "targets": len(dump.targets)},
        cause=cause,
        rest=rest,
        kinds=sorted(Counter((o.kind, str(o.cause)) for o in error.omissions).items()),
        omissions=error.omissions[:MOST_ROWS],
        omissions_in_all=len(error.omissions),
        version=__version__,
    )
    path = result / "report.html"
    write_whole(path, lambda target: target.write_text(text, encoding="utf-8"))
    return path
