"""Missions with known truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly, named_scenario
from boresight.pipeline.files.whole_file import is_vacant
from boresight.version import __version__

__all__ = ["simulate"]


def simulate(scenario: str, out: str | Path, *, seed: int = 1, changes: Sequence[str] = ()) -> Path:
    """Render a mission with known truth as a dump.

    Parameters
    ----------
    scenario : str
        "mini", "paper", "sky", or the path of a TOML file (docs/simulator.md).
    out : path
        Folder to make; it must not exist or be empty.
    seed : int
        All random numbers come from it.
    changes : sequence of str
        Changed settings such as "strips.count=5".

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    ValueError
        If the folder holds files, or the scenario or a change is not known.
    """
    folder = Path(out)
    if not is_vacant(folder):
        raise ValueError(f"{folder} exists and is not an empty folder")
    made_by = f"boresight {__version__}: simulate {scenario} --seed {seed}"
    write_dump(fly(named_scenario(scenario, changes), seed), folder, created_by=made_by)
    return folder
