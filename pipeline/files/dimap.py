"""Read the metadata of a Pleiades primary product (DIMAP V1): ephemeris, attitude, look angles and times.

The XML is parsed without DTD, entities or references, and every number is checked. The result is a rigorous
model of the strip in the operator's convention, verified against the operator's location grid:

* line 0 is taken at START, and the look angles are polynomials of the column counted from the first one;
* the look vector of angles psi is `[psi_y, -psi_x, 1]`, without tangents, rotated into ITRS axes by the
  quaternion Q0 (scalar) ... Q3, polynomials in (UTC second of the day - OFFSET) / SCALE;
* positions are ITRS, interpolated through all points from positions alone; the velocities of the file are
  relative to inertial axes, so the Earth's rotation is subtracted here;
* the operator's model has no aberration and no light time, so `LightEffects` with all effects off reproduces
  the operator's ground coordinates.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import EarthFixedAttitude
from boresight.geometry.constants import DAY_S
from boresight.geometry.earth_orientation import EarthOrientationTable
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.groundlight import LightEffects
from boresight.geometry.line_camera import LookAngleCamera, LookTable
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import Pushbroom, RowClock
from boresight.geometry.record import Floats, record, scalar
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.xml_files import numbers_of, read_xml, text_of, whole_of

__all__ = ["DimapStrip", "read_dimap"]

_MODEL = "Geometric_Data/Sensor_Model_Characteristics"
_EPHEMERIS = f"{_MODEL}/Sensor_Ephemeris/Point_List/Point"
_ATTITUDE = f"{_MODEL}/Sensor_Attitudes"
_VIEWING = f"{_MODEL}/Sensor_Viewing_Model"
_MAX_ITEMS = 10_000  # points of the ephemeris
_MAX_PIXELS = 10_000_000  # rows or columns
_LOOK_SAMPLES = 201  # a cubic spline through them holds a polynomial of degree 5 to 1e-13 rad


@record
class DimapStrip:
    """One panchromatic strip as its operator describes it; frames s and c are the same."""

    pushbroom: Pushbroom = scalar("model of the strip: pixel and row to ground")
    width_px: int = scalar("columns")
    height_px: int = scalar("lines")
    dataset: str = scalar("name of the data set, at most 128 characters")


def read_dimap(
    path: Path, eop: EarthOrientationTable, effects: LightEffects, *, allow_stale_eop: bool = False
) -> DimapStrip:
    """The strip of a Pleiades DIMAP file; `RawDataError` for anything missing, damaged or out of range."""
    file = path.name
    root = read_xml(path, file)
    if root.tag != "PHR_Dimap_Document":
        raise RawDataError(file, "root element", root.tag, "PHR_Dimap_Document")
    width, height = (
        whole_of(root, f"Raster_Dimensions/{name}", file, _MAX_PIXELS) for name in ("NCOLS", "NROWS")
    )
    start = _utc(text_of(root, f"{_MODEL}/UTC_Sensor_Model_Range/START", file), "START", file)
    epoch = Epoch.from_utc(start)
    t_first = float(epoch.seconds_from_utc([start])[0])
    period = 1e-3 * numbers_of(root, f"{_MODEL}/SENSOR_LINE_PERIOD", file, 1)[0]
    if not 0.0 < period < 1.0:
        raise RawDataError(file, "SENSOR_LINE_PERIOD", period, "a period in milliseconds, below 1000")
    t_orbit, positions, inertial = _ephemeris(root, epoch, file)
    last = t_first + height * period
    try:
        earth = EarthRotation.over(
            epoch, float(t_orbit[0]), float(t_orbit[-1]), eop, allow_stale_eop=allow_stale_eop
        )
        orbit = Orbit(
            epoch=epoch,
            t_s=t_orbit,
            positions_m=positions,
            velocities_m_s=inertial - np.cross(earth.omega_e, positions),
            frame="ITRF",
            degree=len(t_orbit) - 1,
            earth=earth,
        )
        pushbroom = Pushbroom(
            camera=_camera(root, width, file),
            rows=RowClock(t_first, period),
            orbit=orbit,
            earth=earth,
            attitude=_attitude(root, epoch, start, earth, (t_first - 1.0, last + 1.0), file),
            R_cs=Rotation.identity(),
            effects=effects,
        )
    except ValueError as error:  # dates without Earth orientation, states that cannot be interpolated
        raise RawDataError(file, _MODEL, str(error), "a strip that a satellite can take") from error
    return DimapStrip(
        pushbroom, width, height, text_of(root, "Dataset_Identification/DATASET_NAME", file)[:128]
    )


def _ephemeris(root: Element, epoch: Epoch, file: str) -> tuple[Floats, Floats, Floats]:
    points = root.findall(_EPHEMERIS)
    if not 2 <= len(points) <= _MAX_ITEMS:
        raise RawDataError(file, _EPHEMERIS, f"{len(points)} points", f"2 to {_MAX_ITEMS} points")
    times = [_utc(text_of(point, "UTC_TIME", file), "UTC_TIME", file) for point in points]
    positions = np.array([numbers_of(point, "LOCATION_VALUES", file, 3) for point in points])
    velocities = np.array([numbers_of(point, "VELOCITY_VALUES", file, 3) for point in points])
    t_s = epoch.seconds_from_utc(times)
    if np.any(np.diff(t_s) <= 0.0):
        raise RawDataError(file, f"{_EPHEMERIS}/UTC_TIME", "times out of order", "increasing times")
    radius = np.linalg.norm(positions, axis=1)
    if np.any((radius < 6.4e6) | (radius > 5e7)):
        raise RawDataError(
            file, f"{_EPHEMERIS}/LOCATION_VALUES", f"{radius.min():.0f} m from the centre", "an orbit, metres"
        )
    return t_s, positions, velocities


def _attitude(
    root: Element, epoch: Epoch, start: str, earth: EarthRotation, span_s: tuple[float, float], file: str
) -> EarthFixedAttitude:
    polynomials = [
        _polynomial(root, f"{_ATTITUDE}/Polynomial_Models/Q{k}", file) for k in (1, 2, 3, 0)
    ]  # scalar last
    coefficients = np.zeros((4, max(len(p) for p in polynomials)))
    for row, polynomial in zip(coefficients, polynomials):
        row[: len(polynomial)] = polynomial
    (offset,), (scale,) = (numbers_of(root, f"{_ATTITUDE}/{name}", file, 1) for name in ("OFFSET", "SCALE"))
    if not (0.0 <= offset < DAY_S + 1.0 and scale > 0.0):
        raise RawDataError(
            file, f"{_ATTITUDE}/OFFSET, SCALE", (offset, scale), "second of the day, scale > 0"
        )
    if not 0.5 < np.linalg.norm(coefficients[:, 0]) < 2.0:
        raise RawDataError(
            file, f"{_ATTITUDE}/Polynomial_Models", coefficients[:, 0].tolist(), "a quaternion"
        )
    midnight = float(epoch.seconds_from_utc([start[:10] + "T00:00:00"])[0])
    return EarthFixedAttitude(coefficients, midnight + offset, scale, earth, span_s)


def _camera(root: Element, width: int, file: str) -> LookAngleCamera:
    first, last = (
        whole_of(root, f"{_VIEWING}/Position_In_Retina/{n}", file, 10**9) for n in ("FIRST_COL", "LAST_COL")
    )
    if last - first + 1 != width:
        raise RawDataError(file, f"{_VIEWING}/Position_In_Retina", f"{first} ... {last}", f"{width} columns")
    psi_x, psi_y = (_polynomial(root, f"{_VIEWING}/Viewing_Directions/Psi{a}_Model", file) for a in "XY")
    samples: Floats = np.linspace(0.0, max(width - 1.0, 1.0), _LOOK_SAMPLES, dtype=np.float64)
    powers = samples[:, None] ** np.arange(21)
    tan_x, tan_y = powers[:, : len(psi_y)] @ psi_y, -powers[:, : len(psi_x)] @ psi_x
    try:
        return LookAngleCamera((LookTable(width, samples, tan_x, tan_y),))
    except ValueError as error:
        raise RawDataError(
            file, f"{_VIEWING}/Viewing_Directions", str(error), "look angles along a line"
        ) from error


def _polynomial(root: Element, where: str, file: str) -> list[float]:
    degree = whole_of(root, f"{where}/DEGREE", file, 20)
    return numbers_of(root, f"{where}/COEFFICIENTS", file, degree + 1)


def _utc(text: str, field: str, file: str) -> str:
    try:
        Epoch.from_utc(text)
    except ValueError as error:
        raise RawDataError(file, field, text, "a UTC instant, 2018-12-26T10:48:55.449Z") from error
    return text
