"""The table of hypotheses: what each error of an input, one unit large, does to the residuals of an estimate.

A hypothesis is a row: what it speaks of, the file and field that state the input, a unit, and the change of
every residual u_c - w (frame c, rad) if the input is stated one unit too large. Tests, findings, blind spots
and minimal detectable errors all follow from it (`reliability`); a further kind of error is a further row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.moved_input import MovedInput
from boresight.calib.star_camera_error import StarEffects
from boresight.calib.strips import PreparedStrip, matrix_of_each, turned
from boresight.geometry.attitude_estimate import cross_matrices
from boresight.geometry.constants import ARCSEC
from boresight.geometry.ledger import Kind, Subject
from boresight.geometry.record import Bools, Floats, array, record, scalar

__all__ = ["Hypothesis", "HypothesisInputs", "HypothesisTable", "hypotheses", "vector_hypotheses"]

# One thousandth: of a second, or of a radian, in units of hypotheses.
MILLI = 1e-3
# One hundredth, in units of hypotheses.
PERCENT = 1e-2
# Largest error of an input that is possible, by unit: an effect of light or of aberration is modelled or not
# (once too much); a focal length or a row period that is a third off is that of another camera; an orbit 100
# km away, or a CCD 10 000 pixels, changes the looks by more than the linear form holds for.
LARGEST = {"times": 3.0, "%": 33.0, "m": 1e5, "px": 1e4}
# Usual size of an error, in its unit, by the beginning of its cause: larger ones are rarer, a size x is less
# likely than a usual one by the factor 1 + x / usual. The mounting and attitudes are as stable as a structure
# that warms and cools; an orbit's velocity is known as its positions are. The first row that fits counts.
USUAL = {
    "clock of the exposures": 10.0,
    "clock of the rows, curved": 1.0,
    "clock of the rows": 10.0,
    "row period": 0.05,
    "lines": 1.0,
    "orbit or targets": 3.0,
    "velocity of the orbit": 1e-3,
    "attitude": 10.0,
    "mounting drifts": 1.0,
    "mounting": 10.0,
    "place of": 0.5,
    "rotation of a CCD": 0.5,
    "length of a CCD": 0.5,
    "bend of a CCD": 0.5,
    "image of a CCD": 0.5,
    "focal length": 0.05,
    "principal point": 1.0,
    "radial distortion": 1.0,
    "line of sight": 1.0,
    "reference": 3.0,
}
RARE = ("mounting", "lines of a strip", "clock of the rows, curved", "length of a CCD", "bend of a CCD")
RARER = 30.0  # times rarer than what is stated wrong by hand (set by hand)
SIZES = ("too large", "too small")  # a positive and a negative size in words
# Lines from which on lines may be missing: of all strips together, of a strip, of one CCD in a strip.
MOST_BREAKS, OF_STRIP, OF_CCD = 300, 33, 3
MOST_JUMPS = 12  # passes from which on the mounting may have moved
MOST_FRAMES = 50  # of vectors whose attitudes are tested one by one: the work grows with the square


@record(kw_only=True)
class Hypothesis:
    """One kind of error of one input."""

    cause: str = scalar('what is wrong: "clock of a strip"')
    item: str = scalar('what it concerns, in words: "strip s02"')
    subjects: tuple[Subject, ...] = scalar("the same as subjects; empty: all", default=())
    unit: str = scalar("of its size")
    words: tuple[str, str] = scalar(
        "a positive and a negative size in words, behind the number", default=SIZES
    )
    file: str = scalar("file of the dump that states the input")
    field: str = scalar("field of that file")
    change_c: Floats = array(
        "J, 3", "change of u_c - w by one unit, frame c, rad; J targets in order of strips"
    )
    star_part: int = scalar("which of `star_camera_error.PARTS` it is; -1: none", default=-1)
    most: float = scalar("largest size that is possible", default=np.inf)

    @property
    def largest(self) -> float:
        """Largest possible size: `most`, or what its unit allows; inf: none."""
        return min(self.most, LARGEST.get(self.unit, np.inf))

    @property
    def usual(self) -> float:
        """Usual size, in its unit; 1 where `USUAL` has none (effects that are there once or not)."""
        return next((size for cause, size in USUAL.items() if self.cause.startswith(cause)), 1.0)

    def price(self, size: float) -> float:
        """Minus twice the logarithm of how likely this error is in this size, beside a usual one."""
        return 2.0 * float(np.log1p(abs(size) / self.usual) + np.log(self.rarity))

    @property
    def rarity(self) -> float:
        """How much rarer its cause is than others."""
        return RARER if self.cause.startswith(RARE) else 1.0

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

    def in_c(self, change_s: Floats) -> Floats:
        """Vectors (J, 3) of frame s in the frame of each target's camera."""
        return turned(self.C, change_s)

    def looks(self) -> tuple[Floats, Floats]:
        """Look directions (J, 3), and what takes a small change of each to the part across it, (J, 3, 3)."""
        u_c: Floats = self.column("u_c")
        return u_c, np.eye(3) - u_c[:, :, None] * u_c[:, None, :]

    def turns(self) -> Floats:
        """Change (3, J, 3) by a rotation of an arc-second of the attitudes about each axis of c."""
        return np.moveaxis(ARCSEC * cross_matrices(self.in_c(self.column("v_s"))), 2, 0)


HypothesisTable = Callable[[HypothesisInputs], list[Hypothesis]]


@dataclass(frozen=True)
class _InputError:
    """One error of an input, one unit large, at all targets: where it is, a scope says."""

    cause: str
    unit: str
    words: tuple[str, str]
    file: str
    field: str
    change_c: Floats  # (J, 3)


# What an error concerns: in words, as subjects, and its targets (J,).
Place = tuple[str, tuple[Subject, ...], Bools]


def _in_each(places: Iterable[Place], errors: Sequence[_InputError]) -> Iterator[Hypothesis]:
    """A hypothesis for each error in each place of its scope."""
    for item, subjects, here in places:
        for one in errors:
            yield Hypothesis(
                cause=one.cause,
                item=item,
                subjects=subjects,
                unit=one.unit,
                words=one.words,
                file=one.file,
                field=one.field,
                change_c=one.change_c * here[:, None],
            )


def hypotheses(of: HypothesisInputs) -> list[Hypothesis]:
    """All hypotheses, those of many observations first: of two that explain the same the first is named."""
    found = [*_of_clock(of), *_of_position(of), *(_of_input(of, one) for one in of.inputs), *_of_looks(of)]
    if len(of.prepared) > 1:
        found += [*_of_attitude(of), *_of_mounting(of), *_of_images(of)]
    found += [*_of_drift(of), *_of_lines(of)]
    if of.effects:
        found += _of_star_camera(of)
    return [one for one in found if np.any(one.change_c)]


def vector_hypotheses(of: HypothesisInputs) -> list[Hypothesis]:
    """The hypotheses about vectors of frames (`from_vectors`): no camera, orbit or clock is known, so they
    concern the axes, the scale and the attitudes. `pixel_rad` is the unit of shifts of the look vectors.
    """
    prepared, (u_c, across) = of.prepared, of.looks()
    every = _all("all frames", prepared)
    turns = [
        _InputError(f"attitude of a frame, about {axis} of c", "″", SIZES, "v_stars, v_targets", "", turn)
        for axis, turn in zip("xyz", of.turns())
    ]
    origin = [
        _InputError(
            f"origin of the look vectors, {'xy'[axis]} of c", "″", SIZES, "w_c", "", of.pixel * column
        )
        for axis, column in enumerate(np.moveaxis(across, 2, 0)[:2])
    ]
    # What aberration, light time or instants of `v_targets` do that differ from those of `v_stars`.
    of_all = [
        replace(one, cause=one.cause.replace("of a frame", "and aberration of all frames")) for one in turns
    ]
    found = list(_in_each(every, [*origin, *of_all]))
    if u_c[:, 2].min() > 0.0:
        found += _in_each(every, [_focal_length(u_c, across, "w_c", "")])
    if 1 < len(prepared) <= MOST_FRAMES:
        frames = ((f"frame {s.strip_id}", (), here) for s, (*_, here) in zip(prepared, _passes(prepared)))
        found += _in_each(frames, turns)
    if of.effects:
        found += [
            replace(one, unit=one.unit.replace("px", "″"), file="u_s", field="", item="all frames")
            for one in _of_star_camera(of)
        ]
    return [one for one in found if np.any(one.change_c)]


def _passes(prepared: Sequence[PreparedStrip]) -> Iterator[Place]:
    """Each pass."""
    number = np.repeat(np.arange(len(prepared)), [len(one.ccd) for one in prepared])
    for n, one in enumerate(prepared):
        strips = tuple(Subject(Kind.STRIP, strip=name) for name in np.unique(one.strip).tolist())
        yield f"{'pass of ' if len(strips) > 1 else ''}strip {one.strip_id}", strips, number == n


def _all(item: str, prepared: Sequence[PreparedStrip]) -> list[Place]:
    """All targets."""
    return [(item, (), np.ones(sum(len(one.ccd) for one in prepared), dtype=bool))]


def _all_strips(prepared: Sequence[PreparedStrip]) -> list[Place]:
    """All strips, where they are of several passes."""
    return _all("all strips", prepared) if len(prepared) > 1 else []


def _strips_within(of: HypothesisInputs) -> Iterator[Place]:
    """Each strip of passes of several: errors of one strip's rows in strips.csv."""
    strip = of.column("strip")
    for one in of.prepared:
        names = np.unique(one.strip).tolist()
        for name in names if len(names) > 1 else ():
            yield f"strip {name}", (Subject(Kind.STRIP, strip=name),), strip == name


def _cameras(of: HypothesisInputs) -> Iterator[Place]:
    """All looks of each camera."""
    camera = of.column("camera")
    for n, name in enumerate(of.cameras):
        subject = Subject(Kind.CCD, camera=name)
        yield subject.words, (subject,) if name else (), camera == n


def _of_clock(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """Rows dated late, and a period of the rows that is too long."""
    late_c = of.in_c(-of.column("late_s"))  # rows dated late by 1 s
    since = np.concatenate([_since_first_row(one) for one in of.prepared])[:, None]
    late = _InputError(
        "clock of the rows", "ms", ("too late", "too early"), "strips.csv", "utc_first_row", MILLI * late_c
    )
    long = _InputError(
        "row period", "%", ("too long", "too short"), "strips.csv", "row_period_s", PERCENT * since * late_c
    )
    of_all = replace(late, field="utc_first_row, time_of_row")
    part = np.concatenate([_part_of_strip(one) for one in of.prepared])[:, None]
    curved = replace(
        late,
        cause="clock of the rows, curved",
        field="times",
        change_c=4.0 * part * (1.0 - part) * late.change_c,
    )
    yield from _in_each(_all_strips(of.prepared), [of_all, long, curved])
    yield from _in_each([*_passes(of.prepared), *_strips_within(of)], [late, long, curved])


def _since_first_row(strip: PreparedStrip) -> Floats:
    """Seconds (J,) from the first row of a strip to the rows of its targets; zero where one row is known."""
    since = np.zeros(len(strip.line))
    for name in np.unique(strip.strip):
        own = strip.strip == name
        line, t_s = strip.line[own], strip.t_s[own]
        if np.ptp(line) >= 1.0:
            first, last = np.argmin(line), np.argmax(line)
            since[own] = line * ((t_s[last] - t_s[first]) / (line[last] - line[first]))
    return since


def _part_of_strip(strip: PreparedStrip) -> Floats:
    """Where (J,) targets lie in what their strip shows of the ground, 0 at its first and 1 at its last."""
    part = np.zeros(len(strip.line))
    for name in np.unique(strip.strip):
        own = strip.strip == name
        part[own] = (strip.line[own] - strip.line[own].min()) / max(float(np.ptp(strip.line[own])), 1.0)
    return part


def _of_lines(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """Lines that are missing, or there twice, from a line of a strip on: in all its CCDs, or in one."""
    strip, ccd, line = of.column("strip"), of.column("ccd"), of.column("line")
    since = np.concatenate([_since_first_row(one) for one in of.prepared])
    period = np.divide(since, line, out=np.zeros(len(line)), where=line > 0.0)[:, None]
    late_c = of.in_c(-of.column("late_s")) * period
    names = np.unique(strip).tolist()
    cells = len(set(zip(strip.tolist(), ccd.tolist())))
    of_strip, of_ccd = min(OF_STRIP, MOST_BREAKS // len(names)), min(OF_CCD, MOST_BREAKS // cells)
    for name in names:
        own = strip == name
        numbers = np.unique(ccd[own]).tolist()
        places = [(own, Subject(Kind.STRIP, strip=name))]
        places += [
            (own & (ccd == n), Subject(Kind.CCD, strip=name, ccd=n)) for n in numbers if len(numbers) > 1
        ]
        for here, subject in places:
            for first in _breaks(line[here], of_strip if here is own else of_ccd):
                error = _InputError(
                    "lines of a strip",
                    "rows",
                    ("missing", "too many"),
                    "strips.csv",
                    "file",
                    -late_c * (line >= first)[:, None],
                )
                yield from _in_each(
                    [(f"{subject.words} from line {first:.0f} on", (subject,), here)], [error]
                )


def _breaks(line: Floats, most: int) -> list[float]:
    """Lines between which targets lie, so many at most, with two targets at least on either side."""
    rows = np.unique(np.round(line))
    middles = 0.5 * (rows[1:-2] + rows[2:-1])
    chosen = np.unique(np.linspace(0, len(middles) - 1, min(len(middles), most)).astype(int))
    return middles[chosen].tolist() if len(middles) and most else []


def _of_mounting(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """A jump of the mounting from one pass to the next, which stays."""
    number = np.repeat(np.arange(len(of.prepared)), [len(one.ccd) for one in of.prepared])
    when = np.array([float(one.t_s.min()) if len(one.t_s) else np.inf for one in of.prepared])
    order = np.argsort(when, kind="stable")
    later = np.argsort(order, kind="stable")[number]  # (J,) how many passes came before
    for n in range(2, min(len(order) - 1, MOST_JUMPS)):  # before or after one pass it is the attitude of that
        strip = of.prepared[order[n]].strip_id
        subject = Subject(Kind.STRIP, strip=strip)
        yield from _in_each(
            [(f"from strip {strip} on", (subject,), later >= n)], _turns(of, "mounting moved")
        )


def _of_drift(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """A drift of the mounting over a pass: in each of them alike, or in one."""
    part = np.concatenate(
        [(one.t_s - one.t_s.min()) / max(float(np.ptp(one.t_s)), 1e-9) - 0.5 for one in of.prepared]
    )
    drift = [replace(one, change_c=part[:, None] * one.change_c) for one in _turns(of, "mounting drifts")]
    yield from _in_each([*_all("every pass", of.prepared), *_passes(of.prepared)], drift)


def _turns(of: HypothesisInputs, what: str) -> list[_InputError]:
    """A rotation of the mounting by an arc-second about each axis of c."""
    return [
        _InputError(
            f"{what}, about {axis} of c",
            "″",
            ("forward", "backward"),
            "temperatures and manoeuvres",
            "",
            turn,
        )
        for axis, turn in zip("xyz", of.turns())
    ]


def _of_position(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """Positions of the satellite, or of all targets: a shift of one is the opposite shift of the other."""
    ground = ~of.column("is_star")[:, None]
    ahead, right, down = np.moveaxis(-of.C @ of.column("move_s"), 2, 0) * ground
    along, *rest = (
        _InputError(f"orbit or targets, {name}", "m", words, f"orbit, {of.target_files}", "", change)
        for name, words, change in (
            ("along the track", ("too far ahead", "too far back"), ahead),
            ("across the track", ("too far right", "too far left"), right),
            ("height", ("too high", "too low"), -down),
        )
    )
    yield from _in_each(_all_strips(of.prepared), [along, *rest])
    # Along the track it is the clock of a pass, but for parts in a thousand.
    yield from _in_each(_passes(of.prepared), rest)
    yield from _in_each(*_references(of))


def _references(of: HypothesisInputs) -> tuple[list[Place], list[_InputError]]:
    """Each ground reference, where targets have several, and its offset."""
    name, moves = of.column("reference"), np.moveaxis(of.C @ of.column("reference_s"), 2, 0)
    names = np.unique(name).tolist()
    places: list[Place] = [(f"reference {one}", (), name == one) for one in names if one and len(names) > 1]
    axes = (("east", ("east", "west")), ("north", ("north", "south")), ("height", SIZES))
    words = [(axis, tuple(f"too far {one}" for one in both)) for axis, both in axes[:2]] + [axes[2]]
    return places, [
        _InputError(f"ground reference, {axis}", "m", (more, less), of.target_files, "reference", change)
        for (axis, (more, less)), change in zip(words, moves)
    ]


def _of_input(of: HypothesisInputs, moved: MovedInput) -> Hypothesis:
    """An input whose effect was predicted: v_s moves by R_si du_i + psi x v_s."""
    change = []
    for one in of.prepared:
        dv_s = np.zeros((len(one.ccd), 3))
        directions_i, turns_s = moved.directions_i.get(one.strip_id), moved.turns_s.get(one.strip_id)
        if directions_i is not None:
            dv_s = dv_s + np.einsum("jab,jb->ja", one.R_si, directions_i)
        if turns_s is not None and len(turns_s) == len(one.used):  # else another head carries the strip
            dv_s = dv_s + np.cross(one.weights @ turns_s[one.used], one.v_s)
        change.append(-dv_s)
    return Hypothesis(
        cause=moved.cause,
        item=moved.item,
        subjects=moved.subjects,
        unit=moved.unit,
        words=moved.words,
        file=moved.file,
        field=moved.field,
        most=moved.most,
        change_c=of.in_c(np.concatenate(change)),
    )


def _of_looks(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """Shifts and rotation of each CCD, all of a camera shifted alike, and its focal length."""
    (u_c, across), ccd, camera = of.looks(), of.column("ccd"), of.column("camera")
    sample, file, pixel_rad = of.column("sample"), "remote_camera.toml", of.pixel
    x, y = across[:, :, 0], across[:, :, 1]

    def placed(what: str) -> list[_InputError]:
        return [
            _InputError(
                f"place of {what}, along the track", "px", SIZES, file, "x_offset_mm", -pixel_rad * x
            ),
            _InputError(
                f"place of {what}, across the track", "px", SIZES, file, "y_first_mm", -pixel_rad * y
            ),
        ]

    every = list(_cameras(of))
    yield from _in_each(every, placed("the CCDs"))
    numbers = sorted(set(zip(camera.tolist(), ccd.tolist())))
    for n, number in numbers:
        if sum(one == n for one, _ in numbers) == 1:
            continue
        here, name = (camera == n) & (ccd == number), of.cameras[n]
        pivot = (of.pivots or {}).get((name, number), float(sample[here].mean()))
        arm = MILLI * pixel_rad * (sample - pivot)[:, None]
        turn = _InputError("rotation of a CCD", "mrad", SIZES, file, "rotation_mrad", arm * x)
        subject = Subject(Kind.CCD, camera=name, ccd=number)
        half = max(float(np.ptp(sample[here])) / 2.0, 1.0)
        at = (sample - float(sample[here].min() + half))[:, None] / half
        shapes = [
            _InputError("length of a CCD", "px", SIZES, file, "pixel_pitch_um", -pixel_rad * at * y),
            _InputError(
                "bend of a CCD", "px", SIZES, file, "look directions", -pixel_rad * (at**2 - 1.0 / 3.0) * x
            ),
        ]
        yield from _in_each([(subject.words, (subject,), here)], [*placed("a CCD"), turn, *shapes])
    yield from _in_each(every, [_focal_length(u_c, across, file, "focal_length_m")])


def _focal_length(u_c: Floats, across: Floats, file: str, field: str) -> _InputError:
    """The focal length of the remote-sensing camera, by which all looks (J, 3) spread from its axis z."""
    v = u_c / u_c[:, 2:]
    v[:, 2] = 0.0
    change = -PERCENT * np.einsum("jab,jb->ja", across, v) * u_c[:, 2:]
    cause = "focal length of the remote-sensing camera"
    return _InputError(cause, "%", ("too long", "too short"), file, field, change)


def _of_attitude(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """Attitude of a pass about the axes of c; about y it is its clock, too."""
    attitudes = next((one.file for one in of.inputs if one.turns_s), "exposures.csv")
    x, y, z = of.turns()
    names = (("across the track", x), ("along the track", y), ("about the line of sight", z))
    file = f"{attitudes}, orbit"
    turns = [
        _InputError(f"attitude or mounting, {name}", "″", SIZES, file, "", change) for name, change in names
    ]
    yield from _in_each(_passes(of.prepared), turns)


def _of_images(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """Shifts of the image of one CCD in one strip, of a pass that has several CCDs."""
    (_, across), strip, ccd = of.looks(), of.column("strip"), of.column("ccd")
    several = [one for one in of.prepared if len(np.unique(one.ccd)) > 1]
    images = [key for one in several for key in sorted(set(zip(one.strip.tolist(), one.ccd.tolist())))]
    subjects = [Subject(Kind.CCD, strip=name, ccd=number) for name, number in images]
    places = ((one.words, (one,), (strip == one.strip) & (ccd == one.ccd)) for one in subjects)
    names = (("lines", across[:, :, 0]), ("samples", across[:, :, 1]))
    shifts = [
        _InputError(f"image of a CCD, {name}", "px", SIZES, "strips.csv", "file", of.pixel * change)
        for name, change in names
    ]
    yield from _in_each(places, shifts)


def _of_star_camera(of: HypothesisInputs) -> Iterator[Hypothesis]:
    """Parts of the star camera's model: they show in its stars, and turn the attitudes."""
    rows = (
        ("focal length of the star camera", "%", "focal_length_mm", ("too long", "too short")),
        ("principal point of the star camera, column", "px", "principal_point_px", SIZES),
        ("principal point of the star camera, row", "px", "principal_point_px", SIZES),
        ("radial distortion of the star camera", "px at its corner", "q1_per_mm2", SIZES),
    )
    every = _all("all exposures", of.prepared)
    for k, (cause, unit, field, words) in enumerate(rows):
        change = [
            cross_matrices(one.v_s) @ (one.weights @ effect.psi[one.used, :, k])[:, :, None]
            for one, effect in zip(of.prepared, of.effects)
        ]
        change_c = (of.C @ np.concatenate(change))[:, :, 0]
        error = _InputError(cause, unit, words, "star_camera.toml", field, change_c)
        yield from (replace(one, star_part=k) for one in _in_each(every, [error]))
