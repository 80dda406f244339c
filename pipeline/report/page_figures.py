"""The figures of a result's page, drawn side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from boresight.pipeline.report import figures
from boresight.pipeline.report.observations import ExposureCard, SeenCard, TargetCard
from boresight.pipeline.report.saved import Saved
from boresight.pipeline.report.strips_on_sky import strips_on_sky
from boresight.pipeline.run.executor import Executor

__all__ = ["page_figures"]


def page_figures(
    saved: Saved,
    targets: Sequence[TargetCard],
    exposures: Sequence[ExposureCard],
    strip_stars: Sequence[SeenCard],
    executor: Executor,
) -> dict[str, Any]:
    """Drawings by name; of stars and of targets where there are any."""
    seen = "stars of strips" if strip_stars and not targets else "targets"
    to_draw: dict[str, Callable[[], Any]] = {
        "of targets": partial(figures.squared_residual_histogram, saved, "targets", seen),
        "of attitudes": partial(figures.allan_plot, saved),
        "convergence": partial(figures.convergence, saved),
        "ellipses": partial(figures.covariance_ellipses, saved),
    }
    if saved.context["star_camera"] is not None:
        to_draw |= {
            "of stars": partial(figures.squared_residual_histogram, saved, "stars", "stars"),
            "of exposures": partial(figures.exposure_chi2, saved, exposures),
            "angles": partial(figures.angle_histogram, saved),
            "spread of angles": partial(figures.angle_spread, saved),
            "star map": partial(figures.star_residual_map, saved),
        }
    if targets or not strip_stars:
        to_draw["residuals"] = partial(figures.residual_panels, saved, targets)
    if strip_stars:
        to_draw["star residuals"] = partial(figures.star_residual_panels, saved, strip_stars)
    to_draw["on the sky"] = partial(strips_on_sky, saved, strip_stars)
    return dict(zip(to_draw, executor.map(_drawn, list(to_draw.values()), lambda n, figure: None)))


def _drawn(figure: Callable[[], Any]) -> Any:
    return figure()
