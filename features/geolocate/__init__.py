"""Pixels of a calibrated strip to places on the ground."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    "features.geolocate",
    commands=(Command("geolocate", Job.LOOK, "Image points of a strip to latitude, longitude."),),
)
