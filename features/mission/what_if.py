"""A result with other strips or other errors, from its information: no image is read and nothing is fitted.

A strip's information is divided by the square of the factor by which its errors are larger; infinite leaves
it out. Matrix and covariance follow from the sum. Weights of targets within a strip stay as the calibration
left them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from boresight.calib.distortion import prior_information
from boresight.calib.information import solve_total
from boresight.display import Result, axes_or_new
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.results.reading import read_mounting, read_pairs
from boresight.records.record import Floats, array, record, scalar

__all__ = ["WhatIf", "strips_of_result", "what_if_of"]

OBSERVABLE_RAD = 1e-2  # 1-sigma about an axis above which the strips that are left do not determine it


@record(kw_only=True)
class WhatIf(Result):
    """Matrix and covariance of a result as it is, and with the change."""

    shift: Floats = array("3", "theta with the change less theta as it is, frame c, rad")
    covariance: Floats = array("3, 3", "of theta with the change, rad²")
    covariance_now: Floats = array("3, 3", "of theta as it is, rad²")
    strips: tuple[str, ...] = scalar("strips that are in it")

    def summary(self) -> str:
        """Shift, 1-sigma errors now and with the change."""
        lines = [f"from {len(self.strips)} strips{'':13s}{'X':>14s}{'Y':>14s}{'Z':>14s}"]
        for name, values in self.table().set_index("quantity").iterrows():
            lines.append(f"{name!s:26s}" + "".join(f"{value:14.4f}" for value in values))
        return "\n".join(lines)

    def table(self) -> pd.DataFrame:
        """One row a quantity, arcsec about X, Y, Z."""
        sigma, now = (np.sqrt(np.diag(C)) / ARCSEC for C in (self.covariance, self.covariance_now))
        rows = [("shift", *self.shift / ARCSEC), ("1 sigma", *sigma), ("1 sigma now", *now)]
        return pd.DataFrame(rows, columns=["quantity", "x_arcsec", "y_arcsec", "z_arcsec"])

    def plot(self, ax: Axes | None = None) -> Axes:
        """1-sigma now and with the change."""
        ax = axes_or_new(ax)
        for name, row in self.table().set_index("quantity").iloc[1:].iterrows():
            ax.plot(["X", "Y", "Z"], row.to_numpy(), "o", label=str(name))
        ax.set_ylabel("1 sigma, arcsec")
        ax.legend()
        return ax

    def content(self) -> dict[str, Any]:
        """For programs."""
        return {
            "shift_rad": self.shift.tolist(),
            "covariance_rad2": self.covariance.tolist(),
            "covariance_now_rad2": self.covariance_now.tolist(),
            "strips": list(self.strips),
        }


def strips_of_result(result: Path) -> list[str]:
    """Names of the strips, or of groups of strips taken together, whose information a result holds."""
    return [str(name) for name in read_pairs(result).names]


def what_if_of(result: Path, factors: Mapping[str, float], camera: str = "") -> WhatIf:
    """A finished result, of several cameras that of `camera`, with the errors of strips larger by factors, by
    the strip's name.

    `ValueError` for an unknown strip or a factor not above 0; `DataNotSufficientError` where what is left
    does not determine the matrix.
    """
    if not isinstance(factors, Mapping) or not all(isinstance(name, str) for name in factors):
        raise ValueError(f"factors is {type(factors).__name__}, expected a mapping of strips to numbers")
    if not all(isinstance(factor, (int, float)) for factor in factors.values()):
        raise ValueError("factors has a value that is no number")
    names = strips_of_result(result)
    if unknown := sorted(set(factors) - set(names)):
        raise ValueError(f"the result has no strip {unknown[0]!r}, only {', '.join(names)}")
    if wrong := [name for name, factor in factors.items() if not factor > 0.0]:
        raise ValueError(f"the factor of strip {wrong[0]!r} is {factors[wrong[0]]}, expected above 0")
    scale = {name: float(factor) ** -2.0 for name, factor in factors.items()}
    now, then = (read_mounting(result, "result", one, camera) for one in ({}, scale))
    prior = prior_information(now.shared)
    found = [
        solve_total(one.F[0], one.F_theta[0], prior, sigma_observable_rad=OBSERVABLE_RAD)
        for one in (now, then)
    ]
    if len(found[1].unobservable):
        raise DataNotSufficientError("the strips that are left do not determine the matrix")
    return WhatIf(
        shift=found[1].theta - found[0].theta,
        covariance=found[1].covariance,
        covariance_now=found[0].covariance,
        strips=tuple(name for name in names if np.isfinite(factors.get(name, 1.0))),
    )
