"""A mission over years: results compared, archived, and the course of the mounting through all of them."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    "features.mission",
    commands=(
        Command("compare", Job.CALIBRATE, "Test whether the matrices of two results differ.", with_json=True),
        Command("archive add", Job.CALIBRATE, "Add results to the archive of a mission.", with_json=True),
        Command("trends", Job.CALIBRATE, "Model the mounting over years.", with_json=True),
        Command(
            "what-if", Job.CALIBRATE, "Leave out or reweight strips of a result, at once.", with_json=True
        ),
    ),
    groups={"archive": "The archive of a mission."},
    after_joint="features.mission.joint_trend:trend_of_dumps",
    to_archive="features.mission.archive:add_results",
)
