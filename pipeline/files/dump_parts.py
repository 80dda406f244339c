"""The parts of a dump, each read from its files and checked against the others, in one order.

Whoever opens a dump stops at the first part that is wrong; whoever checks one goes on to the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path

import numpy as np

from boresight.gct_match.records import GroundReference
from boresight.geometry.earth_orientation import EarthOrientationTable
from boresight.geometry.epoch import Epoch
from boresight.geometry.geodesy import unit_vectors
from boresight.geometry.orbit import Orbit
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files import dump_schema as schema
from boresight.pipeline.files import ground_points, terrain_files
from boresight.pipeline.files.content import check_bytes
from boresight.pipeline.files.dates import Span, check_exposure_dates, check_orbit_dates, orbit_covers
from boresight.pipeline.files.orbit_and_earth import (
    bundled_table,
    orbit_of,
    read_earth_orientation,
    read_orbit,
    segment_over,
)
from boresight.pipeline.files.orbit_file import Ephemeris
from boresight.pipeline.files.remote_camera import RemoteCamera, read_remote_camera
from boresight.pipeline.files.repeats import heads_once, points_once, strips_once
from boresight.pipeline.files.spice_kernels import NO_KERNELS, Kernels
from boresight.pipeline.files.star_side import Head, SolvedAttitudes, check_attitudes, open_heads
from boresight.pipeline.files.star_tables import StarTable, survey_of
from boresight.pipeline.files.strip_table import Strip, check_what_strips_show, read_strips
from boresight.pipeline.files.text_files import path_inside, read_toml
from boresight.records.ledger import Entry
from boresight.records.record import Floats

__all__ = ["DumpParts"]

OUTSIDE_LINES = (
    10.0  # by which a measured point may lie outside its image: no error of a measurement is as large
)


class DumpParts:
    """The parts of the dump in a folder; a part that is wrong raises `RawDataError`.

    They stand in the order in which they are read. Epoch and strips without which others cannot be read have
    a substitute where their own file is wrong, so that the others are read nevertheless.
    """

    def __init__(self, root: Path, *, allow_stale_eop: bool = False, sky_alone: bool = False) -> None:
        self.root, self.allow_stale_eop, self.sky_alone = root, allow_stale_eop, sky_alone

    def faults(self) -> Iterator[RawDataError]:
        """What is wrong in each part, in their order; one that needs a wrong one has that one's fault."""
        for name in (name for name, member in vars(DumpParts).items() if isinstance(member, cached_property)):
            try:
                getattr(self, name)
            except RawDataError as error:
                yield error

    @cached_property
    def head(self) -> schema.DumpFile:
        """What dump.toml says."""
        return read_toml(self.root / "dump.toml", schema.DumpFile, "dump.toml")

    @cached_property
    def remote_cameras(self) -> dict[str, RemoteCamera]:
        """The remote-sensing cameras by name, and what their files say; the only one has no name."""
        return {
            name: read_remote_camera(
                self.root, self._inside(file, "cameras" if name else "files.remote_camera"), file
            )
            for name, file in self.head.remote_cameras.items()
        }

    @cached_property
    def installations(self) -> dict[str, schema.InstallationFile]:
        """Installation matrices of the reference head in cameras that have files of their own."""
        stated = {one.id: one.installation for one in self.head.cameras if one.installation is not None}
        kind = schema.InstallationFile
        return {name: read_toml(self._inside(file, "cameras"), kind, file) for name, file in stated.items()}

    @cached_property
    def kernels(self) -> Kernels:
        """The SPICE kernels that a dump names beside those of attitudes and orbit."""
        spice = self.head.spice
        if spice is None:
            return NO_KERNELS
        paths = tuple(self._inside(name, f"spice.kernels.{n}") for n, name in enumerate(spice.kernels))
        return Kernels(files=tuple(spice.kernels), paths=paths, spacecraft=spice.spacecraft)

    @cached_property
    def segments(self) -> tuple[Ephemeris, ...]:
        """The orbit, as its file has it."""
        return read_orbit(self._path("orbit"), self.head.files.orbit, self.kernels)

    @cached_property
    def earth_table(self) -> EarthOrientationTable:
        """Earth orientation of that orbit."""
        own = self.head.files.earth_orientation
        if own is None:
            return bundled_table()
        return read_earth_orientation(self._path("earth_orientation"), own)

    @cached_property
    def listed_strips(self) -> tuple[tuple[Strip, ...], tuple[Entry, ...]]:
        """All strips in order of time, and images that are not used."""
        file, names = self.head.files.strips, self.head.remote_cameras
        cameras = {name: (remote, names[name]) for name, (_, remote) in self.remote_cameras.items()}
        return read_strips(self.root, self._path("strips"), file, self.epoch, cameras)

    @cached_property
    def ephemeris(self) -> tuple[Ephemeris, str]:
        """The part of the orbit that covers the strips; its name in errors."""
        return segment_over(self.segments, self.spans, self.head.files.orbit)

    @cached_property
    def orbit(self) -> Orbit:
        """The trajectory of the satellite."""
        ephemeris, file = self.ephemeris
        return orbit_of(ephemeris, file, self.earth_table, allow_stale_eop=self.allow_stale_eop)

    @cached_property
    def strips(self) -> tuple[tuple[Strip, ...], tuple[Strip, ...], tuple[Entry, ...]]:
        """Strips of the ground, those of the sky, and what is given twice."""
        every, file = self.listed_strips[0], self.head.files.strips
        ground, sky = (tuple(strip for strip in every if strip.kind == kind) for kind in ("ground", "sky"))
        if not self.sky_alone:
            check_what_strips_show(ground, sky, self.head)
        (ground, of_ground), (sky, of_sky) = strips_once(ground, file), strips_once(sky, file)
        return ground, sky, (*of_ground, *of_sky)

    @cached_property
    def targets(self) -> tuple[ground_points.SurveyedPoints, tuple[ground_points.ChipFile, ...]]:
        """The targets, and the files of their chips."""
        if self._is_without("targets"):
            return ground_points.NO_TARGETS, ()
        file = str(self.head.files.targets)
        return ground_points.read_targets(self.root, self._path("targets"), file, self.ground_references)

    @cached_property
    def listed_heads(self) -> tuple[Head, ...]:
        """The star cameras with all that their tables list."""
        return open_heads(self.root, self.head, self.epoch, self.earth_table, self.kernels)

    @cached_property
    def heads(self) -> tuple[tuple[Head, ...], list[Entry]]:
        """The star cameras, the reference head first, and what is given twice."""
        return heads_once(self.listed_heads)

    @cached_property
    def orbit_covers(self) -> str:
        """What the orbit covers, for messages; an error if it, or all exposures, miss the times of strips."""
        ephemeris, file = self.ephemeris
        epoch, t_s = ephemeris.epoch, ephemeris.t_s
        covers = orbit_covers(epoch, t_s, ephemeris.time_system, file, self.spans)
        check_orbit_dates(covers, epoch, t_s, file, self.spans)
        check_exposure_dates(epoch, *self._exposed(), self.spans)
        return covers

    @cached_property
    def attitudes(self) -> None:
        """Nothing; an error if attitudes contradict the orbit."""
        check_attitudes(self.heads[0], self.orbit, self.ephemeris[1], _spans(self.strips[0]))

    @cached_property
    def listed_points(
        self,
    ) -> tuple[tuple[ground_points.StripPoints, ...], tuple[ground_points.SurveyedPoints, ...]]:
        """Measured image points, one record a strip of the ground, and the same points on the ground.

        `RawDataError` for points in a strip, a CCD or lines that the dump has not.
        """
        if self._is_without("points"):
            return (), ()
        file = str(self.head.files.points)
        points, surveyed = ground_points.read_points(self._path("points"), file, self.ground_references)
        known = {strip.strip_id: strip for strip in self.listed_strips[0] if strip.kind == "ground"}
        for measured in points:
            if measured.strip_id not in known:
                raise RawDataError(file, "strip", measured.strip_id, "a strip of the dump")
            ccds = known[measured.strip_id].ccd_lines
            if unknown := sorted(set(measured.ccd.tolist()) - set(ccds)):
                raise RawDataError(file, "ccd", unknown[0], f"a CCD of strip {measured.strip_id}")
            line, lines = measured.xy_px[:, 1], np.array([ccds[ccd] for ccd in measured.ccd.tolist()])
            for n in np.flatnonzero((line < -OUTSIDE_LINES) | (line > lines + OUTSIDE_LINES))[:1].tolist():
                item = f"line of {measured.targets[n].target_id}, strip {measured.strip_id}"
                raise RawDataError(file, item, f"{line[n]:g}", f"a line of the strip, 0 to {lines[n] - 1}")
        return points, (surveyed,)

    @cached_property
    def points(self) -> tuple[tuple[ground_points.StripPoints, ...], list[Entry]]:
        """The points in CCDs of strips that are used, and what is given twice."""
        once, twice = points_once(self.listed_points[0], str(self.head.files.points))
        ccds = {strip.strip_id: list(strip.ccd_lines) for strip in self.strips[0]}
        return tuple(points.of(ccds[points.strip_id]) for points in once if points.strip_id in ccds), twice

    @cached_property
    def terrain(self) -> terrain_files.TerrainFiles | terrain_files.TargetHeights:
        """The surface of the Earth."""
        if self.sky_alone:
            return terrain_files.NO_TERRAIN
        stated, names = self.head.terrain, self.head.files.terrain
        if names is None or stated is None:
            known = ground_points.SurveyedPoints.together((self.targets[0], *self.listed_points[1]))
            return terrain_files.TargetHeights(unit_vectors(known.lon_rad, known.lat_rad), known.height_m)
        paths = tuple(self._inside(name, "files.terrain") for name in names)
        terrain = terrain_files.TerrainFiles(tuple(names), paths, stated.height_kind)
        for name, path in zip(terrain.files, terrain.paths):
            check_bytes(path, name, terrain_files.MAX_TERRAIN_BYTES)
        terrain_files.surface_of(terrain)  # an invalid file is reported before hours of work
        return terrain

    @cached_property
    def star_catalogue(self) -> StarTable | None:
        """Stars of strips of the sky; None: the bundled Hipparcos."""
        if (file := self.head.files.star_catalogue) is None:
            return None
        table = StarTable(file, self._path("star_catalogue"))
        if self.strips[1]:
            survey_of(table)  # an invalid file is reported before hours of work
        return table

    @property
    def ground_references(self) -> dict[str, GroundReference]:
        """The mosaics and surveys whose points have an offset in common."""
        found = {}
        for one in self.head.ground_references:
            sigma_m = np.array([one.sigma_east_m, one.sigma_north_m, one.sigma_up_m])
            found[one.id] = GroundReference(one.id, sigma_m, 1e3 * one.correlation_km)
        return found

    @property
    def epoch(self) -> Epoch:
        """Zero of all times, that of the orbit."""
        with suppress(RawDataError):
            return self.segments[0].epoch
        return Epoch.from_utc("2000-01-01T12:00:00Z")

    @property
    def spans(self) -> list[Span]:
        """First and last instant of each listed strip, TAI seconds since the epoch."""
        with suppress(RawDataError):
            return _spans(self.listed_strips[0])
        return []

    def _path(self, key: str) -> Path:
        return self._inside(self.head.files.single[key], f"files.{key}")

    def _inside(self, file: str, field: str) -> Path:
        return path_inside(self.root, file, file="dump.toml", field=field)

    def _is_without(self, key: str) -> bool:
        """Whether the targets, or the points, are not stated or not needed."""
        return self.sky_alone or getattr(self.head.files, key) is None

    def _exposed(self) -> tuple[Floats, str]:
        """Instants of all exposures and attitudes, and the file of the first."""
        heads = self.heads[0]
        first = heads[0].source
        file = first.file if isinstance(first, SolvedAttitudes) else self.head.files.exposures
        return np.concatenate([head.t_s for head in heads]), file or f"exposures of {heads[0].name}"


def _spans(strips: Sequence[Strip]) -> list[Span]:
    """First and last instant of each strip, TAI seconds since the epoch."""
    return [(strip.t_first_row_s, strip.t_first_row_s + strip.lines * strip.row_period_s) for strip in strips]
