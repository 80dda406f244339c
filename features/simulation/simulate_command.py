"""`boresight simulate`: a mission with known truth as a dump."""

from __future__ import annotations

import itertools
import time
from pathlib import Path
from typing import Annotated

import typer

from boresight.pipeline import __version__
from boresight.pipeline.console.messages import (
    Answer,
    wrong_usage,
)
from boresight.pipeline.console.progress import progress_bars
from boresight.pipeline.files.dump_writer import images_in, write_dump
from boresight.pipeline.files.scenario_file import fly, named_scenario
from boresight.pipeline.files.whole_file import is_vacant
from boresight.simulator.scenario import ScenarioError

__all__ = ["simulate_command"]


def simulate_command(
    scenario: Annotated[str, typer.Argument(help="mini, paper, sky, or the path of a TOML file.")],
    out: Annotated[Path, typer.Argument(help="Folder to be made; must not exist or be empty.")],
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.", min=0)] = 1,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Change one setting: strips.count=5. May be repeated.")
    ] = None,
) -> Answer:
    """Render a mission with known truth: raw star images and strips, written as a dump.

    Example: boresight simulate mini dump --seed 7 --set strips.count=5
    """
    try:
        chosen = named_scenario(scenario, set_ or [])
    except ScenarioError as error:
        raise wrong_usage(str(error)) from error
    if not is_vacant(out):
        raise wrong_usage(f"{out} is there already and is not an empty folder")
    start = time.perf_counter()
    mission = fly(chosen, seed)
    changes = "".join(f" --set {item}" for item in set_ or [])
    command = f"boresight {__version__}: simulate {chosen.name} --seed {seed}{changes}"
    images, done = images_in(mission), itertools.count(1)
    with progress_bars() as progress:
        write_dump(
            mission,
            out,
            created_by=command[:500],
            on_image=lambda name: progress("rendering", next(done), images),
        )
    strips = len({strip.strip_id for strip in mission.strips})
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return Answer(
        text=f"{len(mission.exposures)} exposures, {strips} strips, {len(mission.targets)} targets, "
        f"{size / 1e6:.1f} MB in {time.perf_counter() - start:.1f} s -> {out}"
    )
