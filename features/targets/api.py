"""The targets of a dump found in its strips."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from boresight.display import Result, axes_or_new
from boresight.features.targets.target_matches import match_strips, matches_table
from boresight.geometry.record import record, scalar
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.calibrate import strips_to_match

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["TargetMatches", "match_targets"]


@record(kw_only=True)
class TargetMatches(Result):
    """Targets of a dump measured in its strips; `len()` counts the measurements, one a target and CCD."""

    measured: pd.DataFrame = scalar("one row a measurement or rejection, as `boresight match` writes them")

    __repr__ = Result.__repr__

    def __len__(self) -> int:
        return int((self.measured["outcome"] == "placed").sum())

    def summary(self) -> str:
        """Three lines, as `print` shows them."""
        good = self.measured[self.measured["outcome"] == "placed"]
        return (
            f"{len(self)} targets measured in {good['strip_id'].nunique()} strips\n"
            f"median 1 sigma {good['sigma_sample_px'].median():.4f} px along samples, "
            f"{good['sigma_line_px'].median():.4f} px along lines\n"
            f"{len(self.measured) - len(self)} rejected, with the reason in table()"
        )

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


def match_targets(dump: str | Path | Dump, *, strips: Sequence[str] | None = None) -> TargetMatches:
    """Targets of a dump found in its raw strips, starting from the pre-launch installation matrix.

    Parameters
    ----------
    dump : path or Dump
        Folder with a dump.toml, or what `open_dump` returned.
    strips : sequence of str, optional
        Ids of the strips wanted; default: all.

    Returns
    -------
    TargetMatches
        Measurements with covariances, and rejections with reasons.

    Raises
    ------
    RawDataError
        If a file of the dump is missing or wrong; the message names file, field, found and expected.
    ValueError
        If the dump has no strip of that id.

    Examples
    --------
    >>> import boresight as bs
    >>> matches = bs.match_targets("fixtures/mini", strips=["s01"])
    >>> len(matches)
    12
    """
    opened = open_dump(dump)
    if unknown := set(strips or ()) - {strip.strip_id for strip in opened.strips}:
        raise ValueError(f"the dump has no strip {', '.join(sorted(unknown))}")
    tasks, _ = strips_to_match(opened, Settings())
    wanted = [task for task in tasks if strips is None or task.strip.strip_id in strips]
    return TargetMatches(measured=matches_table(list(match_strips(wanted, None))))
