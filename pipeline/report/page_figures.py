"""The figures of a result's page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from boresight.pipeline.report import figures
from boresight.pipeline.report.observations import ExposureCard, SeenCard, TargetCard
from boresight.pipeline.report.saved import Saved
from boresight.pipeline.report.strips_on_sky import strips_on_sky

__all__ = ["page_figures"]


def page_figures(
    saved: Saved,
    targets: Sequence[TargetCard],
    exposures: Sequence[ExposureCard],
    strip_stars: Sequence[SeenCard],
) -> dict[str, Any]:
    """Drawings by name; of stars and of targets where there are any."""
    seen = "stars of strips" if strip_stars and not targets else "targets"
    drawings: dict[str, Any] = {
        "of targets": figures.squared_residual_histogram(saved, "targets", seen),
        "of attitudes": figures.allan_plot(saved),
        "of attitudes in time": figures.attitudes_in_time(saved),
        "convergence": figures.convergence(saved),
        "ellipses": figures.covariance_ellipses(saved),
        "on the sky": strips_on_sky(saved, strip_stars),
    }
    if saved.context["star_camera"] is not None:
        drawings |= {
            "of stars": figures.squared_residual_histogram(saved, "stars", "stars"),
            "of exposures": figures.exposure_chi2(saved, exposures),
            "angles": figures.angle_histogram(saved),
            "spread of angles": figures.angle_spread(saved),
            "star map": figures.star_residual_map(saved),
        }
    if targets or not strip_stars:
        drawings["residuals"] = figures.residual_panels(saved, targets)
    if strip_stars:
        drawings["star residuals"] = figures.star_residual_panels(saved, strip_stars)
    return drawings
