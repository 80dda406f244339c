"""Whether the mounting moved between several results."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    commands=(
        Command(
            "drift",
            Job.CALIBRATE,
            "Merge results; test whether the mounting has moved.",
            "features.drift.drift_command:drift_command",
            with_json=True,
        ),
    ),
    after_joint="features.drift.drift_files:drift_of_dumps",
)
