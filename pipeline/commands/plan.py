"""The command `plan`: the accuracy that a campaign will reach, before any data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["add_plan_commands"]

DATA_DID_NOT_ALLOW = 1


def add_plan_commands(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command()(plan)


def plan(
    plan_file: Annotated[Path, typer.Argument(metavar="PLAN", help="TOML file that describes the campaign.")],
    target: Annotated[
        float | None, typer.Option(help="Arcsec on every axis: how many strips are needed?", min=1e-9)
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for plan.csv and plan.png.")] = None,
) -> None:
    """Forecast how well a campaign will determine the installation matrix."""
    from boresight.pipeline.experiments.plots import plot_forecast
    from boresight.pipeline.stages.plan import forecast_plan, read_plan

    found = forecast_plan(read_plan(plan_file), target)
    typer.echo(found.text)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        found.table.to_csv(out / "plan.csv", index=False, float_format="%.6g")
        plot_forecast(found.table, target).savefig(out / "plan.png", dpi=110, bbox_inches="tight")
        typer.echo(f"-> {out / 'plan.csv'}, {out / 'plan.png'}")
    if target is not None and found.strips_needed is None:
        raise typer.Exit(DATA_DID_NOT_ALLOW)
