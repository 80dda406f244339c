"""The other side of bench_rugged.py: the same scene through Orekit's Rugged, in an environment of its own.

    python -m venv peer && peer/bin/pip install orekit-jpype numpy      (and Java 11 or newer)
    peer/bin/python benchmarks/rugged_peer.py scene.npz result.npz

Imports nothing of boresight. The scene is arrays; Earth orientation is finals2000A.all and a table of leap
seconds, written beside the scene by bench_rugged.py.
"""

import sys
from pathlib import Path

import jpype
import numpy as np
import orekit_jpype

orekit_jpype.initVM()

from java.io import File  # noqa: E402
from java.lang import System  # noqa: E402
from java.util import ArrayList  # noqa: E402
from org.hipparchus.geometry.euclidean.threed import Rotation, Vector3D  # noqa: E402
from org.orekit.data import DataContext, DirectoryCrawler  # noqa: E402
from org.orekit.rugged.api import (  # noqa: E402
    AlgorithmId,
    BodyRotatingFrameId,
    EllipsoidId,
    InertialFrameId,
    RuggedBuilder,
)
from org.orekit.rugged.linesensor import LinearLineDatation, LineSensor  # noqa: E402
from org.orekit.rugged.los import LOSBuilder  # noqa: E402
from org.orekit.rugged.raster import TileUpdater  # noqa: E402
from org.orekit.rugged.refraction import MultiLayerModel  # noqa: E402
from org.orekit.time import AbsoluteDate, TimeScalesFactory  # noqa: E402
from org.orekit.utils import (  # noqa: E402
    AngularDerivativesFilter,
    CartesianDerivativesFilter,
    TimeStampedAngularCoordinates,
    TimeStampedPVCoordinates,
)


@jpype.JImplements(TileUpdater)
class Terrain:
    """One tile that holds the whole grid: heights[row, column] at latitude first + row step."""

    def __init__(self, heights, south, west, step):
        self.heights, self.south, self.west, self.step = heights, south, west, step

    @jpype.JOverride
    def updateTile(self, latitude, longitude, tile):
        rows, columns = self.heights.shape
        tile.setGeometry(self.south, self.west, self.step, self.step, rows, columns)
        for row in range(rows):
            for column in range(columns):
                tile.setElevation(row, column, float(self.heights[row, column]))


def dates(scene):
    origin = AbsoluteDate(2000, 1, 1, 12, 0, 0.0, TimeScalesFactory.getTAI())
    start = origin.shiftedBy(float(scene["epoch_tai_s"]))
    return lambda t_s: start.shiftedBy(float(t_s))


def trajectory(scene, date):
    orbit, attitude = ArrayList(), ArrayList()
    for t, p, v in zip(scene["orbit_t"], scene["orbit_p"], scene["orbit_v"]):
        orbit.add(TimeStampedPVCoordinates(date(t), Vector3D(*map(float, p)), Vector3D(*map(float, v))))
    for t, R in zip(scene["attitude_t"], scene["attitude_R"]):
        rotation = Rotation(jpype.JArray(jpype.JDouble, 2)(R.tolist()), 1e-12)
        attitude.add(TimeStampedAngularCoordinates(date(t), rotation, Vector3D.ZERO, Vector3D.ZERO))
    return orbit, attitude


def sensor(name, looks, scene, date):
    vectors = ArrayList()
    for look in looks:
        vectors.add(Vector3D(*map(float, look)))
    lines = LinearLineDatation(date(scene["t_first_row"]), 0.0, 1.0 / float(scene["row_period"]))
    return LineSensor(name, lines, Vector3D.ZERO, LOSBuilder(vectors).build())


def rugged(scene, date, names, light_time, aberration, refraction, terrain, height):
    orbit, attitude = trajectory(scene, date)
    builder = RuggedBuilder()
    if terrain is None:
        builder.setAlgorithm(AlgorithmId.CONSTANT_ELEVATION_OVER_ELLIPSOID)
        builder.setConstantElevation(height)
    else:
        builder.setAlgorithm(AlgorithmId.DUVENHAGE)
        builder.setDigitalElevationModel(terrain, 4)
    builder.setEllipsoid(EllipsoidId.WGS84, BodyRotatingFrameId.ITRF)
    builder.setTimeSpan(date(scene["t_min"]), date(scene["t_max"]), 0.01, 0.1)
    builder.setTrajectory(
        InertialFrameId.GCRF,
        orbit,
        8,
        CartesianDerivativesFilter.USE_PV,
        attitude,
        6,
        AngularDerivativesFilter.USE_R,
    )
    builder.setLightTimeCorrection(bool(light_time))
    builder.setAberrationOfLightCorrection(bool(aberration))
    if refraction:
        builder.setRefractionCorrection(MultiLayerModel(builder.getEllipsoid()))
    for name, looks in names.items():
        builder.addLineSensor(sensor(name, looks, scene, date))
    return builder.build()


def located(model, name, lines):
    """Geodetic latitude, longitude and height, (lines, pixels, 3)."""
    result = []
    for line in lines:
        points = model.directLocation(name, float(line))
        result.append([[p.getLatitude(), p.getLongitude(), p.getAltitude()] for p in points])
    return np.array(result)


def layers_of(model):
    field = model.getClass().getDeclaredField("refractionLayers")
    field.setAccessible(True)
    layers = field.get(model)
    return np.array([[layer.getLowestAltitude(), layer.getRefractiveIndex()] for layer in layers])


def main(scene_path, result_path):
    scene = np.load(scene_path)
    DataContext.getDefault().getDataProvidersManager().addProvider(
        DirectoryCrawler(File(str(Path(scene_path).parent / "earth")))
    )
    date = dates(scene)
    terrain = Terrain(scene["dem"], *map(float, scene["dem_origin"]))
    sparse = {"sparse": scene["looks"][:: int(scene["every"])]}
    result = {"java": str(System.getProperty("java.version"))}
    for case in scene["cases"]:
        flags = [flag in case for flag in ("light_time", "aberration", "refraction")]
        ground = terrain if "terrain" in case else None
        model = rugged(scene, date, sparse, *flags, ground, float(scene["height"]))
        result[f"points_{case}"] = located(model, "sparse", scene["lines"])
    builder = RuggedBuilder()
    builder.setEllipsoid(EllipsoidId.WGS84, BodyRotatingFrameId.ITRF)
    result["layers"] = layers_of(MultiLayerModel(builder.getEllipsoid()))
    np.savez(result_path, **result)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
