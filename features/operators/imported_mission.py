"""Write what an operator's files say as a dump (docs/dump-format.md): attitudes, look tables, no images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import Interpolation
from boresight.geometry.constants import ARCSEC
from boresight.geometry.earth_orientation import EarthOrientationTable
from boresight.geometry.epoch import Epoch
from boresight.geometry.line_camera import LookAngleCamera
from boresight.geometry.orbit import Orbit
from boresight.pipeline.files.dump_schema import LOOK_TABLES, PointRow, head_of_dump
from boresight.pipeline.files.orbit_file import orbit_message
from boresight.pipeline.files.text_tables import write_csv, write_toml
from boresight.pipeline.files.whole_file import is_vacant
from boresight.records.record import Floats, array, record, scalar

__all__ = [
    "ImportedGyro",
    "ImportedHead",
    "ImportedMission",
    "ImportedStrip",
    "white_noise_rad",
    "write_imported",
]

# File of an imported dump that holds measured image points, if any are given.
POINTS = "points.csv"
GYRO = "gyro.csv"


@record(kw_only=True)
class ImportedHead:
    """One source of attitudes."""

    name: str = scalar("id of the head")
    t_s: Floats = array("K", "TAI seconds since the epoch")
    R_is: Rotation = array("K", "frame s to GCRS")
    R_cs0: Rotation = scalar("installation matrix in the operator's files")
    sigma_installation_rad: Floats = array("3", "1-sigma error of `R_cs0` about the axes of c")
    white_rad: Floats = array("3", "1-sigma of the white noise of the attitudes about the axes of s, assumed")
    is_measured: bool = scalar("attitudes as a star camera gave them, whose record shows their noise")
    interpolation: Interpolation = scalar("of the operator's software")


@record(kw_only=True)
class ImportedGyro:
    """A gyro, about axes that `R_sg` takes to frame s of the first head."""

    t_s: Floats = array("K", "TAI seconds since the epoch")
    turns_g: Floats = array("K, 3", "angles turned since the row before, rad; the first: 0")
    R_sg: Rotation = scalar("its axes to frame s")
    random_walk_rad: float = scalar("1-sigma of an angle after one second, about each axis")
    bias_walk_rad_s: float = scalar("1-sigma by which the bias changes in one second")
    white_rad: float = scalar("resolution of an angle")


@record(kw_only=True)
class ImportedStrip:
    """One CCD of a strip."""

    strip_id: str = scalar("id of the strip")
    ccd: int = scalar("from 0")
    t_first_row_s: float = scalar("middle of row 0, TAI seconds since the epoch")
    row_period_s: float = scalar("s")
    lines: int = scalar("number of rows")
    camera: str = scalar("id of its camera; empty: the only one", default="")


@record(kw_only=True)
class ImportedMission:
    """All that a dump without images holds, but for the measured points."""

    mission: str = scalar("name of the mission")
    created_by: str = scalar("program and command")
    epoch: Epoch = scalar("zero of all times")
    orbit: Orbit = scalar("nodes and interpolation of the ephemeris")
    heads: tuple[ImportedHead, ...] = scalar("sources of attitudes")
    cameras: dict[str, LookAngleCamera] = scalar("look directions by id of the camera; of one alone, empty")
    strips: tuple[ImportedStrip, ...] = scalar("one record a CCD")
    gyro: ImportedGyro | None = scalar("rotations between the attitudes", default=None)
    errors: dict[str, float] = scalar("table [errors] of dump.toml")
    earth_orientation: EarthOrientationTable | None = scalar("the operator's own; None: the bundled one")


def white_noise_rad(t_s: Floats, R_is: Rotation) -> Floats:
    """1-sigma (3,) about the axes of s of white noise, from third differences of K attitudes at equal steps.

    Motion slower than a step has none; noise that is correlated from row to row is understated.
    """
    step = (R_is[:-1].inv() * R_is[1:]).as_rotvec()
    third = np.diff(step, 2, axis=0)  # of white noise: variance 1 + 9 + 9 + 1
    return np.asarray(np.maximum(np.sqrt((third**2).mean(axis=0) / 20.0), 1e-3 * ARCSEC))


def write_imported(
    root: Path, mission: ImportedMission, points: str | None = None, object_id: str = ""
) -> None:
    """Write the dump to `root`; `points` is the text of a table of measured points; None: an empty one.
    `object_id` is the satellite's international designator; empty: the mission's name.

    Raises `FileExistsError` if `root` is not empty.
    """
    if not is_vacant(root):
        raise FileExistsError(f"{root} exists and is not an empty folder")
    root.mkdir(parents=True, exist_ok=True)
    utc = mission.epoch.utc_from_seconds
    orbit = mission.orbit
    assert orbit.velocities_m_s is not None
    message = orbit_message(
        "".join(c if c.isalnum() else "_" for c in mission.mission),
        orbit.frame,
        (orbit.method, orbit.degree),
        utc(orbit.t_s),
        orbit.positions_m,
        orbit.velocities_m_s,
        object_id,
    )
    (root / "orbit.oem").write_text(message, encoding="utf-8")
    for head in mission.heads:
        rows = ([t, *map(float, q)] for t, q in zip(utc(head.t_s), head.R_is.as_quat()))
        write_csv(root / f"{head.name}.csv", ["utc", "qx", "qy", "qz", "qw"], rows)
        installation = {
            "quaternion_cs": head.R_cs0.as_quat().tolist(),
            "sigma_rad": head.sigma_installation_rad.tolist(),
        }
        write_toml(root / f"installation_{head.name}.toml", installation)
    if mission.gyro is not None:
        turns = zip(utc(mission.gyro.t_s), (mission.gyro.turns_g / ARCSEC).tolist())
        write_csv(root / GYRO, ["utc", *"xyz"], ([t, *(round(v, 7) for v in row)] for t, row in turns))
    for name, camera in mission.cameras.items():
        _camera(root, name, camera)
    strips = (
        [s.strip_id, s.ccd, "", utc([s.t_first_row_s])[0], repr(s.row_period_s), s.lines, s.camera]
        for s in mission.strips
    )
    header = ["id", "ccd", "file", "utc_first_row", "row_period_s", "lines", "camera"]
    write_csv(root / "strips.csv", header, strips)
    if mission.earth_orientation is not None:
        _earth_orientation(root / "earth_orientation.csv", mission.earth_orientation)
    no_points = ",".join(PointRow.model_fields) + "\n"
    (root / POINTS).write_text(points if points is not None else no_points, encoding="utf-8")
    write_toml(root / "dump.toml", _head(mission))


def _head(mission: ImportedMission) -> dict[str, Any]:
    files = {"orbit": "orbit.oem", "strips": "strips.csv", "points": POINTS}
    cameras = [{"id": name, "file": _camera_file(name)} for name in mission.cameras if name]
    if not cameras:
        files["remote_camera"] = _camera_file("")
    if mission.earth_orientation is not None:
        files["earth_orientation"] = "earth_orientation.csv"
    return {
        **head_of_dump(mission.mission, mission.created_by),
        "files": files,
        **({"cameras": cameras} if cameras else {}),
        **({"gyro": _gyro(mission.gyro)} if mission.gyro else {}),
        "errors": mission.errors,
        "light": {"light_time": False, "aberration": False, "refraction": False},
        "star_cameras": [
            {
                "name": head.name,
                "level": "attitudes",
                "installation": f"installation_{head.name}.toml",
                "attitudes": f"{head.name}.csv",
                "frame": "GCRF",
                "rotation": "head to inertial",
                "aberration_removed": "annual and orbital",  # the operator corrects no more, on either side
                "interpolation": head.interpolation,
                "noise": {
                    "white_arcsec": [round(v, 4) for v in (head.white_rad / ARCSEC).tolist()],
                    "origin": "assumed",
                },
            }
            for head in mission.heads
        ],
    }


def _gyro(gyro: ImportedGyro) -> dict[str, Any]:
    sizes = {
        "random_walk_arcsec": gyro.random_walk_rad,
        "bias_walk_arcsec_s": gyro.bias_walk_rad_s,
        "white_arcsec": gyro.white_rad,
    }
    return {
        "file": GYRO,
        "quantity": "angles",
        "unit": "arcsec",
        "quaternion_sg": gyro.R_sg.as_quat().tolist(),
        **{name: float(f"{size / ARCSEC:.4g}") for name, size in sizes.items()},
    }


def _camera(root: Path, name: str, camera: LookAngleCamera) -> None:
    looks = (
        [ccd, float(n), float(x), float(y)]
        for ccd, table in enumerate(camera.ccds)
        for n, x, y in zip(table.samples, table.tan_x, table.tan_y)
    )
    table_file = f"looks_{name}.csv" if name else "looks.csv"
    write_csv(root / table_file, ["ccd", "sample", "x", "y"], looks)
    ccds = [{"n_px": table.n_px} for table in camera.ccds]
    model = {"model": LOOK_TABLES, "looks": table_file, "directions": "tangents", "ccds": ccds}
    write_toml(root / _camera_file(name), model)


def _camera_file(name: str) -> str:
    return f"remote_camera_{name}.toml" if name else "remote_camera.toml"


def _earth_orientation(path: Path, table: EarthOrientationTable) -> None:
    columns = (table.mjd_utc, table.ut1_utc_s, table.xp_rad / ARCSEC, table.yp_rad / ARCSEC)
    rows = ([int(day), *map(float, values)] for day, *values in zip(*columns))
    write_csv(path, ["mjd_utc", "ut1_utc_s", "x_arcsec", "y_arcsec"], rows)
