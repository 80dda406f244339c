"""The targets of a dump found in its strips."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import TYPE_CHECKING

import pandas as pd

from boresight.accepted import PathLike, Progress, counted, listed, no_progress, progress_of, source_of, wrong
from boresight.display import Result, axes_or_new
from boresight.features.targets.target_matches import matched_lines, matches_table
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.strip_tasks import strips_to_match
from boresight.records.record import record, scalar

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["TargetMatches", "match_targets"]


@record(kw_only=True)
class TargetMatches(Result):
    """Targets of a dump measured in its strips; `len()` counts the measurements, one a target and CCD."""

    measured: pd.DataFrame = scalar("one row a measurement or rejection, as `boresight match` writes them")

    def __len__(self) -> int:
        return int((self.measured["outcome"] == "placed").sum())

    def summary(self) -> str:
        """Three lines on what was found, as `print` shows them."""
        good = self.measured[self.measured["outcome"] == "placed"]
        return (
            f"{len(self)} targets measured in {good['strip_id'].nunique()} strips\n"
            f"median 1 sigma {good['sigma_sample_px'].median():.4f} px along samples, "
            f"{good['sigma_line_px'].median():.4f} px along lines\n"
            f"not used: {self._not_used()}"
        )

    def _not_used(self) -> str:
        """Counts of what was not measured, by reason."""
        outcomes = self.measured.loc[self.measured["outcome"] != "placed", "outcome"].value_counts()
        counts = [f"{n} {outcome}" for outcome, n in zip(outcomes.index.tolist(), outcomes.tolist())]
        return f"{', '.join(counts)} (reasons in table())" if counts else "nothing"

    def table(self) -> pd.DataFrame:
        """One row a measurement or rejection: strip_id, target_id, ccd, sample_px, line_px, ..., reason."""
        return self.measured

    def plot(self, ax: Axes | None = None) -> Axes:
        """Residuals of each strip's targets about the rotation that they have in common."""
        ax = axes_or_new(ax)
        for strip, rows in self.measured[self.measured["outcome"] == "placed"].groupby("strip_id"):
            ax.plot(
                rows["residual_sample_px"], rows["residual_line_px"], "o", fillstyle="none", label=str(strip)
            )
        ax.set(xlabel="residual along samples, px", ylabel="residual along lines, px")
        ax.grid(color="0.9")
        ax.legend(title="strip")
        return ax


def match_targets(
    dump: PathLike | Dump, *, strips: Iterable[str] | str | None = None, progress: Progress = no_progress
) -> TargetMatches:
    """Targets of a dump found in its raw strips, starting from the pre-launch installation matrix.

    Parameters
    ----------
    dump : path or Dump
        Folder with a dump.toml, or what `open_dump` returned.
    strips : str or iterable of str, optional
        Ids of the strips wanted; default: all.
    progress : callable, optional
        Called with the stage, the tasks done and all tasks; default: a bar in a notebook, else nothing.

    Returns
    -------
    TargetMatches
        Measurements with covariances, and rejections with reasons.

    Raises
    ------
    RawDataError
        If a file of the dump is missing or wrong; the message names file, field, found and expected.
    ValueError
        If the dump has no strip of that id, or an argument is not as described.
    DataNotSufficientError
        If no star exposures cover any strip.

    Examples
    --------
    >>> import boresight as bs
    >>> matches = bs.match_targets(bs.example("mini"), strips=["s01"])
    >>> len(matches)
    12
    """
    if not isinstance(dump, str | os.PathLike | Dump):
        raise wrong("dump", dump, "a path or an open Dump")
    told = progress_of(progress)
    chosen = None if strips is None else [str(one) for one in listed(strips, "strips", "ids of strips")]
    opened = dump if isinstance(dump, Dump) else open_dump(source_of(dump, "dump"))
    tasks, _ = strips_to_match(opened if chosen is None else opened.of_strips(chosen), Settings())
    return TargetMatches(measured=matches_table(list(matched_lines(counted(tasks, "targets", told)))))
