"""Centroids of images as a CSV table, and their score against a list of true stars as text and plot."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from boresight.features.sky_images.options import Dark
from boresight.features.sky_images.score import CentroidScore, score_centroids
from boresight.pipeline.console.arguments import option
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.images.star_images import read_star_image
from boresight.pipeline.files.text_files import read_text
from boresight.pipeline.files.text_tables import table_csv
from boresight.pipeline.files.whole_file import write_figure, write_text
from boresight.pipeline.report.panels import GREY, SERIES, panels
from boresight.pipeline.results.limits import Limit, given_limits
from boresight.records.record import record
from boresight.star_id.finding.star_list import StarList, list_stars
from boresight.star_id.settings import StarSettings

__all__ = ["ScoreRequest", "centroid_limits", "draw_score", "score_images", "score_lines"]

Array = NDArray[np.float64]


@record(kw_only=True)
class ScoreRequest:
    """What is known of images, and what is written."""

    truth: Path | None = option("CSV with columns x_px, y_px, flux_dn (and file, for several images).")
    psf_sigma_px: float | None = option("PSF width, if known.", min=0.1, max=1e3)
    gain: float | None = option("Electrons per DN, if known.", min=1e-9, max=1e9)
    dark: Dark = None
    out: Path | None = option("CSV file for all centroids with their errors.")
    plot: Path | None = option("PNG of error against SNR and bias against phase.")


def score_images(
    images: Sequence[Path], asked: ScoreRequest, settings: StarSettings, say: Callable[[str], None]
) -> CentroidScore | None:
    """The score of the centroids of images, where `truth` is given.

    `say` gets a line for each image, then those of the score.

    `RawDataError` for a damaged file or unequal sizes.
    """
    if asked.gain is not None:
        settings = replace(settings, gain_e_per_dn=asked.gain)
    true_stars = None if asked.truth is None else _read_truth(asked.truth)
    dark = None if asked.dark is None else read_star_image(asked.dark, str(asked.dark))
    lists, truths, tables, top = [], [], [], 255.0
    for path in images:
        image = read_star_image(path, str(path))
        if dark is not None and dark.shape != image.shape:
            shapes = (f"{d.shape[1]} x {d.shape[0]} px" for d in (dark, image))
            raise RawDataError(str(asked.dark), "image size", *shapes)
        stars = list_stars(image, settings, dark)
        whole_numbers = image.dtype.kind == "u"
        top = settings.saturation_dn or (float(np.iinfo(image.dtype).max) if whole_numbers else np.inf)
        tables.append(_table(path, stars))
        say(
            f"{path}   {len(stars.xy_px)} stars above {stars.threshold:.2f} sigma   "
            f"PSF sigma {stars.psf.sigma_px:.3f} px from {stars.psf_stars} stars   "
            f"{stars.hot_pixels} hot pixels, {stars.misshapen} trails or cosmic rays rejected"
        )
        if true_stars is not None:
            lists.append(stars)
            truths.append(_truth_of(true_stars, path, len(images), str(asked.truth)))
    if asked.out is not None:
        write_text(asked.out, table_csv(pd.concat(tables)))
    if true_stars is None:
        return None
    psf = None
    if (sigma := asked.psf_sigma_px) is not None:
        psf = replace(lists[0].psf, sigma_px=sigma, sigma_corner_px=sigma, smear_px=(0.0, 0.0))
    score = score_centroids(lists, truths, saturation_dn=top, psf=psf, gain_e_per_dn=asked.gain)
    say("\n".join(score_lines(score, len(images))))
    if asked.plot is not None:
        draw_score(score, asked.plot)
    return score


def score_lines(score: CentroidScore, frames: int) -> list[str]:
    """The score as text: one line per bin of signal-to-noise ratio, with standard errors."""
    lines = ["  SNR          stars complete   rms px bound px  x bound           chi2"]
    for k, (low, high) in enumerate(zip(score.snr_edges[:-1], score.snr_edges[1:])):
        if score.stars[k]:
            complete = score.found[k] / score.stars[k]
            lines.append(
                f"{low:5.0f} -{high:6.0f} {score.stars[k]:6d} {complete:8.4f} {score.rms_px[k]:8.4f}"
                f" {score.bound_px[k]:8.4f} {score.over_bound[k]:8.3f} +-{score.over_bound_error[k]:6.3f}"
                f" {score.chi2[k]:6.2f} +-{score.chi2_error[k]:5.2f}"
            )
    worst = np.nanmax(np.abs(score.phase_bias_px)) if np.isfinite(score.phase_bias_px).any() else np.nan
    error = np.nanmax(score.phase_error_px) if np.isfinite(score.phase_error_px).any() else np.nan
    lines.append(f"false detections {score.false} in {frames} images")
    lines.append(f"largest bias over pixel phase {worst:.4f} px (standard error of a phase {error:.4f} px)")
    return lines


def draw_score(score: CentroidScore, path: Path) -> None:
    """Write a PNG: error and Cramér-Rao bound against SNR, mean error against pixel phase."""
    figure, ((left, right),) = panels(1, 2, 3.0)
    middle = np.sqrt(score.snr_edges[:-1] * np.minimum(score.snr_edges[1:], 2.0 * score.snr_edges[:-1]))
    left.loglog(middle, score.rms_px, "o", color=SERIES[0][0], label="rms error, one axis")
    left.loglog(middle, score.bound_px, "-", color=SERIES[1][0], label="Cramér-Rao bound")
    left.set(xlabel="signal-to-noise ratio", ylabel="px")
    left.legend(fontsize=8, frameon=False)
    phases = len(score.phase_bias_px)
    phase = (np.arange(phases) + 0.5) / phases - 0.5
    for axis, (name, (colour, _, marker)) in enumerate(zip(("column", "row"), SERIES)):
        bias, error = score.phase_bias_px[:, axis], score.phase_error_px[:, axis]
        right.errorbar(phase, bias, error, fmt=marker, color=colour, label=name)
    right.axhline(0.0, color=GREY, lw=0.8)
    right.set(xlabel="pixel phase, px", ylabel="mean error, px")
    right.legend(fontsize=8, frameon=False)
    write_figure(path, figure)


def _table(path: Path, stars: StarList) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "file": str(path),
            "x_px": stars.xy_px[:, 0],
            "y_px": stars.xy_px[:, 1],
            "sigma_x_px": np.sqrt(stars.cov_px[:, 0, 0]),
            "sigma_y_px": np.sqrt(stars.cov_px[:, 1, 1]),
            "cov_xy_px2": stars.cov_px[:, 0, 1],
            "flux_dn": stars.flux_dn,
            "snr": stars.snr,
            "saturated": stars.saturated,
            "blended": stars.blended,
            "psf_sigma_px": stars.psf.sigma_px,
        }
    )


def _read_truth(path: Path) -> pd.DataFrame:
    text = read_text(path, str(path))
    with refusing(str(path), "file", "a CSV file with x_px, y_px, flux_dn", (ValueError, OverflowError)):
        table = pd.read_csv(io.StringIO(text))
    for column in ("x_px", "y_px", "flux_dn"):
        if column not in table or not pd.api.types.is_numeric_dtype(table[column]):
            found = ", ".join(map(str, table.columns[:20]))
            raise RawDataError(str(path), f"column {column}", found, "x_px, y_px, flux_dn as numbers")
    return table


def _truth_of(table: pd.DataFrame, image: Path, images: int, file: str) -> tuple[Any, Any]:
    if "file" in table:
        table = table[table["file"].map(lambda name: Path(str(name)).name) == image.name]
    elif images > 1:
        raise RawDataError(
            file, "column file", "none", "the name of the image for each star: there are several"
        )
    return table[["x_px", "y_px"]].to_numpy(float), table["flux_dn"].to_numpy(float)


def centroid_limits(
    score: CentroidScore,
    max_x_bound: float | None = None,
    min_complete: float | None = None,
    from_snr: float = 10.0,
) -> list[Limit]:
    """The limits that are given, against a score of centroids, over all stars of at least `from_snr` (rounded
    up to the next edge of the score's bins): root mean square of error over Cramer-Rao bound, and the share
    of the true stars that are found.
    """
    bins = (score.snr_edges[:-1] >= from_snr) & (score.stars > 0)
    found, over = score.found[bins], score.over_bound[bins]
    seen = found > 0
    x_bound = np.sqrt(np.average(over[seen] ** 2, weights=found[seen])) if seen.any() else np.nan
    complete = found.sum() / score.stars[bins].sum() if bins.any() else np.nan
    stars = f"of {score.stars[bins].sum()} stars of SNR {from_snr:g} and more"
    figures = (
        ("max-x-bound", x_bound, max_x_bound, f"error over bound {stars}"),
        ("min-complete", complete, min_complete, f"share found {stars}"),
    )
    return given_limits(figures)
