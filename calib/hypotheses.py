"""The table of hypotheses: what each error of an input, one unit large, does to the residuals of an estimate.

A hypothesis is a row: what it speaks of, the file and field that state the input, a unit, and the change of
every residual u_c - w (frame c, rad) if the input is stated one unit too large. Tests, findings, blind spots
and minimal detectable errors all follow from it (`reliability`); a further kind of error is a further row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.spatial.transform import Rotation

from boresight.calib.star_camera_error import PARTS, StarEffects
from boresight.calib.strips import PreparedStrip, matrix_of_each, turned
from boresight.geometry.attitude_estimate import cross_matrices
from boresight.geometry.constants import ARCSEC, DAY_S
from boresight.geometry.sightings import GroundSightings
from boresight.records.ledger import Kind, Subject
from boresight.records.record import Bools, Floats, Ints, array, record, scalar

__all__ = [
    "POSITION",
    "SIZES",
    "STABILITY",
    "USUAL",
    "Hypothesis",
    "HypothesisInputs",
    "HypothesisTable",
    "InputError",
    "MovedInput",
    "hypotheses",
    "vector_hypotheses",
]

SIZES = ("too large", "too small")  # a positive and a negative size in words
MILLI, PERCENT = 1e-3, 1e-2  # of a second, of a radian, of a length or rate, in units of hypotheses
# Largest error of an input that is possible, by unit: an effect of light or of aberration is modelled or not
# (once too much); a focal length or a row period that is a third off is that of another camera; an orbit 100
# km away, or a CCD 10 000 pixels, changes the looks by more than the linear form holds for.
LARGEST = {"times": 3.0, "%": 33.0, "m": 1e5, "px": 1e4}
STRIPS, CAMERA, STAR = "strips.csv", "remote_camera.toml", "star_camera.toml"
TARGETS, ORBIT = "{targets}", "orbit, {targets}"  # files of the dump that state these
MOVES, VECTORS = "temperatures and manoeuvres", "v_stars, v_targets"
LATE, LONG = ("too late", "too early"), ("too long", "too short")
STABILITY, POSITION = "mounting_arcsec", "position_m"  # keys under [errors], which state usual sizes
USUAL = {STABILITY: 10.0, POSITION: 3.0}  # an orbit is seldom known by less
ErrorKind = tuple[str, float | str, float, str, str, tuple[str, str]]
# Kinds of errors, all directions of one alike unless they have rows of their own: unit; usual size in it, set
# by hand or by a key under [errors]; how much rarer it is than what is stated wrong by hand; file and field
# that state it; a positive and a negative size in words. A size x is less likely than a usual one by the
# factor 1 + x / usual. Heights and datums are off by tens of metres.
ERRORS: dict[str, ErrorKind] = {
    "clock of the rows": ("ms", 10.0, 1.0, STRIPS, "utc_first_row", LATE),
    "clock of the rows, curved": ("ms", 1.0, 30.0, STRIPS, "times", LATE),
    "row period": ("%", 0.05, 1.0, STRIPS, "row_period_s", LONG),
    "lines of a strip": ("rows", 1.0, 30.0, STRIPS, "file", ("missing", "too many")),
    "orbit or targets, along the track": ("m", POSITION, 1.0, ORBIT, "", ("too far ahead", "too far back")),
    "orbit or targets, across the track": ("m", POSITION, 1.0, ORBIT, "", ("too far right", "too far left")),
    "orbit or targets, height": ("m", 30.0, 1.0, ORBIT, "", ("too high", "too low")),
    "datum of the targets, east": ("m", 30.0, 3.0, TARGETS, "", ("too far east", "too far west")),
    "datum of the targets, north": ("m", 30.0, 3.0, TARGETS, "", ("too far north", "too far south")),
    "datum of the targets, height": ("m", 30.0, 3.0, TARGETS, "", SIZES),
    "attitude or mounting": ("″", STABILITY, 1.0, "{attitudes}, orbit", "", SIZES),
    "mounting moved": ("″", STABILITY, 30.0, MOVES, "", SIZES),
    "mounting varies with the season": ("″", STABILITY, 30.0, MOVES, "", SIZES),
    "mounting drifts": ("″", 1.0, 30.0, MOVES, "", SIZES),
    "mounting bends": ("″", 1.0, 30.0, MOVES, "", SIZES),
    "place of the CCDs, along the track": ("px", 0.5, 1.0, CAMERA, "x_offset_mm", SIZES),
    "place of the CCDs, across the track": ("px", 0.5, 1.0, CAMERA, "y_first_mm", SIZES),
    "place of a CCD, along the track": ("px", 0.5, 1.0, CAMERA, "x_offset_mm", SIZES),
    "place of a CCD, across the track": ("px", 0.5, 1.0, CAMERA, "y_first_mm", SIZES),
    "rotation of a CCD": ("mrad", 0.5, 1.0, CAMERA, "rotation_mrad", SIZES),
    "length of a CCD": ("px", 0.5, 30.0, CAMERA, "pixel_pitch_um", SIZES),
    "bend of a CCD": ("px", 0.5, 30.0, CAMERA, "look directions", SIZES),
    "distortion of the remote-sensing camera": ("px", 0.5, 1.0, CAMERA, "distortion_offsets_um", SIZES),
    "focal length of the remote-sensing camera": ("%", 0.05, 1.0, CAMERA, "focal_length_m", LONG),
    "image of a CCD": ("px", 0.5, 1.0, STRIPS, "file", SIZES),
    "focal length of the star camera": ("%", 0.05, 1.0, STAR, "focal_length_mm", LONG),
    "principal point of the star camera": ("px", 1.0, 1.0, STAR, "principal_point_px", SIZES),
    "radial distortion of the star camera": ("px at its corner", 1.0, 1.0, STAR, "q1_per_mm2", SIZES),
    "decentring of the star camera": ("px at its corner", 1.0, 1.0, STAR, "p1_per_mm, p2_per_mm", SIZES),
    # Of vectors of frames.
    "attitude of a frame": ("″", 10.0, 1.0, VECTORS, "", SIZES),
    "attitude and aberration of all frames": ("″", 10.0, 1.0, VECTORS, "", SIZES),
    "origin of the look vectors": ("″", 1.0, 1.0, "w_c", "", SIZES),
}
ABOUT_AXES = ("about x of c", "about y of c", "about z of c")
ABOUT_TRACK = (
    "across the track",
    "along the track",
    "about the line of sight",
)  # the same; y is a clock, too
# Lines from which on lines may be missing: of all strips together, of a strip, of one CCD in a strip.
MOST_BREAKS, OF_STRIP, OF_CCD = 300, 33, 3
MOST_JUMPS = 12  # passes from which on the mounting may have moved
# A season is looked for where passes of so many days span so much of a year; its phases are 30° apart, so
# that one of them has 0.93 of the variance of any season.
FEWEST_DAYS, LEAST_YEARS, PHASES = 5, 0.5, 6
DEGREES = 5  # of polynomials over a CCD that a distortion of all CCDs may have
MOST_FRAMES = 50  # of vectors whose attitudes are tested one by one: the work grows with the square


@record(kw_only=True)
class InputError:
    """One kind of error of one input."""

    cause: str = scalar('what is wrong: "clock of a strip"')
    item: str = scalar('what it concerns, in words: "strip s02"', default="")
    subjects: tuple[Subject, ...] = scalar("the same as subjects; empty: all", default=())
    unit: str = scalar("of its size")
    words: tuple[str, str] = scalar(
        "a positive and a negative size in words, behind the number", default=SIZES
    )
    file: str = scalar("file of the dump that states the input")
    field: str = scalar("field of that file", default="")
    most: float = scalar("largest size that is possible", default=np.inf)
    usual: float = scalar("usual size", default=1.0)
    usual_of: str = scalar("key under [errors] that states it; empty: set by hand", default="")
    rarity: float = scalar("how much rarer it is than what is stated wrong by hand", default=1.0)


@record(kw_only=True)
class MovedInput(InputError):
    """What one unit too much of an input does, strip by strip; a strip that is not named does not move.

    Hypotheses that the estimate's own derivatives do not give (effects on light, the aberration that a head
    has left in, the velocity of the satellite, the clock of the star camera) are two evaluations of a
    prediction, made by who reads the dump.
    """

    directions_i: Mapping[str, Floats] = scalar(
        "by strip: change (J, 3) of the targets' known directions, GCRS", default_factory=dict
    )
    turns_s: Mapping[str, Floats] = scalar(
        "by strip: right-handed rotation (K, 3) of the exposures' attitudes, axes of s, rad",
        default_factory=dict,
    )


@record(kw_only=True)
class Hypothesis(InputError):
    """One kind of error of one input, and what one unit of it does."""

    rows: Ints = array("K", "targets that it moves, of all in order of strips")
    moves_c: Floats = array("K, 3", "change of u_c - w of these by one unit, frame c, rad")
    star_part: int = scalar("which of `star_camera_error.PARTS` it is; -1: none", default=-1)

    @property
    def largest(self) -> float:
        """Largest possible size: `most`, or what its unit allows; inf: none."""
        return min(self.most, LARGEST.get(self.unit, np.inf))

    def price(self, size: float) -> float:
        """Minus twice the logarithm of how likely this error is in this size, beside a usual one."""
        return 2.0 * float(np.log1p(abs(size) / self.usual) + np.log(self.rarity))

    @property
    def named(self) -> str:
        """Cause and item."""
        return f"{self.cause}, {self.item}"

    @property
    def kind(self) -> str:
        """Cause without its direction."""
        return self.cause.partition(",")[0]

    @property
    def remedy(self) -> str:
        """What to look at."""
        return f"check {self.field} in {self.file}" if self.field else f"check {self.file}"


@dataclass(frozen=True)
class HypothesisInputs:
    """What a table of hypotheses is computed from."""

    prepared: Sequence[PreparedStrip]  # as they enter the solution
    R_cs: Rotation  # the estimate
    pixel_rad: float | Sequence[float]  # of the remote-sensing camera, or of each
    effects: Sequence[StarEffects] = ()  # errors of the star camera, by strip; none: attitudes were delivered
    inputs: Sequence[MovedInput] = ()  # what moves in the prediction with further inputs
    pivots: Mapping[tuple[str, int], float] | None = None  # samples about which CCDs rotate; else: their mean
    target_files: str = "targets.csv"  # files of the dump with the coordinates of the targets
    cameras: Sequence[str] = ("",)  # names of several
    usual: Mapping[str, float] = field(default_factory=lambda: USUAL)  # sizes by key under [errors]

    @cached_property
    def ground(self) -> GroundSightings:
        """All targets (J), pass after pass."""
        return GroundSightings.together([one.ground for one in self.prepared])

    def column(self, name: str) -> Any:
        """A field of all targets (J, ...), pass after pass."""
        return np.concatenate([getattr(one, name) for one in self.prepared])

    @property
    def C(self) -> Floats:
        """Matrix of the camera of each target (J, 3, 3); of a single camera (3, 3)."""
        return matrix_of_each(self.R_cs, self.column("camera"))

    @property
    def pixel(self) -> Floats:
        """Angle (J, 1) of a pixel of each target's camera."""
        return np.broadcast_to(self.pixel_rad, len(self.cameras))[self.column("camera"), None]

    @property
    def number(self) -> Ints:
        """Pass (J,) of each target."""
        return np.repeat(np.arange(len(self.prepared)), [len(one.v_s) for one in self.prepared])

    def subject(self, row: int) -> Subject:
        """The observation of a row."""
        of, strip = self.ground, str(self.column("strip")[row])
        kind = Kind.STAR if of.is_star[row] else Kind.TARGET
        return Subject(kind, strip=strip, ccd=int(of.ccd[row]), id=str(of.target_id[row]))

    def in_c(self, change_s: Floats) -> Floats:
        """Vectors (J, 3) of frame s in the frame of each target's camera."""
        return turned(self.C, change_s)

    def looks(self) -> tuple[Floats, Floats]:
        """Look directions (J, 3), and what takes a small change of each to the part across it, (J, 3, 3)."""
        u_c = self.ground.u_c
        return u_c, np.eye(3) - u_c[:, :, None] * u_c[:, None, :]

    def shifts(self) -> Floats:
        """Change (2, J, 3) by looks that are a pixel too far along x and along y of c."""
        return self.pixel * np.moveaxis(self.looks()[1][:, :, :2], 2, 0)

    def turns(self) -> Floats:
        """Change (3, J, 3) by a rotation of an arc-second of the attitudes about each axis of c."""
        return np.moveaxis(ARCSEC * cross_matrices(self.in_c(self.column("v_s"))), 2, 0)


HypothesisTable = Callable[[HypothesisInputs], list[Hypothesis]]


# What an error concerns: in words, as subjects, and its targets (J,).
Place = tuple[str, tuple[Subject, ...], Bools]


def hypotheses(of: HypothesisInputs) -> list[Hypothesis]:
    """All hypotheses, those of many observations first: of two that explain the same the first is named."""
    found = [*_of_clock(of), *_of_position(of), *(_of_input(of, one) for one in of.inputs), *_of_looks(of)]
    found += _of_datum(of)
    if len(of.prepared) > 1:
        found += _in_each(_passes(of), _errors(of, "attitude or mounting", ABOUT_TRACK, of.turns()))
        found += _of_season(of)
        found += _in_each(_later_passes(of), _errors(of, "mounting moved", ABOUT_AXES, of.turns()))
        found += _in_each(_images(of), _errors(of, "image of a CCD", ("lines", "samples"), of.shifts()))
    found += [*_of_motion(of), *_of_lines(of)]
    if of.effects:
        found += _of_star_camera(of)
    return [one for one in found if np.any(one.moves_c)]


def vector_hypotheses(of: HypothesisInputs) -> list[Hypothesis]:
    """The hypotheses about vectors of frames, of which no camera, orbit or clock is known: they concern the
    axes, the scale and the attitudes. `pixel_rad` is the unit of shifts of the look vectors.
    """
    prepared, (u_c, _) = of.prepared, of.looks()
    every = _all("all frames", of)
    origin = _errors(of, "origin of the look vectors", ("x of c", "y of c"), of.shifts())
    # What aberration, light time or instants of `v_targets` do that differ from those of `v_stars`.
    attitude = _errors(of, "attitude and aberration of all frames", ABOUT_AXES, of.turns())
    found = list(_in_each(every, [*origin, *attitude]))
    if u_c[:, 2].min() > 0.0:
        found += _in_each(every, [replace(_focal_length(of), file="w_c", field="")])
    if 1 < len(prepared) <= MOST_FRAMES:
        frames = ((f"frame {s.strip_id}", (), here) for s, (*_, here) in zip(prepared, _passes(of)))
        found += _in_each(frames, _errors(of, "attitude of a frame", ABOUT_AXES, of.turns()))
    if of.effects:
        found += [
            replace(one, unit=one.unit.replace("px", "″"), file="u_s", field="", item="all frames")
            for one in _of_star_camera(of)
        ]
    return [one for one in found if np.any(one.moves_c)]


def _error(of: HypothesisInputs, cause: str, change_c: Floats) -> Hypothesis:
    """A row of `ERRORS` at all targets: where it is, a place says."""
    row = ERRORS.get(cause) or ERRORS[cause.partition(",")[0]]
    unit, usual, rarity, file, field_name, words = row
    key, usual = (usual, of.usual[usual]) if isinstance(usual, str) else ("", usual)
    attitudes = next((one.file for one in of.inputs if one.turns_s), "exposures.csv")
    return Hypothesis(
        cause=cause,
        unit=unit,
        words=words,
        file=file.format(attitudes=attitudes, targets=of.target_files),
        field=field_name,
        usual=usual,
        usual_of=key,
        rarity=rarity,
        rows=np.arange(len(change_c)),
        moves_c=change_c,
    )


def _errors(
    of: HypothesisInputs, cause: str, names: Sequence[str], changes_c: Iterable[Floats]
) -> list[Hypothesis]:
    """A row of `ERRORS` in each of some directions, by name, with the change (J, 3) that it makes."""
    return [_error(of, f"{cause}, {name}", change_c) for name, change_c in zip(names, changes_c)]


def _in_each(places: Iterable[Place], errors: Sequence[Hypothesis]) -> Iterator[Hypothesis]:
    """A hypothesis for each error, of all targets, in each place."""
    for item, subjects, here in places:
        rows = np.flatnonzero(here)
        for one in errors:
            yield replace(one, item=item, subjects=subjects, rows=rows, moves_c=one.moves_c[rows])


# --- Places


def _all(item: str, of: HypothesisInputs) -> list[Place]:
    return [(item, (), np.ones(len(of.number), dtype=bool))]


def _all_strips(of: HypothesisInputs) -> list[Place]:
    """All strips, where they are of several passes."""
    return _all("all strips", of) if len(of.prepared) > 1 else []


def _passes(of: HypothesisInputs) -> Iterator[Place]:
    for n, one in enumerate(of.prepared):
        strips = tuple(Subject(Kind.STRIP, strip=name) for name in np.unique(one.strip).tolist())
        yield f"{'pass of ' if len(strips) > 1 else ''}strip {one.strip_id}", strips, of.number == n


def _strips(of: HypothesisInputs, fewest: int = 1) -> Iterator[Place]:
    """Each strip of the passes that have so many at least."""
    strip = of.column("strip")
    for one in of.prepared:
        names = np.unique(one.strip).tolist()
        for name in names if len(names) >= fewest else ():
            subject = Subject(Kind.STRIP, strip=name)
            yield subject.words, (subject,), strip == name


def _images(of: HypothesisInputs) -> Iterator[Place]:
    """Each CCD in each strip of the passes that have several CCDs."""
    strip, ccd = of.column("strip"), of.ground.ccd
    for one in of.prepared:
        several = len(np.unique(one.ground.ccd)) > 1
        for name, number in sorted(set(zip(one.strip.tolist(), one.ground.ccd.tolist()))) if several else ():
            subject = Subject(Kind.CCD, strip=name, ccd=number)
            yield subject.words, (subject,), (strip == name) & (ccd == number)


def _cameras(of: HypothesisInputs) -> Iterator[Place]:
    """All looks of each camera."""
    camera = of.column("camera")
    for n, name in enumerate(of.cameras):
        subject = Subject(Kind.CCD, camera=name)
        yield subject.words, (subject,) if name else (), camera == n


def _later_passes(of: HypothesisInputs) -> Iterator[Place]:
    """All passes from one on, in order of time; from the second or the last on it is an error of one pass."""
    when = np.array([float(min(one.ground.t_s, default=np.inf)) for one in of.prepared])
    order = np.argsort(when, kind="stable")
    before = np.argsort(order, kind="stable")[of.number]  # (J,) how many passes came before
    for n in range(2, min(len(order) - 1, MOST_JUMPS)):
        subject = Subject(Kind.STRIP, strip=of.prepared[order[n]].strip_id)
        yield f"from {subject.words} on", (subject,), before >= n


# --- Times of rows


def _of_clock(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """Rows dated late, a period of the rows that is too long, and a clock that bends."""
    late = _late(of)
    long = _error(of, "row period", PERCENT / MILLI * _since_first_row(of)[:, None] * late.moves_c)
    curved = _error(of, "clock of the rows, curved", _bend(_part_of_pass(of))[:, None] * late.moves_c)
    yield from _in_each(_all_strips(of), [replace(late, field="utc_first_row, time_of_row"), long, curved])
    yield from _in_each([*_passes(of), *_strips(of, fewest=2)], [late, long, curved])


def _of_lines(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """Lines that are missing, or there twice, from a line of a strip on: in all its CCDs, or in one."""
    line, since = of.ground.xy_px[:, 1], _since_first_row(of)
    period = np.divide(since, line, out=np.zeros(len(line)), where=line > 0.0)[:, None]
    late = _error(of, "lines of a strip", -period / MILLI * _late(of).moves_c)
    for places, most in ((list(_strips(of)), OF_STRIP), (list(_images(of)), OF_CCD)):
        for item, subjects, here in places:
            for first in _breaks(line[here], min(most, MOST_BREAKS // len(places))):
                where = f"{item} from line {first:.0f} on", subjects, here & (line >= first)
                yield from _in_each([where], [late])


def _late(of: HypothesisInputs) -> Hypothesis:
    """Rows dated late by a millisecond."""
    return _error(of, "clock of the rows", of.in_c(-MILLI * of.column("late_s")))


def _since_first_row(of: HypothesisInputs) -> Floats:
    """Seconds (J,) from the first row of a strip to the rows of its targets; zero where one row is known."""
    line, t_s, since = of.ground.xy_px[:, 1], of.ground.t_s, np.zeros(len(of.number))
    for _, _, own in _strips(of):
        if np.ptp(line[own]) >= 1.0:
            first, last = np.flatnonzero(own)[[np.argmin(line[own]), np.argmax(line[own])]]
            since[own] = line[own] * ((t_s[last] - t_s[first]) / (line[last] - line[first]))
    return since


def _part_of_pass(of: HypothesisInputs) -> Floats:
    """Where (J,) targets lie in what their pass shows, 0 at its first and 1 at its last."""
    times = [one.ground.t_s for one in of.prepared]
    return np.concatenate([(t_s - t_s.min()) / max(float(np.ptp(t_s)), 1e-9) for t_s in times])


def _bend(part: Floats) -> Floats:
    return 4.0 * part * (1.0 - part)


def _breaks(line: Floats, most: int) -> list[float]:
    """Lines between which targets lie, so many at most, with two targets at least on either side."""
    rows = np.unique(np.round(line))
    middles = 0.5 * (rows[1:-2] + rows[2:-1])
    chosen = np.unique(np.linspace(0, len(middles) - 1, min(len(middles), most)).astype(int))
    return middles[chosen].tolist() if len(middles) and most else []


# --- Attitudes and mounting


def _of_season(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """A yearly variation of the mounting, of phases in equal steps from that of the first pass on."""
    t_s = of.ground.t_s
    years = (t_s - t_s.min()) / (365.25 * DAY_S)
    if years.max() < LEAST_YEARS or len(np.unique(np.floor(365.25 * years))) < FEWEST_DAYS:
        return
    first = Subject(Kind.STRIP, strip=of.column("strip")[np.argmin(t_s)])
    for n in range(PHASES):
        place = f"every pass, most {round(182.625 * n / PHASES)} days after {first.words}"
        profile = np.cos(2.0 * np.pi * years - np.pi * n / PHASES)[:, None]
        turns = _errors(of, "mounting varies with the season", ABOUT_AXES, of.turns())
        yield from _in_each(_all(place, of), [replace(one, moves_c=profile * one.moves_c) for one in turns])


def _of_motion(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """A drift, or a bend, of the mounting over a pass: in each of them alike, or in one."""
    places, part = [*_all("every pass", of), *_passes(of)], _part_of_pass(of)
    for what, profile in (("drifts", part - 0.5), ("bends", _bend(part))):
        turns = _errors(of, f"mounting {what}", ABOUT_AXES, of.turns())
        yield from _in_each(places, [replace(one, moves_c=profile[:, None] * one.moves_c) for one in turns])


# --- Positions on the ground and of the satellite


def _of_position(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """Positions of the satellite, or of all targets: a shift of one is the opposite shift of the other."""
    ground = ~of.ground.is_star[:, None]
    ahead, right, down = np.moveaxis(-of.C @ of.column("move_s"), 2, 0) * ground
    names = ("along the track", "across the track", "height")
    along, *rest = _errors(of, "orbit or targets", names, (ahead, right, -down))
    yield from _in_each(_all_strips(of), [along, *rest])
    # Along the track it is the clock of a pass, but for parts in a thousand.
    yield from _in_each(_passes(of), rest)


def _of_datum(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """Coordinates of targets that are all off alike: of a pass, of all, or of one of several references."""
    moves = np.moveaxis(-of.C @ of.column("reference_s"), 2, 0)
    errors = _errors(of, "datum of the targets", ("east", "north", "height"), moves)
    # The height of all, or of a pass, is that of the orbit.
    yield from _in_each([*_all_strips(of), *_passes(of)], errors[:2])
    name = of.ground.referenced().name
    names = np.unique(name).tolist()
    places = [(f"reference {one}", (), name == one) for one in names if one and len(names) > 1]
    yield from _in_each(places, [replace(one, field="reference") for one in errors])


def _of_input(of: HypothesisInputs, moved: MovedInput) -> Hypothesis:
    """An input whose effect was predicted: v_s moves by R_si du_i + psi x v_s."""
    change = []
    for one in of.prepared:
        dv_s, used = np.zeros_like(one.v_s), one.attitudes.usable
        directions_i, turns_s = moved.directions_i.get(one.strip_id), moved.turns_s.get(one.strip_id)
        if directions_i is not None:
            dv_s = dv_s + np.einsum("jab,jb->ja", one.R_si, directions_i)
        if turns_s is not None and len(turns_s) == len(used):  # else another head carries the strip
            dv_s = dv_s + np.cross(one.weights @ turns_s[used], one.v_s)
        change.append(-dv_s)
    stated = {one.name: getattr(moved, one.name) for one in fields(InputError)}
    moves_c = of.in_c(np.concatenate(change))
    return Hypothesis(**stated, rows=np.arange(len(moves_c)), moves_c=moves_c)


# --- Cameras


def _of_looks(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """Place, rotation, length and bend of each CCD; all of a camera shifted or distorted alike; its focal
    length.
    """
    ccd, camera, sample = of.ground.ccd, of.column("camera"), of.ground.xy_px[:, 0]
    axes, (x, y) = ("along the track", "across the track"), -of.shifts()
    every = list(_cameras(of))
    yield from _in_each(every, _errors(of, "place of the CCDs", axes, (x, y)))
    numbers, beside = sorted(set(zip(camera.tolist(), ccd.tolist()))), np.zeros((len(sample), 1))
    for n, number in numbers:
        here = (camera == n) & (ccd == number)
        pivot = (of.pivots or {}).get((of.cameras[n], number), float(sample[here].mean()))
        beside[here, 0] = sample[here] - pivot
    widest = [max(float(np.abs(beside[camera == n]).max(initial=0.0)), 1.0) for n in range(len(every))]
    at = beside / np.array(widest)[camera, None]  # -1 to 1 over the widest CCD of a camera
    if len(numbers) > len(every):  # of one CCD it is the length of that
        changes_c = np.moveaxis(legvander(at, DEGREES)[:, :, 1:] * y[:, :, None], 2, 0)
        names = tuple(f"degree {degree} over each CCD" for degree in range(1, DEGREES + 1))
        yield from _in_each(every, _errors(of, "distortion of the remote-sensing camera", names, changes_c))
    for n, number in numbers:
        if sum(one == n for one, _ in numbers) == 1:
            continue
        here = (camera == n) & (ccd == number)
        shapes = [
            _error(of, "rotation of a CCD", -MILLI * beside * x),
            _error(of, "length of a CCD", at * y),
            _error(of, "bend of a CCD", (at**2 - 1.0 / 3.0) * x),
        ]
        subject = Subject(Kind.CCD, camera=of.cameras[n], ccd=number)
        placed = _errors(of, "place of a CCD", axes, (x, y))
        yield from _in_each([(subject.words, (subject,), here)], [*placed, *shapes])
    yield from _in_each(every, [_focal_length(of)])


def _focal_length(of: HypothesisInputs) -> Hypothesis:
    """The focal length of the remote-sensing camera, by which all looks (J, 3) spread from its axis z."""
    u_c, across = of.looks()
    v = u_c / u_c[:, 2:]
    v[:, 2] = 0.0
    change = -PERCENT * np.einsum("jab,jb->ja", across, v) * u_c[:, 2:]
    return _error(of, "focal length of the remote-sensing camera", change)


def _of_star_camera(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """Parts of the star camera's model: they show in its stars, and turn the attitudes."""
    every = _all("all exposures", of)
    for k, part in enumerate(PARTS):
        what, comma, which = part.partition(",")
        change = [
            cross_matrices(one.v_s) @ (one.weights @ effect.psi[one.attitudes.usable, :, k])[:, :, None]
            for one, effect in zip(of.prepared, of.effects)
        ]
        change_c = (of.C @ np.concatenate(change))[:, :, 0]
        error = _error(of, f"{what} of the star camera{comma}{which}", change_c)
        yield from (replace(one, star_part=k) for one in _in_each(every, [error]))
