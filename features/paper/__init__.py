"""The simulations of the paper, computed anew beside its printed values."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    "features.paper",
    commands=(Command("experiment", Job.PLAN, "Run a simulation of the paper from scratch."),),
)
