"""Results in formats that other tools read: SPICE, CCSDS, CSM, RPC, FITS, GIS; one image of several CCDs."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    "features.exports",
    commands=(
        Command("export", Job.EXCHANGE, "Write a result in formats that other tools read."),
        Command("virtual-ccd", Job.LOOK, "Stitch the CCDs of one strip to one ideal line."),
    ),
)
