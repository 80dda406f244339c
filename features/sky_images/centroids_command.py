"""`boresight centroids`: the stars of images found and measured; with a truth, how well."""

from __future__ import annotations

import time
from pathlib import Path

from boresight.features.sky_images.centroid_report import ScoreRequest, centroid_limits, score_images
from boresight.features.sky_images.options import star_settings
from boresight.pipeline.console.arguments import SettingsFile, argument, option
from boresight.pipeline.console.limit_options import JunitFile, held
from boresight.pipeline.console.messages import Answer, tell, wrong_usage

__all__ = ["centroids_command"]


def centroids_command(
    images: list[Path] = argument("Star images: PNG, TIFF, FITS, JPEG or BMP."),
    *,
    asked: ScoreRequest,
    max_x_bound: float | None = option("Limit: rms error over the Cramér-Rao bound, at most.", min=0.0),
    min_complete: float | None = option("Limit: share of the true stars found, at least.", min=0.0, max=1.0),
    from_snr: float = option("The limits count stars of this signal-to-noise ratio and more.", 10.0, min=0.0),
    junit: JunitFile = None,
    settings: SettingsFile = None,
) -> Answer:
    """Find the stars of images and place them; with a truth, say how well: completeness, error, bound,
    bias. Exit status 4 if a limit is missed.

    Example: boresight centroids sky.png --truth stars.csv --max-x-bound 1.1 --min-complete 0.99
    """
    begun_s = time.perf_counter()
    if asked.truth is None and not (max_x_bound is None and min_complete is None and junit is None):
        raise wrong_usage("--max-x-bound, --min-complete and --junit need --truth")
    if asked.plot is not None and asked.truth is None:
        raise wrong_usage("--plot needs --truth")
    score = score_images(images, asked, star_settings(settings), tell)
    if score is None:
        return Answer()
    return held("centroids", centroid_limits(score, max_x_bound, min_complete, from_snr), junit, begun_s)
