"""The accuracy of a campaign before any data."""

from __future__ import annotations

from pathlib import Path

from boresight.features.planning.campaign_plan import PlanForecast, forecast_plan, read_plan

__all__ = ["forecast"]


def forecast(plan: str | Path, *, target_arcsec: float | None = None) -> PlanForecast:
    """Expected 1-sigma of the installation matrix for a planned campaign, before any data.

    Parameters
    ----------
    plan : path
        TOML file that describes cameras, strips, targets and errors, as for `boresight plan`.
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
    """
    return forecast_plan(read_plan(Path(plan)), target_arcsec)
