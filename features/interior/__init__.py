"""The interior orientation of the remote-sensing camera, calibrated in orbit."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    "features.interior",
    commands=(
        Command(
            "remote-camera-calibrate",
            Job.CALIBRATE,
            "Calibrate the interior of the remote camera.",
            with_json=True,
        ),
    ),
)
