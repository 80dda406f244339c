"""What every result of the package's functions can do: a summary of three lines, HTML, a table and a plot."""

from __future__ import annotations

import html
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

__all__ = ["Result", "SuccessfulResult", "axes_or_new", "feature_function"]


class Result:
    """Base of all results. `repr()` gives `summary()`; a notebook shows it with the head of `table()`."""

    __slots__ = ()

    def summary(self) -> str:
        """Three lines: what was found, its values with 1-sigma errors, what they rest on."""
        raise NotImplementedError

    def table(self) -> pd.DataFrame:
        """The result's rows as a pandas table; column names end with the unit."""
        raise NotImplementedError

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the result into `ax`, or into axes of a new figure, and return the axes."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        head = self.table().head(8).to_html(border=0, float_format="{:.6g}".format)
        return f"<pre>{html.escape(self.summary())}</pre>{head}"


class SuccessfulResult(Result):
    """Base of results of what may fail: true in a condition, where the reason of a failure is false."""

    __slots__ = ()

    def __bool__(self) -> Literal[True]:
        return True


def axes_or_new(ax: Axes | None) -> Axes:
    """The given axes, or those of a new figure."""
    if ax is not None:
        return ax
    from matplotlib.pyplot import figure  # 0.5 s to load; only needed to draw

    return figure(layout="constrained").add_subplot()


def feature_function(feature: str, name: str) -> Any:
    """A public function of a feature; `ImportError` where the feature was taken out of the package."""
    try:
        return getattr(import_module(f"boresight.features.{feature}.api"), name)
    except ModuleNotFoundError as error:
        raise ImportError(f"this installation has no feature {feature!r}, which {name} needs") from error
