"""Open a dump: read and check every text file; build cameras, orbit, Earth rotation and terrain.

Images are not decoded here; one whose header cannot be used becomes an `Entry`. Nothing under `truth/` is
opened. The records hold arrays and paths, so that parts of them can be sent to worker processes.
"""

from __future__ import annotations

import html
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from boresight.gct_match.records import Target
from boresight.geometry.constants import ARCSEC, GM_EARTH
from boresight.geometry.earth_orientation import EarthOrientationTable, bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.geoid import egm96
from boresight.geometry.groundlight import LightEffects
from boresight.geometry.ledger import Entry, Kind, Reason, Subject
from boresight.geometry.line_camera import LineCamera, LookAngleCamera
from boresight.geometry.orbit import Orbit
from boresight.geometry.orbit_consistency import find_orbit_fault
from boresight.geometry.pushbroom import RowClock
from boresight.geometry.record import Floats, array, record, scalar, value_text
from boresight.geometry.spherical import unit_vectors
from boresight.geometry.star_camera import StarCamera
from boresight.geometry.terrain import Surface, TerrainGrid, TerrainTiles
from boresight.geometry.terrain_tiles import Raster, joined
from boresight.pipeline.errors import RawDataError, printable
from boresight.pipeline.files import dump_schema as schema
from boresight.pipeline.files.content import Identity, identity_of
from boresight.pipeline.files.dates import check_exposure_dates, check_orbit_dates, orbit_covers
from boresight.pipeline.files.ground_points import StripPoints, SurveyedPoints, read_points, targets_of
from boresight.pipeline.files.images.rasters import read_grid
from boresight.pipeline.files.images.tiff import StripFiles, check_strip_file
from boresight.pipeline.files.object_store import dump_folder
from boresight.pipeline.files.orbit_file import Ephemeris, covered_by, joined_segments, read_segments
from boresight.pipeline.files.remote_camera import read_remote_camera
from boresight.pipeline.files.repeated_exposures import exposures_once
from boresight.pipeline.files.repeated_points import points_once
from boresight.pipeline.files.repeated_strips import strips_once
from boresight.pipeline.files.spice_kernels import NO_KERNELS, SPK, Kernels, is_kernel
from boresight.pipeline.files.spice_orbit import read_spk
from boresight.pipeline.files.star_side import (
    Exposure,
    Head,
    SolvedAttitudes,
    StarImages,
    check_attitudes,
    each_once,
    open_heads,
    seconds_of,
)
from boresight.pipeline.files.star_tables import StarTable, survey_of
from boresight.pipeline.files.text_files import path_inside, read_table, read_toml

__all__ = [
    "ChipFile",
    "Dump",
    "Strip",
    "TargetHeights",
    "TerrainFiles",
    "bundled_table",
    "dump_faults",
    "open_dump",
    "orbit_of",
    "read_earth_orientation",
    "surface_of",
]

# Longest step of an orbit, of a revolution: velocities and positions then still agree to 2 m/s (degree 3).
MOST_REVOLUTION = 0.1
MOST_NAMED = 8  # strips, and items not used, in the text of a dump
# Most pixels of a terrain model; of single precision they take 256 MiB.
MAX_TERRAIN_PIXELS = 8192 * 8192
StripMember = tuple[str, schema.StripRow, float]  # where in the table, row, its time in TAI seconds
# Files of the star camera in a dump with one head, with the schema of each.
OF_ONE_HEAD: dict[str, Any] = {
    "star_camera": schema.StarCameraFile,
    "installation": schema.InstallationFile,
    "exposures": schema.ExposureRow,
}
# Fields of a place: latitude and longitude, then the ellipsoidal height.
PLACE = ("lat_rad", "lon_rad", "height_m")


@record(kw_only=True)
class Strip:
    """One strip of strips.csv, with the CCDs whose files have a valid header."""

    strip_id: str = scalar("id of the table")
    images: StripFiles = scalar("image files by CCD")
    t_first_row_s: float = scalar(
        "label of row 0, TAI seconds since the epoch (see the camera's `time_of_row`)"
    )
    row_period_s: float = scalar("s")
    lines: int = scalar("number of rows, from the first of any CCD to the last")
    first_row: dict[int, float] = scalar("row of the strip at which line 0 of a CCD's image lies, by CCD")
    ccd_lines: dict[int, int] = scalar("number of lines of each CCD of the table")
    kind: str = scalar("what the camera looks at: ground or sky", default="ground")

    @property
    def subject(self) -> Subject:
        """The strip as a subject."""
        return Subject(Kind.STRIP, strip=self.strip_id)

    def ccd_subject(self, ccd: int) -> Subject:
        """One CCD of it as a subject."""
        return Subject(Kind.CCD, strip=self.strip_id, ccd=ccd)

    @property
    def clock(self) -> RowClock:
        """Time labels of the rows, and the row at which each CCD begins."""
        first_row = self.first_row if any(self.first_row.values()) else {}
        return RowClock(self.t_first_row_s, self.row_period_s, first_row)


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
        points = unit_vectors(lon.ravel(), lat.ravel())
        good = np.isfinite(points).all(axis=1)
        heights = np.full(len(points), np.nan)
        if good.any():
            heights[good] = self.heights_m[self._tree.query(points[good])[1]]
        return heights.reshape(lat.shape)

    def height_range_m(self) -> tuple[float, float]:
        """Heights (m) of the lowest and the highest target."""
        return float(self.heights_m.min()), float(self.heights_m.max())


NO_TERRAIN = TargetHeights(np.zeros((0, 3)), np.zeros(0))  # of a dump with strips of the sky alone


@dataclass(frozen=True, slots=True)
class TerrainFiles:
    """Terrain models that are read where they are needed. Equal files are read once (`surface_of`)."""

    files: tuple[str, ...]  # paths as dump.toml gives them
    paths: tuple[Path, ...]
    height_kind: str


@record(kw_only=True)
class Dump:
    """All inputs of `calibrate`. Units are SI, times are TAI seconds since `epoch`."""

    root: Path = scalar("folder of the dump")
    mission: str = scalar("name of the mission")
    satellite: str = scalar("name of the satellite; may be empty")
    epoch: Epoch = scalar("zero of all times")
    heads: tuple[Head, ...] = scalar("star cameras; the first is the reference head, of frame s")
    line_camera: LineCamera | LookAngleCamera = scalar("camera of frame c")
    remote_bit_depth: int = scalar("bits of a count of the strips; 0 where no strip has an image")
    errors: schema.Errors = scalar("errors of the mission's data as it states them")
    light: LightEffects = scalar("effects on light that the mission's own software models")
    orbit: Orbit = scalar("trajectory of the satellite")
    earth_table: EarthOrientationTable = scalar("Earth orientation of that orbit")
    earth_file: str = scalar("the mission's own file of it; empty: the bundled table")
    strips: tuple[Strip, ...] = scalar("of the ground, in order of time")
    sky_strips: tuple[Strip, ...] = scalar("of the sky, in order of time")
    targets: tuple[Target, ...] = scalar("in the order of targets.csv")
    chips: tuple[ChipFile, ...] = scalar("of the same targets")
    points: tuple[StripPoints, ...] = scalar("measured image points, one record a strip")
    terrain: TerrainFiles | TargetHeights = scalar("the surface of the Earth")
    star_catalogue: StarTable | None = scalar("stars of strips of the sky; None: the bundled Hipparcos")
    orbit_covers: str = scalar(
        'what the orbit covers, for messages: "orbit.oem covers 2024-11-20T03:39:49 to ..."'
    )
    omissions: tuple[Entry, ...] = scalar("images that are not used, with the reasons")
    listed: dict[str, int] = scalar(
        "how many targets, measured points, strips and exposures of the reference head its tables list"
    )

    def __repr__(self) -> str:
        named = ", ".join(one.strip_id for one in (*self.strips, *self.sky_strips)[:MOST_NAMED])
        more = ", ..." if len(self.strips) + len(self.sky_strips) > MOST_NAMED else ""
        satellite = f" ({self.satellite})" if self.satellite else ""
        points = f", {sum(len(one.ccd) for one in self.points)} measured points" if self.points else ""
        unused = [entry.line for entry in self.omissions[:MOST_NAMED]]
        lines = [
            f"dump {self.mission}{satellite} in {self.root}",
            f"{len(self.exposures)} exposures of {len(self.heads)} star cameras",
            f"{len(self.strips)} strips of the ground and {len(self.sky_strips)} of the sky: {named}{more}",
            f"{len(self.targets)} targets{points}",
            self.orbit_covers,
            f"not used: {len(self.omissions) or 'nothing'}",
            *(f"  {printable(text)[:120]}" for text in unused),
        ]
        return "\n".join(lines)

    @property
    def target_files(self) -> str:
        """Files with the coordinates of its targets, for messages."""
        chips = "targets.csv" if self.targets or not self.points else ""
        return ", ".join(filter(None, (chips, "points.csv" if self.points else "")))

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(repr(self))}</pre>"

    @property
    def R_cs0(self) -> Rotation:
        """Installation rotation of the reference head measured before launch, frame s to frame c."""
        return self.heads[0].R_cs0

    @property
    def sigma_installation_rad(self) -> Floats:
        """1-sigma error (3,) of `R_cs0`: rotation about the axes of c."""
        return self.heads[0].sigma_installation_rad

    @property
    def ground_targets(self) -> dict[str, Target]:
        """All targets and measured points by their ids."""
        measured = (target for points in self.points for target in points.targets)
        return {target.target_id: target for target in (*self.targets, *measured)}

    @property
    def star_images(self) -> tuple[StarImages, ...]:
        """The heads that deliver raw images."""
        return tuple(head.source for head in self.heads if isinstance(head.source, StarImages))

    @property
    def star_camera(self) -> StarCamera | None:
        """Camera model of the reference head; None where it delivers attitudes."""
        source = self.heads[0].source
        return None if isinstance(source, SolvedAttitudes) else source.camera

    @property
    def exposures(self) -> tuple[Exposure, ...]:
        """Raw images of all heads, head by head in order of time."""
        return tuple(exposure for images in self.star_images for exposure in images.exposures)

    def span_s(self, strip: Strip) -> tuple[float, float]:
        """Instants of the middle of the first and the last row of a strip, TAI seconds since the epoch."""
        first = strip.t_first_row_s + self.line_camera.delay_to_middle_s(strip.row_period_s)
        return first, first + (strip.lines - 1) * strip.row_period_s

    @property
    def pixels(self) -> int:
        """Number of pixels of all images."""
        star = sum(i.camera.width_px * i.camera.height_px * len(i.exposures) for i in self.star_images)
        return star + sum(a * b for strip in self.strips for a, b in strip.images.shapes.values())


def open_dump(
    root: str | os.PathLike[str] | Dump,
    *,
    allow_stale_eop: bool = False,
    sky_alone: bool = False,
) -> Dump:
    """A dump read and checked: cameras, orbit, exposures, strips, targets; images are not decoded.

    Parameters
    ----------
    root : path, str or Dump
        Folder with a dump.toml (docs/dump-format.md), or its address in a store (`s3://bucket/dump`); an open
        dump is returned as it is.
    allow_stale_eop : bool
        Accept dates after the end of the Earth-orientation table, with a warning.
    sky_alone : bool
        For what needs no ground: targets, points and terrain are not read and may be missing.

    Returns
    -------
    Dump
        Images whose header is not usable are in `Dump.omissions`.

    Raises
    ------
    RawDataError
        A file is missing or invalid; the error names file, field, found and expected.
    ValueError
        If `root` is neither a path nor a dump.
    WorkerError
        If an object store does not answer.

    Examples
    --------
    >>> import boresight as bs
    >>> dump = bs.open_dump(bs.example("mini"))
    >>> len(dump.exposures), len(dump.strips), len(dump.targets)
    (42, 3, 36)
    """
    if isinstance(root, Dump):
        return root
    root = _existing(root)
    head = read_toml(root / "dump.toml", schema.DumpFile, "dump.toml")
    paths = {
        field: path_inside(root, name, file="dump.toml", field=f"files.{field}")
        for field, name in head.files.single.items()
    }
    line_camera, remote = read_remote_camera(root, paths["remote_camera"], head.files.remote_camera)
    kernels = _kernels(root, head)
    segments = _read_orbit(paths["orbit"], head.files.orbit, kernels)
    own = head.files.earth_orientation
    table = bundled_table() if own is None else read_earth_orientation(paths["earth_orientation"], own)
    every, omitted = _strips(
        root, paths["strips"], head.files.strips, segments[0].epoch, remote, head.files.remote_camera
    )
    of_strips = _spans(every)
    ephemeris, orbit_file = _segment(segments, of_strips, head.files.orbit)
    orbit = orbit_of(ephemeris, orbit_file, table, allow_stale_eop=allow_stale_eop)
    ground, sky = (tuple(one for one in every if one.kind == kind) for kind in ("ground", "sky"))
    if sky_alone:
        paths = {key: path for key, path in paths.items() if key not in ("targets", "points")}
    else:
        _check_what_they_show(ground, sky, head)
    (strips, twice), (sky_strips, sky_twice) = (strips_once(one, head.files.strips) for one in (ground, sky))
    rows = _target_rows(paths["targets"], str(head.files.targets)) if "targets" in paths else []
    surveyed = targets_of(rows)
    every_head = open_heads(root, head, ephemeris.epoch, kernels)
    heads, exposures_twice = exposures_once(every_head)
    covers = _checked_dates(ephemeris, orbit_file, _exposure_times(heads, head), of_strips)
    check_attitudes(heads, orbit, orbit_file, _spans(strips))
    points, of_points = _points(paths.get("points"), head, ground)
    single_points, points_twice = points_once(points, str(head.files.points))
    return Dump(
        root=root,
        mission=head.mission,
        satellite=head.satellite,
        epoch=ephemeris.epoch,
        heads=heads,
        line_camera=line_camera,
        remote_bit_depth=remote.bit_depth or 0,
        errors=head.errors,
        light=LightEffects(**head.light.model_dump()),
        orbit=orbit,
        earth_table=table,
        earth_file=own or "",
        strips=strips,
        sky_strips=sky_strips,
        targets=surveyed.targets,
        chips=_chips(root, rows, str(head.files.targets)),
        points=_points_of(single_points, strips),
        terrain=NO_TERRAIN if sky_alone else _terrain(root, head, (surveyed, *of_points)),
        star_catalogue=_star_catalogue(paths.get("star_catalogue"), head, sky_strips),
        orbit_covers=covers,
        omissions=(*omitted, *twice, *sky_twice, *exposures_twice, *points_twice),
        listed={
            "targets": len(rows),
            "points": sum(len(one.ccd) for one in points),
            "strips": len(every) + sum(entry.subject.kind is Kind.STRIP for entry in omitted),
            "exposures": 0 if isinstance(heads[0].source, SolvedAttitudes) else every_head[0].n_exposures,
        },
    )


def _existing(root: object) -> Path:
    """The folder of a dump; `ValueError` for what cannot be one, `RawDataError` for one that is not there."""
    if not isinstance(root, str | os.PathLike) or not str(root).strip() or "\0" in str(root):
        found = printable(value_text(root))
        raise ValueError(f"root: found {found}, expected the folder of a dump, or a Dump")
    folder = dump_folder(os.fspath(root))
    try:
        is_there = folder.is_dir()
    except OSError as error:  # a name that is too long, no permission
        raise RawDataError(str(folder)[:200], "dump", error.strerror, "a folder with a dump.toml") from error
    if not is_there:
        found = "a file" if folder.is_file() else "no such folder"
        raise RawDataError(str(folder), "dump", found, "a folder with a dump.toml")
    if not (folder / "dump.toml").exists():
        expected = "the folder's dump.toml; `boresight dump init FOLDER` writes one to fill in"
        raise RawDataError("dump.toml", "file", f"no such file in {folder}", expected)
    return folder


def _spans(strips: Sequence[Strip]) -> list[tuple[float, float]]:
    """First and last instant of each strip, TAI seconds since the epoch."""
    return [(s.t_first_row_s, s.t_first_row_s + s.lines * s.row_period_s) for s in strips]


def _checked_dates(
    ephemeris: Ephemeris, file: str, exposed: tuple[Floats, str], spans: Sequence[tuple[float, float]]
) -> str:
    """What the orbit of `file` covers, for messages; `RawDataError` where it, or all instants `exposed` of
    the file named with them, are of another time than the strips, whose `spans` are given.
    """
    covers = orbit_covers(ephemeris.epoch, ephemeris.t_s, ephemeris.time_system, file, spans)
    check_orbit_dates(covers, ephemeris.epoch, ephemeris.t_s, file, spans)
    check_exposure_dates(ephemeris.epoch, *exposed, spans)
    return covers


def _exposure_times(heads: Sequence[Head], head: schema.DumpFile) -> tuple[Floats, str]:
    """Instants of all exposures and attitudes, and the file of the first."""
    of_head = [
        one.source.rows.t_s
        if isinstance(one.source, SolvedAttitudes)
        else np.array([exposure.t_s for exposure in one.source.exposures])
        for one in heads
    ]
    first = heads[0].source
    file = first.file if isinstance(first, SolvedAttitudes) else head.files.exposures
    return np.concatenate(of_head), file or f"exposures of {heads[0].name}"


def dump_faults(root: Path) -> list[RawDataError]:
    """Everything that is wrong in the text files of a dump, each file checked by itself."""
    faults: list[RawDataError] = []

    def tried(read: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        try:
            return read(*arguments, **named)
        except RawDataError as error:
            known = {str(one) for one in faults}
            faults.extend(one for one in (error, *error.others) if str(one) not in known)
            return None

    head = tried(read_toml, root / "dump.toml", schema.DumpFile, "dump.toml")
    if head is None:
        return faults
    named = head.files.single
    paths = {key: tried(path_inside, root, name, file="dump.toml", field=key) for key, name in named.items()}
    read = {key: path for key, path in paths.items() if path is not None}
    remote = read.get("remote_camera") and tried(
        read_remote_camera, root, read["remote_camera"], head.files.remote_camera
    )
    kernels = tried(_kernels, root, head) or NO_KERNELS
    segments = read.get("orbit") and tried(_read_orbit, read["orbit"], head.files.orbit, kernels)
    epoch = segments[0].epoch if segments else Epoch.from_utc("2000-01-01T12:00:00Z")
    if segments:
        own = head.files.earth_orientation
        table = tried(read_earth_orientation, read.get("earth_orientation"), own) if own else bundled_table()
        if table is not None:
            for one in segments if len(segments) == 1 else ():
                tried(orbit_of, one, head.files.orbit, table, allow_stale_eop=False)
    if remote and "strips" in read:
        of_camera = (epoch, remote[1], head.files.remote_camera)
        tried(_strips, root, read["strips"], head.files.strips, *of_camera)
    if "targets" in read:
        rows = tried(_target_rows, read["targets"], str(head.files.targets))
        tried(_chips, root, rows or [], str(head.files.targets))
    for key, model in OF_ONE_HEAD.items():
        if key in read:
            tried(read_table if key == "exposures" else read_toml, read[key], model, named[key])
    tried(open_heads, root, head, epoch, kernels)
    tried(open_dump, root)
    return faults


def _kernels(root: Path, head: schema.DumpFile) -> Kernels:
    """The SPICE kernels that a dump names beside those of attitudes and orbit."""
    if head.spice is None:
        return NO_KERNELS
    paths = (
        path_inside(root, name, file="dump.toml", field=f"spice.kernels.{n}")
        for n, name in enumerate(head.spice.kernels)
    )
    return Kernels(files=tuple(head.spice.kernels), paths=tuple(paths), spacecraft=head.spice.spacecraft)


def _read_orbit(path: Path, file: str, kernels: Kernels) -> tuple[Ephemeris, ...]:
    """The orbit of an SPK, or the segments of an OEM, by the first bytes of the file."""
    return (read_spk(path, file, kernels),) if is_kernel(path, file, SPK) else read_segments(path, file)


def _segment(
    segments: tuple[Ephemeris, ...], strips: list[tuple[float, float]], file: str
) -> tuple[Ephemeris, str]:
    """All segments joined, or where they do not follow one another, or none covers a strip, the one that
    covers most of them; its name in errors.
    """
    covered = covered_by(segments, strips)
    if any(covered) and (all_of_them := joined_segments(segments)) is not None:
        return all_of_them, file
    n = covered.index(max(covered))
    return segments[n], file if len(segments) == 1 else f"{file} (segment {n + 1} of {len(segments)})"


@lru_cache(maxsize=1)
def bundled_table() -> EarthOrientationTable:
    """The Earth-orientation table of the installed package, parsed once in each process."""
    return bundled_earth_orientation()


def read_earth_orientation(path: Path, file: str) -> EarthOrientationTable:
    """A mission's own table of Earth orientation; `RawDataError` for fewer than 4 consecutive days."""
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
    table: EarthOrientationTable,
    *,
    allow_stale_eop: bool,
) -> Orbit:
    """The orbit through the states of an ephemeris.

    `RawDataError` for dates without Earth orientation and states that cannot be interpolated.
    """
    t, frame = ephemeris.t_s, ephemeris.frame
    _check_steps(ephemeris, file)
    for begin, end in pairwise((0, *ephemeris.begins, len(t))):
        positions, velocities = ephemeris.positions_m[begin:end], ephemeris.velocities_m_s[begin:end]
        if fault := find_orbit_fault(t[begin:end], positions, velocities, frame):
            if fault.fault.is_of_frame:
                raise RawDataError(file, "REF_FRAME", f"{frame}, but {fault}", "the frame of the states")
            expected = (
                f"{frame} velocities in km/s that are the rate of change of the positions, and no jumps"
            )
            raise RawDataError(file, f"state {begin + fault.state + 1}", str(fault), expected)
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
            method=ephemeris.method,
            begins=ephemeris.begins,
        )
    except ValueError as error:
        raise RawDataError(file, "states", str(error), "an orbit that can be interpolated") from error


def _check_steps(ephemeris: Ephemeris, file: str) -> None:
    """`RawDataError` for states too far apart to be interpolated, or compared with their velocities."""
    radius = np.median(np.linalg.norm(ephemeris.positions_m, axis=1))
    longest = MOST_REVOLUTION * 2.0 * np.pi * np.sqrt(radius**3 / GM_EARTH)
    if (step := float(np.median(np.diff(ephemeris.t_s)))) > longest:
        expected = f"at most {longest:.0f} s, {MOST_REVOLUTION:g} of a revolution"
        raise RawDataError(file, "time of the states", f"steps of {step:.0f} s", expected)


def _strips(
    root: Path,
    path: Path,
    file: str,
    epoch: Epoch,
    remote: schema.RemoteCameraFile | schema.LookCameraFile,
    remote_file: str,
) -> tuple[tuple[Strip, ...], tuple[Entry, ...]]:
    rows = read_table(path, schema.StripRow, file)
    if not rows:
        raise RawDataError(file, "rows", "none", "at least one strip")
    each_once([f"{row.id}, ccd {row.ccd}" for row in rows], file)
    t_s = seconds_of(epoch, [row.utc_first_row for row in rows], file, "utc_first_row")
    of_strip: dict[str, list[StripMember]] = {}
    for n, (row, t) in enumerate(zip(rows, t_s)):
        where = f"line {n + 2}"
        if row.ccd >= len(remote.ccds):
            raise RawDataError(file, f"{where}, ccd", str(row.ccd), f"0 to {len(remote.ccds) - 1}")
        of_strip.setdefault(row.id, []).append((where, row, float(t)))
    strips: list[Strip] = []
    omitted: list[Entry] = []
    for strip_id, members in of_strip.items():
        _check_alike(members, file)
        images, of_images = _strip_images(root, members, file, remote, remote_file)
        omitted += of_images
        if not images.paths and all(row.file for _, row, _ in members):
            name = members[0][1].file
            unread = "none of its images can be read"
            omitted.append(Entry(Subject(Kind.STRIP, strip=strip_id), Reason.UNREADABLE, unread, name))
            continue
        strips.append(_strip(strip_id, images, members))
    return tuple(sorted(strips, key=lambda one: (one.t_first_row_s, one.strip_id))), tuple(omitted)


def _strip(strip_id: str, images: StripFiles, members: list[StripMember]) -> Strip:
    """The strip, its rows counted from the earliest row of any CCD."""
    begin, period = min(t for _, _, t in members), members[0][1].row_period_s
    first_row = {row.ccd: (t - begin) / period for _, row, t in members}
    lines = max(row.lines + int(np.ceil(first_row[row.ccd] - 1e-6)) for _, row, _ in members)
    return Strip(
        strip_id=strip_id,
        images=images,
        t_first_row_s=begin,
        row_period_s=period,
        lines=lines,
        first_row=first_row,
        ccd_lines={row.ccd: row.lines for _, row, _ in members},
        kind=members[0][1].kind,
    )


def _check_alike(members: list[StripMember], file: str) -> None:
    """Refuse CCDs of a strip whose rows differ in period, or in a strip of the sky in begin and number."""
    _, reference, _ = members[0]
    together = reference.kind == "sky"  # its stars are identified in all CCDs by one motion over the rows
    for where, row, _ in members:
        same = ("kind", "row_period_s", *(("utc_first_row", "lines") if together else ()))
        for key in same:
            if (got := getattr(row, key)) != (expected := getattr(reference, key)):
                raise RawDataError(
                    file, f"{where}, {key}", str(got), f"{expected}, as for CCD {reference.ccd}"
                )


def _check_what_they_show(ground: Sequence[Strip], sky: Sequence[Strip], head: schema.DumpFile) -> None:
    """`RawDataError` for a strip without an image and without points, and for ground without any targets."""
    files = head.files
    if ground and files.targets is None and files.points is None:
        expected = (
            "files.targets (chips) or files.points (measured image points), for its strips of the ground"
        )
        raise RawDataError("dump.toml", "files.targets", "nothing", expected)
    bare = [one.strip_id for one in ground if not one.images.names] if files.points is None else []
    if bare := bare + [one.strip_id for one in sky if not one.images.names]:
        found = f"no image of strip {bare[0]}"
        raise RawDataError(files.strips, "file", found, "an image, or files.points in dump.toml")


def _strip_images(
    root: Path,
    members: list[StripMember],
    file: str,
    remote: schema.RemoteCameraFile | schema.LookCameraFile,
    remote_file: str,
) -> tuple[StripFiles, list[Entry]]:
    """The images of a strip whose headers are valid, and omissions for the others."""
    paths: dict[int, Path] = {}
    names: dict[int, str] = {}
    shapes: dict[int, tuple[int, int]] = {}
    omitted = []
    for where, row, _ in members:
        if not row.file:
            continue
        image = path_inside(root, row.file, file=file, field=f"{where}, file")
        if remote.bit_depth is None:
            raise RawDataError(remote_file, "bit_depth", "nothing", f"this key, for the image {row.file}")
        lines, samples = shape = row.lines, remote.ccds[row.ccd].n_px
        try:
            check_strip_file(image, row.file, lines=lines, samples=samples, bit_depth=remote.bit_depth)
        except RawDataError as error:
            subject = Subject(Kind.CCD, strip=row.id, ccd=row.ccd)
            omitted.append(Entry(subject, Reason.UNREADABLE, str(error), row.file))
            continue
        paths[row.ccd], names[row.ccd], shapes[row.ccd] = image, row.file, shape
    return StripFiles(paths, names, shapes), omitted


def _target_rows(path: Path, file: str) -> list[schema.TargetRow]:
    rows = read_table(path, schema.TargetRow, file)
    if not rows:
        raise RawDataError(file, "rows", "none", "at least one target")
    each_once([row.id for row in rows], file)
    return rows


def _points(
    path: Path | None, head: schema.DumpFile, strips: Sequence[Strip]
) -> tuple[tuple[StripPoints, ...], tuple[SurveyedPoints, ...]]:
    """Measured image points of the strips, and the same points as places on the ground."""
    if path is None:
        return (), ()
    points, surveyed = read_points(path, str(head.files.points))
    known = {strip.strip_id: strip for strip in strips}
    for one in points:
        if one.strip_id not in known:
            raise RawDataError(str(head.files.points), "strip", one.strip_id, "a strip of the dump")
        if unknown := sorted(set(one.ccd.tolist()) - set(known[one.strip_id].ccd_lines)):
            raise RawDataError(str(head.files.points), "ccd", unknown[0], f"a CCD of strip {one.strip_id}")
    return points, (surveyed,)


def _points_of(points: Sequence[StripPoints], strips: Sequence[Strip]) -> tuple[StripPoints, ...]:
    """The points in CCDs of strips that are used."""
    ccds = {strip.strip_id: list(strip.ccd_lines) for strip in strips}
    return tuple(one.of(ccds[one.strip_id]) for one in points if one.strip_id in ccds)


def _chips(root: Path, rows: Sequence[schema.TargetRow], file: str) -> tuple[ChipFile, ...]:
    return tuple(
        ChipFile(row.id, row.chip, path_inside(root, row.chip, file=file, field=f"line {n + 2}, chip"))
        for n, row in enumerate(rows)
    )


def _terrain(
    root: Path, head: schema.DumpFile, known: Sequence[SurveyedPoints]
) -> TerrainFiles | TargetHeights:
    if head.files.terrain is None or head.terrain is None:
        lat, lon, heights = (np.concatenate([getattr(one, name) for one in known]) for name in PLACE)
        return TargetHeights(unit_vectors(lon, lat), heights)
    names = tuple(head.files.terrain)
    paths = tuple(path_inside(root, name, file="dump.toml", field="files.terrain") for name in names)
    terrain = TerrainFiles(names, paths, head.terrain.height_kind)
    surface_of(terrain)  # an invalid file is reported before hours of work
    return terrain


def _star_catalogue(path: Path | None, head: schema.DumpFile, sky: Sequence[Strip]) -> StarTable | None:
    if path is None:
        return None
    table = StarTable(str(head.files.star_catalogue), path)
    if sky:
        survey_of(table)  # an invalid file is reported before hours of work
    return table


def surface_of(terrain: TerrainFiles | TargetHeights) -> Surface:
    """The surface of the Earth. A terrain file is read once in each process, as long as it stays the same."""
    if isinstance(terrain, TargetHeights):
        return terrain
    return _read_terrain(terrain, tuple(map(identity_of, terrain.paths)))


@lru_cache(maxsize=1)
def _read_terrain(terrain: TerrainFiles, identities: tuple[Identity, ...]) -> TerrainGrid | TerrainTiles:
    rasters, left = [], MAX_TERRAIN_PIXELS
    for file, path in zip(terrain.files, terrain.paths):
        grid = read_grid(path, file, max_pixels=left)
        rasters.append(Raster(grid.values, grid.transform, grid.crs))
        left -= grid.values.size
    geoid = egm96() if terrain.height_kind == "egm96" else None
    try:
        grids = tuple(
            TerrainGrid.from_raster(one.heights_m, one.transform, one.crs, geoid)
            for one in joined(rasters, MAX_TERRAIN_PIXELS)
        )
    except ValueError as error:
        raise RawDataError(", ".join(terrain.files), "heights", str(error), "a grid of heights") from error
    return grids[0] if len(grids) == 1 else TerrainTiles(grids)
