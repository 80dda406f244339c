"""The picture of docs/plan.md from its example: `python scripts/figures/plan.py [FOLDER]`."""

from __future__ import annotations

import re
import tempfile
from dataclasses import replace
from pathlib import Path

from style import IMAGES

from boresight.features.planning.campaign_plan import Plan, PlannedSky, forecast_plan, read_plan
from boresight.features.planning.figure import plot_forecast

DOCS = Path(__file__).parents[2] / "docs"


def example() -> Plan:
    """The plan that the page shows."""
    found = re.search(r"```toml\n(.*?)```", (DOCS / "plan.md").read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plan.toml"
        path.write_text(found[1], encoding="utf-8")
        return read_plan(path)


def main() -> None:
    found = forecast_plan(replace(example(), sky=PlannedSky()))  # strips of the sky are not drawn
    figure = plot_forecast(found.table, None, found.by_targets, found.without)
    figure.savefig(IMAGES / "plan.png", dpi=110, bbox_inches="tight")


if __name__ == "__main__":
    main()
