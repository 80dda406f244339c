"""Read the metadata of primary products in DIMAP: ephemeris, attitude, look angles and times.

DIMAP V1 (Pleiades 1A and 1B, root element PHR_Dimap_Document) and V2 (Pleiades, Pleiades Neo, SPOT 6 and 7,
root Dimap_Document with Geometric_Data/Refined_Model) have one model with other names of elements. The XML is
parsed without DTD, entities or references, and every number is checked. The result is a rigorous model of the
strip in the operator's convention, verified for V1 against the operator's location grid:

* line 0 is taken at START, and the look angles are polynomials of the column counted from the first one (V2:
  from FIRST_COL);
* the look vector of angles psi is `[psi_y, -psi_x, 1]`, without tangents, rotated into ITRS axes by the
  quaternion Q0 (scalar) ... Q3: polynomials in (UTC second of the day - OFFSET) / SCALE, or a list (V2);
* positions are ITRS, interpolated from positions alone, in V1 through all points, in V2 with degree 7;
  velocities may be relative to inertial axes (V1) or to ITRS, which the positions show;
* the line period is in milliseconds or microseconds, whichever the product's begin and end show (V2);
* the operator's model has no aberration and no light time, so `LightEffects` with all effects off reproduces
  the operator's ground coordinates.

Corners of the image that the product states as longitude and latitude must lie on their lines of sight: a
product of another convention is refused, not placed kilometres away.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import AttitudeTrack, EarthFixedAttitude
from boresight.geometry.constants import DAY_S
from boresight.geometry.earth_orientation import EarthOrientationTable, bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.geodesy import ecef_from_geodetic
from boresight.geometry.groundlight import LightEffects
from boresight.geometry.line_camera import LookAngleCamera, LookTable
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import Pushbroom, RowClock
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.orbit_file import HIGHEST_M, LOWEST_M
from boresight.pipeline.files.xml_files import elements_of, numbers_of, read_xml, text_of, whole_of
from boresight.records.record import Floats, record, scalar

__all__ = ["DimapStrip", "model_attitudes", "operator_model", "read_dimap"]

_CORNER_M = 1000.0  # the height of a corner is not stated, products round and sharpen
_PERIOD_ALIKE = 0.01  # of the mean line period, by which the stated one may differ
_UNIT_LENGTH = 1e-3  # by which a quaternion may be longer or shorter
# Heights, m, between which a corner of the product may lie: no ground is lower or higher.
_CORNER_HEIGHTS_M = (-500.0, 9000.0)
# States at most so far apart, s, are extended by one, 1.25 steps beyond the end. Steps above 1.5 would be
# gaps; over 0.1 s a parabola errs by 1 mm in a low orbit.
_DENSE_S, _BEYOND = 0.1, 1.25
_MAX_ITEMS = 10_000  # points of the ephemeris, quaternions
_MAX_PIXELS = 10_000_000  # rows or columns
# Highest power of a look polynomial that is read.
_MAX_POWERS = 20
_LOOK_SAMPLES = 201  # a cubic spline through them holds a polynomial of degree 5 to 1e-13 rad


@record(by_value=True)
class _Names:
    """Where a version of DIMAP has what."""

    raster: str
    start: str
    period: str
    point: str
    of_point: tuple[str, str, str]  # time, position, velocity
    attitude: str
    quaternion: str  # of a polynomial, below `attitude`
    degree: int | None  # of the interpolation of positions; None: through all points


# Paths of elements below the root: DIMAP V1 (PHR_Dimap_Document), then V2 (Dimap_Document).
_V1 = "Geometric_Data/Sensor_Model_Characteristics"
_VIEWING = f"{_V1}/Sensor_Viewing_Model"  # V1: look angles psi_x, psi_y
_V2 = "Geometric_Data/Refined_Model"  # V2
_CALIBRATION = f"{_V2}/Geometric_Calibration/Instrument_Calibration"  # V2: look angles
_QUATERNIONS = f"{_V2}/Attitudes/Quaternion_List/Quaternion"  # V2: sampled attitude
_OF_STRIP = "Data_Strip/Satellite_Attitudes/Corrected_Attitudes"  # V2, data strip
# By the tag of the root.
_VERSIONS = {
    "PHR_Dimap_Document": _Names(
        raster="Raster_Dimensions",
        start=f"{_V1}/UTC_Sensor_Model_Range/START",
        period=f"{_V1}/SENSOR_LINE_PERIOD",
        point=f"{_V1}/Sensor_Ephemeris/Point_List/Point",
        of_point=("UTC_TIME", "LOCATION_VALUES", "VELOCITY_VALUES"),
        attitude=f"{_V1}/Sensor_Attitudes",
        quaternion="Polynomial_Models/Q",
        degree=None,
    ),
    "Dimap_Document": _Names(
        raster="Raster_Data/Raster_Dimensions",
        start=f"{_V2}/Time/Time_Range/START",
        period=f"{_V2}/Time/Time_Stamp/LINE_PERIOD",
        point=f"{_V2}/Ephemeris/Point_List/Point",
        of_point=("TIME", "LOCATION_XYZ", "VELOCITY_XYZ"),
        attitude=f"{_V2}/Attitudes/Polynomial_Quaternions",
        quaternion="Q",
        degree=7,
    ),
}


@record
class DimapStrip:
    """One strip as its operator describes it; frames s and c are the same."""

    pushbroom: Pushbroom = scalar("model of the strip: pixel and row to ground")
    width_px: int = scalar("columns")
    height_px: int = scalar("lines")
    dataset: str = scalar("name of the data set, at most 128 characters")


def read_dimap(path: Path, eop: EarthOrientationTable, effects: LightEffects) -> DimapStrip:
    """The strip of a DIMAP file; `RawDataError` for anything missing, damaged or out of range."""
    file = path.name
    root = read_xml(path, file)
    names = _VERSIONS.get(root.tag)
    if names is None or (root.tag == "Dimap_Document" and root.find(_V2) is None):
        expected = f"PHR_Dimap_Document (DIMAP V1), or Dimap_Document with {_V2} (DIMAP V2: not SPOT 1 to 5)"
        names_of = ("METADATA_PROFILE", "METADATA_SUBPROFILE", "MISSION", "MISSION_INDEX")
        what = " ".join(filter(None, (root.findtext(f".//{name}", "").strip()[:32] for name in names_of)))
        if root.tag == "Dimap_Document":
            found = " ".join(filter(None, ("Dimap_Document", what, f"without {_V2}")))
            expected += "; a file of RPC has no rigorous model"
            raise RawDataError(file, "root element", found, expected)
        raise RawDataError(file, "root element", root.tag[:64], expected)
    places = (f"{names.raster}/{name}" for name in ("NCOLS", "NROWS"))
    width, height = (whole_of(root, place, file, _MAX_PIXELS) for place in places)
    start = _utc(text_of(root, names.start, file), "START", file)
    epoch = Epoch.from_utc(start)
    t_first = float(epoch.seconds_from_utc([start])[0])
    period = _period(root, names, epoch, height, file)
    image_s = (t_first - period, t_first + height * period)
    t_orbit, positions, velocities = _extended(*_ephemeris(root, names, epoch, file), image_s)
    span = (t_first - 1.0, t_first + height * period + 1.0)
    # Dates may be without Earth orientation, states too few to interpolate.
    with refusing(file, names.point, "a strip that a satellite can take"):
        earth = EarthRotation.over(epoch, float(t_orbit[0]), float(t_orbit[-1]), eop)
        orbit = Orbit(
            epoch=epoch,
            t_s=t_orbit,
            positions_m=positions,
            velocities_m_s=_relative_to_itrs(t_orbit, positions, velocities, earth),
            frame="ITRF",
            degree=min(names.degree or len(t_orbit), len(t_orbit) - 1),
            earth=earth,
        )
        attitude: EarthFixedAttitude | AttitudeTrack
        if root.find(names.attitude) is None and root.find(_QUATERNIONS) is not None:
            attitude = _attitude_list(root, orbit, file)
        else:
            attitude = _attitude(root, names, epoch, start, earth, span, file)
        pushbroom = Pushbroom(
            camera=_camera(root, width, file),
            rows=RowClock(t_first, period),
            orbit=orbit,
            earth=earth,
            attitude=attitude,
            R_cs=Rotation.identity(),
            effects=effects,
        )
        first, last = pushbroom.known_rows()
    if first > 0.0 or last < height - 1.0:
        found = f"orbit and attitudes of lines {first:.0f} to {last:.0f}"
        raise RawDataError(file, names.point, found, f"of all lines, 0 to {height - 1}")
    _check_corners(root, pushbroom, (width, height), file)
    dataset = text_of(root, "Dataset_Identification/DATASET_NAME", file)[:128]
    return DimapStrip(pushbroom, width, height, dataset)


def _check_corners(root: Element, pushbroom: Pushbroom, size: tuple[int, int], file: str) -> None:
    """`RawDataError` where a corner that the product states is on no height of its line of sight."""
    frames = [frame for name in ("Dataset_Frame", "Dataset_Extent") for frame in root.iter(name)]
    for vertex in [vertex for frame in frames[:1] for vertex in frame.findall("Vertex")][:8]:
        if any(vertex.find(name) is None for name in ("LON", "LAT", "COL", "ROW")):
            continue
        lon, lat, column, row = (numbers_of(vertex, n, file, 1)[0] for n in ("LON", "LAT", "COL", "ROW"))
        if not (0.5 <= column <= size[0] + 0.5 and 0.5 <= row <= size[1] + 0.5):
            continue
        low, high = (
            pushbroom.ground_points(0, [column - 1.0], [row - 1.0], ConstantHeight(height))[0]
            - ecef_from_geodetic(np.radians(lat), np.radians(lon), height)
            for height in _CORNER_HEIGHTS_M
        )
        step = high - low
        share = float(np.clip(-(low @ step) / max(float(step @ step), 1e-9), 0.0, 1.0))
        off_m = float(np.linalg.norm(low + share * step))
        if not off_m <= _CORNER_M:
            found = f"{off_m:.0f} m from the line of sight of its pixel"
            raise RawDataError(file, f"Vertex of COL {column:g}, ROW {row:g}", found, _CONVENTION)


# What messages say was expected of the corners that the model computes.
_CONVENTION = f"at most {_CORNER_M:.0f} m: the product follows a convention that is not known here"


def model_attitudes(root: Element) -> tuple[list[Element], list[Element], list[Element]]:
    """The elements of a product that hold the attitude of its model, whatever their namespace: groups of the
    polynomials Q0 ... Q3; quaternions with children Q0 ... Q3; and quaternions as one text, scalar first.

    Other quaternions of a product (of the satellite, in inertial axes) are not among them.
    """

    def at(*places: str) -> list[Element]:
        paths = ("/".join("{*}" + name for name in place.split("/")) for place in places)
        return [element for path in paths for element in root.findall(path)]

    polynomials = at(f"{_V1}/Sensor_Attitudes/Polynomial_Models", f"{_V2}/Attitudes/Polynomial_Quaternions")
    return polynomials, at(_QUATERNIONS), at(f"{_OF_STRIP}/WGS84_Attitudes_List/WGS84_Attitudes/Q_VALUES")


def _period(root: Element, names: _Names, epoch: Epoch, height: int, file: str) -> float:
    """Line period, s: in the file in milliseconds or, in products of V2, in microseconds."""
    (stated,) = numbers_of(root, names.period, file, 1)
    period, field = 1e-3 * stated, names.period.rpartition("/")[2]
    if root.tag == "Dimap_Document":
        ends = [text_of(root, f"{_V2}/Time/Time_Range/{name}", file) for name in ("START", "END")]
        t_s = epoch.seconds_from_utc([_utc(text, "Time_Range", file) for text in ends])
        mean = float(t_s[1] - t_s[0]) / max(height - 1, 1)
        period = min((1e-3 * stated, 1e-6 * stated), key=lambda one: abs(one - mean))
        if not abs(period - mean) <= _PERIOD_ALIKE * mean:
            expected = f"{1e3 * mean:.6g} ms or its microseconds, by START, END and NROWS"
            raise RawDataError(file, field, stated, expected)
    if not 0.0 < period < 1.0:
        raise RawDataError(file, field, stated, "a period in milliseconds, below 1000")
    return period


def _ephemeris(root: Element, names: _Names, epoch: Epoch, file: str) -> tuple[Floats, Floats, Floats]:
    points = elements_of(root, names.point, file, 2, _MAX_ITEMS)
    time, place, velocity = names.of_point
    times = [_utc(text_of(point, time, file), time, file) for point in points]
    positions = np.array([numbers_of(point, place, file, 3) for point in points])
    velocities = np.array([numbers_of(point, velocity, file, 3) for point in points])
    t_s = epoch.seconds_from_utc(times)
    if np.any(np.diff(t_s) <= 0.0):
        raise RawDataError(file, f"{names.point}/{time}", "times out of order", "increasing times")
    radius = np.linalg.norm(positions, axis=1)
    if np.any((radius < LOWEST_M) | (radius > HIGHEST_M)):
        found = f"{radius.min():.0f} m from the centre"
        raise RawDataError(file, f"{names.point}/{place}", found, "an orbit, metres")
    return t_s, positions, velocities


def _extended(
    t_s: Floats, positions: Floats, velocities: Floats, image_s: tuple[float, float]
) -> tuple[Floats, Floats, Floats]:
    """States with one more before and after dense ones that begin after the image or end before it, as those
    of Pleiades Neo do by some milliseconds: parabolas through the three states at that end.
    """
    step = float(np.median(np.diff(t_s)))
    if len(t_s) < 4 or step > _DENSE_S:
        return t_s, positions, velocities
    for at_end in (False, True):
        if t_s[0] <= image_s[0] if not at_end else t_s[-1] >= image_s[1]:
            continue
        near = slice(-3, None) if at_end else slice(0, 3)
        t = t_s[-1] + _BEYOND * step if at_end else t_s[0] - _BEYOND * step
        where = len(t_s) if at_end else 0
        positions, velocities = (
            np.insert(of, where, np.polyval(np.polyfit((t_s[near] - t) / step, of[near], 2), 0.0), axis=0)
            for of in (positions, velocities)
        )
        t_s = np.insert(t_s, where, t)
    return t_s, positions, velocities


def _relative_to_itrs(t_s: Floats, positions: Floats, stated: Floats, earth: EarthRotation) -> Floats:
    """The stated velocities, less the Earth's rotation if the positions show that they are inertial."""
    shown = (
        np.gradient(positions, t_s, axis=0)[1:-1]
        if len(t_s) > 2
        else np.diff(positions, axis=0) / np.diff(t_s)
    )
    inner = slice(1, -1) if len(t_s) > 2 else slice(0, 1)
    choices = (stated - np.cross(earth.omega_e, positions), stated)
    return min(choices, key=lambda one: float(np.linalg.norm(one[inner] - shown)))


def _attitude(
    root: Element,
    names: _Names,
    epoch: Epoch,
    start: str,
    earth: EarthRotation,
    span_s: tuple[float, float],
    file: str,
) -> EarthFixedAttitude:
    where = names.attitude
    polynomials = [
        _polynomial(root, f"{where}/{names.quaternion}{k}", file) for k in (1, 2, 3, 0)
    ]  # scalar last
    coefficients = np.zeros((4, max(len(p) for p in polynomials)))
    for row, polynomial in zip(coefficients, polynomials):
        row[: len(polynomial)] = polynomial
    (offset,), (scale,) = (numbers_of(root, f"{where}/{name}", file, 1) for name in ("OFFSET", "SCALE"))
    if not (0.0 <= offset < DAY_S + 1.0 and scale > 0.0):
        raise RawDataError(file, f"{where}/OFFSET, SCALE", (offset, scale), "second of the day, scale > 0")
    if not 0.5 < np.linalg.norm(coefficients[:, 0]) < 2.0:
        raise RawDataError(file, where, coefficients[:, 0].tolist(), "a quaternion")
    midnight = float(epoch.seconds_from_utc([start[:10] + "T00:00:00"])[0])
    return EarthFixedAttitude(coefficients, midnight + offset, scale, earth, span_s)


def _attitude_list(root: Element, orbit: Orbit, file: str) -> AttitudeTrack:
    rows = elements_of(root, _QUATERNIONS, file, 4, _MAX_ITEMS)
    quaternions = np.array([[numbers_of(row, f"Q{k}", file, 1)[0] for k in (1, 2, 3, 0)] for row in rows])
    size = np.linalg.norm(quaternions, axis=1)
    if not np.all(np.abs(size - 1.0) < _UNIT_LENGTH):
        raise RawDataError(file, _QUATERNIONS, f"length {size[np.argmax(np.abs(size - 1.0))]:g}", "length 1")
    t_s = orbit.epoch.seconds_from_utc([_utc(text_of(row, "TIME", file), "TIME", file) for row in rows])
    inside = (t_s >= orbit.t_s[0]) & (t_s <= orbit.t_s[-1])
    t_s, R_es = t_s[inside], Rotation.from_quat(quaternions[inside])
    return AttitudeTrack(t_s, (orbit.earth.rotations_ie(t_s) * R_es).inv(), orbit)


def _camera(root: Element, width: int, file: str) -> LookAngleCamera:
    first_column = 0
    if root.tag == "Dimap_Document":
        (looks, *_) = elements_of(root, f"{_CALIBRATION}//Polynomial_Look_Angles", file, 1, 64)
        psi_x, psi_y = (_line_of_sight(looks, name, file) for name in ("XLOS", "YLOS"))
        if root.find(f"{_CALIBRATION}/Swath_Range/FIRST_COL") is not None:
            first_column = whole_of(root, f"{_CALIBRATION}/Swath_Range/FIRST_COL", file, 10**9) - 1
    else:
        place = f"{_VIEWING}/Position_In_Retina"
        first, last = (whole_of(root, f"{place}/{n}", file, 10**9) for n in ("FIRST_COL", "LAST_COL"))
        if last - first + 1 - width not in (0, 1):  # products of 39951 columns end at LAST_COL 39952
            raise RawDataError(file, place, f"{first} ... {last}", f"{width} columns, or one more")
        psi_x, psi_y = (_polynomial(root, f"{_VIEWING}/Viewing_Directions/Psi{a}_Model", file) for a in "XY")
    samples: Floats = np.linspace(0.0, max(width - 1.0, 1.0), _LOOK_SAMPLES, dtype=np.float64)
    tan_x, minus_y = (np.asarray(polyval(samples + first_column, psi), np.float64) for psi in (psi_y, psi_x))
    with refusing(file, "look angles", "look angles along a line"):
        return LookAngleCamera((LookTable(width, samples, tan_x, -minus_y),))


def _line_of_sight(looks: Element, name: str, file: str) -> list[float]:
    """Coefficients name_0, name_1, ... as far as they go."""
    count = next((n for n in range(_MAX_POWERS) if looks.find(f"{name}_{n}") is None), _MAX_POWERS)
    return [numbers_of(looks, f"{name}_{n}", file, 1)[0] for n in range(max(count, 1))]


def _polynomial(root: Element, where: str, file: str) -> list[float]:
    degree = whole_of(root, f"{where}/DEGREE", file, _MAX_POWERS)
    return numbers_of(root, f"{where}/COEFFICIENTS", file, degree + 1)


def _utc(text: str, field: str, file: str) -> str:
    with refusing(file, field, "a UTC instant, 2018-12-26T10:48:55.449Z", found=text):
        Epoch.from_utc(text)
    return text


def operator_model(path: Path) -> DimapStrip:
    """The strip in the operator's convention: without aberration, light time and refraction."""
    off = LightEffects(light_time=False, aberration=False, refraction=False)
    return read_dimap(path, bundled_earth_orientation(), off)
