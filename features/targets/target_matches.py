"""Targets matched without a calibration: what the command `match` does.

dump -> stars, attitudes -> each strip: matches, refusals -> table (CSV or Parquet)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from boresight.gct_match.records import TargetMatch
from boresight.pipeline.files.text_tables import table_csv
from boresight.pipeline.files.whole_file import write_text
from boresight.pipeline.stages.strip import StripTask, strip_matches
from boresight.records.ledger import Entry, State
from boresight.records.record import Floats, record

__all__ = ["StripLine", "matched_lines", "matches_table", "write_matches"]


@record
class StripLine:
    """What became of one strip."""

    strip_id: str
    matches: tuple[TargetMatch, ...]
    refused: tuple[Entry, ...]
    theta: Floats  # (3,) rad, common rotation of its targets; NaN if they agree on none
    text: str

    @property
    def outcomes(self) -> tuple[TargetMatch | Entry, ...]:
        """Matches, then refusals, as the rows of `matches_table`."""
        return *self.matches, *self.refused


def matched_lines(tasks: Iterable[StripTask]) -> Iterator[StripLine]:
    """Match the strips one after another."""
    for task in tasks:
        result, omitted = strip_matches(task)
        if result is None:
            said = f"{task.strip.strip_id}   {omitted[-1].text}"
            yield StripLine(task.strip.strip_id, (), (), np.full(3, np.nan), said)
            continue
        in_view = tuple(entry for entry in result.refused if entry.state is not State.OUT_OF_VIEW)
        theta = ", ".join(f"{value:+.6f}" for value in result.theta_vote)
        counts = f"{len(result.matches)} matched, {len(in_view)} refused"
        text = f"{task.strip.strip_id}   {counts}, theta ({theta}) rad"
        yield StripLine(task.strip.strip_id, result.matches, in_view, result.theta_vote, text)


def write_matches(path: Path, lines: Sequence[StripLine]) -> None:
    """Write `matches_table`: Parquet if the file's name says so, else CSV."""
    table = matches_table(lines)
    if path.suffix == ".parquet":
        table.to_parquet(path, index=False)
    else:
        write_text(path, table_csv(table))


def matches_table(lines: Sequence[StripLine]) -> pd.DataFrame:
    """One row a measurement and one a rejection, with its reason."""
    rows: list[dict[str, object]] = []
    for line in lines:
        for m in line.matches:
            rows.append(
                {
                    "strip_id": line.strip_id,
                    "target_id": m.target_id,
                    "ccd": m.ccd,
                    "outcome": "placed",
                    "sample_px": m.xy_px[0],
                    "line_px": m.xy_px[1],
                    "sigma_sample_px": np.sqrt(m.cov_px[0, 0]),
                    "sigma_line_px": np.sqrt(m.cov_px[1, 1]),
                    "covariance_px2": m.cov_px[0, 1],
                    "correlation": m.correlation,
                    "probability_wrong": m.probability_wrong,
                    "model": m.model,
                    "predicted_sample_px": m.predicted_px[0],
                    "predicted_line_px": m.predicted_px[1],
                    "residual_sample_px": m.residual_px[0],
                    "residual_line_px": m.residual_px[1],
                    "reason": "",
                }
            )
        rows += [
            {
                "strip_id": line.strip_id,
                "target_id": entry.subject.id,
                "ccd": entry.subject.ccd,
                "outcome": "refused",
                "reason": entry.text,
            }
            for entry in line.refused
        ]
    return pd.DataFrame(rows)
