"""The uncertainty budget as pages show it: each source's share of the variance about each axis."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from boresight.pipeline.report.saved import number_from

__all__ = ["CONTEXT", "budget_rows"]

CONTEXT = "evidence/context.json"  # file of a result that holds the budget


def budget_rows(context: Mapping[str, Any], installation: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row for each source: name, shares about X, Y and Z, %, and the lengths of their bars; none of a
    result that does not know its budget.

    `context` is the content of `CONTEXT`, `installation` that of installation.json.
    """
    total = [installation["covariance_rad2"][i][i] for i in range(3)]
    rows = []
    for n, one in enumerate(context.get("budget", ())):
        percent = [
            number_from(
                context, CONTEXT, f"budget.{n}.covariance_rad2.{i}.{i}", ".1f", scale=100.0 / total[i]
            )
            for i in range(3)
        ]
        width = [f"{100.0 * one['covariance_rad2'][i][i] / total[i]:.1f}" for i in range(3)]
        rows.append({"source": one["source"], "percent": percent, "width": width})
    return rows
