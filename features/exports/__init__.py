"""Results in formats that other tools read: SPICE, CCSDS, CSM, RPC, FITS, GIS; one image of several CCDs."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    commands=(
        Command(
            "export",
            Job.EXCHANGE,
            "Write a result in formats that other tools read.",
            "features.exports.export_command:export_command",
        ),
        Command(
            "virtual-ccd",
            Job.LOOK,
            "Stitch the CCDs of one strip to one ideal line.",
            "features.exports.virtual_ccd_command:virtual_ccd_command",
        ),
    ),
)
