"""A template found in a picture."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from boresight.display import Outcome, Result, axes_or_new
from boresight.gct_match.locate import match_template as match_arrays
from boresight.gct_match.records import Refusal as NotMatched
from boresight.gct_match.records import TemplateMatch
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.record import record

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Match", "NotMatched", "match_template"]


@record(kw_only=True)
class Match(TemplateMatch, Outcome):
    """A template found in a picture. Points are (column, row); (0, 0) is the centre of the first pixel."""

    __repr__ = Result.__repr__

    def summary(self) -> str:
        (x, y), (sx, sy) = self.xy_px, np.sqrt(np.diag(self.cov_px))
        return (
            f"found at ({x:.3f} +- {sx:.3f}, {y:.3f} +- {sy:.3f}) px\n"
            f"correlation {self.correlation:.3f}, wrong with probability {self.probability_wrong:.1e}\n"
            f"{'affine map' if self.affine.any() else 'translation'} of {self.found.shape[1]} x "
            f"{self.found.shape[0]} px"
        )

    def table(self) -> pd.DataFrame:
        """One row: x_px, y_px, sigma_x_px, sigma_y_px, correlation, probability_wrong."""
        (x, y), (sx, sy) = self.xy_px, np.sqrt(np.diag(self.cov_px))
        values = {"x_px": x, "y_px": y, "sigma_x_px": sx, "sigma_y_px": sy}
        values |= {"correlation": self.correlation, "probability_wrong": self.probability_wrong}
        return pd.DataFrame([values])

    def plot(self, ax: Axes | None = None) -> Axes:
        """The picture where the template was found, and the fit's residual beside it, on one grey scale."""
        ax = axes_or_new(ax)
        beside = np.hstack([self.found, self.residual + np.median(self.found)])
        low, high = np.percentile(self.found, (1.0, 99.0))
        ax.imshow(beside, cmap="gray", vmin=low, vmax=high)
        ax.set_title("found | residual")
        ax.set_axis_off()
        return ax


def match_template(
    template: NDArray[np.generic],
    picture: NDArray[np.generic],
    *,
    start_px: tuple[float, float],
    radius_px: int = 8,
    settings: MatchSettings = MatchSettings(),  # noqa: B008
) -> Match | NotMatched:
    """Position of a template in a picture, to a few hundredths of a pixel, with its covariance.

    Light, season and haze may differ between the two; scale and orientation must agree to a few percent.

    Parameters
    ----------
    template : (h, w) array
        Grey values, at least 32 px a side; NaN marks pixels not to be used.
    picture : (H, W) array
        Grey values; NaN marks pixels not to be used. It should show the template and `radius_px` + 8 px on
        every side of it.
    start_px : (column, row)
        Expected position in the picture of the template's middle, ((w - 1) / 2, (h - 1) / 2) in its own
        pixels.
    radius_px : int
        Half width of the search window, px, at least 4.
    settings : MatchSettings
        Limits of acceptance.

    Returns
    -------
    Match or NotMatched
        `NotMatched` is false, has a `reason`, and says in `sentence` what was measured and what is needed.

    Raises
    ------
    ValueError
        If an array is not two-dimensional, the template too small or `radius_px` below 4.

    Examples
    --------
    >>> import boresight as bs, numpy as np
    >>> from scipy.ndimage import gaussian_filter
    >>> ground = gaussian_filter(np.random.default_rng(1).normal(size=(200, 200)), 1.5) * 100
    >>> match = bs.match_template(ground[60:124, 50:114], ground + 5.0, start_px=(84, 88))
    >>> [round(float(x), 2) for x in match.xy_px] if match else match.sentence
    [81.5, 91.5]
    """
    found = match_arrays(template, picture, start_px, radius_px, settings=settings)
    if isinstance(found, NotMatched):
        return found
    return Match(**{field.name: getattr(found, field.name) for field in fields(found)})
