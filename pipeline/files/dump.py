"""Open a dump: read and check every text file; build cameras, orbit, Earth rotation and terrain.

Images are not decoded here; one whose header cannot be used becomes an `Entry`. Nothing under `truth/` is
opened. The records hold arrays and paths, so that parts of them can be sent to worker processes.
"""

from __future__ import annotations

import html
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.gct_match.records import Target
from boresight.geometry.earth_orientation import EarthOrientationTable
from boresight.geometry.epoch import Epoch
from boresight.geometry.groundlight import LightEffects
from boresight.geometry.line_camera import LineCamera, LookAngleCamera
from boresight.geometry.orbit import Orbit
from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.errors import RawDataError, printable
from boresight.pipeline.files import dump_schema as schema
from boresight.pipeline.files.dump_parts import DumpParts
from boresight.pipeline.files.ground_points import ChipFile, StripPoints
from boresight.pipeline.files.object_store import dump_folder
from boresight.pipeline.files.star_side import Exposure, Head, SolvedAttitudes, StarImages
from boresight.pipeline.files.star_tables import StarTable
from boresight.pipeline.files.strip_table import Strip
from boresight.pipeline.files.terrain_files import TargetHeights, TerrainFiles
from boresight.records.ledger import Entry, Kind, Reason, Subject
from boresight.records.record import Floats, record, scalar, value_text

__all__ = ["Dump", "dump_or_faults", "open_cameras", "open_dump"]

MOST_NAMED = 8  # strips, and items not used, in the text of a dump


@record(kw_only=True)
class Dump:
    """All inputs of `calibrate`. Units are SI, times are TAI seconds since `epoch`."""

    root: Path = scalar("folder of the dump")
    mission: str = scalar("name of the mission")
    satellite: str = scalar("name of the satellite; may be empty")
    epoch: Epoch = scalar("zero of all times")
    heads: tuple[Head, ...] = scalar("star cameras; the first is the reference head, of frame s")
    camera: str = scalar("name of the remote-sensing camera, of several; empty: the only one", default="")
    line_camera: LineCamera | LookAngleCamera = scalar("camera of frame c")
    remote_bit_depth: int = scalar("bits of a count of the strips; 0 where no strip has an image")
    errors: schema.Errors = scalar("errors of the mission's data as it states them")
    light: LightEffects = scalar("effects on light that the mission's own software models")
    orbit: Orbit = scalar("trajectory of the satellite")
    orbit_time_system: str = scalar('of the dates in its file, as stated: "UTC"')
    earth_table: EarthOrientationTable = scalar("Earth orientation of that orbit")
    earth_file: str = scalar("the mission's own file of it; empty: the bundled table")
    strips: tuple[Strip, ...] = scalar("of the ground, in order of time")
    sky_strips: tuple[Strip, ...] = scalar("of the sky, in order of time")
    targets: tuple[Target, ...] = scalar("in the order of targets.csv")
    chips: tuple[ChipFile, ...] = scalar("of the same targets")
    points: tuple[StripPoints, ...] = scalar("measured image points, one record a strip")
    terrain: TerrainFiles | TargetHeights = scalar("the surface of the Earth")
    star_catalogue: StarTable | None = scalar("stars of strips of the sky; None: the bundled Hipparcos")
    orbit_covers: str = scalar('what the orbit covers, for messages: "orbit.oem covers 2024-11-20T03 ..."')
    omissions: tuple[Entry, ...] = scalar("images that are not used, with the reasons")
    listed: dict[str, int] = scalar("targets, points, strips, reference head's exposures in its tables")

    def __repr__(self) -> str:
        named = ", ".join(strip.strip_id for strip in (*self.strips, *self.sky_strips)[:MOST_NAMED])
        more = ", ..." if len(self.strips) + len(self.sky_strips) > MOST_NAMED else ""
        satellite = f" ({self.satellite})" if self.satellite else ""
        measured = sum(len(points.ccd) for points in self.points)
        points = f", {measured} measured points" if self.points else ""
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

    def of_strips(self, wanted: Sequence[str]) -> Dump:
        """The dump with these strips only, others in its omissions; `ValueError`: unknown ones or none."""
        names = [strip.strip_id for strip in (*self.strips, *self.sky_strips)]
        if not wanted or (unknown := set(wanted) - set(names)):
            found = "no ids" if not wanted else repr(min(unknown))
            raise ValueError(f"strips: found {found}, expected ids among {', '.join(names)}")
        left_out = tuple(
            Entry(Subject(Kind.STRIP, strip=name), Reason.NOT_ASKED_FOR, "not among the strips asked for")
            for name in names
            if name not in wanted
        )
        return replace(
            self,
            strips=tuple(strip for strip in self.strips if strip.strip_id in wanted),
            sky_strips=tuple(strip for strip in self.sky_strips if strip.strip_id in wanted),
            points=tuple(points for points in self.points if points.strip_id in wanted),
            omissions=(*self.omissions, *left_out),
        )

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
    camera: str | None = None,
    allow_stale_eop: bool = False,
    sky_alone: bool = False,
) -> Dump:
    """A dump read and checked: cameras, orbit, exposures, strips, targets; images are not decoded.

    Parameters
    ----------
    root : path, str or Dump
        Folder with a dump.toml (docs/dump-format.md), or its address in a store (`s3://bucket/dump`); an open
        dump is returned as it is.
    camera : str, optional
        Which of several remote-sensing cameras: its strips, matrix and model; needed where there are several.
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
    views = open_cameras(root, allow_stale_eop=allow_stale_eop, sky_alone=sky_alone)
    names = [one.camera for one in views]
    if camera is None and (sky_alone or len(views) == 1):
        return views[0]
    if camera not in names:
        expected = f"one of {', '.join(names)}" if names[0] else "none: the dump has one camera"
        raise RawDataError("dump.toml", "camera", camera or f"{len(names)} cameras", expected)
    return views[names.index(camera)]


def open_cameras(
    root: str | os.PathLike[str] | Dump, *, allow_stale_eop: bool = False, sky_alone: bool = False
) -> tuple[Dump, ...]:
    """A dump as each of its remote-sensing cameras sees it, as `open_dump` reads and checks it: that camera's
    model, strips and matrices, and the star cameras that all share. Cameras without a strip are left out.
    """
    if isinstance(root, Dump):
        return (root,)
    return _views(DumpParts(_existing(root), allow_stale_eop=allow_stale_eop, sky_alone=sky_alone))


def dump_or_faults(root: Path) -> tuple[Dump, ...] | tuple[RawDataError, ...]:
    """A dump as `open_cameras` gives it, or all that is wrong in its text files, each checked by itself."""
    parts = DumpParts(root)
    every = {str(fault): fault for first in parts.faults() for fault in (first, *first.others)}
    return tuple(every.values()) or _views(parts)


def _views(parts: DumpParts) -> tuple[Dump, ...]:
    """The dump of its parts, by camera; what is wrong in the first one that is wrong."""
    for fault in parts.faults():
        raise fault
    seen = {strip.camera for strip in parts.listed_strips[0]} or set(parts.remote_cameras)
    return tuple(_view(parts, name) for name in parts.remote_cameras if name in seen)


# Fields of a dump that are those of its parts, whichever camera sees it.
OF_PARTS = "root epoch orbit earth_table terrain star_catalogue orbit_covers".split()


def _view(parts: DumpParts, camera: str) -> Dump:
    """The dump as one camera sees it."""
    head, (line_camera, remote) = parts.head, parts.remote_cameras[camera]
    every_strip, unreadable = parts.listed_strips
    others = {strip.strip_id for strip in every_strip if strip.camera != camera}
    strips, sky_strips = (tuple(s for s in part if s.camera == camera) for part in parts.strips[:2])
    strips_twice = parts.strips[2]
    heads, exposures_twice = parts.heads
    heads = _mounted(heads, parts.installations.get(camera))
    surveyed, chips = parts.targets
    points, points_twice = parts.points
    points = tuple(measured for measured in points if measured.strip_id not in others)
    of_images = not isinstance(heads[0].source, SolvedAttitudes)
    return Dump(
        **{name: getattr(parts, name) for name in OF_PARTS},
        mission=head.mission,
        satellite=head.satellite,
        heads=heads,
        camera=camera,
        line_camera=line_camera,
        remote_bit_depth=remote.bit_depth or 0,
        errors=head.errors,
        light=LightEffects(**head.light.model_dump()),
        orbit_time_system=parts.ephemeris[0].time_system,
        earth_file=head.files.earth_orientation or "",
        strips=strips,
        sky_strips=sky_strips,
        targets=surveyed.targets,
        chips=chips,
        points=points,
        omissions=(
            *(entry for entry in (*unreadable, *strips_twice) if entry.subject.strip not in others),
            *exposures_twice,
            *(entry for entry in points_twice if entry.subject.strip not in others),
        ),
        listed={
            "targets": len(surveyed.targets),
            "points": sum(len(m.ccd) for m in parts.listed_points[0] if m.strip_id not in others),
            "strips": len(every_strip) - len(others) + sum(e.subject.kind is Kind.STRIP for e in unreadable),
            "exposures": len(parts.listed_heads[0].t_s) if of_images else 0,
        },
    )


def _mounted(heads: tuple[Head, ...], own: schema.InstallationFile | None) -> tuple[Head, ...]:
    """The heads with matrices to a camera in which the matrix of the reference head is its `own`."""
    if own is None:
        return heads
    turn = Rotation.from_quat(own.quaternion_cs) * heads[0].R_cs0.inv()
    first = replace(heads[0], sigma_installation_rad=np.array(own.sigma_rad))
    return tuple(replace(one, R_cs0=turn * one.R_cs0) for one in (first, *heads[1:]))


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
