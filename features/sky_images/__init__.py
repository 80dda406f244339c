"""Any photograph of the sky: its stars found and named, and the camera calibrated from them."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    "features.sky_images",
    commands=(
        Command("identify", Job.STARS, "Name the stars of images, wherever they look."),
        Command("centroids", Job.STARS, "Find the stars of images; with truth, say how well."),
        Command("star-camera-plan", Job.STARS, "Choose the fields that calibrate a camera best."),
        Command("star-camera-calibrate", Job.STARS, "Calibrate a star camera from images of the sky."),
    ),
)
