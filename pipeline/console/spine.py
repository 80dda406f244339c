"""The commands of the calibration itself."""

from __future__ import annotations

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["SPINE"]

# The commands of the spine, in the form of a feature, each with a line of help.
SPINE = Feature(
    "pipeline.console",
    commands=(
        Command(
            "calibrate", Job.CALIBRATE, "Estimate the installation matrix from raw images.", with_json=True
        ),
        Command("validate", Job.CALIBRATE, "Compare a result with a simulated dump's truth.", with_json=True),
        Command(
            "status", Job.CALIBRATE, "Show what of a run is finished, and what is unused.", with_json=True
        ),
        Command("report", Job.CALIBRATE, "Draw one HTML page about a result."),
    ),
)
