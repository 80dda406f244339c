"""Files of satellite operators: Sentinel-2 datastrips, DIMAP products, measured points."""

from boresight.pipeline.console.feature import Command, Feature, Job

__all__ = ["FEATURE"]

IMPORTS = {
    "import sentinel2": "Make a dump of one band of a Sentinel-2 datastrip.",
    "import dimap": "Make a dump of a Pleiades, Pleiades Neo or SPOT strip.",
    "import points": "Make a points.csv of points measured elsewhere.",
}
GRIDS = {
    "dimap": "Geolocate by a DIMAP product, or check its grid.",
    "sentinel2": "Check a Sentinel-2 model against its grid.",
}

# What `boresight.features.table` finds of this feature: its commands, each with a line of help.
FEATURE = Feature(
    "features.operators",
    commands=(
        *(Command(name, Job.EXCHANGE, line, module="import_command") for name, line in IMPORTS.items()),
        *(Command(name, Job.EXCHANGE, line, True, "grid_command") for name, line in GRIDS.items()),
    ),
    groups={"import": "Make a dump of an operator's own files."},
)
