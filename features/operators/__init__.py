"""Files of satellite operators: Sentinel-2 datastrips, DIMAP products, measured points."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    "features.operators",
    commands=(
        Command(
            "import sentinel2",
            Job.EXCHANGE,
            "Make a dump of one band of a Sentinel-2 datastrip.",
            module="import_command",
        ),
        Command(
            "import dimap",
            Job.EXCHANGE,
            "Make a dump of a Pleiades, Pleiades Neo or SPOT strip.",
            module="import_command",
        ),
        Command(
            "import points",
            Job.EXCHANGE,
            "Make a points.csv of points measured elsewhere.",
            module="import_command",
        ),
        Command(
            "dimap",
            Job.EXCHANGE,
            "Geolocate by a DIMAP product, or check its grid.",
            with_json=True,
            module="grid_command",
        ),
        Command(
            "sentinel2",
            Job.EXCHANGE,
            "Check a Sentinel-2 model against its grid.",
            with_json=True,
            module="grid_command",
        ),
    ),
    groups={"import": "Make a dump of an operator's own files."},
)
