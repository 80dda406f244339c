"""`boresight compare`: whether the matrices of two results differ by more than their errors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.features.mission.mounting_comparison import compare_mountings
from boresight.features.mission.saved_mounting import read_saved_mounting
from boresight.pipeline.console.arguments import CameraOption, option
from boresight.pipeline.console.messages import DONE, LIMIT_MISSED, Answer
from boresight.pipeline.files.whole_file import write_text

__all__ = ["compare_command"]

Folder = typer.Argument(help="Folder that `calibrate` wrote.", exists=True, file_okay=False)


def compare_command(
    first: Annotated[Path, Folder],
    second: Annotated[Path, Folder],
    html: Path | None = option("Write the comparison as an HTML page."),
    false_alarm: float = option(
        "Probability that equal mountings are said to differ.", 0.01, min=1e-9, max=0.5
    ),
    camera: CameraOption = "",
) -> Answer:
    """Test whether the matrices of two results differ; exit with 4 where they do.

    The difference is given in both frames and on the ground, with the covariance of what the results do not
    share, and with all that differs in inputs, settings and versions.

    Example: boresight compare may june --html june-against-may.html
    """
    one, other = (read_saved_mounting(folder, camera) for folder in (first, second))
    found = compare_mountings(one, other, false_alarm)
    if html is not None:
        write_text(html, found.card())
    return Answer(
        text="\n".join(
            [found.summary(), *(f"  {one.what}: {one.first} -> {one.second}" for one in found.differing)]
        ),
        line=found.verdict,
        content=found.content(),
        files=() if html is None else (html,),
        exit_status=LIMIT_MISSED if found.differs else DONE,
    )
