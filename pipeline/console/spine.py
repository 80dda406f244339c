"""The commands of the calibration itself."""

from __future__ import annotations

from boresight.pipeline.console.feature import Command, Feature

__all__ = ["SPINE"]

_CONSOLE = "pipeline.console"
SPINE = Feature(
    commands=(
        Command(
            "calibrate",
            "Estimate the installation matrix from raw images.",
            f"{_CONSOLE}.calibrate_command:calibrate_command",
            with_json=True,
        ),
        Command(
            "validate",
            "Compare a result with the truth of a simulated dump.",
            f"{_CONSOLE}.validate_command:validate_command",
            with_json=True,
        ),
        Command(
            "status",
            "Show what of a run is finished, and what is not used.",
            f"{_CONSOLE}.status_command:status_command",
            with_json=True,
        ),
        Command("report", "Draw one HTML page about a result.", f"{_CONSOLE}.report_command:report_command"),
    ),
)
