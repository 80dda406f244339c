"""Before any data: what a campaign will reach, and which scans of the sky to take."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    "features.planning",
    commands=(
        Command("plan", Job.PLAN, "Forecast how well a campaign tells the matrix.", with_json=True),
        Command("sky-strip-plan", Job.PLAN, "Choose the scans of the sky that tell most.", with_json=True),
    ),
)
