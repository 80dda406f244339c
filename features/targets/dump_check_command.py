"""`boresight dump check`: all about a dump that needs no calibration."""

from __future__ import annotations

from pathlib import Path

from boresight.features.targets.dump_check import check_dump, check_lines
from boresight.pipeline.console.arguments import DumpArgument, SettingsFile, option
from boresight.pipeline.console.messages import DATA_DID_NOT_ALLOW, DONE, Answer
from boresight.pipeline.files.record_tables import plain
from boresight.pipeline.run.executor import executor_for
from boresight.pipeline.run.settings import read_settings

__all__ = ["dump_check_command"]


def dump_check_command(
    dump: DumpArgument,
    out: Path | None = option("HTML page with the footprints on a map."),
    settings: SettingsFile = None,
    workers: int | None = option("Processes for the star images.", min=1),
) -> Answer:
    """Check everything about a dump that needs no calibration: all errors at once, footprints, targets.

    Example: boresight dump check my-dump --out check.html
    """
    with executor_for(workers, None, 0) as executor:
        check = check_dump(dump, read_settings(settings), executor)
    lines = check_lines(check)
    if out is not None:
        from boresight.features.targets.check_page import write_check_page  # with Matplotlib 0.2 s to load

        write_check_page(check, out)
        lines.append(f"-> {out}")
    return Answer(
        text="\n".join(lines),
        content={
            "errors": [*map(str, check.faults), *check.wrong],
            "facts": list(check.facts),
            "omitted": [entry.row for entry in check.omissions],
            "targets": [plain(target) for target in check.targets],
            "footprints": {name: outline.tolist() for name, outline in check.footprints.items()},
        },
        files=() if out is None else (out,),
        exit_status=DATA_DID_NOT_ALLOW if check.faults or check.wrong else DONE,
    )
