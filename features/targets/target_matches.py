"""Targets matched without a calibration: what the command `match` does.

dump -> stars, attitudes -> each strip: matches, refusals -> table (CSV or Parquet), pictures of matches
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from boresight.gct_match.records import TargetMatch
from boresight.geometry.ledger import Entry, State
from boresight.pipeline.files.text_tables import table_csv
from boresight.pipeline.files.whole_file import write_text
from boresight.pipeline.stages.strip import StripTask, strip_matches

__all__ = ["StripLine", "matched_lines", "matches_table", "overlay_picture", "write_matches"]

# Side of a picture of a match, px.
_PANEL_PX = 256


@dataclass(frozen=True, slots=True, eq=False)
class StripLine:
    """What became of one strip."""

    strip_id: str
    matches: tuple[TargetMatch, ...]
    refused: tuple[Entry, ...]
    text: str


def matched_lines(tasks: Iterable[StripTask], overlay: Path | None) -> Iterator[StripLine]:
    """Match the strips one after another; pictures of every place go to the folder `overlay`."""
    for task in tasks:
        result, omitted = strip_matches(task)
        if result is None:
            yield StripLine(task.strip.strip_id, (), (), f"{task.strip.strip_id}   {omitted[-1].text}")
            continue
        in_view = tuple(entry for entry in result.refused if entry.state is not State.OUT_OF_VIEW)
        if overlay is not None:
            overlay.mkdir(parents=True, exist_ok=True)
            for match in result.matches:
                name = f"{task.strip.strip_id}_{match.target_id}_ccd{match.ccd}.png"
                _save(overlay / name, overlay_picture(match))
        theta = ", ".join(f"{value:+.6f}" for value in result.theta_vote)
        counts = f"{len(result.matches)} matched, {len(in_view)} refused"
        text = f"{task.strip.strip_id}   {counts}, theta ({theta}) rad"
        yield StripLine(task.strip.strip_id, result.matches, in_view, text)


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


def overlay_picture(match: TargetMatch) -> NDArray[np.uint8]:
    """Picture (h, w): template, strip at the match, residual, correlation surface; figures below."""
    found, template = match.found, match.template
    low, high = np.percentile(found, [1.0, 99.0])
    span = max(float(high - low), 1e-6)
    shown = (template - template.mean()) * (found.std() / max(float(template.std()), 1e-6))
    residual = match.residual / (0.5 * span) + 0.5
    panels = (
        ("predicted", (shown + found.mean() - low) / span),
        ("found", (found - low) / span),
        ("residual x2", residual),
        ("correlation", np.clip(match.surface, 0.0, 1.0)),
    )
    pictures = [_panel(name, np.asarray(image, dtype=np.float32)) for name, image in panels]
    foot = np.full((44, len(pictures) * _PANEL_PX), 255, np.uint8)
    sigma = np.sqrt(np.diag(match.cov_px))
    texts = (
        f"{match.target_id}, CCD {match.ccd}: ({match.xy_px[0]:.3f}, {match.xy_px[1]:.3f}) px, "
        f"1 sigma ({sigma[0]:.4f}, {sigma[1]:.4f}), {match.model}",
        f"correlation {match.correlation:.3f}, probability of being wrong {match.probability_wrong:.1g}, "
        f"off the common rotation ({match.residual_px[0]:+.2f}, {match.residual_px[1]:+.2f}) px",
    )
    for n, text in enumerate(texts):
        cv2.putText(foot, text, (6, 16 + 20 * n), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0,), 1, cv2.LINE_AA)
    return np.vstack([np.hstack(pictures), foot])


def _panel(name: str, image: NDArray[np.float32]) -> NDArray[np.uint8]:
    grey = np.round(255.0 * np.clip(image, 0.0, 1.0)).astype(np.uint8)
    picture = cv2.resize(grey, (_PANEL_PX, _PANEL_PX), interpolation=cv2.INTER_NEAREST)
    cv2.putText(picture, name, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0,), 3, cv2.LINE_AA)
    cv2.putText(picture, name, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255,), 1, cv2.LINE_AA)
    return np.asarray(picture, dtype=np.uint8)


def _save(path: Path, picture: NDArray[np.uint8]) -> None:
    done, encoded = cv2.imencode(".png", picture)
    if not done:
        raise OSError(f"{path}: the picture could not be encoded")
    path.write_bytes(encoded.tobytes())
