"""Other ways to read an input, tried where strips do not see their stars or targets.

A quaternion of the other sense, times of another scale, exchanged files or a mirrored image lead far from any
linear test. Each is a row: what would be wrong, where the dump states it, and `apply`, the input as it was
meant. `best_reading` tries rows and counts the observations that agree. A further mistake is a further row.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, islice, pairwise
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.calib.finding import Finding
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from boresight.pipeline.diagnosis.losses import Crossings, as_bright_as_named, crossings, names, stars_found
from boresight.pipeline.files.dates import other_scales
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.ground_points import StripPoints
from boresight.pipeline.files.images.tiff import StripFiles
from boresight.pipeline.files.star_side import Head, SolvedAttitudes
from boresight.pipeline.files.strip_table import Strip
from boresight.pipeline.stages.exposure import StarTask, exposure_image, is_identified
from boresight.pipeline.stages.sky_side import SkySide
from boresight.pipeline.stages.sky_strip import NamedStars, SkyTask
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, match_strip_targets
from boresight.records.ledger import Entry, Kind, Ledger, Subject
from boresight.records.record import Floats, record, scalar
from boresight.star_id.strip_stars.find import StripStars

__all__ = [
    "MIRRORED",
    "Reading",
    "are_mirrored",
    "best_reading",
    "exchanged_in_ground",
    "exchanged_in_sky",
    "exchanged_strips",
    "orders_of",
    "readings_of_dump",
    "reversed_in_ground",
    "reversed_strips",
    "strips_without_stars",
]

FEWEST = 3  # targets or stars that agree with a reading
MOST_EXCHANGED = 6  # strips whose measured points are exchanged pair by pair: the work grows with the square
MOST_TRIED = 3  # strips, or pairs of them, that are matched with other images; bounds their time
T = TypeVar("T")
Image = NDArray[Any]
Turn = Callable[[Rotation], Rotation]
Points = Callable[[StripPoints, Dump], StripPoints]


@dataclass(frozen=True)
class Reading(Generic[T]):
    """One other way to read an input: a dump, images, or detections in them."""

    cause: str  # what would be wrong
    item: str  # what it concerns, in words
    subjects: tuple[Subject, ...]  # the same; empty: the whole dump
    file: str  # file of the dump that states it
    field: str  # field of that file
    changed: str  # how it is read, in words
    apply: Callable[[T], T]  # the input as it would have been meant

    def finding(self, text: str, *, refutes: bool = False) -> Finding:
        """That this is how the input was meant; `text` says by what that is seen."""
        return Finding(
            cause=self.cause,
            item=self.item,
            subjects=self.subjects,
            text=f"{text}: check {self.field} in {self.file}.",
            file=self.file,
            field=self.field,
            refutes=refutes,
        )


def best_reading(
    given: T, readings: Iterable[Reading[T]], agreeing: Callable[[T], int], fewest: int, enough: int
) -> tuple[Reading[T], int] | None:
    """The reading of an input by which most observations agree, at least `fewest`, and how many do; of equals
    the first, and the first by which `enough` do. None where there is none. `agreeing` counts them.
    """
    best, most = None, fewest - 1
    for reading in readings:
        count = agreeing(reading.apply(given))
        if count > most:
            best, most = (reading, count), count
        if count >= enough:
            break
    return best


# --- Tables of a dump


def readings_of_dump(dump: Dump) -> Iterator[Reading[Dump]]:
    """Every other reading of the tables of a dump alone, the commonest mistakes first."""
    for head in dump.heads:
        words, subjects = head.subject.words, (head.subject,)
        rows = OF_HEADS[1:] if isinstance(head.source, SolvedAttitudes) else OF_HEADS[:3]
        for cause, changed, file, field, changed_head, R_meant in rows:
            apply = partial(_with_head, head.name, partial(changed_head, R_meant))
            yield Reading(cause, words, subjects, file.format(head), field, changed, apply)
    for a, b in pairwise([head for head in dump.heads if isinstance(head.source, SolvedAttitudes)]):
        words, both = f"heads {a.name} and {b.name}", (a.subject, b.subject)
        field, apply = "star_cameras.attitudes", partial(_heads_exchanged, a.name, b.name)
        yield Reading("files of two heads", words, both, "dump.toml", field, "exchanged,", apply)
    strips, first_s = Subject(Kind.STRIP), dump.orbit.span_s[0]
    for scale, late_s in other_scales(dump.epoch, "UTC", first_s):
        changed, apply = f"read as {scale} ({late_s:+.4g} s),", partial(_with_later_strips, late_s)
        cause, field = "scale of times", "utc_first_row"
        yield Reading(cause, strips.words, (strips,), "strips.csv", field, changed, apply)
    for scale, late_s in other_scales(dump.epoch, dump.orbit_time_system, first_s):
        changed, apply = f"dated in {scale} ({late_s:+.4g} s),", partial(_with_later_orbit, late_s)
        cause, field = "time system of the orbit", "TIME_SYSTEM"
        yield Reading(cause, "all states", (), "the orbit", field, changed, apply)
    for cause, changed, field, meant in POINTS if dump.points else ():
        apply = partial(_with_points, meant)
        yield Reading(cause, "all measured points", (), "points.csv", field, changed, apply)
    for one, other in combinations([points.strip_id for points in dump.points[:MOST_EXCHANGED]], 2):
        both = Subject(Kind.STRIP, strip=one), Subject(Kind.STRIP, strip=other)
        apply = partial(_with_points, partial(_renamed, {one: other, other: one}))
        cause, words = "points of two strips", f"strips {one} and {other}"
        yield Reading(cause, words, both, "points.csv", "strip", "exchanged,", apply)


def _with_head(name: str, changed: Callable[[Head], Head], dump: Dump) -> Dump:
    return replace(dump, heads=tuple(changed(one) if one.name == name else one for one in dump.heads))


def _mounted(meant: Turn, head: Head) -> Head:
    return replace(head, R_cs0=meant(head.R_cs0))


def _turned(meant: Turn, head: Head) -> Head:
    source = head.source
    assert isinstance(source, SolvedAttitudes)  # of others there is no such reading
    rows = replace(source.rows, R_si=meant(source.rows.R_si))
    return replace(head, source=replace(source, rows=rows))


def _heads_exchanged(a: str, b: str, dump: Dump) -> Dump:
    source = {head.name: head.source for head in dump.heads}
    source[a], source[b] = source[b], source[a]
    return replace(dump, heads=tuple(replace(head, source=source[head.name]) for head in dump.heads))


def _with_later_strips(late_s: float, dump: Dump) -> Dump:
    strips, sky = (
        tuple(replace(strip, t_first_row_s=strip.t_first_row_s + late_s) for strip in those)
        for those in (dump.strips, dump.sky_strips)
    )
    return replace(dump, strips=strips, sky_strips=sky)


def _with_later_orbit(late_s: float, dump: Dump) -> Dump:
    first_s, last_s = (end_s + late_s for end_s in dump.orbit.span_s)
    earth = replace(dump.orbit.earth, t_start_s=first_s, t_stop_s=last_s)
    return replace(dump, orbit=replace(dump.orbit, t_s=dump.orbit.t_s + late_s, earth=earth))


def _with_points(meant: Points, dump: Dump) -> Dump:
    return replace(dump, points=tuple(meant(points, dump) for points in dump.points))


def _renamed(names: dict[str, str], points: StripPoints, _: Dump) -> StripPoints:
    return replace(points, strip_id=names.get(points.strip_id, points.strip_id))


def _from_other_end(axis: int, points: StripPoints, dump: Dump) -> StripPoints:
    """Samples (0) or lines (1) counted from the other end of their CCD."""
    (strip,) = (strip for strip in dump.strips if strip.strip_id == points.strip_id)
    length = strip.ccd_lines.__getitem__ if axis else dump.line_camera.n_px
    xy_px = points.xy_px.copy()
    xy_px[:, axis] = [length(ccd) - 1.0 for ccd in points.ccd.tolist()] - xy_px[:, axis]
    return replace(points, xy_px=xy_px)


def _columns_exchanged(points: StripPoints, _: Dump) -> StripPoints:
    return replace(points, xy_px=points.xy_px[:, ::-1])


def _ccds_reversed(points: StripPoints, dump: Dump) -> StripPoints:
    return replace(points, ccd=dump.line_camera.n_ccds - 1 - points.ccd)


def _at(meant: Callable[[Floats, Floats], tuple[Floats, Floats]]) -> Points:
    """Places on the ground of other latitude and longitude, rad."""

    def moved(points: StripPoints, _: Dump) -> StripPoints:
        lat, lon, height = geodetic_from_ecef(np.array([one.p_e for one in points.targets]), WGS84)
        p_e = ecef_from_geodetic(*meant(lat, lon), height, WGS84)
        return replace(points, targets=tuple(replace(one, p_e=at) for one, at in zip(points.targets, p_e)))

    return moved


def _geodetic(geocentric_rad: Floats) -> Floats:
    """Latitude whose direction from the centre of the ellipsoid is that of another, at height 0."""
    return np.asarray(np.arctan(np.tan(geocentric_rad) / (1.0 - WGS84.eccentricity_squared)))


def _scalar_first(stated: Rotation) -> Rotation:
    """A rotation if the first of its four numbers was the scalar."""
    return Rotation.from_quat(np.roll(stated.as_quat(), -1, axis=-1))


def _inverse_scalar_first(stated: Rotation) -> Rotation:
    """The same where the file states the inverse."""
    return _scalar_first(stated.inv()).inv()


# Of a head: its images, its installation file, then attitudes that it has solved: cause, words, file, field,
# what is changed, and the rotation that was meant.
MOUNTING = "the installation file of {0.name}", "quaternion_cs", _mounted
HALF_TURN = Rotation.from_rotvec([0.0, 0.0, np.pi])
SENSE = "sense of the attitudes' rotation", "with the quaternions conjugated"
ORDER = "order of the quaternions' components", "with the scalar first", "{0.source.file}", "qx, qy, qz, qw"
OF_HEADS: tuple[tuple[str, str, str, str, Callable[[Turn, Head], Head], Turn], ...] = (
    (
        "axes of the star images",
        "rotated by 180°",
        "exposures.csv",
        "file",
        _mounted,
        lambda R: R * HALF_TURN,
    ),
    ("sense of the installation matrix", "inverted,", *MOUNTING, Rotation.inv),
    ("order of the quaternion's components", "with the scalar first", *MOUNTING, _scalar_first),
    (*SENSE, "dump.toml", "star_cameras.rotation", _turned, Rotation.inv),
    (*ORDER, _turned, _inverse_scalar_first),
    (*ORDER, _turned, _scalar_first),
)
# Of measured points: cause, words, field, and the points that were meant.
POINTS: tuple[tuple[str, str, str, Points], ...] = (
    ("origin of the lines", "with lines counted from the last", "line", partial(_from_other_end, 1)),
    (
        "origin of the samples",
        "with samples counted from the other end",
        "sample",
        partial(_from_other_end, 0),
    ),
    ("order of the columns", "with sample and line exchanged,", "sample, line", _columns_exchanged),
    ("order of the CCDs", "with CCDs counted from the other end", "ccd", _ccds_reversed),
    (
        "order of the columns",
        "with latitude and longitude exchanged,",
        "lat_deg, lon_deg",
        _at(lambda lat, lon: (lon, lat)),
    ),
    ("sign of the latitudes", "with the other sign", "lat_deg", _at(lambda lat, lon: (-lat, lon))),
    ("sign of the longitudes", "with the other sign", "lon_deg", _at(lambda lat, lon: (lat, -lon))),
    ("kind of latitude", "read as geocentric", "lat_deg", _at(lambda lat, lon: (_geodetic(lat), lon))),
)


# --- Files of images


def _exchanged_ccds(strip: Strip, a: int, b: int, apply: Callable[[T], T]) -> Reading[T]:
    words = f"CCD {a} and CCD {b} in {strip.subject.words}"
    both = (strip.ccd_subject(a), strip.ccd_subject(b))
    return Reading("files of two CCDs", words, both, "strips.csv", "file", "exchanged,", apply)


def _told(
    given: T, readings: Iterable[Reading[T]], agreeing: Callable[[T], int], n: int, what: str
) -> Iterator[Finding]:
    """How images are meant, if of `n` observations, none of which is found as stated, half are."""
    enough = max(FEWEST, (n + 1) // 2)
    if best := best_reading(given, readings, agreeing, enough, enough):
        yield best[0].finding(f"{best[0].changed} {best[1]} of {n} {what} are found, as stated none")


def _empty_pairs(strip: Strip, ledger: Ledger) -> Iterator[tuple[int, int, int]]:
    """Pairs of CCDs of a strip on which nothing is found, and how many observations they must show."""
    cells = ledger.of_strip(strip.strip_id).cells()
    empty = [(ccd, n) for (_, ccd), (kept, n) in cells.items() if not kept]
    yield from ((a, b, n_a + n_b) for (a, n_a), (b, n_b) in combinations(empty, 2))


def exchanged_in_ground(
    tasks: Sequence[StripTask], matched: Sequence[MatchedTargets], ledger: Ledger
) -> Iterator[Finding]:
    """Pairs of CCDs of strips of the ground on which nothing matches, but with the image of the other."""
    for task, of_strip in zip(tasks, matched):
        for a, b, n in _empty_pairs(task.strip, ledger) if len(of_strip.ccd) else ():
            images = task.strip.images.of((a, b))
            if images.shape(a) == images.shape(b):
                reading = _exchanged_ccds(task.strip, a, b, partial(_with_files, {a: b, b: a}))
                yield from _told((images,), [reading], partial(_matches, (task,)), n, "targets")


def exchanged_strips(tasks: Sequence[StripTask], matched: Sequence[MatchedTargets]) -> Iterator[Finding]:
    """Pairs of strips of the ground of which nothing matches, but with the images of the other."""
    for (a, n_a), (b, n_b) in islice(combinations(_unmatched(tasks, matched), 2), MOST_TRIED):
        if a.strip.images.shapes == b.strip.images.shapes:
            one, other, images = a.strip.subject, b.strip.subject, (a.strip.images, b.strip.images)
            cause, words = "files of two strips", f"{one.words} and {other.words}"
            reading = Reading[tuple[StripFiles, StripFiles]](
                cause, words, (one, other), "strips.csv", "file", "exchanged,", lambda both: both[::-1]
            )
            found = partial(_matches, (a, b))
            yield from _told(images, [reading], found, n_a + n_b, "targets")


def _unmatched(tasks: Sequence[StripTask], matched: Sequence[MatchedTargets]) -> list[tuple[StripTask, int]]:
    """Strips of the ground with targets in view of which nothing matches, and how many these are."""
    every = [(task, one) for task, one in zip(tasks, matched) if task.targets]
    return [(task, len(one.omissions)) for task, one in every if not len(one.ccd)]


def exchanged_in_sky(
    dump: Dump, side: SkySide, named: Sequence[NamedStars], ledger: Ledger, R_cs: Rotation
) -> Iterator[Finding]:
    """Pairs of CCDs of strips of the sky whose bright stars all are on the other one."""
    if not len(ledger.ccd):
        return
    bright = as_bright_as_named(dump, named)
    for task, of_strip in zip(side.tasks, named):
        for a, b, n in _empty_pairs(task.strip, ledger):
            expected = crossings(task, bright, R_cs)
            expected = expected.take(np.isin(expected.ccd, (a, b)))

            def found(stars: StripStars, task: SkyTask = task, expected: Crossings = expected) -> int:
                return int(stars_found(dump, task, stars, expected).sum())

            reading = _exchanged_ccds(task.strip, a, b, partial(_of_other_ccd, a, b))
            yield from _told(of_strip.found, [reading], found, n, "bright stars")


def _of_other_ccd(a: int, b: int, stars: StripStars) -> StripStars:
    """Detections with the numbers of two CCDs exchanged."""
    return replace(stars, ccd=np.where(stars.ccd == a, b, np.where(stars.ccd == b, a, stars.ccd)))


def _with_files(files: dict[int, int], images: tuple[StripFiles]) -> tuple[StripFiles]:
    """The images of CCDs, each that of another."""
    of_files: Any = (images[0].paths, images[0].names, images[0].shapes)
    return (StripFiles(*({ccd: one[of] for ccd, of in files.items()} for one in of_files)),)


def _matches(tasks: Sequence[StripTask], images: Sequence[StripFiles]) -> int:
    """How many targets of strips are found in other images."""
    strips = (replace(task, strip=replace(task.strip, images=of)) for task, of in zip(tasks, images))
    outcomes = [match_strip_targets(task) for task in strips]
    return sum(len(outcome.ccd) for outcome in outcomes if not isinstance(outcome, Entry))


# --- Order of pixels


@record
class ReversedFiles(StripFiles):
    """Images of a strip with their lines, samples or both in reverse order."""

    steps: tuple[int, int] = scalar("-1 where lines, or samples, are reversed, else 1", default=(1, 1))

    def read(self, ccd: int, line0: int, line1: int, sample0: int, sample1: int) -> Image:
        """Raw counts of a window, as `StripFiles`."""
        of = zip((line0, sample0), (line1, sample1), self.shapes[ccd], self.steps)
        lines, samples = [(a, b) if step > 0 else (n - b, n - a) for a, b, n, step in of]
        return StripFiles.read(self, ccd, *lines, *samples)[:: self.steps[0], :: self.steps[1]]


def reversed_in_ground(tasks: Sequence[StripTask], matched: Sequence[MatchedTargets]) -> Iterator[Finding]:
    """Strips of the ground of which nothing matches, but with the pixels of their images in another order."""
    for task, n in _unmatched(tasks, matched)[:MOST_TRIED]:
        of, found = (task.strip.images,), partial(_matches, (task,))
        yield from _told(of, _orders(task.strip, _with_steps, STEPS), found, n, "targets")


def _with_steps(steps: tuple[int, int], images: tuple[StripFiles]) -> tuple[StripFiles]:
    return (ReversedFiles(images[0].paths, images[0].names, images[0].shapes, steps),)


def _reversed(axis: int, side: SkySide) -> SkySide:
    """Detections of one strip of the sky with samples (0) or rows (1) in reverse order."""
    (task,), (stars,) = side.tasks, side.found
    xy_px = stars.xy_px.copy()
    length = [task.strip.lines if axis else task.camera.n_px(ccd) for ccd in stars.ccd.tolist()]
    xy_px[:, axis] = np.array(length) - 1.0 - xy_px[:, axis]
    return replace(side, found=(replace(stars, xy_px=xy_px),))


MIRRORED = Reading[Image](
    "order of an image",
    Subject(Kind.EXPOSURE).words,
    (Subject(Kind.EXPOSURE),),
    "exposures.csv",
    "file",
    "mirrored left to right",
    lambda image: image[:, ::-1].copy(),
)


def are_mirrored(tasks: Sequence[StarTask]) -> bool:
    """Whether stars of some exposures, not identified as stated, are in the mirror image of one."""
    images = (exposure_image(task.exposure, task.camera, task.bit_depth) for task in tasks)
    trials = (
        best_reading(image, [MIRRORED], partial(is_identified, task), 1, 1)
        for task, image in zip(tasks, images)
    )
    return any(trials)


ORDERS = ("with the order of columns reversed", "with the order of rows reversed", "rotated by 180°")
STEPS = ((1, -1), (-1, 1), (-1, -1))  # of lines and samples in these


def _orders(strip: Strip, apply: Callable[[Any, T], T], by: Iterable[Any]) -> list[Reading[T]]:
    """Other orders of pixels in the images of a strip: the first of `ORDERS`, each by what `apply` takes."""
    told = "order of an image", strip.subject.words, (strip.subject,), "strips.csv", "file"
    return [Reading(*told, changed, partial(apply, one)) for changed, one in zip(ORDERS, by)]


def orders_of(strip: Strip) -> list[Reading[SkySide]]:
    """Other orders of pixels in the images of a strip of the sky: of columns, of rows."""
    return _orders(strip, _reversed, (0, 1))


def _order(dump: Dump, side: SkySide) -> Reading[SkySide] | None:
    """With which other order of its image the stars of a strip are named."""
    best = best_reading(side, orders_of(side.tasks[0].strip), partial(names, dump), FEWEST, FEWEST)
    return best and best[0]


def reversed_strips(dump: Dump, side: SkySide) -> Iterator[Finding]:
    """Strips of the sky of which no star is named as stated, but with rows or columns reversed."""
    for n in range(len(side.tasks)):
        strip = side.only(n)
        if names(dump, strip) < FEWEST and (order := _order(dump, strip)):
            yield order.finding(f"none of its stars named, but {order.changed} they are", refutes=True)


def strips_without_stars(
    dump: Dump, side: SkySide, named: Sequence[NamedStars], ledger: Ledger, explained: Collection[str]
) -> Iterator[Finding]:
    """Strips of the sky in which no star is where it must be, but those `explained` by a cause. A strip whose
    stars agree by themselves contradicts the others, and refutes.
    """
    head = dump.heads[0]
    solved = isinstance(head.source, SolvedAttitudes)
    attitudes = f"; or attitudes in {head.times_in[0]}" if solved else ""
    for n, (task, of_strip) in enumerate(zip(side.tasks, named)):
        strip = task.strip
        expected = len(ledger.of_strip(strip.strip_id).ccd)
        if len(of_strip.rows) or expected < FEWEST or strip.strip_id in explained:
            continue
        alone = names(dump, side.only(n)) >= FEWEST
        if not alone and (order := _order(dump, side.only(n))):
            yield order.finding(f"none of its {expected} brightest stars found, but {order.changed} they are")
            continue
        which = "its stars agree by themselves, but none of" if alone else "none of its"
        what = f"{which} {expected}{'' if alone else ' brightest stars'} is where the other strips place it"
        file, field = "strips.csv", "file, utc_first_row"
        text = f"{what}: check {field} in {file}{attitudes if alone else ''}."
        rivals = (f"attitudes, {head.subject.words}",) if alone and solved else ()
        cause = "images, clock or attitudes"
        yield Finding.about(cause, strip.subject, text, file, field, refutes=alone, rivals=rivals)
