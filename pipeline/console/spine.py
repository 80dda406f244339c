"""The commands of the calibration itself."""

from __future__ import annotations

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["SPINE"]

_CONSOLE = "pipeline.console"  # module below `boresight` with the spine's commands
# The commands of the spine, in the form of a feature, each with a line of help.
SPINE = Feature(
    commands=(
        Command(
            "calibrate",
            Job.CALIBRATE,
            "Estimate the installation matrix from raw images.",
            f"{_CONSOLE}.calibrate_command:calibrate_command",
            with_json=True,
        ),
        Command(
            "validate",
            Job.CALIBRATE,
            "Compare a result with a simulated dump's truth.",
            f"{_CONSOLE}.validate_command:validate_command",
            with_json=True,
        ),
        Command(
            "status",
            Job.CALIBRATE,
            "Show what of a run is finished, and what is unused.",
            f"{_CONSOLE}.status_command:status_command",
            with_json=True,
        ),
        Command(
            "report",
            Job.CALIBRATE,
            "Draw one HTML page about a result.",
            f"{_CONSOLE}.report_command:report_command",
        ),
    ),
)
