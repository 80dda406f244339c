"""Missions with known truth."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from boresight import accepted, version
from boresight.accepted import PathLike, Progress, no_progress
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly, named_scenario
from boresight.version import __version__

__all__ = ["example", "simulate"]

# Folders of example dumps; in a checkout links to `fixtures`.
EXAMPLES = Path(version.__file__).with_name("examples")


def example(name: Literal["mini", "sky"] = "mini") -> Path:
    """The folder of an example dump, a small simulated mission with known truth.

    The package holds it: every installation has the same files, and with one version the same results.

    Parameters
    ----------
    name : str
        "mini": 42 star exposures, 3 strips of the ground, 36 targets; 23 MB.
        "sky": 12 star exposures, one strip of the sky; 2 MB.

    Returns
    -------
    Path
        The folder; it is shared: write nothing into it.

    Raises
    ------
    ValueError
        If there is no example of that name.

    Examples
    --------
    >>> import boresight as bs
    >>> (bs.example("sky") / "dump.toml").is_file()
    True
    """
    if name not in ("mini", "sky"):
        raise accepted.wrong("name", name, "'mini' or 'sky'")
    return (EXAMPLES / name).resolve()


def simulate(
    scenario: PathLike,
    out: PathLike,
    *,
    seed: int = 1,
    changes: Iterable[str] | str = (),
    progress: Progress = no_progress,
) -> Path:
    """Render a mission with known truth as a dump.

    Parameters
    ----------
    scenario : str or path
        "mini", "paper", "sky", or the path of a TOML file (docs/simulator.md).
    out : path
        Folder to make; it must not exist or be empty.
    seed : int
        All random numbers come from it.
    changes : str or iterable of str
        Changed settings such as "strips.count=5".
    progress : callable, optional
        Called with the stage, the tasks done and all tasks; default: a bar in a notebook, else nothing.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    ValueError
        If the folder holds files, or the scenario or a change is not known or not possible.
    RawDataError
        If a file of the scenario cannot be read.
    """
    name, told = os.fspath(accepted.path_of(scenario, "scenario")), accepted.progress_of(progress)
    folder, number = accepted.vacant_folder_of(out, "out"), accepted.count_of(seed, "seed")
    wanted = [
        accepted.instance_of(one, str, "changes") for one in accepted.listed(changes, "changes", "texts")
    ]
    made_by = f"boresight {__version__}: simulate {name} --seed {number}"
    write_dump(
        fly(named_scenario(name, wanted), number),
        folder,
        created_by=made_by,
        each=lambda render, images: map(render, accepted.counted(images, "images", told)),
    )
    return folder
