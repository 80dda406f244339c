"""Files of satellite operators: Sentinel-2 datastrips, DIMAP products, measured points."""

from boresight.pipeline.console.feature import Command, Feature

__all__ = ["FEATURE"]

FEATURE = Feature(
    commands=(
        Command(
            "import sentinel2",
            "Make a dump of one band of a Sentinel-2 datastrip.",
            "features.operators.import_command:import_sentinel2_command",
        ),
        Command(
            "import dimap",
            "Make a dump of a Pleiades, Pleiades Neo or SPOT strip.",
            "features.operators.import_command:import_dimap_command",
        ),
        Command(
            "import points",
            "Make a points.csv of points measured elsewhere.",
            "features.operators.import_command:import_points_command",
        ),
        Command(
            "dimap",
            "Geolocate pixels of a DIMAP strip, or check its grid.",
            "features.operators.dimap_command:dimap_command",
            with_json=True,
        ),
        Command(
            "sentinel2",
            "Check a Sentinel-2 model against its location grid.",
            "features.operators.sentinel2_command:sentinel2_command",
            with_json=True,
        ),
    ),
    groups={"import": "Make a dump of an operator's own files."},
)
