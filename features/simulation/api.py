"""Missions with known truth."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from platformdirs import user_cache_path

from boresight import version
from boresight.accepted import PathLike, count_of, instance_of, listed, new_folder_of, path_of, wrong
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly, named_scenario
from boresight.pipeline.files.whole_file import is_vacant
from boresight.version import __version__

__all__ = ["example", "simulate"]

CHECKOUT = Path(version.__file__).resolve().parents[1]  # the repository, where the package is used from one
EXAMPLES = ("mini", "sky")  # fixtures of the checkout, and built-in scenarios of the same name


def example(name: Literal["mini", "sky"] = "mini") -> Path:
    """The folder of an example dump, a small simulated mission with known truth.

    In a checkout it is a folder of `fixtures`. Otherwise the simulator renders it at first use, without any
    network, into the user's cache directory, from where later calls take it.

    Parameters
    ----------
    name : str
        "mini": 42 star exposures, 3 strips of the ground, 36 targets; 25 MB, rendered in about 8 s.
        "sky": 12 star exposures, one strip of the sky; 2 MB, about 1 s.

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
    if name not in EXAMPLES:
        raise wrong("name", name, " or ".join(map(repr, EXAMPLES)))
    fixture = CHECKOUT / "fixtures" / name
    if (CHECKOUT / "pyproject.toml").is_file() and (fixture / "dump.toml").is_file():
        return fixture
    folder = user_cache_path("boresight", appauthor=False) / "examples" / __version__ / name
    if not (folder / "dump.toml").is_file():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
            made = simulate(name, Path(scratch) / name)
            try:
                os.rename(made, folder)
            except OSError:  # another process was faster, or an incomplete folder is in the way
                if not (folder / "dump.toml").is_file():
                    shutil.rmtree(folder, ignore_errors=True)
                    os.rename(made, folder)
    return folder


def simulate(scenario: PathLike, out: PathLike, *, seed: int = 1, changes: Iterable[str] | str = ()) -> Path:
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
    name = os.fspath(path_of(scenario, "scenario"))
    folder, number = new_folder_of(out, "out"), count_of(seed, "seed")
    wanted = [instance_of(one, str, "changes") for one in listed(changes, "changes", "texts")]
    if not is_vacant(folder):
        raise ValueError(f"{folder} exists and is not an empty folder")
    made_by = f"boresight {__version__}: simulate {name} --seed {number}"
    write_dump(fly(named_scenario(name, wanted), number), folder, created_by=made_by)
    return folder
