"""The uncertainty budget as pages show it: each source's share of the variance about each axis."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from boresight.pipeline.report.page_template import number_from

__all__ = ["CONTEXT", "JOINT_BUDGET", "budget_rows"]

# Files that hold the budget: of one dump with all else of its page, of several dumps by itself.
CONTEXT = "evidence/context.json"
JOINT_BUDGET = "evidence/budget.json"


def budget_rows(
    content: Mapping[str, Any], installation: Mapping[str, Any], source: str = CONTEXT
) -> list[dict[str, Any]]:
    """A row for each source: name, shares about X, Y and Z, %, and the lengths of their bars; none of a
    result that does not know its budget.

    `content` is that of the file `source` of the result, `installation` that of installation.json.
    """
    total = [installation["covariance_rad2"][i][i] for i in range(3)]
    rows = []
    for n, one in enumerate(content.get("budget", ())):
        percent = [
            number_from(content, source, f"budget.{n}.covariance_rad2.{i}.{i}", ".1f", scale=100.0 / total[i])
            for i in range(3)
        ]
        width = [f"{100.0 * one['covariance_rad2'][i][i] / total[i]:.1f}" for i in range(3)]
        rows.append({"source": one["source"], "percent": percent, "width": width})
    return rows
