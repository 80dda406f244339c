"""Commands of the ground half alone: match, targets suggest."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from boresight.pipeline.console.arguments import DumpArgument, SettingsFile
from boresight.pipeline.console.messages import (
    DATA_DID_NOT_ALLOW,
    DONE,
    Answer,
    say,
    talks,
    tell,
    wrong_usage,
)
from boresight.pipeline.files.object_store import dump_folder

__all__ = ["add_match_commands"]

targets_app = typer.Typer(help="Ground calibration targets.", no_args_is_help=True)


def add_match_commands(app: typer.Typer) -> None:
    """Plug the commands into the program."""
    app.command()(talks(match, with_json=True))
    targets_app.command()(talks(suggest))
    app.add_typer(targets_app, name="targets")


def match(
    dump: DumpArgument,
    out: Annotated[Path, typer.Option(help="File for matches and refusals: .csv or .parquet.")],
    strip: Annotated[list[str] | None, typer.Option(help="Only this strip. May be repeated.")] = None,
    overlay: Annotated[
        Path | None, typer.Option(help="Folder for a picture of each place: predicted, found, residual.")
    ] = None,
    settings: SettingsFile = None,
    workers: Annotated[int | None, typer.Option(help="Processes for the star images.", min=1)] = None,
) -> Answer:
    """Find a dump's targets in its strips, from the pre-launch installation matrix.

    Example: boresight match dump --out matches.csv
    """
    from boresight.features.targets.target_matches import match_strips, matches_table, write_matches
    from boresight.pipeline.errors import DataNotSufficientError
    from boresight.pipeline.files.dump import open_dump
    from boresight.pipeline.files.record_tables import plain
    from boresight.pipeline.run.settings import read_settings
    from boresight.pipeline.run.workers import executor_for
    from boresight.pipeline.stages.calibrate import strips_to_match

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
    orthos: Annotated[
        list[Path],
        typer.Argument(metavar="ORTHO", help="GeoTIFF, COG or VRT with a map; where two overlap: two dates."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for chips/ and targets.csv.")],
    dem: Annotated[list[Path] | None, typer.Option(help="Height model. May be repeated.")] = None,
    heights: Annotated[
        Literal["ellipsoidal", "egm96", "egm2008"], typer.Option(help="What the heights of --dem refer to.")
    ] = "egm96",
    height_m: Annotated[
        float | None, typer.Option(help="Ellipsoidal height of flat ground, in place of --dem.")
    ] = None,
    dump: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            parser=dump_folder,
            help="Only what its strips will show, spread for the best forecast.",
        ),
    ] = None,
    size_px: Annotated[int, typer.Option(help="Side of a chip, in pixels of its image.", min=32)] = 256,
    most: Annotated[int, typer.Option(help="So many targets at most.", min=1)] = 40,
    band: Annotated[
        int | None, typer.Option(help="Band of the images; default: the mean of the first three.", min=1)
    ] = None,
    sigma_m: Annotated[float, typer.Option(help="1-sigma of the images' georeferencing.", min=0.0)] = 1.0,
    sigma_up_m: Annotated[float, typer.Option(help="1-sigma of the heights.", min=0.0)] = 2.0,
    settings: Annotated[Path | None, typer.Option(help="TOML file of settings, for --dump.")] = None,
) -> Answer:
    """Choose ground targets in ortho-images; write their chips and the list that goes into a dump.

    Example: boresight targets suggest ortho1.tif ortho2.tif --dem dem.tif --dump dump --out targets
    """
    from boresight.features.targets.ortho_files import HeightModel, read_heights, read_ortho
    from boresight.features.targets.suggestions import (
        SuggestRequest,
        suggest_in,
        suggestion_lines,
        write_targets,
    )
    from boresight.geometry.terrain import ConstantHeight
    from boresight.pipeline.files.dump import open_dump
    from boresight.pipeline.run.settings import read_settings

    if bool(dem) == (height_m is not None):
        raise wrong_usage("give the heights by --dem or by --height-m, one of them")
    flat = HeightModel((ConstantHeight(height_m or 0.0),), "ellipsoidal")
    model = read_heights(dem, heights) if dem else flat
    opened = None if dump is None else open_dump(dump)
    request = SuggestRequest(size_px=size_px, most=most, sigma_m=sigma_m, sigma_up_m=sigma_up_m)
    images = [read_ortho(path, band) for path in orthos]
    found = suggest_in(images, model, request, opened, read_settings(settings))
    table = write_targets(found.targets, out, size_px)
    lines = [*suggestion_lines(found), f"{len(found.targets)} targets -> {table}"]
    return Answer(text="\n".join(lines), files=(table,))
