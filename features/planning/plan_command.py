"""`boresight plan`: what a campaign will reach."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.features.planning.campaign_plan import forecast_plan, read_plan
from boresight.features.planning.figure import plot_forecast
from boresight.pipeline.console.arguments import option
from boresight.pipeline.console.messages import DATA_DID_NOT_ALLOW, DONE, Answer
from boresight.pipeline.files.text_tables import table_csv
from boresight.pipeline.files.whole_file import write_text

__all__ = ["plan_command"]


def plan_command(
    plan_file: Annotated[Path, typer.Argument(metavar="PLAN", help="TOML file that describes the campaign.")],
    target: float | None = option("Arcsec on every axis: how many strips are needed?", min=1e-9),
    out: Path | None = option("Folder for plan.csv and plan.png."),
) -> Answer:
    """Forecast how well a campaign will determine the installation matrix.

    Example: boresight plan plan.toml --target 0.5 --out forecast
    """
    found = forecast_plan(read_plan(plan_file), target)
    text, files = found.text, tuple[Path, ...]()
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_text(out / "plan.csv", table_csv(found.table, "%.6g"))
        plot_forecast(found.table, target, found.by_targets, found.without).savefig(
            out / "plan.png", dpi=110, bbox_inches="tight"
        )
        files = (out / "plan.csv", out / "plan.png")
        text += f"\n-> {files[0]}, {files[1]}"
    failed = target is not None and found.strips_needed is None
    return Answer(
        text=text,
        content={
            "strips_needed": found.strips_needed,
            "forecast": found.table.to_dict("records"),
            "by_targets": found.by_targets.to_dict("records"),
            "without": found.without.to_dict("records"),
            "campaigns": found.campaigns.to_dict("records"),
        },
        files=files,
        exit_status=DATA_DID_NOT_ALLOW if failed else DONE,
    )
