"""The strips of a dump: strips.csv, and the headers of the images that it names. No image is decoded here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from boresight.geometry.epoch import Epoch
from boresight.geometry.pushbroom import RowClock
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files import dump_schema as schema
from boresight.pipeline.files.dates import seconds_of
from boresight.pipeline.files.images.tiff import StripFiles, check_strip_file
from boresight.pipeline.files.text_files import each_once, path_inside, read_table
from boresight.records.ledger import Entry, Kind, Reason, Subject
from boresight.records.record import record, scalar

__all__ = ["Strip", "check_what_strips_show", "read_strips"]

StripMember = tuple[str, schema.StripRow, float]  # where in the table, row, its time in TAI seconds


@record(kw_only=True)
class Strip:
    """One strip of strips.csv, with the CCDs whose files have a valid header."""

    strip_id: str = scalar("id of the table")
    images: StripFiles = scalar("image files by CCD")
    t_first_row_s: float = scalar("label of row 0 (see `time_of_row`), TAI seconds since the epoch")
    row_period_s: float = scalar("s")
    lines: int = scalar("number of rows, from the first of any CCD to the last")
    first_row: dict[int, float] = scalar("row of the strip at which line 0 of a CCD's image lies, by CCD")
    ccd_lines: dict[int, int] = scalar("number of lines of each CCD of the table")
    kind: str = scalar("what the camera looks at: ground or sky", default="ground")
    camera: str = scalar("remote-sensing camera, of several; empty: the only one", default="")

    @property
    def subject(self) -> Subject:
        """The strip as a subject."""
        return Subject(Kind.STRIP, strip=self.strip_id)

    @property
    def item(self) -> Entry:
        """Kind and id of what is processed, without a reason."""
        return Entry(self.subject)

    def ccd_subject(self, ccd: int) -> Subject:
        """One CCD of it as a subject."""
        return Subject(Kind.CCD, strip=self.strip_id, ccd=ccd)

    @property
    def clock(self) -> RowClock:
        """Time labels of the rows, and the row at which each CCD begins."""
        first_row = self.first_row if any(self.first_row.values()) else {}
        return RowClock(self.t_first_row_s, self.row_period_s, first_row)


def read_strips(
    root: Path,
    path: Path,
    file: str,
    epoch: Epoch,
    cameras: Mapping[str, tuple[schema.RemoteCameraFile | schema.LookCameraFile, str]],
) -> tuple[tuple[Strip, ...], tuple[Entry, ...]]:
    """The strips of strips.csv in order of time, and entries for images and strips that cannot be used.
    `cameras` is what the file of each remote-sensing camera says, with its name.

    `RawDataError` for a table that is not valid, or whose CCDs of one strip contradict one another.
    """
    rows = read_table(path, schema.StripRow, file, "at least one strip")
    each_once([f"{row.id}, ccd {row.ccd}" for row in rows], file)
    t_s = seconds_of(epoch, [row.utc_first_row for row in rows], file, "utc_first_row")
    of_strip: dict[str, list[StripMember]] = {}
    for n, (row, t) in enumerate(zip(rows, t_s)):
        where = f"line {n + 2}"
        if row.camera not in cameras:
            expected = f"one of [[cameras]]: {', '.join(cameras)}" if "" not in cameras else "nothing"
            raise RawDataError(file, f"{where}, camera", row.camera or "nothing", expected)
        remote, _ = cameras[row.camera]
        if row.ccd >= len(remote.ccds):
            raise RawDataError(file, f"{where}, ccd", str(row.ccd), f"0 to {len(remote.ccds) - 1}")
        of_strip.setdefault(row.id, []).append((where, row, float(t)))
    strips: list[Strip] = []
    omitted: list[Entry] = []
    for strip_id, members in of_strip.items():
        _check_alike(members, file)
        images, of_images = _strip_images(root, members, file, *cameras[members[0][1].camera])
        omitted += of_images
        if not images.paths and all(row.file for _, row, _ in members):
            name = members[0][1].file
            unread = "none of its images can be read"
            omitted.append(Entry(Subject(Kind.STRIP, strip=strip_id), Reason.UNREADABLE, unread, name))
            continue
        strips.append(_strip(strip_id, images, members))
    return tuple(sorted(strips, key=lambda strip: (strip.t_first_row_s, strip.strip_id))), tuple(omitted)


def check_what_strips_show(ground: Sequence[Strip], sky: Sequence[Strip], head: schema.DumpFile) -> None:
    """`RawDataError` for a strip without an image and without points, and for ground without any targets."""
    files = head.files
    if ground and files.targets is None and files.points is None:
        expected = "files.targets (chips) or files.points (measured image points), "
        expected += "for its strips of the ground"
        raise RawDataError("dump.toml", "files.targets", "nothing", expected)
    bare = [strip.strip_id for strip in ground if not strip.images.names] if files.points is None else []
    if bare := bare + [strip.strip_id for strip in sky if not strip.images.names]:
        found = f"no image of strip {bare[0]}"
        raise RawDataError(files.strips, "file", found, "an image, or files.points in dump.toml")


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
        camera=members[0][1].camera,
    )


def _check_alike(members: list[StripMember], file: str) -> None:
    """Refuse CCDs of a strip whose rows differ in period, or in a strip of the sky in begin and number."""
    _, reference, _ = members[0]
    together = reference.kind == "sky"  # its stars are identified in all CCDs by one motion over the rows
    for where, row, _ in members:
        same = ("kind", "camera", "row_period_s", *(("utc_first_row", "lines") if together else ()))
        for key in same:
            if (got := getattr(row, key)) != (expected := getattr(reference, key)):
                alike = f"{expected}, as for CCD {reference.ccd}"
                raise RawDataError(file, f"{where}, {key}", str(got), alike)


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
