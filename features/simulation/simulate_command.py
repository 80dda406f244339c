"""`boresight simulate`: a mission with known truth as a dump."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import typer

from boresight.pipeline import __version__
from boresight.pipeline.console.arguments import argument, option
from boresight.pipeline.console.completion import among, first_argument
from boresight.pipeline.console.messages import Answer, wrong_usage
from boresight.pipeline.console.progress import progress_bars
from boresight.pipeline.files.dump_writer import Rendered, write_dump
from boresight.pipeline.files.scenario_file import fly, named_scenario
from boresight.pipeline.files.text_tables import leaves
from boresight.pipeline.files.whole_file import is_vacant
from boresight.pipeline.run.executor import FORKS, executor_for
from boresight.simulator.scenario import (
    ScenarioError,
    builtin_scenario,
    builtin_scenario_names,
    scenario_to_dict,
)

__all__ = ["simulate_command"]


def _settings_of(context: typer.Context, incomplete: str) -> list[str]:
    """Settings of a built-in scenario that are one value, each as KEY=VALUE."""
    name = first_argument(context, "scenario")
    if name is None or name not in builtin_scenario_names():
        return []
    words = []
    for key, value in leaves(scenario_to_dict(builtin_scenario(name))):
        if isinstance(value, (str, bool, int, float)) and key != "name":
            words.append(f"{key}={value if isinstance(value, str) else json.dumps(value)}")
    return sorted(word for word in words if word.startswith(incomplete))


def simulate_command(
    scenario: str = argument(
        "mini, paper, sky, or the path of a TOML file.", autocompletion=among(builtin_scenario_names())
    ),
    out: Path = argument("Folder to be made; must not exist or be empty."),
    seed: int = option("Seed of all random numbers.", 1, min=0),
    set_: list[str] | None = option(
        "Change one setting: strips.count=5. May be repeated.", None, "--set", autocompletion=_settings_of
    ),
    workers: int | None = option(
        "Processes on this machine; default: one a core, one for a small mission.", min=1
    ),
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
    pixels = sum(strip.samples * strip.lines for strip in mission.strips)
    with progress_bars() as progress, executor_for(workers if FORKS else 1, None, pixels) as executor:

        def each(render: Callable[[Rendered], None], images: Sequence[Rendered]) -> list[None]:
            return executor.map(render, images, lambda done, _: progress("images", done, len(images)))

        write_dump(mission, out, created_by=command[:500], each=each)
    strips = len({strip.strip_id for strip in mission.strips})
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return Answer(
        text=f"{len(mission.exposures)} exposures, {strips} strips, {len(mission.targets)} targets, "
        f"{size / 1e6:.1f} MB in {time.perf_counter() - start:.1f} s -> {out}"
    )
