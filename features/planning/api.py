"""The accuracy of a campaign before any data."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from boresight.accepted import PathLike, in_unit, number_of, path_of, wrong
from boresight.features.planning.campaign_plan import Plan, PlanForecast, forecast_plan, read_plan
from boresight.pipeline.run.settings import settings_from_values

__all__ = ["forecast"]

LEAST_ARCSEC, MOST_ARCSEC = 1e-9, 1e9  # of a wanted accuracy


def forecast(
    plan: PathLike | Mapping[str, Mapping[str, Any]] | None = None, *, target_arcsec: float | None = None
) -> PlanForecast:
    """Expected 1-sigma of the installation matrix for a planned campaign, before any data.

    Parameters
    ----------
    plan : path or mapping of mappings, optional
        TOML file that describes cameras, strips, targets and errors, as for `boresight plan`, or the same as
        values: `{"strips": {"count": 12}, "targets": {"sigma_px": 0.2}}`; default: the paper's campaign.
    target_arcsec : float, optional
        Wanted 1-sigma on every axis, arcsec: the number of strips that reach it is returned, too.

    Returns
    -------
    PlanForecast
        `table`: 1-sigma about each axis against the number of strips, arcsec; `strips_needed`.

    Raises
    ------
    RawDataError
        If the file has unknown or wrong entries.
    DataNotSufficientError
        If the campaign cannot be forecast.
    ValueError
        If an argument is not as described.

    Examples
    --------
    >>> import boresight as bs
    >>> bs.forecast({"strips": {"count": 12}}).table.columns.tolist()
    ['strips', 'axis', 'sigma_arcsec', 'floor_arcsec']
    """
    if target_arcsec is not None:
        target_arcsec = number_of(target_arcsec, "target_arcsec", LEAST_ARCSEC, MOST_ARCSEC)
    return forecast_plan(_plan(plan), target_arcsec)


def _plan(plan: object) -> Plan:
    if plan is None or isinstance(plan, Mapping):
        return settings_from_values(Plan, _plain(plan or {}, "plan"), "plan", "plan")
    if not isinstance(plan, str | os.PathLike):
        raise wrong("plan", plan, "the path of a TOML file, or a mapping of sections")
    return read_plan(path_of(plan, "plan"))


def _plain(value: object, name: str) -> Any:
    """Mappings as dictionaries, arrays as lists, and NumPy's numbers as Python's, in the unit of the name."""
    if isinstance(value, Mapping):
        return {key: _plain(one, f"{name}.{key}") for key, one in value.items()}
    value = in_unit(value, name)
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value
