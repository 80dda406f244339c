"""The star cameras of one satellite against one another, and the noise of their attitudes."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    "features.heads",
    commands=(
        Command("noise", Job.CALIBRATE, "Estimate the noise of star cameras' attitudes.", with_json=True),
        Command("heads", Job.CALIBRATE, "Align a satellite's star cameras with one another.", with_json=True),
    ),
)
