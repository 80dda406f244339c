"""Observations that a dump lists twice: images of CCDs, exposures, attitudes, measured points, targets.

The same content of one sensor at one instant is one observation, which is counted once. Other content of one
sensor at one instant, or the same content of another instant or sensor, contradicts the tables: none of these
is used, or the dump cannot be opened. A further kind is a call of `_why` with its key (`near`: which rows are
of one sensor and instant, or of one place) and its comparison (`repeats`, `equal`). Only files of equal size
are read, first in part; strips are compared by windows.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtr

from boresight.gct_match.settings import MatchSettings
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef, local_axes_e
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.attitude_files import AttitudeRows
from boresight.pipeline.files.content import content_digest
from boresight.pipeline.files.ground_points import StripPoints
from boresight.pipeline.files.images.image_file import check_length
from boresight.pipeline.files.images.rasters import grid_place
from boresight.pipeline.files.images.star_images import read_exposure
from boresight.pipeline.files.star_side import Exposure, Head, SolvedAttitudes, StarCentroids, StarImages
from boresight.records.ledger import Entry, Kind, Reason, Subject
from boresight.records.record import Bools, Floats, record, scalar

if TYPE_CHECKING:
    from boresight.pipeline.files.dump import Dump
    from boresight.pipeline.files.strip_table import Strip

__all__ = [
    "common_errors",
    "grouped",
    "heads_once",
    "points_once",
    "same_exposure",
    "strips_once",
    "targets_once",
]

SAMPLE_BYTES = 4096  # at the beginning, in the middle and at the end of a file, compared before all bytes are
WINDOW_PX, WINDOWS = 64, 5  # of two strips that are compared
SAME_GROUND = 0.5  # least correlation of windows of the same ground; of independent ground it stays below
FIRST_TO_LAST = (0.1, 0.9)  # parts of the common time at which windows are compared

Key = TypeVar("Key")


def equal_files(paths: Mapping[Key, Path]) -> list[list[Key]]:
    """Groups of two and more files with the same bytes, by their keys; what cannot be read is in none."""
    of_size = grouped(paths, lambda key: paths[key].stat().st_size)
    alike = [part for group in of_size for part in grouped(group, lambda key: _sample(paths[key]))]
    return [part for group in alike for part in grouped(group, lambda key: content_digest(paths[key]))]


def grouped(keys: Iterable[Key], what: Callable[[Key], object]) -> list[list[Key]]:
    """Groups of two and more keys with the same `what`; those for which it raises `OSError` are in none."""
    groups = defaultdict(list)
    for key in keys:
        with suppress(OSError):
            groups[what(key)].append(key)
    return [group for group in groups.values() if len(group) > 1]


def _sample(path: Path) -> bytes:
    size = path.stat().st_size
    with path.open("rb") as stream:
        parts = []
        for share in (0.0, 0.5, 1.0):
            stream.seek(int(share * max(size - SAMPLE_BYTES, 0)))
            parts.append(stream.read(SAMPLE_BYTES))
    return b"".join(parts)


def same_exposure(images: StarImages, a: Exposure, b: Exposure) -> bool:
    """Whether two exposures have the same pixels; true where one cannot be read, which its reader reports."""
    form = {"width": images.camera.width_px, "height": images.camera.height_px, "bit_depth": images.bit_depth}
    if a.path == b.path or equal_files({"a": a.path, "b": b.path}):
        return True
    with suppress(RawDataError, OSError):
        return np.array_equal(read_exposure(a.path, a.file, **form), read_exposure(b.path, b.file, **form))
    return True


def same_ground(a: Strip, b: Strip, ccd: int, span_s: tuple[float, float]) -> bool:
    """Whether windows of two images of a CCD show the same ground at the same times; true where that is not
    seen.
    """
    if a.images.paths.get(ccd) == b.images.paths.get(ccd):
        return True
    (begin, end), correlations = span_s, list[float]()
    for share in np.linspace(*FIRST_TO_LAST, WINDOWS).tolist():
        with suppress(RawDataError, ValueError, KeyError):
            of_a, of_b = (_window(strip, ccd, begin + share * (end - begin), share) for strip in (a, b))
            if of_a.std() > 0.0 and of_b.std() > 0.0:
                correlations.append(float(np.corrcoef(of_a.ravel(), of_b.ravel())[0, 1]))
    return not correlations or float(np.median(correlations)) >= SAME_GROUND


def has_one_grey_value(strip: Strip, ccd: int, t_s: float) -> bool:
    """Whether the middle of an image, at an instant, has one grey value."""
    try:
        return bool(np.ptp(_window(strip, ccd, t_s, 0.5)) == 0.0)
    except RawDataError:
        return False


def _window(strip: Strip, ccd: int, t_s: float, share: float) -> Floats:
    """Counts around an instant, at a share of the CCD's samples."""
    lines, samples = strip.images.shape(ccd)
    middle = float(strip.clock.lines_of_rows(ccd, strip.clock.row(t_s)))
    top = round(middle) - WINDOW_PX // 2
    top, left = min(max(top, 0), max(lines - WINDOW_PX, 0)), int(share * max(samples - WINDOW_PX, 0))
    below, right = min(top + WINDOW_PX, lines), min(left + WINDOW_PX, samples)
    return strip.images.read(ccd, top, below, left, right).astype(float)


OVERLAP = 0.5  # of the time of the shorter image: from here two images of a sensor are of one instant
SAME_PX = 0.01  # image positions of two measurements, whose noise is larger, are never so near ...
SAME_M = 0.1  # ... at points of the ground that are so near
APART = 10.0  # of these: measurements of different strips or CCDs are never one
SHARED = 0.25  # of a template's pixels: errors of two targets then correlate by as much
CLOSE = 0.1  # of the longer step beside: attitudes closer than this may be one attitude given twice
PROBABILITY_COMMON = 1e-6  # that independent errors agree as well as those of attitudes given twice

Pair = tuple[int, int]


@record
class Image:
    """An image that a sensor takes, one at a time."""

    entry: Entry = scalar("subject and file")
    sensor: tuple[str, int] = scalar("camera and CCD, or head and -1")
    begin_s: float = scalar("TAI seconds since the epoch")
    end_s: float = scalar("likewise")
    content: Path | bytes | None = scalar("its file, or what a file has of it; None: not listed")
    source: Any = scalar("the strip, or what the head delivers")
    exposure: Any = scalar("of a head", default=None)


def _why(
    entries: Sequence[Entry],
    near: Iterable[Pair],
    repeats: Callable[[int, int], str],
    equal: Callable[[list[int]], list[list[int]]] = lambda rows: [],
    *,
    one_at_a_time: bool = False,
) -> dict[int, Entry]:
    """Why rows are not used; of several that are one the first stays.

    `near` are pairs of rows of one sensor at one instant, or of one place. `repeats` says how the second
    repeats the first, nothing where its content differs: a contradiction if sensors observe `one_at_a_time`.
    `equal` groups rows with the same content, of whatever sensor and instant.
    """
    why: dict[int, Entry] = {}
    for first, second in sorted(near, key=lambda pair: pair[::-1]):
        if second in why or (first in why and why[first].reason is Reason.REPEATED):
            continue
        if first not in why and (text := repeats(first, second)):
            why[second] = entries[second].because(Reason.REPEATED, f"{text}: counted once")
        elif one_at_a_time:
            for row, other in ((first, second), (second, first)):
                text = f"{entries[other].subject.words} has the same time, but another image"
                why.setdefault(row, entries[row].because(Reason.SAME_TIME, text))
    for group in equal([row for row in range(len(entries)) if row not in why]):
        for row in group:
            like = entries[group[row == group[0]]]
            text = f"{entries[row].file} has the same content as {like.file} of {like.subject.words}"
            text += ": one of the two rows names a wrong file"
            why[row] = entries[row].because(Reason.SAME_PIXELS, text)
    return dict(sorted(why.items()))


def _why_images(
    images: Sequence[Image], same: Callable[[Image, Image], bool], has_one_grey_value: Callable[[Image], bool]
) -> dict[int, Entry]:
    """Why images are not used: they have the time of another one of their sensor, or its content."""

    def near() -> Iterator[Pair]:
        order = sorted(range(len(images)), key=lambda row: (images[row].sensor, images[row].begin_s))
        for at, row in enumerate(order):
            for other in (order[n] for n in range(at + 1, len(order))):
                a, b = images[row], images[other]
                if a.sensor != b.sensor or b.begin_s >= a.end_s:
                    break
                shorter_s = min(a.end_s - a.begin_s, b.end_s - b.begin_s)
                if min(a.end_s, b.end_s) - b.begin_s > OVERLAP * shorter_s:
                    yield min(row, other), max(row, other)

    def repeats(first: int, second: int) -> str:
        a, b = images[first], images[second]
        text = f"it begins {b.begin_s - a.begin_s:.3g} s after {a.entry.subject.words}, which lasts "
        return f"{text}{a.end_s - a.begin_s:.3g} s, and shows the same" if same(a, b) else ""

    def equal(rows: list[int]) -> list[list[int]]:
        files = {row: path for row in rows if isinstance(path := images[row].content, Path)}
        lists = {row: stars for row in rows if isinstance(stars := images[row].content, bytes)}
        groups = equal_files(files) + grouped(lists, lists.__getitem__)
        return [group for group in groups if not has_one_grey_value(images[group[0]])]

    entries = [image.entry for image in images]
    return _why(entries, near(), repeats, equal, one_at_a_time=True)


def strips_once(strips: Sequence[Strip], file: str) -> tuple[tuple[Strip, ...], list[Entry]]:
    """The strips without images of CCDs that repeat others, and entries for these; of two strips the one with
    more CCDs stays, then the earlier one.

    `RawDataError` for other ground in a CCD of a camera at one time. `file` is the table of the strips.
    """

    def image(strip: Strip, ccd: int) -> Image:
        begin_s = strip.t_first_row_s + strip.first_row[ccd] * strip.row_period_s
        end_s = begin_s + strip.ccd_lines[ccd] * strip.row_period_s
        entry = Entry(strip.ccd_subject(ccd), file=strip.images.names.get(ccd, ""))
        return Image(entry, (strip.camera, ccd), begin_s, end_s, strip.images.paths.get(ccd), strip)

    def same(a: Image, b: Image) -> bool:
        ccd, common_s = a.sensor[1], (max(a.begin_s, b.begin_s), min(a.end_s, b.end_s))
        if not same_ground(a.source, b.source, ccd, common_s):
            found = f"the same time for {a.source.strip_id} and {b.source.strip_id}"
            found += f", whose images of CCD {ccd} differ"
            raise RawDataError(file, "utc_first_row", found, "a time of its own for each strip")
        return True

    def dead(of_ccd: Image) -> bool:
        return has_one_grey_value(of_ccd.source, of_ccd.sensor[1], 0.5 * (of_ccd.begin_s + of_ccd.end_s))

    order = sorted(strips, key=lambda strip: (-len(strip.ccd_lines), strip.t_first_row_s, strip.strip_id))
    images = [image(strip, ccd) for strip in order for ccd in strip.ccd_lines]
    why = {entry.subject: entry for entry in _why_images(images, same, dead).values()}
    kept, entries = [], []
    for strip in strips:
        own = [why[subject] for ccd in strip.ccd_lines if (subject := strip.ccd_subject(ccd)) in why]
        left = {ccd: n for ccd, n in strip.ccd_lines.items() if strip.ccd_subject(ccd) not in why}
        if left:
            kept.append(replace(strip, ccd_lines=left, images=strip.images.of(left)) if own else strip)
        entries += own if left else [replace(own[0], subject=strip.subject)]
    return tuple(kept), entries


def heads_once(heads: Sequence[Head]) -> tuple[tuple[Head, ...], list[Entry]]:
    """The heads without exposures and attitudes that repeat others, without exposures whose files are longer
    than their pixels can account for, and entries for these.

    `RawDataError` for two heads with the same attitudes.
    """
    images = [image for head in heads for image in _images_of(head)]

    def same(a: Image, b: Image) -> bool:
        if isinstance(a.content, Path):
            return same_exposure(a.source, a.exposure, b.exposure)
        return a.content == b.content or None in (a.content, b.content)

    why = _why_images(images, same, has_one_grey_value=lambda image: False)
    why |= {row: entry for row, image in enumerate(images) for entry in _too_long(image)}
    kept, entries = [], list(why.values())
    for name, entry in ((entry.subject.head, entry) for entry in entries if entry.subject.head):
        expected = "a file of its own for each head"
        raise RawDataError("dump.toml", f"attitudes of {name}", entry.text, expected)
    for head in heads:
        source = head.source
        if isinstance(source, SolvedAttitudes):
            source, repeated = _attitudes_once(head, source)
            entries += repeated
        else:
            of_head = [row for row, image in enumerate(images) if image.sensor == (head.name, -1)]
            left = [k for k, row in enumerate(of_head) if row not in why]
            if isinstance(source, StarCentroids):
                source = replace(source, lists=tuple(source.lists[k] for k in left))
            source = replace(source, exposures=tuple(source.exposures[k] for k in left))
        kept.append(replace(head, source=source))
    return tuple(kept), entries


def _images_of(head: Head) -> Iterator[Image]:
    """The exposures of a head, or all attitudes that it has solved as one content."""
    source, sensor = head.source, (head.name, -1)
    if isinstance(source, SolvedAttitudes):
        content = source.rows.t_s.tobytes() + source.rows.R_si.as_quat().tobytes()
        yield Image(Entry(head.subject, file=source.file), sensor, 0.0, 0.0, content, source)
        return
    for k, exposure in enumerate(source.exposures):
        begin_s, end_s = exposure.t_s - 0.5 * exposure.exposure_s, exposure.t_s + 0.5 * exposure.exposure_s
        stars = source.lists[k] if isinstance(source, StarCentroids) else None
        of_list = None if stars is None else stars.xy_px.tobytes()
        content = exposure.path if isinstance(source, StarImages) else of_list
        yield Image(exposure.item, sensor, begin_s, end_s, content, source, exposure)


def _too_long(image: Image) -> Iterator[Entry]:
    """Why the file of an exposure is not even opened, if it is too long."""
    if isinstance(image.source, StarImages) and image.exposure is not None:
        camera, exposure = image.source.camera, image.exposure
        size = camera.width_px * camera.height_px * (1 if image.source.bit_depth <= 8 else 2)
        try:
            check_length(exposure.path, exposure.file, size)
        except RawDataError as error:
            yield image.entry.because(Reason.UNREADABLE, str(error))


def _attitudes_once(head: Head, source: SolvedAttitudes) -> tuple[SolvedAttitudes, list[Entry]]:
    rows, repeated = source.rows, common_errors(source.rows, head.noise.white_covariance_s)
    if not repeated.any():
        return source, []
    text = f"{repeated.sum()} of {len(repeated)} attitudes of {source.file} follow another one closely and "
    text += "have the same error: each is counted once"
    entry = Entry(head.subject, Reason.REPEATED, text, source.file)
    return replace(source, rows=rows.take(~repeated)), [entry]


def common_errors(rows: AttitudeRows, white_s: Floats) -> Bools:
    """Which attitudes (N,) are copies of the one before: they follow it closely, and all such rows together
    differ from it by less than independent errors do.

    `white_s` (3, 3) is the covariance of an attitude where the rows state none, rad².
    """
    t_s, R = rows.t_s, rows.R_si
    repeated, step = np.zeros(len(t_s), dtype=bool), np.diff(t_s)
    beside = np.maximum(np.append(step[1:], 0.0), np.append(0.0, step[:-1]))
    close = np.flatnonzero(step < CLOSE * beside)
    if not len(close):
        return repeated
    first, last = np.maximum(close - 1, 0), np.minimum(close + 2, len(t_s) - 1)
    rate = (R[last] * R[first].inv()).as_rotvec() / (t_s[last] - t_s[first])[:, None]
    apart = (R[close + 1] * R[close].inv()).as_rotvec() - rate * step[close, None]
    one = np.tile(white_s, (len(close), 1, 1)) if rows.covariance_s is None else rows.covariance_s[close]
    statistic = float(np.einsum("ni,nij,nj->", apart, np.linalg.inv(2.0 * one), apart))
    repeated[close + 1] = chdtr(3 * len(close), statistic) < PROBABILITY_COMMON
    return repeated


def points_once(points: Sequence[StripPoints], file: str) -> tuple[tuple[StripPoints, ...], list[Entry]]:
    """The points of each strip without measurements that are listed again under other ids, and entries for
    these: at one image position and place on the ground they are one.
    """
    entries = [
        Entry(Subject(Kind.TARGET, strip=of_strip.strip_id, id=target.target_id), file=file)
        for of_strip in points
        for target in of_strip.targets
    ]
    place = [
        (APART * n, APART * ccd, *xy_px / SAME_PX, *target.p_e / SAME_M)
        for n, of_strip in enumerate(points)
        for ccd, xy_px, target in zip(of_strip.ccd, of_strip.xy_px, of_strip.targets)
    ]
    why = _why(entries, _near(place, 1.0), lambda n, _: f"the same measurement as {entries[n].subject.id}")
    kept = np.array([row not in why for row in range(len(entries))], dtype=bool)
    of_strips = np.split(kept, np.cumsum([len(of_strip.ccd) for of_strip in points]))
    return tuple(of_strip.take(rows) for of_strip, rows in zip(points, of_strips)), list(why.values())


def _near(places: Any, distance: float) -> list[Pair]:
    """Pairs of rows, the earlier one first, whose places (N, D) are within a distance in each component."""
    if len(places) < 2:
        return []
    pairs = cKDTree(places).query_pairs(distance, p=np.inf, output_type="ndarray")
    return list(map(tuple, np.sort(pairs, axis=1).tolist()))


def targets_once(dump: Dump, settings: MatchSettings) -> Dump:
    """The dump without targets whose templates share more than a quarter of their pixels with that of one
    that stays, and with entries for these. The first in the order of targets.csv stays.
    """
    height_m = float(np.median(np.linalg.norm(dump.orbit.positions_m, axis=1))) - WGS84.semi_major_m
    template_m = settings.template_px * height_m * dump.line_camera.pixel_rad  # on the ground, at most
    p_e = [target.p_e for target in dump.targets]

    def repeats(first: int, second: int) -> str:
        sides_m = [template_m]
        for chip in (dump.chips[first], dump.chips[second]):
            with suppress(RawDataError):  # reported by its reader
                sides_m.append(grid_place(chip.path, chip.file).side_m)
        lat, lon, _ = geodetic_from_ecef(p_e[first][None])
        apart_m = np.abs(local_axes_e(lat, lon)[0].T @ (p_e[second] - p_e[first]))[:2]
        share = float(np.prod(np.maximum(1.0 - apart_m / min(sides_m), 0.0)))
        where = f"it lies {np.hypot(*apart_m):.3g} m from target {dump.targets[first].target_id}"
        return f"{where} and shares {share:.0%} of its pixels" if share > SHARED else ""

    listed = list(zip(dump.targets, dump.chips))
    entries = [Entry(Subject(Kind.TARGET, id=target.target_id), file=chip.file) for target, chip in listed]
    why = _why(entries, _near(p_e, np.sqrt(2.0) * template_m), repeats)
    left = [row for row in range(len(listed)) if row not in why]
    return replace(
        dump,
        targets=tuple(dump.targets[row] for row in left),
        chips=tuple(dump.chips[row] for row in left),
        omissions=(*dump.omissions, *why.values()),
    )
