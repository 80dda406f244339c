"""The star cameras of one satellite against one another, and the noise of their attitudes."""

from boresight.pipeline.console.feature import Command, Feature

__all__ = ["FEATURE"]

FEATURE = Feature(
    commands=(
        Command(
            "noise",
            "Estimate the noise of the star cameras' attitudes.",
            "features.heads.noise_command:noise_command",
            with_json=True,
        ),
        Command(
            "heads",
            "Align the star cameras of a satellite with one another.",
            "features.heads.heads_command:heads_command",
            with_json=True,
        ),
    ),
)
