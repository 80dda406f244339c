"""A dump opened: every text file read and checked, cameras, orbit, Earth and terrain ready to be used.

Images are not decoded here; what their headers reveal to be unusable is on the list of omissions. Nothing
under `truth/` is opened. The record is made of arrays and paths, so that a worker process can be handed parts
of it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from boresight.gct_match.records import Target
from boresight.geometry.constants import WGS84
from boresight.geometry.earth_orientation import EarthOrientationTable, bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.geodesy import ecef_from_geodetic
from boresight.geometry.geoid import egm96
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.geometry.orbit import Orbit
from boresight.geometry.star_camera import StarCamera
from boresight.geometry.terrain import Surface, TerrainGrid
from boresight.pipeline.errors import Omission, RawDataError
from boresight.pipeline.files import dump_schema as schema
from boresight.pipeline.files.image_files import StripFiles, check_strip_file, read_grid
from boresight.pipeline.files.orbit_file import Ephemeris, read_oem
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

Array = NDArray[np.float64]
MAX_TERRAIN_PIXELS = 8192 * 8192


@dataclass(frozen=True, slots=True)
class Exposure:
    """One line of exposures.csv. `file` is the path as the dump names it."""

    exposure_id: str
    file: str
    path: Path
    t_s: float  # middle of the exposure
    exposure_s: float


@dataclass(frozen=True, slots=True)
class Strip:
    """One strip of strips.csv with the CCDs whose files have a good header."""

    strip_id: str
    images: StripFiles
    t_first_row_s: float  # as labelled (see the camera's time_of_row)
    row_period_s: float
    lines: int


@dataclass(frozen=True, slots=True)
class ChipFile:
    """Where the chip of a target lies."""

    target_id: str
    file: str
    path: Path


@dataclass(frozen=True, slots=True, eq=False)
class TargetHeights:
    """The surface of a dump without terrain model: each point has the ellipsoidal height of the nearest
    target.
    """

    directions: Array  # (N, 3) of the targets from the centre of a sphere, unit vectors
    heights_m: Array  # (N,)
    _tree: cKDTree = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tree", cKDTree(self.directions))

    def height_m(self, lat_rad: Array, lon_rad: Array) -> Array:
        """Ellipsoidal height (m) of points (...), latitude and longitude in radians; NaN for NaN."""
        lat, lon = np.broadcast_arrays(np.asarray(lat_rad, dtype=float), np.asarray(lon_rad, dtype=float))
        points = _on_unit_sphere(lat.ravel(), lon.ravel())
        good = np.isfinite(points).all(axis=1)
        heights = np.full(len(points), np.nan)
        if good.any():
            heights[good] = self.heights_m[self._tree.query(points[good])[1]]
        return heights.reshape(lat.shape)

    def height_range_m(self) -> tuple[float, float]:
        """Lowest and highest target."""
        return float(self.heights_m.min()), float(self.heights_m.max())


@dataclass(frozen=True, slots=True)
class TerrainFile:
    """A terrain model that is read where it is needed."""

    file: str
    path: Path
    height_kind: str


@dataclass(frozen=True, slots=True, eq=False)
class Dump:
    """Everything that `calibrate` knows, in SI units and `t_s` = TAI seconds since `epoch`."""

    root: Path
    mission: str
    epoch: Epoch
    star_camera: StarCamera
    star_bit_depth: int
    line_camera: LineCamera
    remote_bit_depth: int
    R_cs0: Rotation  # as measured on the ground
    sigma_installation_rad: Array  # (3,) 1-sigma of the turn about the axes of c by which R_cs0 may be wrong
    errors: schema.Errors
    orbit: Orbit
    exposures: tuple[Exposure, ...]  # in order of time
    strips: tuple[Strip, ...]  # in order of time
    targets: tuple[Target, ...]  # in the file's order
    chips: tuple[ChipFile, ...]  # of the same targets
    terrain: TerrainFile | TargetHeights
    omissions: tuple[Omission, ...]

    @property
    def pixels(self) -> int:
        """Pixels of all images."""
        star = self.star_camera.width_px * self.star_camera.height_px * len(self.exposures)
        return star + sum(a * b for strip in self.strips for a, b in strip.images.shapes.values())


def open_dump(root: Path, *, allow_stale_eop: bool = False) -> Dump:
    """Read a dump (docs/dump-format.md). `RawDataError` for anything wrong that is not one image's own
    matter.
    """
    if not root.is_dir():
        raise RawDataError(str(root), "dump", "no such folder", "a folder with a dump.toml")
    head = read_toml(root / "dump.toml", schema.DumpFile, "dump.toml")
    paths = {
        field: path_inside(root, name, file="dump.toml", field=f"files.{field}")
        for field, name in head.files.model_dump(exclude_none=True).items()
    }
    star = read_toml(paths["star_camera"], schema.StarCameraFile, head.files.star_camera)
    remote = read_toml(paths["remote_camera"], schema.RemoteCameraFile, head.files.remote_camera)
    installation = read_toml(paths["installation"], schema.InstallationFile, head.files.installation)
    line_camera = _line_camera(remote, head.files.remote_camera)
    ephemeris = read_oem(paths["orbit"], head.files.orbit)
    orbit = orbit_of(
        ephemeris, head.files.orbit, head.errors.position_m, bundled_table(), allow_stale_eop=allow_stale_eop
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
    """The bundled Earth orientation, parsed once in each process."""
    return bundled_earth_orientation()


def star_camera_of(file: schema.StarCameraFile, name: str) -> StarCamera:
    """The camera that a star_camera.toml describes; `RawDataError` for a lens that cannot be."""
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
        found = "a distortion that folds the image within the detector"
        raise RawDataError(name, "distortion", found, "p1, p2 in 1/mm, q1 in 1/mm^2, q2 in 1/mm^4")
    return camera


def _line_camera(file: schema.RemoteCameraFile, name: str) -> LineCamera:
    ccds = []
    for n, ccd in enumerate(file.ccds):
        try:
            ccds.append(
                Ccd(
                    n_px=ccd.n_px,
                    y_first_m=ccd.y_first_mm * 1e-3,
                    x_offset_m=ccd.x_offset_mm * 1e-3,
                    rotation_rad=ccd.rotation_mrad * 1e-3,
                    pixel_m=ccd.pixel_pitch_um * 1e-6,
                    principal_sample=ccd.principal_sample,
                    distortion_samples=np.array(ccd.distortion_samples, dtype=float),
                    distortion_offsets_m=np.array(ccd.distortion_offsets_um, dtype=float) * 1e-6,
                )
            )
        except ValueError as error:
            raise RawDataError(name, f"ccds.{n}", str(error), "a detector that can be") from error
    return LineCamera(file.focal_length_m, tuple(ccds), file.tdi_stages, file.time_of_row)


def orbit_of(
    ephemeris: Ephemeris,
    file: str,
    sigma_position_m: float | tuple[float, float, float],
    table: EarthOrientationTable,
    *,
    allow_stale_eop: bool,
) -> Orbit:
    """The orbit that an ephemeris describes; `RawDataError` for times and states that cannot be."""
    t = ephemeris.t_s
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
            ephemeris.epoch,
            t,
            ephemeris.positions_m,
            ephemeris.velocities_m_s,
            ephemeris.frame,
            ephemeris.interpolation_degree,
            earth,
            sigma_position_m,
            ephemeris.method,
        )
    except ValueError as error:
        raise RawDataError(file, "states", str(error), "an orbit that can be interpolated") from error


def _seconds(epoch: Epoch, utc: Sequence[str], file: str, field: str) -> Array:
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
    root: Path, path: Path, file: str, epoch: Epoch, remote: schema.RemoteCameraFile
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


def _targets(rows: Sequence[schema.TargetRow]) -> tuple[tuple[Target, ...], Array]:
    """The targets in ITRS, and their ellipsoidal heights (m)."""
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
    path: Path | None, head: schema.DumpFile, rows: Sequence[schema.TargetRow], heights: Array
) -> TerrainFile | TargetHeights:
    if path is None or head.terrain is None:
        lat = np.radians([row.lat_deg for row in rows])
        lon = np.radians([row.lon_deg for row in rows])
        return TargetHeights(_on_unit_sphere(lat, lon), heights)
    terrain = TerrainFile(str(head.files.terrain), path, head.terrain.height_kind)
    surface_of(terrain)  # what is wrong with it shall be known before hours of work
    return terrain


def surface_of(terrain: TerrainFile | TargetHeights) -> Surface:
    """The ground. A file is read once in each process."""
    return terrain if isinstance(terrain, TargetHeights) else _read_terrain(terrain)


@lru_cache(maxsize=1)
def _read_terrain(terrain: TerrainFile) -> TerrainGrid:
    grid = read_grid(terrain.path, terrain.file, max_pixels=MAX_TERRAIN_PIXELS)
    geoid = egm96() if terrain.height_kind == "egm96" else None
    try:
        return TerrainGrid.from_raster(grid.values, grid.transform, grid.crs, geoid)
    except ValueError as error:
        raise RawDataError(terrain.file, "heights", str(error), "a grid of heights") from error


def _on_unit_sphere(lat_rad: Array, lon_rad: Array) -> Array:
    return np.column_stack(
        [np.cos(lat_rad) * np.cos(lon_rad), np.cos(lat_rad) * np.sin(lon_rad), np.sin(lat_rad)]
    )
