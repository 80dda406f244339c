"""Pixels of a calibrated strip to places on the ground, and one virtual CCD of several."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    commands=(
        Command(
            "geolocate",
            Job.LOOK,
            "Image points of a strip to latitude, longitude.",
            "features.geolocate.geolocate_command:geolocate_command",
        ),
        Command(
            "virtual-ccd",
            Job.LOOK,
            "Stitch the CCDs of one strip to one ideal line.",
            "features.geolocate.virtual_ccd_command:virtual_ccd_command",
        ),
    ),
)
