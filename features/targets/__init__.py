"""Before a calibration: targets chosen and tried, dumps begun and checked."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    commands=(
        Command(
            "match",
            Job.LOOK,
            "Find a dump's targets in its strips, no more.",
            "features.targets.match_command:match_command",
            with_json=True,
        ),
        Command(
            "targets suggest",
            Job.PLAN,
            "Choose targets in ortho-images; write their chips.",
            "features.targets.targets_suggest_command:targets_suggest_command",
        ),
        Command(
            "dump init",
            Job.CALIBRATE,
            "Write a skeleton of a dump, to be filled in.",
            "features.targets.dump_init_command:dump_init_command",
        ),
        Command(
            "dump check",
            Job.CALIBRATE,
            "Check a dump: errors, footprints, targets.",
            "features.targets.dump_check_command:dump_check_command",
            with_json=True,
        ),
    ),
    groups={"targets": "Ground calibration targets.", "dump": "Dumps: begin one, check one."},
)
