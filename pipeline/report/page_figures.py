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
    """Drawings by their names in the page's template; of stars and of targets where there are any."""
    has_stars = saved.context["star_camera"] is not None
    seen = "stars of strips" if strip_stars and not targets else "targets"
    statistics = [
        figures.squared_residual_histogram(saved, "stars", "stars") if has_stars else None,
        figures.squared_residual_histogram(saved, "targets", seen),
        figures.exposure_chi2(saved, exposures) if has_stars else None,
        figures.allan_plot(saved),
        figures.attitudes_in_time(saved),
    ]
    return {
        "convergence": figures.convergence(saved),
        "ellipses": figures.covariance_ellipses(saved),
        "on_sky": strips_on_sky(saved, strip_stars),
        "angles": [figures.angle_histogram(saved), figures.angle_spread(saved)] if has_stars else [],
        "star_map": figures.star_residual_map(saved) if has_stars else None,
        "statistics": [drawing for drawing in statistics if drawing is not None],
        "residuals": figures.residual_panels(saved, targets) if targets or not strip_stars else [],
        "star_residuals": figures.star_residual_panels(saved, strip_stars) if strip_stars else [],
    }
