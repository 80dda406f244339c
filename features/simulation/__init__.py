"""Missions with known truth, rendered as dumps."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    "features.simulation",
    commands=(Command("simulate", Job.PLAN, "Render a mission with known truth as a dump."),),
)
