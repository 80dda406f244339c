"""Single targets that contradict the rest: where each lies, and what several of them have in common."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import xlogy

from boresight.calib.finding import Finding
from boresight.calib.reliability import Contradiction
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef, local_axes_e
from boresight.geometry.pushbroom import Pushbroom
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, compass, displaced_m, pushbroom_of
from boresight.pipeline.stages.strip_tasks import fitting_slip
from boresight.records.ledger import Kind, Ledger, Subject, list_words
from boresight.records.record import Bools

__all__ = ["MeasuredTargets", "single_targets"]

FEWEST = 3  # targets that make a pattern
ALIKE_SIGMAS = 5.0  # of a target, within which those of a part of a strip, or of several CCDs, are off alike
MOSTLY = 0.7  # of a group, that are off alike
SUSPECT_SHARE = 0.05  # of good data with wrong coordinates or chips; only compares groups
# Log likelihood that a share of suspected targets of its own must gain a group, to be one (set by hand).
GROUP_PENALTY = 3.0


@dataclass(frozen=True)
class MeasuredTargets:
    """Where strips of the ground show their targets."""

    tasks: Mapping[str, StripTask]  # strips by id, with the estimated matrix
    xy_px: Mapping[Subject, tuple[float, ...]]  # (sample, line) by target

    @classmethod
    def of(
        cls, tasks: Sequence[StripTask], matched: Sequence[MatchedTargets], R_cs: Rotation
    ) -> MeasuredTargets:
        """Targets that were matched, and those that contradict the others of their strips."""
        xy_px: dict[Subject, tuple[float, ...]] = {}
        for strip in matched:
            for name, ccd, place in zip(strip.target_id.tolist(), strip.ccd.tolist(), strip.xy_px.tolist()):
                xy_px[Subject(Kind.TARGET, strip=strip.strip_id, ccd=ccd, id=name)] = tuple(place)
            xy_px |= {entry.subject: entry.xy_px for entry in strip.contradicting}
        known = {"R_cs": R_cs, "sigma_installation_rad": np.zeros(3)}  # beside what a target is off
        return cls({task.strip.strip_id: replace(task, **known) for task in tasks}, xy_px)

    @cached_property
    def models(self) -> dict[str, Pushbroom]:
        """Rigorous models of the strips."""
        return {strip_id: pushbroom_of(task) for strip_id, task in self.tasks.items()}

    def is_point(self, subject: Subject) -> bool:
        """Whether a target is a point that others measured: without a chip."""
        points = self.tasks[subject.strip].points.targets
        return any(target.target_id == subject.id for target in points)

    def slip(self, subject: Subject) -> str:
        """What would have to be read for the coordinates of a measured point, behind a semicolon."""
        task = self.tasks[subject.strip]
        every = zip(task.points.targets, task.points.ccd.tolist())
        point = next(one for one, ccd in every if (one.target_id, ccd) == (subject.id, subject.ccd))
        return fitting_slip(task, point, subject.ccd, np.array(self.xy_px[subject]))

    def displaced(self, suspect: Contradiction) -> tuple[float, float, float]:
        """How far a stated place lies east and north of the true one, and the 1-sigma of that distance, m."""
        subject = suspect.subject
        model, xy_px = self.models[subject.strip], self.xy_px[subject]
        p_e = self.tasks[subject.strip].places[subject.id].p_e
        stated_m = np.array(displaced_m(model, p_e, subject.ccd, xy_px))
        t_s = np.asarray(model.instants_of_lines(subject.ccd, np.array([xy_px[1]])))
        lat, lon, _ = geodetic_from_ecef(p_e[None], WGS84)
        axes_i = model.earth.matrices_ie(t_s)[0] @ local_axes_e(lat, lon)[0]
        axes_o = self.tasks[subject.strip].orbit.R_oi(t_s).as_matrix()[0] @ axes_i
        off_m, covariance = suspect.displaced_m(stated_m, axes_o[:, :2])
        along = off_m / max(float(np.hypot(*off_m)), 1e-9)
        return float(off_m[0]), float(off_m[1]), float(np.sqrt(along @ covariance @ along))


def single_targets(
    suspects: Sequence[Contradiction],
    measured: MeasuredTargets,
    ledger: Ledger,
    *,
    is_explained: bool = False,
) -> Iterator[Finding]:
    """A finding for each target of the ground that is off, for those of a part of a strip that are off alike
    and, where more than three of a strip, of a CCD or of a CCD in one strip are, for that group, or for those
    of several CCDs that are off alike; none for groups where a common cause is found already. The ledger
    holds all targets in view.
    """
    rest = [suspect for suspect in suspects if suspect.subject in measured.xy_px]
    for alike in _stretches(rest, measured):
        yield _of_stretch(alike, measured)
        rest = [suspect for suspect in rest if suspect not in alike]
    found: dict[tuple[str, bool], dict[Subject, list[Contradiction]]] = defaultdict(dict)
    for group in _groups([suspect.subject for suspect in rest], ledger):
        found[group.strip, group.ccd >= 0][group] = [one for one in rest if _holds(group, one.subject)]
        rest = [suspect for suspect in rest if not _holds(group, suspect.subject)]
    for groups in () if is_explained else found.values():
        every = [one for those in groups.values() for one in those]
        alike = [one for one, is_near in zip(every, _near_middle(every, measured).tolist()) if is_near]
        if len(alike) > MOSTLY * len(every) and len({one.subject.ccd for one in alike}) > 1:
            yield _of_displaced(alike, measured)
        else:
            subjects = {group: [one.subject for one in those] for group, those in groups.items()}
            yield _of_groups(subjects, of_points=measured.is_point(every[0].subject))
    of_target: dict[str, list[Contradiction]] = defaultdict(list)
    for suspect in rest:
        of_target[suspect.subject.id].append(suspect)
    yield from (_of_target(those, measured) for those in of_target.values())


def _stretches(suspects: Sequence[Contradiction], measured: MeasuredTargets) -> Iterator[list[Contradiction]]:
    """Those of a strip, three at least, between whose lines it shows no other target, that are off alike."""
    off = {suspect.subject: suspect for suspect in suspects}
    for strip in sorted({subject.strip for subject in off}):
        shown = sorted(
            (one for one in measured.xy_px if one.strip == strip), key=lambda one: measured.xy_px[one][1]
        )
        for is_off, part in groupby(shown, off.__contains__):
            those = [off[name] for name in part] if is_off else []
            if not FEWEST <= len(those) < len(shown):
                continue
            if _near_middle(those, measured).all():
                yield those


def _near_middle(those: Sequence[Contradiction], measured: MeasuredTargets) -> Bools:
    """Which targets (N,) are off as their median is."""
    off_m = np.array([measured.displaced(one) for one in those])
    middle = np.median(off_m[:, :2], axis=0)
    return np.asarray(np.hypot(*(off_m[:, :2] - middle).T) < ALIKE_SIGMAS * off_m[:, 2])


def _of_stretch(those: Sequence[Contradiction], measured: MeasuredTargets) -> Finding:
    """Targets of a part of a strip that are off alike: its lines or attitudes, not their coordinates."""
    first, last = (measured.xy_px[one.subject][1] for one in (those[0], those[-1]))
    one, where = _of_target(those, measured), Subject(Kind.STRIP, strip=those[0].subject.strip).words
    return replace(
        one,
        cause="lines or attitudes of a part of a strip",
        item=f"{where}, lines {first:.0f} to {last:.0f}",
        text=f"all {len(those)} targets there are off alike, by {one.value:.3g} m: check file in strips.csv.",
        file="strips.csv",
        field="file",
    )


def _of_displaced(those: Sequence[Contradiction], measured: MeasuredTargets) -> Finding:
    """Targets on several CCDs that are off alike: their coordinates."""
    east_m, north_m, _ = np.median([measured.displaced(one) for one in those], axis=0).tolist()
    one, strips = _of_target(those, measured), sorted({suspect.subject.strip for suspect in those})
    look_at = f"{one.field} in {one.file}{'' if measured.is_point(those[0].subject) else ' and the chips'}"
    if [subject.strip for subject in measured.xy_px].count(strips[0]) == len(those):  # a whole strip
        look_at += "; or utc_first_row in strips.csv"
    return replace(
        one,
        item=f"{len(those)} targets in strip{'s' * (len(strips) > 1)} {list_words(strips)}",
        text=f"all lie about {compass(east_m, north_m)} of the true place: check {look_at}.",
        value=float(np.hypot(east_m, north_m)),
    )


def _of_target(those: Sequence[Contradiction], measured: MeasuredTargets) -> Finding:
    """One target that is off, in one strip or in several."""
    worst = max(those, key=lambda suspect: suspect.distance)
    subject, strips = worst.subject, [suspect.subject.strip for suspect in those]
    east_m, north_m, sigma_m = measured.displaced(worst)
    is_point = measured.is_point(subject)
    file, what = ("points.csv", "it lies") if is_point else ("targets.csv", "its chip or coordinates lie")
    advice = measured.slip(subject) if is_point else ""
    advice = advice or f": check {file}{'' if is_point else ' and the chip'}"
    return Finding(
        cause="coordinates" if is_point else "coordinates or chip",
        item=f"target {subject.id} (strip{'s' if len(strips) > 1 else ''} {', '.join(strips)})",
        subjects=tuple(replace(suspect.subject, ccd=-1) for suspect in those),
        text=f"{what} about {compass(east_m, north_m)} of the true place ({worst.distance:.1f} σ){advice}.",
        value=float(np.hypot(east_m, north_m)),
        sigma=sigma_m,
        unit="m",
        file=file,
        field="lat_deg, lon_deg",
        explains=tuple(suspect.subject for suspect in those),
    )


EVERY = Subject(Kind.TARGET)  # the group of all targets


def _holds(group: Subject, target: Subject) -> bool:
    return group == EVERY or group.holds(target)


def _groups(suspected: Sequence[Subject], ledger: Ledger) -> list[Subject]:
    """What more than three targets that are off have in common: all, strips, CCDs or CCDs in one strip,
    whichever explains most. The gain of a group is that of the likelihood if it has a share of its own, less
    a penalty.
    """
    kinds: list[set[Subject]] = [
        {EVERY},
        {Subject(Kind.STRIP, strip=target.strip) for target in suspected},
        {Subject(Kind.CCD, ccd=target.ccd) for target in suspected},
        {Subject(Kind.CCD, strip=target.strip, ccd=target.ccd) for target in suspected},
    ]
    best, most = list[Subject](), 0.0
    for kind in kinds:
        sizes = {group: sum(_holds(group, target) for target in suspected) for group in kind}
        crowded = [group for group in kind if sizes[group] > FEWEST]
        crowded.sort(key=lambda group: (-sizes[group], group.name))
        in_view = {g: len(ledger.ccd) if g == EVERY else int(ledger.within([g]).sum()) for g in crowded}
        gain = sum(_gain(sizes[group], in_view[group]) for group in crowded)
        if gain > most:
            best, most = crowded, gain
    return best


def _gain(k: int, n: int) -> float:
    """Of the logarithm of the likelihood, if k of n targets are off with a share of their own."""
    n = max(k, n)
    own = float(xlogy(k, k / n / SUSPECT_SHARE) + xlogy(n - k, (1.0 - k / n) / (1.0 - SUSPECT_SHARE)))
    return own - GROUP_PENALTY


def _of_groups(groups: Mapping[Subject, Sequence[Subject]], *, of_points: bool) -> Finding:
    """Targets that contradict the rest: all, those of a strip, of CCDs in one strip or in all. Two CCDs,
    or any in one strip, may be exchanged.
    """
    those = tuple(target for group in groups for target in groups[group])
    subjects = tuple(sorted((group for group in groups if group != EVERY), key=lambda group: group.ccd))
    strip_id, of_ccds, n = next(iter(groups)).strip, next(iter(groups)).ccd >= 0, len(those)
    file, camera = "points.csv" if of_points else "targets.csv", "remote_camera.toml"
    item = " and ".join(Subject(Kind.CCD, ccd=one.ccd).words for one in subjects)
    unexplained = "contradict the rest, and no common cause explains them: check"
    places = "x_offset_mm, y_first_mm"
    if of_ccds and strip_id:
        field, file = ("ccd", file) if of_points else ("file", "strips.csv")
        cause, item = "images of a CCD", f"{item} in strip {strip_id}"
        text = f"{n} targets contradict the rest: check {field} in {file}, CCDs may be exchanged."
    elif of_ccds:
        file, field, several = camera, f"rotation_mrad, {places}", len(groups) > 1
        cause = "images or look directions of CCDs" if several else "look directions of a CCD"
        exchanged = f"{'ccd in points.csv' if of_points else 'files in strips.csv'} exchanged"
        first, second = f"{field} in {file}", exchanged
        first, second = (second, first) if len(groups) == 2 else (first, second)
        whose = "their" if several else "its"
        text = f"{n} of {whose} targets contradict the rest: check {first}; or {second}."
    elif strip_id:
        cause, item, field = "coordinates, chips or times", f"{n} targets in strip {strip_id}", ""
        check = f"{file}{'' if of_points else ', the chips'}, utc_first_row in strips.csv"
        text = f"{list_words([target.id for target in those])} {unexplained} {check}."
    else:
        cause, item, field = "look directions or coordinates", f"{n} targets of all strips", ""
        text, file = f"they {unexplained} {places} in {camera}, and {file}.", f"{camera}, {file}"
    return Finding(
        cause=cause, item=item, subjects=subjects, text=text, file=file, field=field, explains=those
    )
