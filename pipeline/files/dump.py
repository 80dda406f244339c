"""Open a dump: read and check every text file; build cameras, orbit, Earth rotation and terrain.

Images are not decoded here; one whose header cannot be used becomes an `Omission`. Nothing under `truth/` is
opened. The records hold arrays and paths, so that parts of them can be sent to worker processes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from boresight.gct_match.records import Target
from boresight.geometry.constants import ARCSEC, WGS84
from boresight.geometry.earth_orientation import EarthOrientationTable, bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.geodesy import ecef_from_geodetic
from boresight.geometry.geoid import egm96
from boresight.geometry.groundlight import LightEffects
from boresight.geometry.line_camera import LineCamera, LookAngleCamera
from boresight.geometry.orbit import Orbit
from boresight.geometry.orbit_consistency import find_orbit_fault
from boresight.geometry.record import Floats, array, record, scalar
from boresight.geometry.star_camera import StarCamera
from boresight.geometry.terrain import Surface, TerrainGrid
from boresight.pipeline.errors import Omission, RawDataError
from boresight.pipeline.files import dump_schema as schema
from boresight.pipeline.files.image_files import StripFiles, check_strip_file, read_grid
from boresight.pipeline.files.orbit_file import Ephemeris, read_oem
from boresight.pipeline.files.remote_camera import read_remote_camera
from boresight.pipeline.files.text_files import path_inside, read_table, read_toml

__all__ = [
    "ChipFile",
    "Dump",
    "Exposure",
    "Strip",
    "TargetHeights",
    "TerrainFile",
    "bundled_table",
    "open_dump",
    "orbit_of",
    "star_camera_of",
    "surface_of",
]

MAX_TERRAIN_PIXELS = 8192 * 8192


@record
class Exposure:
    """One line of exposures.csv."""

    exposure_id: str = scalar("id of the table")
    file: str = scalar("path as the table gives it")
    path: Path = scalar("path of the image")
    t_s: float = scalar("middle of the exposure, TAI seconds since the dump's epoch")
    exposure_s: float = scalar("exposure time, s")


@record
class Strip:
    """One strip of strips.csv, with the CCDs whose files have a valid header."""

    strip_id: str = scalar("id of the table")
    images: StripFiles = scalar("image files by CCD")
    t_first_row_s: float = scalar(
        "label of row 0, TAI seconds since the epoch (see the camera's `time_of_row`)"
    )
    row_period_s: float = scalar("s")
    lines: int = scalar("number of rows")


@record
class ChipFile:
    """Image file of a target's chip."""

    target_id: str = scalar("id of the target")
    file: str = scalar("path as targets.csv gives it")
    path: Path = scalar("path of the image")


@record
class TargetHeights:
    """The surface of a dump without terrain model: a point has the height of the nearest target."""

    directions: Floats = array("N, 3", "unit vectors to the targets from the centre of a sphere")
    heights_m: Floats = array("N", "ellipsoidal heights of the targets, m")
    _tree: cKDTree = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tree", cKDTree(self.directions))

    def height_m(self, lat_rad: Floats, lon_rad: Floats) -> Floats:
        """Ellipsoidal heights (m) at points (...), latitude and longitude in radians; NaN for NaN."""
        lat, lon = np.broadcast_arrays(np.asarray(lat_rad, dtype=float), np.asarray(lon_rad, dtype=float))
        points = _on_unit_sphere(lat.ravel(), lon.ravel())
        good = np.isfinite(points).all(axis=1)
        heights = np.full(len(points), np.nan)
        if good.any():
            heights[good] = self.heights_m[self._tree.query(points[good])[1]]
        return heights.reshape(lat.shape)

    def height_range_m(self) -> tuple[float, float]:
        """Heights (m) of the lowest and the highest target."""
        return float(self.heights_m.min()), float(self.heights_m.max())


@dataclass(frozen=True, slots=True)
class TerrainFile:
    """A terrain model that is read where it is needed. Equal files are read once (`surface_of`)."""

    file: str
    path: Path
    height_kind: str


@record(kw_only=True)
class Dump:
    """All inputs of `calibrate`. Units are SI, times are TAI seconds since `epoch`."""

    root: Path = scalar("folder of the dump")
    mission: str = scalar("name of the mission")
    epoch: Epoch = scalar("zero of all times")
    star_camera: StarCamera = scalar("camera of frame s")
    star_bit_depth: int = scalar("bits of a count of the exposures")
    line_camera: LineCamera | LookAngleCamera = scalar("camera of frame c")
    remote_bit_depth: int = scalar("bits of a count of the strips")
    R_cs0: Rotation = scalar("installation rotation measured before launch, frame s to frame c")
    sigma_installation_rad: Floats = array("3", "1-sigma error of `R_cs0`: rotation about the axes of c")
    errors: schema.Errors = scalar("errors of the mission's data as it states them")
    light: LightEffects = scalar("effects on light that the mission's own software models")
    orbit: Orbit = scalar("trajectory of the satellite")
    exposures: tuple[Exposure, ...] = scalar("in order of time")
    strips: tuple[Strip, ...] = scalar("in order of time")
    targets: tuple[Target, ...] = scalar("in the order of targets.csv")
    chips: tuple[ChipFile, ...] = scalar("of the same targets")
    terrain: TerrainFile | TargetHeights = scalar("the surface of the Earth")
    omissions: tuple[Omission, ...] = scalar("images that are not used, with the reasons")

    @property
    def pixels(self) -> int:
        """Number of pixels of all images."""
        star = self.star_camera.width_px * self.star_camera.height_px * len(self.exposures)
        return star + sum(a * b for strip in self.strips for a, b in strip.images.shapes.values())


def open_dump(root: Path, *, allow_stale_eop: bool = False) -> Dump:
    """Read a dump and check it.

    Parameters
    ----------
    root : Path
        Folder with a dump.toml (docs/dump-format.md).
    allow_stale_eop : bool
        Accept dates after the end of the Earth-orientation table, with a warning.

    Returns
    -------
    Dump
        Images whose header is not usable are in `Dump.omissions`.

    Raises
    ------
    RawDataError
        A file is missing or invalid; the error names file, field, found and expected.
    """
    if not root.is_dir():
        raise RawDataError(str(root), "dump", "no such folder", "a folder with a dump.toml")
    if not (root / "dump.toml").exists():
        expected = "the folder's dump.toml; `boresight dump init FOLDER` writes one to fill in"
        raise RawDataError(str(root / "dump.toml"), "file", "no such file", expected)
    head = read_toml(root / "dump.toml", schema.DumpFile, "dump.toml")
    paths = {
        field: path_inside(root, name, file="dump.toml", field=f"files.{field}")
        for field, name in head.files.model_dump(exclude_none=True).items()
    }
    star = read_toml(paths["star_camera"], schema.StarCameraFile, head.files.star_camera)
    line_camera, remote = read_remote_camera(root, paths["remote_camera"], head.files.remote_camera)
    installation = read_toml(paths["installation"], schema.InstallationFile, head.files.installation)
    ephemeris = read_oem(paths["orbit"], head.files.orbit)
    table = _earth_orientation(paths.get("earth_orientation"), head.files.earth_orientation)
    orbit = orbit_of(
        ephemeris, head.files.orbit, head.errors.position_m, table, allow_stale_eop=allow_stale_eop
    )
    strips, omitted = _strips(root, paths["strips"], head.files.strips, ephemeris.epoch, remote)
    rows = _target_rows(paths["targets"], head.files.targets)
    targets, heights = _targets(rows)
    return Dump(
        root=root,
        mission=head.mission,
        epoch=ephemeris.epoch,
        star_camera=star_camera_of(star, head.files.star_camera),
        star_bit_depth=star.bit_depth,
        line_camera=line_camera,
        remote_bit_depth=remote.bit_depth,
        R_cs0=Rotation.from_quat(installation.quaternion_cs),
        sigma_installation_rad=np.array(installation.sigma_rad),
        errors=head.errors,
        light=LightEffects(**head.light.model_dump()),
        orbit=orbit,
        exposures=_exposures(root, paths["exposures"], head.files.exposures, ephemeris.epoch),
        strips=strips,
        targets=targets,
        chips=_chips(root, rows, head.files.targets),
        terrain=_terrain(paths.get("terrain"), head, rows, heights),
        omissions=omitted,
    )


@lru_cache(maxsize=1)
def bundled_table() -> EarthOrientationTable:
    """The Earth-orientation table of the installed package, parsed once in each process."""
    return bundled_earth_orientation()


def star_camera_of(file: schema.StarCameraFile, name: str) -> StarCamera:
    """The camera of a star_camera.toml; `RawDataError` if its distortion cannot be inverted."""
    x0, y0 = file.principal_point_px
    d = file.distortion
    camera = StarCamera(
        focal_m=file.focal_length_mm * 1e-3,
        pixel_m=file.pixel_pitch_um * 1e-6,
        width_px=file.width_px,
        height_px=file.height_px,
        principal_px=(x0, y0),
        p1=d.p1_per_mm,
        p2=d.p2_per_mm,
        q1=d.q1_per_mm2,
        q2=d.q2_per_mm4,
    )
    right, low = file.width_px - 0.5, file.height_px - 0.5
    corners = np.array([[-0.5, -0.5], [right, -0.5], [-0.5, low], [right, low]])
    if not np.isfinite(camera.directions_from_pixels(corners)).all():
        found = "a distortion that is not invertible within the detector"
        raise RawDataError(name, "distortion", found, "p1, p2 in 1/mm, q1 in 1/mm^2, q2 in 1/mm^4")
    return camera


def _earth_orientation(path: Path | None, file: str | None) -> EarthOrientationTable:
    """The mission's own table, or the bundled one."""
    if path is None or file is None:
        return bundled_table()
    rows = read_table(path, schema.EarthOrientationRow, file)
    columns = np.array([[r.mjd_utc, r.ut1_utc_s, r.x_arcsec, r.y_arcsec] for r in rows], dtype=float)
    mjd, ut1_utc, x, y = columns.reshape(-1, 4).T
    try:
        return EarthOrientationTable(
            mjd_utc=mjd,
            ut1_utc_s=ut1_utc,
            xp_rad=x * ARCSEC,
            yp_rad=y * ARCSEC,
            dx_rad=np.zeros(len(mjd)),
            dy_rad=np.zeros(len(mjd)),
            source=file,
            mjd_last_measured=float(mjd[-1]) if len(mjd) else np.nan,
        )
    except ValueError as error:
        raise RawDataError(file, "mjd_utc", str(error), "4 or more consecutive days") from error


def orbit_of(
    ephemeris: Ephemeris,
    file: str,
    sigma_position_m: float | tuple[float, float, float],
    table: EarthOrientationTable,
    *,
    allow_stale_eop: bool,
) -> Orbit:
    """The orbit through the states of an ephemeris.

    `RawDataError` for dates without Earth orientation and states that cannot be interpolated.
    """
    t, frame = ephemeris.t_s, ephemeris.frame
    if fault := find_orbit_fault(t, ephemeris.positions_m, ephemeris.velocities_m_s, frame):
        expected = f"{frame} velocities in km/s that are the rate of change of the positions, and no jumps"
        raise RawDataError(file, f"state {fault.state + 1}", str(fault), expected)
    try:
        earth = EarthRotation.over(
            ephemeris.epoch, float(t[0]), float(t[-1]), table, allow_stale_eop=allow_stale_eop
        )
    except ValueError as error:  # before 1972, or EarthOrientationError
        found = f"{ephemeris.first_time} to {ephemeris.last_time}"
        expected = f"dates within the Earth-orientation table ({error})"
        raise RawDataError(file, "time of the states", found, expected) from error
    try:
        return Orbit(
            epoch=ephemeris.epoch,
            t_s=t,
            positions_m=ephemeris.positions_m,
            velocities_m_s=ephemeris.velocities_m_s,
            frame=frame,
            degree=ephemeris.interpolation_degree,
            earth=earth,
            sigma_position_m=sigma_position_m,
            method=ephemeris.method,
        )
    except ValueError as error:
        raise RawDataError(file, "states", str(error), "an orbit that can be interpolated") from error


def _seconds(epoch: Epoch, utc: Sequence[str], file: str, field: str) -> Floats:
    try:
        return epoch.seconds_from_utc(utc)
    except ValueError as error:
        raise RawDataError(file, field, str(error), "UTC times that exist") from error


def _once(ids: Sequence[str], file: str) -> None:
    if twice := [f"{name} {n} times" for name, n in Counter(ids).items() if n > 1]:
        raise RawDataError(file, "id", ", ".join(twice[:5]), "each id once")


def _exposures(root: Path, path: Path, file: str, epoch: Epoch) -> tuple[Exposure, ...]:
    rows = read_table(path, schema.ExposureRow, file)
    if not rows:
        raise RawDataError(file, "rows", "none", "at least one exposure")
    _once([row.id for row in rows], file)
    t_s = _seconds(epoch, [row.utc_mid for row in rows], file, "utc_mid")
    if len(bad := np.flatnonzero(np.diff(t_s) <= 0)):
        k = int(bad[0])
        found = f"{rows[k + 1].utc_mid} ({rows[k + 1].id}) after {rows[k].utc_mid} ({rows[k].id})"
        raise RawDataError(file, f"line {k + 3}, utc_mid", found, "strictly increasing times")
    return tuple(
        Exposure(
            row.id,
            row.file,
            path_inside(root, row.file, file=file, field=f"line {n + 2}, file"),
            float(t),
            row.exposure_s,
        )
        for n, (row, t) in enumerate(zip(rows, t_s))
    )


def _strips(
    root: Path, path: Path, file: str, epoch: Epoch, remote: schema.RemoteCameraFile | schema.LookCameraFile
) -> tuple[tuple[Strip, ...], tuple[Omission, ...]]:
    rows = read_table(path, schema.StripRow, file)
    if not rows:
        raise RawDataError(file, "rows", "none", "at least one strip")
    _once([f"{row.id}, ccd {row.ccd}" for row in rows], file)
    t_s = _seconds(epoch, [row.utc_first_row for row in rows], file, "utc_first_row")
    first: dict[str, tuple[schema.StripRow, float]] = {}
    paths: dict[str, dict[int, Path]] = {}
    names: dict[str, dict[int, str]] = {}
    omitted = []
    for n, (row, t) in enumerate(zip(rows, t_s)):
        where = f"line {n + 2}"
        image = path_inside(root, row.file, file=file, field=f"{where}, file")
        if row.ccd >= len(remote.ccds):
            raise RawDataError(file, f"{where}, ccd", str(row.ccd), f"0 to {len(remote.ccds) - 1}")
        reference, _ = first.setdefault(row.id, (row, float(t)))
        for key in ("utc_first_row", "row_period_s", "lines"):
            if (got := getattr(row, key)) != (expected := getattr(reference, key)):
                raise RawDataError(
                    file, f"{where}, {key}", str(got), f"{expected}, as for CCD {reference.ccd}"
                )
        try:
            check_strip_file(
                image,
                row.file,
                lines=row.lines,
                samples=remote.ccds[row.ccd].n_px,
                bit_depth=remote.bit_depth,
            )
        except RawDataError as error:
            omitted.append(Omission("ccd", f"{row.id}/{row.ccd}", row.file, str(error)))
            continue
        paths.setdefault(row.id, {})[row.ccd] = image
        names.setdefault(row.id, {})[row.ccd] = row.file
    strips = []
    for strip_id, (row, t) in sorted(first.items(), key=lambda item: (item[1][1], item[0])):
        if strip_id not in paths:
            omitted.append(Omission("strip", strip_id, row.file, "none of its images can be read"))
            continue
        shapes = {ccd: (row.lines, remote.ccds[ccd].n_px) for ccd in paths[strip_id]}
        images = StripFiles(paths[strip_id], names[strip_id], shapes)
        strips.append(Strip(strip_id, images, t, row.row_period_s, row.lines))
    return tuple(strips), tuple(omitted)


def _target_rows(path: Path, file: str) -> list[schema.TargetRow]:
    rows = read_table(path, schema.TargetRow, file)
    if not rows:
        raise RawDataError(file, "rows", "none", "at least one target")
    _once([row.id for row in rows], file)
    return rows


def _targets(rows: Sequence[schema.TargetRow]) -> tuple[tuple[Target, ...], Floats]:
    """The targets with ITRS positions, and their ellipsoidal heights (m)."""
    lat = np.radians([row.lat_deg for row in rows])
    lon = np.radians([row.lon_deg for row in rows])
    height = np.array([row.height_m for row in rows], dtype=float)
    orthometric = np.array([row.height_kind == "egm96" for row in rows])
    if orthometric.any():
        height[orthometric] += egm96().undulation_m(lat[orthometric], lon[orthometric])
    p_e = ecef_from_geodetic(lat, lon, height, WGS84)
    return tuple(
        Target(row.id, p, np.array([row.sigma_east_m, row.sigma_north_m, row.sigma_up_m]))
        for row, p in zip(rows, p_e)
    ), height


def _chips(root: Path, rows: Sequence[schema.TargetRow], file: str) -> tuple[ChipFile, ...]:
    return tuple(
        ChipFile(row.id, row.chip, path_inside(root, row.chip, file=file, field=f"line {n + 2}, chip"))
        for n, row in enumerate(rows)
    )


def _terrain(
    path: Path | None, head: schema.DumpFile, rows: Sequence[schema.TargetRow], heights: Floats
) -> TerrainFile | TargetHeights:
    if path is None or head.terrain is None:
        lat = np.radians([row.lat_deg for row in rows])
        lon = np.radians([row.lon_deg for row in rows])
        return TargetHeights(_on_unit_sphere(lat, lon), heights)
    terrain = TerrainFile(str(head.files.terrain), path, head.terrain.height_kind)
    surface_of(terrain)  # an invalid file is reported before hours of work
    return terrain


def surface_of(terrain: TerrainFile | TargetHeights) -> Surface:
    """The surface of the Earth. A terrain file is read once in each process."""
    return terrain if isinstance(terrain, TargetHeights) else _read_terrain(terrain)


@lru_cache(maxsize=1)
def _read_terrain(terrain: TerrainFile) -> TerrainGrid:
    grid = read_grid(terrain.path, terrain.file, max_pixels=MAX_TERRAIN_PIXELS)
    geoid = egm96() if terrain.height_kind == "egm96" else None
    try:
        return TerrainGrid.from_raster(grid.values, grid.transform, grid.crs, geoid)
    except ValueError as error:
        raise RawDataError(terrain.file, "heights", str(error), "a grid of heights") from error


def _on_unit_sphere(lat_rad: Floats, lon_rad: Floats) -> Floats:
    return np.column_stack(
        [np.cos(lat_rad) * np.cos(lon_rad), np.cos(lat_rad) * np.sin(lon_rad), np.sin(lat_rad)]
    )
