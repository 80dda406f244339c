"""Read a Sentinel-2 L1B datastrip with its GIPP files: orbit, attitudes, star trackers, looks and line times.

The datastrip (`S2?_OPER_MTD_L1B_DS_*.xml`) names the GIPP files that belong to it; of these SPAMOD (mounting
angles) and VIEDIR (look directions of one band) are read. Conventions, each verified against location grids
of the operator's own software (`benchmarks/real_sentinel2.py`):

* frame c is the MSI frame, `u_c ~ [tan_psi_y, -tan_psi_x, 1]`: x along track, y across, z to nadir;
* line n (from 0) of a detector is exposed about `GPS_TIME + (n + 1/2) period`, in GPS time; the period is
  LINE_PERIOD times the band's pixel size over 10 m;
* quaternions are scalar last and take frame s to EME2000; s is the piloting frame for the corrected
  attitudes, a tracker's own frame for the raw ones, whose annual aberration is already removed;
* PILOTING_TO_MSI_FRAME and the refining rotation are intrinsic rotations about y, x, z; a line of sight is
  `v_piloting = Q(t)^-1 diag(1, 1, 1 + h) P^-1 v_msi`, with polynomials in seconds from mid-sensing;
* positions and velocities are ITRF; there is no light time, aberration or refraction.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.features.operators.gipp_files import find_gipp_files, gipp_root
from boresight.geometry.constants import ARCSEC
from boresight.geometry.earth_orientation import EarthOrientationTable
from boresight.geometry.earth_rotation import rotation_to_gcrs
from boresight.geometry.epoch import Epoch
from boresight.geometry.line_camera import LookAngleCamera, LookTable
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.xml_files import elements_of, numbers_of, read_xml, text_of, whole_of
from boresight.records.record import Floats, array, record, scalar

__all__ = ["BANDS", "AttitudeRecord", "Refining", "Sentinel2", "read_sentinel2"]

_FIRST_PIXEL_M = 10.0  # pixel size to which LINE_PERIOD refers
_GRANULE_LINES = 2304  # of 10 m
# Paths of elements below the root of a datastrip's metadata.
_ANCILLARY = "Satellite_Ancillary_Data_Info"
_POINTS = f"{_ANCILLARY}/Ephemeris/GPS_Points_List/GPS_Point"  # states of the orbit
_CORRECTED = f"{_ANCILLARY}/Attitudes/Corrected_Attitudes/Values"  # attitudes that the operator uses
_TRACKERS = f"{_ANCILLARY}/Attitudes/Raw_Attitudes/STR_List/STR"  # attitudes of each star tracker
_GYROS = f"{_ANCILLARY}/Attitudes/Raw_Attitudes/IMU_List/IMU"  # angles about the axis of each gyro
_GYRO_AXES = 4
_COUNT_RAD = 4.989e-9  # of RAW_ANGLE: with it the axes that attitudes show have length 1 to 0.02 %
_SENSOR = "Image_Data_Info/Sensor_Configuration"  # times and TDI
# Element of a datastrip's metadata that says whether its model is refined.
_STATE = "Image_Data_Info/Geometric_Info/Refined_Corrections_List/Refined_Corrections/MSI_State"
# Most elements of a kind that are read from a datastrip.
_MANY = 1_000_000


@record
class AttitudeRecord:
    """Attitudes of one frame s, valid or not, in order of time."""

    t_s: Floats = array("K", "TAI seconds since the epoch, increasing")
    R_is: Rotation = array("K", "frame s to GCRS")


# Names of the bands of the instrument, in the order of their wavelengths.
BANDS = (*(f"B{n:02d}" for n in range(1, 9)), "B8A", *(f"B{n:02d}" for n in range(9, 13)))


@record(kw_only=True)
class Refining:
    """The operator's correction of the lines of sight: rotations about x, y, z and a scale along z."""

    t_middle_s: float = scalar("origin of the polynomials, TAI seconds since the epoch")
    angles: tuple[Floats, Floats, Floats] = scalar("polynomials about x, y, z, lowest power first, rad and s")
    homothety: float = scalar("h of diag(1, 1, 1 + h)")

    def rotations(self, t_s: Floats) -> Rotation:
        """Q (N,) at instants (N,): it takes the piloting frame to the refined one."""
        x, y, z = (np.polynomial.polynomial.polyval(t_s - self.t_middle_s, c) for c in self.angles)
        return Rotation.from_euler("YXZ", np.column_stack([y, x, z]))


@record
class GyroAngles:
    """Angles that gyros have summed up about four axes, which the datastrip does not state."""

    t_s: Floats = array("K", "TAI seconds since the epoch, increasing")
    angles_rad: Floats = array("K, 4", "RAW_ANGLE about the axis of each gyro")


@record(kw_only=True)
class Sentinel2:
    """One band of a datastrip as its operator describes it. The detectors 01 ... 12 are CCDs 0 ... 11."""

    satellite: str = scalar("SPACECRAFT_NAME, at most 32 characters")
    band: str = scalar("B01 ... B12, B8A")
    epoch: Epoch = scalar("zero of all times")
    camera: LookAngleCamera = scalar("look directions of the detectors in the MSI frame c")
    lines: int = scalar("lines of each detector")
    row_period_s: float = scalar("from line to line of the band")
    t_first_row_s: Floats = array("D", "middle of line 0 of each detector, TAI seconds since the epoch")
    t_orbit_s: Floats = array("N", "instants of the ephemeris")
    positions_m: Floats = array("N, 3", "ITRF")
    velocities_m_s: Floats = array("N, 3", "relative to the rotating Earth, ITRF axes")
    sigma_position_m: float = scalar("rms of POSITION_ERRORS, per axis")
    corrected: AttitudeRecord = scalar("corrected attitudes; frame s is the piloting frame")
    trackers: dict[str, AttitudeRecord] = scalar("raw attitudes by the name of the star tracker")
    gyros: GyroAngles | None = scalar("IMU_List, where there is one")
    R_ps: dict[str, Rotation] = scalar("mounting in the operator's file, star tracker to piloting frame")
    mounting_angles_rad: Floats = array("3", "PILOTING_TO_MSI_FRAME about x, y, z")
    refining: Refining | None = scalar("the operator's own correction, where there is one")
    earth_orientation: EarthOrientationTable = scalar("the operator's IERS_Bulletin, constant over days")

    @property
    def R_cp(self) -> Rotation:
        """P, piloting frame to MSI frame, in the operator's file."""
        x, y, z = self.mounting_angles_rad
        return Rotation.from_euler("YXZ", [y, x, z])


def read_sentinel2(datastrip: Path, gipp: Path, band: str) -> Sentinel2:
    """One band of a datastrip; `gipp` is the folder or archive of the SPAMOD and VIEDIR files that it names.

    Raises `RawDataError` for anything missing, damaged or out of range.
    """
    file = datastrip.name
    root = read_xml(datastrip, file)
    if root.tag != "Level-1B_DataStrip_ID":
        raise RawDataError(file, "root element", root.tag[:64], "Level-1B_DataStrip_ID")
    band_id, pixel_m = _band(root, band, file)
    start, stop = (
        text_of(root, f"General_Info/Datastrip_Time_Info/DATASTRIP_SENSING_{end}", file)
        for end in ("START", "STOP")
    )
    try:
        epoch = Epoch.from_utc(start)
        t_middle = float(epoch.seconds_from_utc([start, stop]).mean())
    except ValueError as error:
        raise RawDataError(file, "DATASTRIP_SENSING_START, STOP", f"{start}, {stop}", str(error)) from error
    looks_file, looks = _gipp(root, gipp, "VIEDIR", band, start, file)
    model_file, model = _gipp(root, gipp, "SPAMOD", "B00", start, file)
    stamps = _SENSOR + "/Time_Stamp"
    period = 1e-3 * numbers_of(root, f"{stamps}/LINE_PERIOD", file, 1)[0] * pixel_m / _FIRST_PIXEL_M
    if not 1e-5 < period < 1.0:
        raise RawDataError(file, "LINE_PERIOD", period, "a period in milliseconds")
    times = elements_of(root, f"{stamps}/Band_Time_Stamp[@bandId='{band_id}']/Detector", file, 1, 64)
    if wrong := [t for t in times if whole_of(t, "REFERENCE_LINE", file, 10**6) != 1]:
        raise RawDataError(file, f"{stamps}, detector {wrong[0].get('detectorId')}", "another line", "line 1")
    tdi = f"{_SENSOR}/Acquisition_Configuration/TDI_Configuration_List/TDI_CONFIGURATION"
    camera = _camera(looks, root.findtext(f"{tdi}[@bandId='{band_id}']", ""), len(times), looks_file)
    t_orbit, positions, velocities, sigma_m = _ephemeris(root, epoch, file)
    trackers = {
        name: _attitudes(rows, epoch, file, "ATTITUDE_QUALITY", "VALIDATT")
        for tracker in elements_of(root, _TRACKERS, file, 1, 16)
        if (rows := tracker.findall("Attitude_Data_List/Attitude_Data"))
        and (name := str(tracker.get("strId"))[:16])
    }
    corrected = elements_of(root, _CORRECTED, file, 8, _MANY)
    return Sentinel2(
        satellite=text_of(root, "General_Info/Datatake_Info/SPACECRAFT_NAME", file)[:32],
        band=band,
        epoch=epoch,
        camera=camera,
        lines=_lines(root, pixel_m, file),
        row_period_s=period,
        t_first_row_s=_gps_seconds(times, epoch, file) + 0.5 * period,
        t_orbit_s=t_orbit,
        positions_m=positions,
        velocities_m_s=velocities,
        sigma_position_m=sigma_m,
        corrected=_attitudes(corrected, epoch, file, "QUATERNION_VALIDITY", "true"),
        trackers=trackers,
        gyros=_gyros(root, epoch, file),
        R_ps={name: _tracker_mounting(model, name, model_file) for name in trackers},
        mounting_angles_rad=_mounting_angles(model, model_file),
        refining=_refining(root, t_middle, file),
        earth_orientation=_earth_orientation(root, epoch, file),
    )


def _band(root: Element, band: str, file: str) -> tuple[int, float]:
    """bandId and pixel size, m, of a band."""
    where = "Image_Data_Info/Radiometric_Info/Spectral_Information_List/Spectral_Information"
    bands = {
        re.sub(r"^B(\d)$", r"B0\1", str(element.get("physicalBand"))): element
        for element in elements_of(root, where, file, 1, 64)
    }
    if band not in bands:
        raise RawDataError(file, where, f"bands {', '.join(sorted(bands))}", f"band {band}")
    if not re.fullmatch(r"[0-9]{1,2}", number := str(bands[band].get("bandId"))):
        raise RawDataError(file, f"{where}, bandId", number[:64], "a number")
    return int(number), float(whole_of(bands[band], "RESOLUTION", file, 1000))


def _gipp(root: Element, place: Path, kind: str, band: str, at: str, file: str) -> tuple[str, Element]:
    """Name and root of the GIPP file of a kind that the datastrip names; of several the one that is valid at
    the UTC date `at`, or of these the only one at hand.
    """
    listed = [
        (element.text or "").strip()
        for element in root.findall("Auxiliary_Data_Info/GIPP_List/GIPP_FILENAME")
    ]
    pattern = rf"S2[A-Z]_[A-Za-z0-9_]*GIP_{kind}_[A-Za-z0-9_]*_{band}"
    names = [name for name in dict.fromkeys(listed) if re.fullmatch(pattern, name)]
    there = find_gipp_files(place, pattern)
    day = re.sub("[-:]", "", at)[:15]
    if len(names) > 1:
        names = [name for name in names if _is_valid(name, day)] or names
    if len(names) > 1:
        names = [name for name in names if name in there] or names
    if len(names) != 1:
        choice = f"one of them alone in --gipp: {' or '.join(names)}" if names else "one"
        raise RawDataError(file, "GIPP_List", f"{len(names)} files {kind} of {band} valid at {day}", choice)
    if names[0] not in there:
        found = ", ".join(there) or f"none of kind {kind}"
        raise RawDataError(str(place), "GIPP files", found, names[0])
    return there[names[0]].file, gipp_root(there[names[0]], names[0])


def _is_valid(name: str, day: str) -> bool:
    """Whether a date lies in the span that the name of a GIPP file states; true where it states none."""
    span = re.search(r"_V([0-9]{8}T[0-9]{6})_([0-9]{8}T[0-9]{6})_", name)
    return span is None or span[1] <= day < span[2]


def _camera(root: Element, tdi: str, detectors: int, file: str) -> LookAngleCamera:
    lists = elements_of(root, "DATA/VIEWING_DIRECTIONS_LIST", file, 1, 4)
    chosen = [one for one in lists if len(lists) == 1 or one.get("tdi_config") == tdi]
    if len(chosen) != 1:
        raise RawDataError(file, "VIEWING_DIRECTIONS_LIST", f"{len(lists)} lists", f"one of TDI {tdi!r}")
    ccds = []
    for n, one in enumerate(elements_of(chosen[0], "VIEWING_DIRECTIONS", file, detectors, detectors)):
        if one.get("detector_id") != f"{n + 1:02d}":
            raise RawDataError(file, "detector_id", str(one.get("detector_id"))[:64], f"{n + 1:02d}")
        n_px = whole_of(one, "NB_OF_PIXELS", file, 65_536)
        psi_x, psi_y = (np.array(numbers_of(one, f"TAN_PSI_{a}_LIST", file, n_px)) for a in "XY")
        with refusing(file, f"detector {n + 1:02d}", "looks along a line"):
            ccds.append(LookTable(n_px, np.arange(n_px, dtype=float), psi_y, -psi_x))
    with refusing(file, "VIEWING_DIRECTIONS", "looks along a line"):  # looks that run to and fro
        return LookAngleCamera(tuple(ccds))


def _lines(root: Element, pixel_m: float, file: str) -> int:
    where = "Image_Data_Info/Granules_Information/Detector_List/Detector/Granule_List/Granule"
    last = max(
        whole_of(granule, "POSITION", file, 10_000_000)
        for granule in elements_of(root, where, file, 1, _MANY)
    )
    return int((last - 1 + _GRANULE_LINES) * _FIRST_PIXEL_M / pixel_m)


def _gps_seconds(elements: list[Element], epoch: Epoch, file: str) -> Floats:
    """TAI seconds since the epoch of the GPS_TIME of each element."""
    texts = [text_of(element, "GPS_TIME", file) for element in elements]
    with refusing(file, "GPS_TIME", "a date in GPS time"):
        return epoch.seconds_from_gps_dates(texts)


def _ephemeris(root: Element, epoch: Epoch, file: str) -> tuple[Floats, Floats, Floats, float]:
    points = elements_of(root, _POINTS, file, 8, _MANY)
    t_s = _increasing(_gps_seconds(points, epoch, file), _POINTS, file)
    positions, velocities, errors = (
        1e-3 * np.array([numbers_of(point, name, file, 3) for point in points])
        for name in ("POSITION_VALUES", "VELOCITY_VALUES", "POSITION_ERRORS")
    )
    radius = np.linalg.norm(positions, axis=1)
    if np.any((radius < 6.4e6) | (radius > 5e7)):
        raise RawDataError(file, "POSITION_VALUES", f"{radius.min():.0f} m from the centre", "an orbit in mm")
    return t_s, positions, velocities, float(np.sqrt(np.mean(errors**2)))


def _attitudes(rows: list[Element], epoch: Epoch, file: str, key: str, good: str) -> AttitudeRecord:
    """The valid attitudes among rows."""
    valid = [row for row in rows if text_of(row, key, file) == good]
    quaternions = np.array([numbers_of(row, "QUATERNION_VALUES", file, 4) for row in valid]).reshape(-1, 4)
    length = np.linalg.norm(quaternions, axis=1)
    if len(valid) < 2 or np.any(np.abs(length - 1.0) > 1e-6):
        found = f"{len(valid)} valid quaternions, lengths up to {length.max(initial=0.0):.6g}"
        raise RawDataError(file, "QUATERNION_VALUES", found, "two or more of length 1")
    t_s = _increasing(_gps_seconds(valid, epoch, file), "GPS_TIME of attitudes", file)
    return AttitudeRecord(t_s, rotation_to_gcrs("EME2000") * Rotation.from_quat(quaternions))


def _gyros(root: Element, epoch: Epoch, file: str) -> GyroAngles | None:
    """The angles of all gyros at the instants at which every one is valid; None where the list is empty."""
    gyros = root.findall(_GYROS)
    if not gyros:
        return None
    gyros = elements_of(root, _GYROS, file, _GYRO_AXES, _GYRO_AXES)
    of_all = [[row for row in gyro.findall("Value") if row.findtext("VALIDITY") == "true"] for gyro in gyros]
    dates = [[text_of(row, "GPS_TIME", file) for row in rows] for rows in of_all]
    common = sorted(set.intersection(*map(set, dates)))
    if len(common) < 8:
        raise RawDataError(file, "IMU_List", f"{len(common)} instants of all gyros", "8 or more")
    counts = [[dict(zip(of_gyro, rows))[date] for date in common] for of_gyro, rows in zip(dates, of_all)]
    angles = np.array([[numbers_of(row, "RAW_ANGLE", file, 1)[0] for row in rows] for rows in counts]).T
    steps = (np.diff(angles, axis=0, prepend=angles[:1]) + 2.0**31) % 2.0**32 - 2.0**31  # 32 bits roll over
    t_s = epoch.seconds_from_gps_dates(common)
    return GyroAngles(_increasing(t_s, "GPS_TIME of IMU_List", file), _COUNT_RAD * np.cumsum(steps, axis=0))


def _increasing(t_s: Floats, where: str, file: str) -> Floats:
    if np.any(np.diff(t_s) <= 0.0):
        raise RawDataError(file, where, "times out of order", "increasing times")
    return t_s


def _tracker_mounting(model: Element, name: str, file: str) -> Rotation:
    where = f"DATA/GSE/{name}_ATT_QUATERNION"
    xyzw = [*numbers_of(model, f"{where}/VECTOR", file, 3), *numbers_of(model, f"{where}/SCALAR", file, 1)]
    if abs(np.linalg.norm(xyzw) - 1.0) > 1e-6:
        raise RawDataError(file, where, "another length", "a quaternion of length 1")
    return Rotation.from_quat(xyzw)


def _mounting_angles(model: Element, file: str) -> Floats:
    """Angles about x, y, z; those further down the chain must be zero, as they are in every file so far."""
    for element in model.iter():
        below = "FOCAL_PLANE" in element.tag or element.tag.startswith("MSI_TO_")
        for name in ("R1", "R2", "R3") if below and element.find("R1") is not None else ():
            if (angle := numbers_of(element, name, file, 1)[0]) != 0.0:
                raise RawDataError(file, f"{element.tag}/{name}", angle, "0: other values are not supported")
    where = "DATA/PILOTING_TO_MSI_FRAME"
    if numbers_of(model, f"{where}/SCALE_FACTOR", file, 1) != [1.0]:
        raise RawDataError(file, f"{where}/SCALE_FACTOR", "another value", "1")
    angles = [numbers_of(model, f"{where}/R{k}[@axis='{a}']", file, 1)[0] for k, a in enumerate("XYZ", 1)]
    if max(map(abs, angles)) > 1e3:
        raise RawDataError(file, where, angles, "angles in mrad")
    return 1e-3 * np.array(angles)


def _refining(root: Element, t_middle_s: float, file: str) -> Refining | None:
    if root.find(f"{_STATE}/Rotation") is None:
        return None
    x, y, z = (_polynomial(root, f"{_STATE}/Rotation/{axis}", file) for axis in "XYZ")
    homothety = _polynomial(root, f"{_STATE}/Homothety/Z", file)
    if len(homothety) != 1:
        raise RawDataError(file, "Homothety/Z", f"degree {len(homothety) - 1}", "degree 0")
    return Refining(t_middle_s=t_middle_s, angles=(x, y, z), homothety=float(homothety[0]))


def _polynomial(root: Element, where: str, file: str) -> Floats:
    degree = whole_of(root, f"{where}/DEGREE", file, 9)
    return np.array(numbers_of(root, f"{where}/COEFFICIENTS", file, degree + 1))


def _earth_orientation(root: Element, epoch: Epoch, file: str) -> EarthOrientationTable:
    """The one value of the datastrip's bulletin on the days around it."""
    where = "Auxiliary_Data_Info/IERS_Bulletin"
    values: Callable[[str], float] = lambda name: numbers_of(root, f"{where}/{name}", file, 1)[0]  # noqa: E731
    day = np.floor(float(epoch.mjd_tai(0.0))) + np.arange(-2.0, 4.0)
    ut1, x, y = values("UT1_UTC"), values("POLE_U_ANGLE"), values("POLE_V_ANGLE")
    if not (abs(ut1) < 1.0 and max(abs(x), abs(y)) < 2.0):
        raise RawDataError(file, where, (ut1, x, y), "UT1 - UTC in s, pole in arc-seconds")
    ones = np.ones(len(day))
    return EarthOrientationTable(
        mjd_utc=day,
        ut1_utc_s=ut1 * ones,
        xp_rad=x * ARCSEC * ones,
        yp_rad=y * ARCSEC * ones,
        dx_rad=0.0 * ones,
        dy_rad=0.0 * ones,
        source=f"IERS_Bulletin of {file[:200]}",
        mjd_last_measured=float(day[-1]),
    )
