"""`boresight report`: one HTML page about a result."""

from __future__ import annotations

from typing import Annotated

import typer

from boresight.pipeline.console.arguments import AboutFile, RequireArcsec, RequireMetres, ResultArgument
from boresight.pipeline.console.messages import Answer
from boresight.pipeline.report.dumps_page import write_dumps_report
from boresight.pipeline.report.page import write_report
from boresight.pipeline.report.pdf import print_page
from boresight.pipeline.results import requirement
from boresight.pipeline.results.folder import dumps_in
from boresight.pipeline.results.identity import write_about
from boresight.pipeline.results.reading import read_installation

__all__ = ["report_command"]


def report_command(
    result: ResultArgument,
    pdf: Annotated[bool, typer.Option("--pdf", help="Print the page to report.pdf, too (Chromium).")] = False,
    require_arcsec: RequireArcsec = None,
    require_m: RequireMetres = None,
    about: AboutFile = None,
) -> Answer:
    """Draw one HTML page about a result, from what was saved, readable without a network.

    Example: boresight report demo-result --pdf --require-arcsec 1
    """
    write_about(result, about)
    requirement.write_requirement(result, requirement.Requirement(require_arcsec, require_m))
    path = write_dumps_report(result) if dumps_in(result) else write_report(result)
    lines = [f"{path.stat().st_size / 1e6:.1f} MB -> {path}"]
    if pdf:
        printed = print_page(path)
        lines.append(f"{printed.stat().st_size / 1e6:.1f} MB -> {printed}")
    lines += requirement.requirement_lines(requirement.saved_requirement(result), read_installation(result))
    return Answer(text="\n".join(lines))
