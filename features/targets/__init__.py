"""Before a calibration: targets chosen and tried, dumps begun and checked."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    "features.targets",
    commands=(
        Command("match", Job.LOOK, "Find a dump's targets in its strips, no more.", with_json=True),
        Command("targets suggest", Job.PLAN, "Choose targets in ortho-images; write their chips."),
        Command("dump init", Job.CALIBRATE, "Write a skeleton of a dump, to be filled in."),
        Command("dump check", Job.CALIBRATE, "Check a dump: errors, footprints, targets.", with_json=True),
    ),
    groups={"targets": "Ground calibration targets.", "dump": "Dumps: begin one, check one."},
)
