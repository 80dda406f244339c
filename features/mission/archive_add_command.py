"""`boresight archive add`: finished results into the archive of a mission."""

from __future__ import annotations

from pathlib import Path

from boresight.features.mission.archive import add_results
from boresight.pipeline.console.arguments import argument, option
from boresight.pipeline.console.messages import Answer

__all__ = ["archive_add_command"]


def archive_add_command(
    results: list[Path] = argument("Folders that `calibrate` wrote, in any order.", metavar="RESULT"),
    to: Path = option("Folder of the archive; it is made.", ...),
) -> Answer:
    """Add finished results to an archive; one that is there already is not added again.

    Example: boresight archive add results/* --to archive
    """
    told = add_results(results, to)
    return Answer(
        text="\n".join(f"{folder}   {what}" for folder, what in told),
        content={"results": [{"folder": str(folder), "outcome": what} for folder, what in told]},
        files=(to / "archive.gpkg",),
    )
