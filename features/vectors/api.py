"""The report of a result from vectors."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from boresight.pipeline import __version__
from boresight.pipeline.files.whole_file import write_text
from boresight.pipeline.report.page_template import template
from boresight.pipeline.report.verdict_section import verdict_view
from boresight.pipeline.results.reading import read_installation

__all__ = ["write_vector_page"]

MOST_ROWS = 300  # shown of a table


def write_vector_page(folder: Path, page: Path, result: Any) -> None:
    """Write the report of a `Calibration` whose result folder is `folder`: one HTML page that needs no
    network.
    """
    drawn = io.StringIO()
    result.plot().figure.savefig(drawn, format="svg")
    tables = {
        "Matrix": result.table(),
        "Findings": result.findings,
        "Blind spots": result.blind_spots,
        "Not used": result.not_used,
        "Residuals of targets": result.targets,
    }
    text = template("vectors.html.j2").render(
        verdict=verdict_view(read_installation(folder)),
        summary=result.summary(),
        figure=drawn.getvalue()[drawn.getvalue().index("<svg") :],
        tables={
            name: table.head(MOST_ROWS).to_html(index=False, border=0, float_format="{:.6g}".format)
            for name, table in tables.items()
            if len(table)
        },
        version=__version__,
    )
    write_text(page, text)
