"""Commands of the ground half alone: match, targets suggest."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.pipeline.commands.messages import DATA_DID_NOT_ALLOW, DONE, Answer, say, talks, tell

__all__ = ["add_match_commands"]

targets_app = typer.Typer(help="Ground calibration targets.", no_args_is_help=True)


def add_match_commands(app: typer.Typer) -> None:
    """Plug the commands into the program."""
    app.command()(talks(match, with_json=True))
    targets_app.command()(talks(suggest))
    app.add_typer(targets_app, name="targets")


def match(
    dump: Annotated[Path, typer.Argument(help="Folder with a dump.toml.")],
    out: Annotated[Path, typer.Option(help="File for matches and refusals: .csv or .parquet.")],
    strip: Annotated[list[str] | None, typer.Option(help="Only this strip. May be repeated.")] = None,
    overlay: Annotated[
        Path | None, typer.Option(help="Folder for a picture of each place: predicted, found, residual.")
    ] = None,
    settings: Annotated[
        Path | None, typer.Option(help="TOML file of settings; unknown keys are refused.")
    ] = None,
    workers: Annotated[int | None, typer.Option(help="Processes for the star images.", min=1)] = None,
) -> Answer:
    """Find a dump's targets in its strips, from the pre-launch installation matrix.

    Example: boresight match dump --out matches.csv
    """
    from boresight.pipeline.errors import DataNotSufficientError
    from boresight.pipeline.files.dump import open_dump
    from boresight.pipeline.files.record_tables import plain
    from boresight.pipeline.settings import read_settings
    from boresight.pipeline.stages.calibrate import strips_to_match
    from boresight.pipeline.stages.match import match_strips, matches_table, write_matches
    from boresight.pipeline.work.workers import executor_for

    chosen, opened = read_settings(settings), open_dump(dump)
    if unknown := set(strip or []) - {s.strip_id for s in opened.strips}:
        names = ", ".join(s.strip_id for s in opened.strips)
        raise DataNotSufficientError(f"{dump} has no strip {', '.join(sorted(unknown))}, only {names}")
    with executor_for(workers, None, opened.pixels) as executor:
        tasks, omissions = strips_to_match(opened, chosen, executor)
    wanted = [task for task in tasks if not strip or task.strip.strip_id in strip]
    for omission in omissions:
        say(f"not used: {omission.kind} {omission.name}: {omission.reason}")
    lines = []
    for line in match_strips(wanted, overlay):
        lines.append(line)
        tell(line.text)
        for refusal in line.refused:
            where = f", CCD {refusal.ccd}" if refusal.ccd >= 0 else ""
            say(f"refused: {line.strip_id}/{refusal.target_id}{where}: {refusal.sentence}")
    write_matches(out, lines)
    matched = sum(len(line.matches) for line in lines)
    return Answer(
        text=f"matched {matched} in {len(lines)} strips -> {out}",
        content={
            "matched": matched,
            "targets": matches_table(lines).to_dict("records"),
            "omitted": [plain(omission) for omission in omissions],
        },
        files=(out,),
        exit_status=DONE if matched else DATA_DID_NOT_ALLOW,
    )


def suggest(
    ortho: Annotated[Path, typer.Argument(help="Ortho-image: GeoTIFF of one band with a CRS.")],
    out: Annotated[Path, typer.Option(help="Folder for chips/ and targets.csv.")],
    size_px: Annotated[int, typer.Option(help="Side of a chip, in pixels of the image.", min=32)] = 256,
    most: Annotated[int, typer.Option(help="So many targets at most.", min=1)] = 40,
    height_m: Annotated[
        float | None, typer.Option(help="Ellipsoidal height of the ground; left empty if not given.")
    ] = None,
    sigma_m: Annotated[float, typer.Option(help="1-sigma of the image's georeferencing.", min=0.0)] = 1.0,
) -> Answer:
    """Tell where in an ortho-image good targets are; cut their chips and write the list that a dump wants.

    Example: boresight targets suggest ortho.tif --height-m 320 --out targets
    """
    from boresight.pipeline.stages.match import suggest as suggest_from

    found = suggest_from(ortho, out, size_px=size_px, most=most, height_m=height_m, sigma_m=sigma_m)
    for n, target in enumerate(found, start=1):
        tell(
            f"t{n:03d}   column {target.column:.0f}, row {target.row:.0f}   "
            f"expected sigma {target.sigma_px:.4f} px, best rival {target.rival:.2f}"
        )
    return Answer(text=f"{len(found)} targets -> {out / 'targets.csv'}")
