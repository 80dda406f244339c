"""A folder for the files of a result that was given none."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

__all__ = ["ScratchFolder"]


class ScratchFolder:
    """A folder that exists as long as this object: the files of a result that was given no folder, written by
    `fill` when they are first asked for.
    """

    def __init__(self, fill: Callable[[Path], object] = lambda path: None) -> None:
        self._fill = fill

    @cached_property
    def path(self) -> Path:
        """The folder, filled."""
        path = Path(tempfile.mkdtemp(prefix="boresight-"))
        weakref.finalize(self, shutil.rmtree, path, ignore_errors=True)
        self._fill(path)
        return path
