"""The table of hypotheses: what each error of an input, one unit large, does to the residuals of an estimate.

A hypothesis is a row: what it speaks of, the file and field that state the input, a unit, and the change of
every residual u_c - w (frame c, rad) if the input is stated one unit too large. Tests, findings, blind spots
and minimal detectable errors all follow from it (`reliability`); a further kind of error is a further row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.moved_input import MovedInput
from boresight.calib.star_camera_error import StarEffects
from boresight.calib.strips import PreparedStrip
from boresight.geometry.attitude_estimate import cross_matrices
from boresight.geometry.constants import ARCSEC
from boresight.geometry.ledger import Kind, Subject
from boresight.geometry.record import Bools, Floats, Ints, array, record, scalar

__all__ = ["Hypothesis", "HypothesisInputs", "HypothesisTable", "hypotheses", "vector_hypotheses"]

# One thousandth: of a second, or of a radian, in units of hypotheses.
MILLI = 1e-3
# One hundredth, in units of hypotheses.
PERCENT = 1e-2
# Largest error of an input that is possible, by unit: an effect of light or of aberration is modelled or not
# (once too much); a focal length or a row period that is a third off is that of another camera; an orbit 100
# km away, or a CCD 10 000 pixels, changes the looks by more than the linear form holds for.
LARGEST = {"times": 3.0, "%": 33.0, "m": 1e5, "px": 1e4}
MOST_FRAMES = 50  # of vectors whose attitudes are tested one by one: the work grows with the square


@record(kw_only=True)
class Hypothesis:
    """One kind of error of one input."""

    cause: str = scalar('what is wrong: "clock of a strip"')
    item: str = scalar('what it concerns, in words: "strip s02"')
    subjects: tuple[Subject, ...] = scalar("the same as subjects; empty: all", default=())
    unit: str = scalar("of its size")
    words: tuple[str, str] = scalar(
        "a positive and a negative size in words, behind the number", default=("too large", "too small")
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
    def remedy(self) -> str:
        """What to look at."""
        return f"check {self.field} in {self.file}" if self.field else f"check {self.file}"


@dataclass(frozen=True)
class HypothesisInputs:
    """What a table of hypotheses is computed from."""

    prepared: Sequence[PreparedStrip]  # as they enter the solution
    R_cs: Rotation  # the estimate
    pixel_rad: float  # of the remote-sensing camera
    effects: Sequence[StarEffects] = ()  # errors of the star camera, by strip; none: attitudes were delivered
    inputs: Sequence[MovedInput] = ()  # what moves in the prediction with further inputs
    pivots: Mapping[int, float] | None = None  # samples about which CCDs rotate; else: their mean
    target_files: str = "targets.csv"  # files of the dump with the coordinates of the targets


HypothesisTable = Callable[[HypothesisInputs], list[Hypothesis]]


def hypotheses(of: HypothesisInputs) -> list[Hypothesis]:
    """All hypotheses, those of many observations first: of two that explain the same the first is named."""
    prepared, pixel_rad = of.prepared, of.pixel_rad
    C = of.R_cs.as_matrix()
    strip = np.repeat(np.arange(len(prepared)), [len(one.ccd) for one in prepared])
    ccd = np.concatenate([one.ccd for one in prepared])
    late_c = -np.concatenate([one.late_s for one in prepared]) @ C.T  # rows dated late by 1 s
    ground = ~np.concatenate([one.is_star for one in prepared])
    found = [*_of_clock(prepared, strip, late_c), *_of_position(of, strip, ground)]
    found += [_of_input(prepared, C, one) for one in of.inputs]
    found += _of_looks(prepared, ccd, pixel_rad, of.pivots or {})
    attitudes = next((one.file for one in of.inputs if one.turns_s), "exposures.csv")
    found += _of_attitude(prepared, strip, C, attitudes)
    found += _of_images(prepared, strip, ccd, pixel_rad)
    if of.effects:
        found += _of_star_camera(prepared, C, of.effects)
    return [one for one in found if np.any(one.change_c)]


def vector_hypotheses(of: HypothesisInputs) -> list[Hypothesis]:
    """The hypotheses about vectors of frames (`from_vectors`): no camera, orbit or clock is known, so they
    concern the axes, the scale and the attitudes. `pixel_rad` is the unit of shifts of the look vectors.
    """
    prepared, pixel_rad = of.prepared, of.pixel_rad
    C = of.R_cs.as_matrix()
    u_c = np.concatenate([one.u_c for one in prepared])
    across = np.eye(3) - u_c[:, :, None] * u_c[:, None, :]
    found = [
        Hypothesis(
            cause=f"origin of the look vectors, {'xy'[axis]} of c",
            item="all frames",
            unit="″",
            file="w_c",
            field="",
            change_c=pixel_rad * across[:, :, axis],
        )
        for axis in range(2)
    ]
    if u_c[:, 2].min() > 0.0:
        found.append(_focal_length(u_c, across, "w_c", "", "all frames"))
    if 1 < len(prepared) <= MOST_FRAMES:
        w = np.concatenate([one.v_s for one in prepared]) @ C.T
        frame, turned = (
            np.repeat(np.arange(len(prepared)), [len(one.ccd) for one in prepared]),
            cross_matrices(w),
        )
        found += [
            Hypothesis(
                cause=f"attitude of a frame, about {'xyz'[axis]} of c",
                item=f"frame {one.strip_id}",
                unit="″",
                file="v_stars, v_targets",
                field="",
                change_c=ARCSEC * turned[:, :, axis] * (frame == n)[:, None],
            )
            for n, one in enumerate(prepared)
            for axis in range(3)
        ]
    if of.effects:
        found += [
            replace(one, unit=one.unit.replace("px", "″"), file="u_s", field="", item="all frames")
            for one in _of_star_camera(prepared, C, of.effects)
        ]
    return [one for one in found if np.any(one.change_c)]


def _each(prepared: Sequence[PreparedStrip]) -> Iterator[tuple[str, tuple[Subject, ...], list[int]]]:
    """All strips, then each strip: in words, as subjects, and their numbers."""
    if len(prepared) > 1:
        yield "all strips", (), list(range(len(prepared)))
    for n, strip in enumerate(prepared):
        subject = Subject(Kind.STRIP, strip=strip.strip_id)
        yield subject.words, (subject,), [n]


def _of_clock(prepared: Sequence[PreparedStrip], strip: Ints, late_c: Floats) -> Iterator[Hypothesis]:
    """Rows dated late, and a period of the rows that is too long."""
    since = np.concatenate([_since_first_row(one) for one in prepared])
    for item, subjects, members in _each(prepared):
        here = np.isin(strip, members)[:, None]
        several = len(members) > 1
        yield Hypothesis(
            cause="clock of the rows",
            item=item,
            subjects=subjects,
            unit="ms",
            words=("too late", "too early"),
            file="strips.csv",
            field="utc_first_row" + (", time_of_row" if several else ""),
            change_c=MILLI * late_c * here,
        )
        yield Hypothesis(
            cause="row period",
            item=item,
            subjects=subjects,
            unit="%",
            words=("too long", "too short"),
            file="strips.csv",
            field="row_period_s",
            change_c=PERCENT * since[:, None] * late_c * here,
        )


def _since_first_row(strip: PreparedStrip) -> Floats:
    """Seconds (J,) from the first row of a strip to the rows of its targets; zero where one row is known."""
    if np.ptp(strip.line) < 1.0:
        return np.zeros(len(strip.line))
    first, last = np.argmin(strip.line), np.argmax(strip.line)
    period = (strip.t_s[last] - strip.t_s[first]) / (strip.line[last] - strip.line[first])
    return np.asarray(strip.line * period)


def _of_position(of: HypothesisInputs, strip: Ints, ground: Bools) -> Iterator[Hypothesis]:
    """Positions of the satellite, or of all targets: a shift of one is the opposite shift of the other."""
    move_c = -of.R_cs.as_matrix() @ np.concatenate([one.move_s for one in of.prepared])
    axes = (
        ("along the track", 1.0, ("too far ahead", "too far back")),
        ("across the track", 1.0, ("too far right", "too far left")),
        ("height", -1.0, ("too high", "too low")),
    )
    for item, subjects, members in _each(of.prepared):
        here = (np.isin(strip, members) & ground)[:, None]
        for axis, (name, sign, words) in enumerate(axes):
            if len(members) == 1 and axis == 0:
                continue  # the clock of the strip, but for parts in a thousand
            yield Hypothesis(
                cause=f"orbit or targets, {name}",
                item=item,
                subjects=subjects,
                unit="m",
                words=words,
                file=f"orbit, {of.target_files}",
                field="",
                change_c=sign * move_c[:, :, axis] * here,
            )


def _of_input(prepared: Sequence[PreparedStrip], C: Floats, moved: MovedInput) -> Hypothesis:
    """An input whose effect was predicted: v_s moves by R_si du_i + psi x v_s."""
    change = []
    for one in prepared:
        dv_s = np.zeros((len(one.ccd), 3))
        directions_i, turns_s = moved.directions_i.get(one.strip_id), moved.turns_s.get(one.strip_id)
        if directions_i is not None:
            dv_s = dv_s + np.einsum("jab,jb->ja", one.R_si, directions_i)
        if turns_s is not None and len(turns_s) == len(one.used):  # else another head carries the strip
            dv_s = dv_s + np.cross(one.weights @ turns_s[one.used], one.v_s)
        change.append(-dv_s @ C.T)
    return Hypothesis(
        cause=moved.cause,
        item=moved.item,
        subjects=moved.subjects,
        unit=moved.unit,
        words=moved.words,
        file=moved.file,
        field=moved.field,
        most=moved.most,
        change_c=np.concatenate(change),
    )


def _of_looks(
    prepared: Sequence[PreparedStrip], ccd: Ints, pixel_rad: float, pivots: Mapping[int, float]
) -> Iterator[Hypothesis]:
    """Shifts and rotation of each CCD, all shifted alike, and the focal length."""
    u_c = np.concatenate([one.u_c for one in prepared])
    across = np.eye(3) - u_c[:, :, None] * u_c[:, None, :]
    sample = np.concatenate([one.sample for one in prepared])
    numbers = np.unique(ccd).tolist()
    for number in (None, *(numbers if len(numbers) > 1 else ())):
        here = np.ones(len(ccd), dtype=bool) if number is None else ccd == number
        ccd_subject = Subject(Kind.CCD, ccd=-1 if number is None else number)
        arm = (sample - pivots.get(number or 0, float(sample[here].mean()))) * here
        rows = (
            ("place", ", along the track", "px", "x_offset_mm", -pixel_rad * here, 0),
            ("place", ", across the track", "px", "y_first_mm", -pixel_rad * here, 1),
            ("rotation", "", "mrad", "rotation_mrad", MILLI * pixel_rad * arm, 0),
        )
        for part, axis_name, unit, field, size, axis in rows if number is not None else rows[:2]:
            yield Hypothesis(
                cause=f"{part} of {'the CCDs' if number is None else 'a CCD'}{axis_name}",
                item=ccd_subject.words,
                subjects=() if number is None else (ccd_subject,),
                unit=unit,
                file="remote_camera.toml",
                field=field,
                change_c=size[:, None] * across[:, :, axis],
            )
    yield _focal_length(u_c, across, "remote_camera.toml", "focal_length_m", "all CCDs")


def _focal_length(u_c: Floats, across: Floats, file: str, field: str, item: str) -> Hypothesis:
    """The focal length of the remote-sensing camera, by which all looks (J, 3) spread from its axis z."""
    v = u_c / u_c[:, 2:]
    v[:, 2] = 0.0
    return Hypothesis(
        cause="focal length of the remote-sensing camera",
        item=item,
        unit="%",
        words=("too long", "too short"),
        file=file,
        field=field,
        change_c=-PERCENT * np.einsum("jab,jb->ja", across, v) * u_c[:, 2:],
    )


def _of_attitude(
    prepared: Sequence[PreparedStrip], strip: Ints, C: Floats, attitudes: str
) -> Iterator[Hypothesis]:
    """Attitude of a strip about the axes x and z of c; about y it is the strip's clock."""
    if len(prepared) < 2:
        return
    w = np.concatenate([one.v_s for one in prepared]) @ C.T
    turned = cross_matrices(w)
    for n, one in enumerate(prepared):
        for axis, name in ((0, "across the track"), (2, "about the line of sight")):
            yield Hypothesis(
                cause=f"attitude {name}",
                item=f"strip {one.strip_id}",
                subjects=(Subject(Kind.STRIP, strip=one.strip_id),),
                unit="″",
                file=f"{attitudes}, orbit",
                field="",
                change_c=ARCSEC * turned[:, :, axis] * (strip == n)[:, None],
            )


def _of_images(
    prepared: Sequence[PreparedStrip], strip: Ints, ccd: Ints, pixel_rad: float
) -> Iterator[Hypothesis]:
    """Shifts of the image of one CCD in one strip."""
    u_c = np.concatenate([one.u_c for one in prepared])
    across = np.eye(3) - u_c[:, :, None] * u_c[:, None, :]
    for n, one in enumerate(prepared):
        numbers = np.unique(one.ccd).tolist()
        for number in numbers if len(numbers) > 1 and len(prepared) > 1 else ():
            here = pixel_rad * ((strip == n) & (ccd == number))
            subject = Subject(Kind.CCD, strip=one.strip_id, ccd=number)
            for axis, name in ((0, "lines"), (1, "samples")):
                yield Hypothesis(
                    cause=f"image of a CCD, {name}",
                    item=subject.words,
                    subjects=(subject,),
                    unit="px",
                    file="strips.csv",
                    field="file",
                    change_c=here[:, None] * across[:, :, axis],
                )


def _of_star_camera(
    prepared: Sequence[PreparedStrip], C: Floats, effects: Sequence[StarEffects]
) -> Iterator[Hypothesis]:
    """Parts of the star camera's model: they show in its stars, and turn the attitudes."""
    rows = (
        ("focal length of the star camera", "%", "focal_length_mm", ("too long", "too short")),
        (
            "principal point of the star camera, column",
            "px",
            "principal_point_px",
            ("too large", "too small"),
        ),
        ("principal point of the star camera, row", "px", "principal_point_px", ("too large", "too small")),
        (
            "radial distortion of the star camera",
            "px at its corner",
            "q1_per_mm2",
            ("too large", "too small"),
        ),
    )
    for k, (cause, unit, field, words) in enumerate(rows):
        change = [
            C @ (cross_matrices(one.v_s) @ (one.weights @ effect.psi[one.used, :, k])[:, :, None])
            for one, effect in zip(prepared, effects)
        ]
        yield Hypothesis(
            cause=cause,
            item="all exposures",
            unit=unit,
            words=words,
            file="star_camera.toml",
            field=field,
            change_c=np.concatenate(change)[:, :, 0],
            star_part=k,
        )
