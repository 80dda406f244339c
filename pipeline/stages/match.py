"""Targets matched without a calibration, and good targets suggested: what the commands `match` and `targets
suggest` do.

    dump -> stars, attitudes -> each strip: matches, refusals -> table (CSV or Parquet), pictures of matches
    ortho-image -> suggested targets -> chips (GeoTIFF) and targets.csv as a dump has them
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import rasterio
from numpy.typing import NDArray
from pyproj import CRS, Transformer

from boresight.gct_match.records import Refusal, TargetMatch
from boresight.gct_match.suggest import SuggestedTarget, suggest_targets
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.image_files import read_grid
from boresight.pipeline.stages.strip import StripTask, strip_matches

__all__ = ["StripLine", "match_strips", "matches_table", "overlay_picture", "suggest", "write_matches"]

MAX_ORTHO_PIXELS = 20_000 * 20_000
_PANEL_PX = 256
# docs/dump-format.md
TARGET_COLUMNS = (
    "id",
    "lat_deg",
    "lon_deg",
    "height_m",
    "height_kind",
    "sigma_east_m",
    "sigma_north_m",
    "sigma_up_m",
    "chip",
)


@dataclass(frozen=True, slots=True, eq=False)
class StripLine:
    """What became of one strip."""

    strip_id: str
    matches: tuple[TargetMatch, ...]
    refused: tuple[Refusal, ...]
    text: str


def match_strips(tasks: Sequence[StripTask], overlay: Path | None) -> Iterator[StripLine]:
    """Match the strips one after another; pictures of every place go to the folder `overlay`."""
    for task in tasks:
        result, omitted = strip_matches(task)
        if result is None:
            yield StripLine(task.strip.strip_id, (), (), f"{task.strip.strip_id}   {omitted[-1].reason}")
            continue
        in_view = tuple(r for r in result.refused if not r.is_out_of_view)
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
        table.to_csv(path, index=False, lineterminator="\n")


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
                "target_id": r.target_id,
                "ccd": r.ccd,
                "outcome": "refused",
                "reason": r.sentence,
            }
            for r in line.refused
        ]
    return pd.DataFrame(rows)


def overlay_picture(match: TargetMatch) -> NDArray[np.uint8]:
    """Picture (h, w): template, strip at the match, residual, correlation surface; figures below."""
    e = match.evidence
    low, high = np.percentile(e.found, [1.0, 99.0])
    span = max(float(high - low), 1e-6)
    template = (e.template - e.template.mean()) * (e.found.std() / max(float(e.template.std()), 1e-6))
    residual = e.residual / (0.5 * span) + 0.5
    panels = (
        ("predicted", (template + e.found.mean() - low) / span),
        ("found", (e.found - low) / span),
        ("residual x2", residual),
        ("correlation", np.clip(e.correlation, 0.0, 1.0)),
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


def suggest(
    ortho: Path, out: Path, *, size_px: int, most: int, height_m: float | None, sigma_m: float
) -> tuple[SuggestedTarget, ...]:
    """Good target positions in an ortho-image; their chips and a targets.csv for a dump go to `out`.

    Without `height_m` (ellipsoidal) the heights are left empty for the user, who has a terrain model or a
    survey. `RawDataError` for an unusable file, `DataNotSufficientError` if no target is found.
    """
    grid = read_grid(ortho, str(ortho), max_pixels=MAX_ORTHO_PIXELS)
    valid = np.isfinite(grid.values)
    try:
        found = suggest_targets(
            np.where(valid, grid.values, 0.0), grid.transform, valid, size_px=size_px, most=most
        )
    except ValueError as error:
        raise RawDataError(str(ortho), "image size", str(error), "a larger image or smaller chips") from error
    if not found:
        raise DataNotSufficientError(f"{ortho}: no place has a texture that is sharp and found only once")
    (out / "chips").mkdir(parents=True, exist_ok=True)
    to_degrees = Transformer.from_crs(CRS.from_user_input(grid.crs), CRS.from_epsg(4326), always_xy=True)
    a, b, c, d, e, f = grid.transform
    with (out / "targets.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(TARGET_COLUMNS)
        for n, target in enumerate(found, start=1):
            name = f"t{n:03d}"
            left, top = int(target.column) - size_px // 2, int(target.row) - size_px // 2
            corner = (a, b, a * left + b * top + c, d, e, d * left + e * top + f)
            chip = grid.values[top : top + size_px, left : left + size_px]
            _write_chip(out / "chips" / f"{name}.tif", chip, corner, grid.crs)
            lon, lat = to_degrees.transform(target.x, target.y)
            height = "" if height_m is None else f"{height_m:.3f}"
            sigma = f"{sigma_m:.3f}"
            place = [f"{lat:.9f}", f"{lon:.9f}", height, "ellipsoidal"]
            table.writerow([name, *place, sigma, sigma, sigma, f"chips/{name}.tif"])
    return found


def _write_chip(
    path: Path,
    image: NDArray[np.float32],
    transform: tuple[float, float, float, float, float, float],
    crs: str,
) -> None:
    whole = bool(np.all(image == np.round(image))) and image.min() >= 0.0 and image.max() <= 65535.0
    kind = "uint8" if whole and image.max() <= 255.0 else "uint16" if whole else "float32"
    profile = {
        "driver": "GTiff",
        "width": image.shape[1],
        "height": image.shape[0],
        "count": 1,
        "dtype": kind,
        "crs": crs,
        "transform": rasterio.Affine(*transform),
        "compress": "deflate",
    }
    with rasterio.open(path, "w", **profile) as file:
        file.write(image.astype(kind), 1)


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
