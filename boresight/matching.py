"""A template found in a picture."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from boresight.accepted import count_of, floats_of, instance_of, wrong
from boresight.display import SuccessfulResult, axes_or_new
from boresight.gct_match.locate import locate_template as match_arrays
from boresight.gct_match.records import TemplateMatch
from boresight.gct_match.settings import MatchSettings
from boresight.records.ledger import Entry, Reason
from boresight.records.record import Floats, record, scalar

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Match", "NotMatched", "match_template"]

# Radius of the search, px, and the largest start of a template, px: slips are beyond (set by hand).
LEAST_RADIUS_PX, MOST_RADIUS_PX, MOST_PX = 4, 1000, 1e6
LARGEST_VALUE = 1e15  # of a grey value: squares and sums of it stay finite


@record
class NotMatched:
    """A template that was not found in a picture; false in a condition."""

    reason: Reason = scalar("which test failed")
    value: float = scalar("value that failed the test; NaN if the test has none")
    limit: float = scalar("its limit in the unit of `value`; NaN if none")
    sentence: str = scalar("what was measured and what is needed")

    def __bool__(self) -> Literal[False]:
        return False

    def __str__(self) -> str:
        return self.sentence

    def __repr__(self) -> str:
        return f"not matched: {self.sentence}"


@record(kw_only=True)
class Match(SuccessfulResult, TemplateMatch):
    """A template found in a picture. Points are (column, row); (0, 0) is the centre of the first pixel."""

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
    template: ArrayLike,
    picture: ArrayLike,
    *,
    start_px: ArrayLike,
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
        If an array is not two-dimensional, the template is too small or larger than the picture, `start_px`
        is not in the picture or `radius_px` is not from 4 to 1000.

    Examples
    --------
    >>> import boresight as bs, numpy as np
    >>> from scipy.ndimage import gaussian_filter
    >>> ground = gaussian_filter(np.random.default_rng(1).normal(size=(200, 200)), 1.5) * 100
    >>> match = bs.match_template(ground[60:124, 50:114], ground + 5.0, start_px=(84, 88))
    >>> [round(float(x), 2) for x in match.xy_px] if match else match.sentence
    [81.5, 91.5]
    """
    chosen = instance_of(settings, MatchSettings, "settings")
    radius = count_of(radius_px, "radius_px", LEAST_RADIUS_PX, MOST_RADIUS_PX)
    small, large = _grey_values(template, "template"), _grey_values(picture, "picture")
    if min(small.shape) < chosen.smallest_template_px:
        raise wrong("template", f"shape {small.shape}", f"at least {chosen.smallest_template_px} px a side")
    if small.shape[0] > large.shape[0] or small.shape[1] > large.shape[1]:
        raise wrong("picture", f"shape {large.shape}", f"at least {small.shape}, the template's")
    start = floats_of(start_px, "start_px", "(2,)")
    if start.shape != (2,) or not (np.abs(start) <= MOST_PX).all():
        raise wrong("start_px", start_px, f"(column, row), finite numbers up to {MOST_PX:g}")
    found = match_arrays(small, large, (float(start[0]), float(start[1])), radius, settings=chosen)
    if isinstance(found, Entry):
        return NotMatched(found.reason, found.value, found.limit, found.text)
    return Match(**{field.name: getattr(found, field.name) for field in fields(found)})


def _grey_values(value: ArrayLike, name: str) -> Floats:
    """Grey values (H, W); NaN marks what is not to be used."""
    array = floats_of(value, name, "(H, W)")
    if array.ndim != 2 or not array.size:
        raise wrong(name, array, "grey values of shape (H, W)")
    with np.errstate(invalid="ignore"):
        if np.any(np.abs(array) > LARGEST_VALUE):
            raise wrong(name, "values beyond 1e15", "grey values; NaN where there is none")
    return array
