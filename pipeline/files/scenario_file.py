"""Read the scenario that a command line names, and simulate its mission.

Star catalogue, Earth-orientation table, geoid and ground image are read here and passed to the simulator.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.geoid import egm96
from boresight.pipeline.files.images.rasters import read_grid
from boresight.pipeline.files.text_files import toml_tables
from boresight.simulator.ground import GroundImage
from boresight.simulator.mission import render_mission
from boresight.simulator.mission_records import Mission
from boresight.simulator.scenario import Scenario, ScenarioError, builtin_scenario_names, scenario_from_dict
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.whole_catalogue import all_hipparcos

__all__ = ["fly", "named_scenario"]

# Most pixels of a picture of the ground that a scenario may name: 1 GiB of bytes.
MAX_GROUND_PIXELS = 2**30


def named_scenario(name: str, changes: Sequence[str]) -> Scenario:
    """The scenario of that name with some settings replaced.

    `name` is a built-in scenario or the path of a TOML file; each change is `section.key=value` with a TOML
    value. Raises `ScenarioError` for an unknown setting or value, `RawDataError` for an unreadable file.
    """
    if name in builtin_scenario_names():
        values: dict[str, Any] = {"based_on": name}
    elif Path(name).is_file():
        values = toml_tables(Path(name), name)
    else:
        known = ", ".join(builtin_scenario_names())
        raise ScenarioError(f"scenario {name!r}: expected {known} or the path of a TOML file")
    for change in changes:
        _apply(values, change)
    return scenario_from_dict(values)


def fly(scenario: Scenario, seed: int) -> Mission:
    """The simulated mission of a scenario, with the bundled catalogue, Earth orientation and geoid."""
    ground = _ground_image(scenario.ground.image) if scenario.ground.image else None
    stars = hipparcos_stars().places
    survey = all_hipparcos() if scenario.sky_strips.scans else None
    return render_mission(scenario, stars, bundled_earth_orientation(), egm96(), seed, ground, survey)


def _ground_image(name: str) -> GroundImage:
    grid = read_grid(Path(name), name, max_pixels=MAX_GROUND_PIXELS, first_band=True)
    return GroundImage(np.nan_to_num(grid.values, nan=0.0), grid.transform, grid.crs)


def _apply(values: dict[str, Any], change: str) -> None:
    key, equals, text = change.partition("=")
    if not equals or not key.strip():
        raise ScenarioError(f"--set {change}: expected section.key=value")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        value = text
    table = values
    *sections, last = key.strip().split(".")
    for section in sections:
        table = table.setdefault(section, {})
        if not isinstance(table, dict):
            raise ScenarioError(f"--set {change}: {section} is not a table")
    table[last] = value
