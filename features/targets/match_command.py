"""`boresight match`: a dump's targets found in its strips."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.features.targets.candidates_page import write_candidates_page
from boresight.features.targets.target_matches import matched_lines, matches_table, write_matches
from boresight.pipeline.console.arguments import DumpArgument, SettingsFile, option
from boresight.pipeline.console.completion import strips_of
from boresight.pipeline.console.messages import DATA_DID_NOT_ALLOW, DONE, Answer, say, tell
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.run.executor import executor_for
from boresight.pipeline.run.settings import read_settings
from boresight.pipeline.stages.strip_tasks import strips_to_match

__all__ = ["match_command"]


def match_command(
    dump: DumpArgument,
    out: Annotated[Path, typer.Option(help="File for matches and refusals: .csv or .parquet.")],
    strip: list[str] | None = option("Only this strip. May be repeated.", autocompletion=strips_of),
    page: Path | None = option("HTML page of all candidates: pictures, and why matched or not."),
    settings: SettingsFile = None,
    workers: int | None = option("Processes for the star images.", min=1),
) -> Answer:
    """Find a dump's targets in its strips, from the pre-launch installation matrix.

    Example: boresight match dump --out matches.csv
    """
    chosen, opened = read_settings(settings), open_dump(dump)
    if unknown := set(strip or []) - {s.strip_id for s in opened.strips}:
        names = ", ".join(s.strip_id for s in opened.strips)
        raise DataNotSufficientError(f"{dump} has no strip {', '.join(sorted(unknown))}, only {names}")
    with executor_for(workers, None, opened.pixels) as executor:
        tasks, omissions = strips_to_match(opened, chosen, executor)
    wanted = [task for task in tasks if not strip or task.strip.strip_id in strip]
    for omission in omissions:
        say(f"not used: {omission.line}")
    lines = []
    for line in matched_lines(wanted):
        lines.append(line)
        tell(line.text)
        for refusal in line.refused:
            say(f"refused: {line.strip_id}/{refusal.subject.name}: {refusal.text}")
    write_matches(out, lines)
    if page is not None:
        write_candidates_page(page, opened.mission, wanted, lines, out.name)
    matched = sum(len(line.matches) for line in lines)
    return Answer(
        text=f"matched {matched} in {len(lines)} strips -> {out}",
        content={
            "matched": matched,
            "targets": matches_table(lines).to_dict("records"),
            "omitted": [omission.row for omission in omissions],
        },
        files=(out,) if page is None else (out, page),
        exit_status=DONE if matched else DATA_DID_NOT_ALLOW,
    )
