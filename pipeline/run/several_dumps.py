"""Several dumps of one mission, or the cameras of one dump, each with a name: opened, in the order of time,
and checked to be of one satellite, no image among them twice.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump, open_cameras
from boresight.pipeline.files.dump_schema import DumpFile
from boresight.pipeline.files.repeats import same_exposure
from boresight.pipeline.files.star_side import Exposure, SolvedAttitudes, StarImages
from boresight.pipeline.files.text_files import read_toml
from boresight.pipeline.run.settings import Settings, calibration_settings
from boresight.records.record import record, scalar

__all__ = ["NamedDump", "dump_names", "named_cameras", "open_dumps"]

# Difference up to which numbers of two dumps are the same, of the largest number of their array, and in SI
# units: files with ten digits, and conversions of units, round. Of a look direction it is 2e-4 arcsec.
ROUNDING, SMALLEST = 5e-10, 1e-15
OF_RESULTS = ("sightings", "evidence", "work", "exports")  # folders of a result: names that no dump gets


@record
class NamedDump:
    """A dump with a name."""

    name: str = scalar("of its result's folder, and prefix of its strips' ids")
    dump: Dump = scalar("the open dump, as one of its cameras sees it")


def open_dumps(
    folders: Sequence[Path], settings: Settings, *, allow_stale_eop: bool = False
) -> tuple[NamedDump, ...]:
    """The dumps in the order of time. `RawDataError` for one that is given twice, as a copy or in parts too,
    and for one that is not of the cameras, pre-launch matrix and stated errors of the first.
    """
    roots = [folder.resolve() for folder in folders]
    if len(roots) == 1:
        return tuple(named_cameras(open_cameras(roots[0], allow_stale_eop=allow_stale_eop)))
    if twice := [root for root, n in Counter(roots).items() if n > 1]:
        raise RawDataError(str(twice[0]), "DUMP", "named twice", "each dump once")
    names = dump_names(roots)
    dumps = [
        named
        for name, root in zip(names, roots)
        for named in named_cameras(open_cameras(root, allow_stale_eop=allow_stale_eop), name)
    ]
    dumps.sort(key=lambda one: (min((sensor[1] for sensor, *_ in _images(one)), default=0), one.name))
    first = {named.dump.camera: named for named in reversed(dumps)}
    for other in dumps[1:]:
        _check_one_mission(dumps[0], first[other.dump.camera], other, settings)
    _check_nothing_twice(dumps)
    return tuple(dumps)


def named_cameras(views: Sequence[Dump], name: str = "") -> list[NamedDump]:
    """A dump as its cameras see it, each named behind `name`; `RawDataError` for names of result folders."""
    if any(view.camera in OF_RESULTS for view in views):
        raise RawDataError("dump.toml", "cameras.id", "a name of a result's folders", "another name")
    return [NamedDump("-".join(filter(None, (name, view.camera))), view) for view in views]


def dump_names(roots: Sequence[Path]) -> list[str]:
    """Unique names of the folders, with as many parent folders as needed; `RawDataError` for equal ones."""
    depth = [1] * len(roots)
    while True:
        names = ["-".join(root.parts[1:][-d:]) or "dump" for root, d in zip(roots, depth)]
        count = Counter(name.casefold() for name in names)
        unclear = [n for n, name in enumerate(names) if count[name.casefold()] > 1 or name in OF_RESULTS]
        if not unclear:
            return names
        if all(depth[n] >= len(roots[n].parts) for n in unclear):
            raise RawDataError(str(roots[unclear[0]]), "DUMP", names[unclear[0]], "a name of its own")
        for n in unclear:
            depth[n] += 1


Image = tuple[tuple[str, int], str, tuple[StarImages, Exposure] | None]  # sensor and TAI ns; name; exposure


def _images(named: NamedDump) -> Iterator[Image]:
    """Each image of a CCD and of a star camera, by what took it and when."""
    dump, epoch_ns = named.dump, named.dump.epoch.tai_s * 10**9
    for strip in dump.strips:
        for ccd in strip.ccd_lines:
            sensor = f"CCD {ccd} {strip.camera}", epoch_ns + round(strip.t_first_row_s * 1e9)
            yield sensor, f"strip {strip.strip_id}", None
    for head in dump.heads:
        if not isinstance(images := head.source, StarImages):
            continue
        for one in images.exposures:
            sensor = head.name, epoch_ns + round(one.t_s * 1e9)
            yield sensor, f"exposure {one.exposure_id}", (images, one)


def _check_nothing_twice(dumps: Sequence[NamedDump]) -> None:
    """`RawDataError` where two dumps hold the image of one CCD, or other images of one exposure: a sensor
    takes one image at a time. An exposure that two dumps hold is counted once.
    """
    seen: dict[tuple[str, int], tuple[NamedDump, str, tuple[StarImages, Exposure] | None]] = {}
    for named in dumps:
        for sensor, name, own in _images(named):
            other, its_name, its = seen.setdefault(sensor, (named, name, own))
            if other.dump.root == named.dump.root or (own and its and same_exposure(own[0], own[1], its[1])):
                continue
            found = f"the same instant as {its_name} of {other.dump.root}"
            raise RawDataError(str(named.dump.root), name, found, "each image in one dump only")


def _check_one_mission(mission: NamedDump, first: NamedDump, other: NamedDump, settings: Settings) -> None:
    """`RawDataError` where star cameras are not the mission's, or the remote camera not the `first` one's."""
    head = read_toml(other.dump.root / "dump.toml", DumpFile, "dump.toml")
    files, a, b = head.files, first.dump, other.dump
    of_a, of_b = (calibration_settings(settings, dump.errors, dump.line_camera) for dump in (a, b))
    compared: tuple[tuple[str, str, Any, Any, str], ...] = (
        ("dump.toml", "mission", mission.dump.mission, b.mission, ""),
        (files.star_camera or "dump.toml", "star camera", mission.dump.star_camera, b.star_camera, ""),
        ("dump.toml", "star cameras", _of_heads(a), _of_heads(b), ""),
        (head.remote_cameras[b.camera], "remote camera", a.line_camera, b.line_camera, ""),
        (files.installation or "dump.toml", "pre-launch installation matrix", a.R_cs0, b.R_cs0, ""),
        ("dump.toml", "ground_references", *_of_references(mission.dump, b), ""),
        ("dump.toml", "errors", of_a, of_b, "; [calibration] in a file of --settings states them for all"),
    )
    for file, what, mine, theirs, hint in compared:
        if (difference := _first_difference(mine, theirs, what)) is not None:
            field, expected, found = difference
            raise RawDataError(str(b.root / file), field, found, f"{expected}, as in {a.root}{hint}")


def _of_heads(dump: Dump) -> tuple[tuple[Any, ...], ...]:
    """What is the mission's of its heads; the reference head's matrix is compared by itself."""
    cameras = [None if isinstance(h.source, SolvedAttitudes) else h.source.camera for h in dump.heads]
    matrices = [dump.heads[0].name, *(head.R_cs0 for head in dump.heads[1:])]
    return tuple((h.name, h.noise, *both) for h, *both in zip(dump.heads, cameras, matrices))


def _of_references(a: Dump, b: Dump) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """The ground references that the points of both dumps name."""
    of_a, of_b = (
        {of.name: of for target in dump.ground_targets.values() if (of := target.reference)}
        for dump in (a, b)
    )
    both = sorted(of_a.keys() & of_b.keys())
    return tuple(of_a[name] for name in both), tuple(of_b[name] for name in both)


def _first_difference(a: Any, b: Any, path: str) -> tuple[str, Any, Any] | None:
    """Where two records differ first: path of fields, and both values."""
    if is_dataclass(a) and type(a) is type(b):
        parts = [(f".{f.name}", getattr(a, f.name), getattr(b, f.name)) for f in fields(a) if f.init]
    elif isinstance(a, tuple) and isinstance(b, tuple) and len(a) == len(b):
        parts = [(f".{n}", *both) for n, both in enumerate(zip(a, b))]
    elif isinstance(a, Rotation):
        return _first_difference(a.as_matrix(), b.as_matrix(), path)
    else:
        return None if _is_same(a, b) else (path, a, b)
    return next((d for name, x, y in parts if (d := _first_difference(x, y, path + name)) is not None), None)


def _is_same(a: Any, b: Any) -> bool:
    """Whether two values are equal, numbers but for the rounding of conversions."""
    numbers = isinstance(a, np.ndarray | float) and isinstance(b, np.ndarray | float)
    if not numbers or np.shape(a) != np.shape(b):
        return not isinstance(a, np.ndarray) and not isinstance(b, np.ndarray) and bool(a == b)
    if {np.asarray(one).dtype.kind for one in (a, b)} == {"f"}:
        largest = np.nanmax(np.abs(a), initial=SMALLEST / ROUNDING, where=np.isfinite(a))
        return bool(np.allclose(a, b, rtol=0.0, atol=ROUNDING * largest, equal_nan=True))
    return bool(np.array_equal(a, b))
