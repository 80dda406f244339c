"""Before a calibration: targets chosen and tried, dumps begun and checked."""

from boresight.pipeline.console.feature import Command, Feature

__all__ = ["FEATURE"]

FEATURE = Feature(
    commands=(
        Command(
            "match",
            "Find a dump's targets in its strips, nothing more.",
            "features.targets.match_command:match_command",
            with_json=True,
        ),
        Command(
            "targets suggest",
            "Choose targets in ortho-images; write their chips.",
            "features.targets.targets_suggest_command:targets_suggest_command",
        ),
        Command(
            "dump init",
            "Write a skeleton of a dump, to be filled in.",
            "features.targets.dump_init_command:dump_init_command",
        ),
        Command(
            "dump check",
            "Check a dump: errors, footprints, targets.",
            "features.targets.dump_check_command:dump_check_command",
            with_json=True,
        ),
    ),
    groups={"targets": "Ground calibration targets.", "dump": "Dumps: begin one, check one."},
)
