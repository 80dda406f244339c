"""Losses: groups of what strips must show of which more is missing than good data lose.

A row of the `Ledger` is a target or a bright star in a CCD of a strip, found or not. Every group, a CCD or
some of them, half of a CCD, half of the field, faint or bright stars of a strip, is held against one binomial
test. What another cause explains is a mask: a group is explained if its loss is chance without it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import comb

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import bdtrc

from boresight.calib.finding import Finding
from boresight.geometry.ledger import Entry, Kind, Ledger, Reason, Subject
from boresight.geometry.record import Bools, Floats, record, scalar
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.images.tiff import StripFiles
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, pushbroom_of

__all__ = [
    "OF_STARS",
    "OF_TARGETS",
    "Group",
    "LossLimits",
    "displaced_ccds",
    "ground_ledger",
    "is_flat",
    "lost_ccds",
    "lost_groups",
    "lost_stars",
    "lost_strip",
    "lost_targets",
]

FEWEST = 3  # targets that make a pattern
FLAT_COUNTS = 2.0  # standard deviation of an image without content
FLAT_SKY_COUNTS = 0.1  # ... of the dark sky, whose noise alone is more


@record(kw_only=True)
class LossLimits:
    """What good data lose, and how often a group of them is named."""

    what: str = scalar("what is looked for, in words")
    share: float = scalar("of a group that is missing in a good strip")
    probability: float = scalar("that any group of good data is named")
    fewest_strips: int = scalar("strips that must have lost half of a half: clouds are in one")


# Clouds and changes take away targets; of 259 CCDs of good scans none missed a bright star, and three missing
# stars of three are enough to name one.
OF_TARGETS = LossLimits(what="targets", share=0.3, probability=1e-4, fewest_strips=2)
OF_STARS = LossLimits(what="stars", share=0.04, probability=1e-3, fewest_strips=1)


@record(kw_only=True)
class Group:
    """Observations that one cause would take away, and those beside them that it would leave."""

    cause: str = scalar("what is lost")
    item: str = scalar("the group in words")
    subjects: tuple[Subject, ...] = scalar("CCDs or strips that it lies in; empty: all")
    advice: str = scalar("what to look at")
    inside: Bools = scalar("(N,) mask of the ledger")
    beside: Bools = scalar("(N,) mask of the ledger")


def ground_ledger(tasks: Sequence[StripTask], matched: Sequence[MatchedTargets], R_cs: Rotation) -> Ledger:
    """Targets in view of strips of the ground: those matched, and those that were not, at the places where
    the matrix `R_cs` expects them.
    """
    rows: list[tuple[int, int, str, float, float, int]] = []
    for n, (task, strip) in enumerate(zip(tasks, matched)):
        ends = [(task.camera.n_px(ccd) - 1.0, task.strip.lines - 1.0) for ccd in range(task.camera.n_ccds)]
        missing = [entry for entry in strip.omissions if entry.subject.ccd >= 0]
        p_e = {target.target_id: target.p_e for target in task.targets} if missing else {}
        model = pushbroom_of(replace(task, R_cs=R_cs)) if missing else None
        for name, ccd, xy_px in zip(strip.target_id.tolist(), strip.ccd.tolist(), strip.xy_px.tolist()):
            rows.append((n, ccd, name, xy_px[0] / ends[ccd][0], xy_px[1] / ends[ccd][1], 0))
        for entry in missing:
            ccd, name = entry.subject.ccd, entry.subject.id
            place: Floats = np.full(2, np.nan)
            if model is not None and name in p_e:
                place = np.concatenate(model.pixels_from_ground(ccd, p_e[name][None])) / ends[ccd]
            rows.append((n, ccd, name, float(place[0]), float(place[1]), entry.reason.number))
    numbers, ccds, names, part, along, reasons = zip(*rows) if rows else ((),) * 6
    return Ledger(
        kind=Kind.TARGET,
        strips=tuple(strip.strip_id for strip in matched),
        strip=np.array(numbers, dtype=np.int64),
        ccd=np.array(ccds, dtype=np.int64),
        id=np.array(names, dtype=str),
        part=np.array(part, dtype=float),
        along=np.array(along, dtype=float),
        magnitude=np.full(len(rows), np.nan),
        reason=np.array(reasons, dtype=np.int64),
    )


def lost_groups(ledger: Ledger, limits: LossLimits) -> Iterator[Finding]:
    """Halves of which more was lost than good data lose, while their other half has not."""
    shown = np.isin(ledger.strip, ledger.strip[ledger.found]) & np.isfinite(ledger.part)
    ledger = ledger.take(shown)
    if not len(ledger.ccd):
        return
    groups, found = [group for split in SPLITS for group in split.groups(ledger)], ledger.found
    left: Bools = np.isin(ledger.ccd, ledger.ccd[found])  # a CCD without any is a finding of its own
    while True:
        tested = [_p_value(ledger, group, left, limits) * len(groups) for group in groups]
        best = int(np.argmin(tested))
        if min(1.0, tested[best]) >= limits.probability:
            return
        group = groups[best]
        kept, rest = found[group.inside & left], found[group.beside & left]
        yield Finding(
            cause=group.cause,
            item=group.item,
            subjects=group.subjects,
            text=f"{kept.sum()} of {len(kept)} {limits.what} found, of the other half {rest.sum()} of "
            f"{len(rest)}: {group.advice}.",
            file="strips.csv",
            field="file",
            p_value=tested[best],
        )
        left = left & ~group.inside  # what it explains is not told again


def _p_value(ledger: Ledger, group: Group, left: Bools, limits: LossLimits) -> float:
    """Of one group; 1 where not most of it is lost, or what lies beside it is, too."""
    inside, found = group.inside & left, ledger.found
    kept, n, rest = int(found[inside].sum()), int(inside.sum()), found[group.beside & left]
    if 2 * kept >= n or 2 * rest.sum() <= len(rest):
        return 1.0
    per_strip = [inside & (ledger.strip == number) for number in np.unique(ledger.strip[inside])]
    if sum(2 * found[here].sum() < here.sum() for here in per_strip) < limits.fewest_strips:
        return 1.0
    return float(bdtrc(n - kept - 1, n, limits.share))


Wholes = Iterator[tuple[tuple[Subject, ...], Bools]]


def _ccds(ledger: Ledger) -> Wholes:
    for number in np.unique(ledger.ccd).tolist():
        yield (Subject(Kind.CCD, ccd=number),), ledger.ccd == number


def _field(ledger: Ledger) -> Wholes:
    if len(np.unique(ledger.ccd)) > 1:
        yield (), np.ones(len(ledger.ccd), dtype=bool)


def _strips(ledger: Ledger) -> Wholes:
    for number, name in enumerate(ledger.strips):
        yield (Subject(Kind.STRIP, strip=name),), ledger.strip == number


def _strips_of_stars(ledger: Ledger) -> Wholes:
    is_star = np.isfinite(ledger.magnitude)
    yield from ((strip, here & is_star) for strip, here in _strips(ledger) if (here & is_star).any())


def _across_field(ledger: Ledger) -> Floats:
    numbers = np.unique(ledger.ccd)
    return np.asarray((np.searchsorted(numbers, ledger.ccd) + ledger.part) / len(numbers))


@dataclass(frozen=True)
class Split:
    """A way to cut what strips must show in halves: a row for each kind of loss."""

    causes: tuple[str, str]  # what is lost, of the lower and of the upper half
    items: tuple[str, str]  # the halves in words: "{whole}", and "{edge}" between them
    advice: tuple[str, str]  # what to look at
    wholes: Callable[[Ledger], Wholes]  # what is cut
    value: Callable[[Ledger], Floats]  # (N,) by which it is cut
    edge: float | None = 0.5  # below it lies the lower half; None: at the median

    def groups(self, ledger: Ledger) -> Iterator[Group]:
        """Both halves of each whole."""
        value = self.value(ledger)
        for subjects, here in self.wholes(ledger):
            edge = float(np.median(value[here])) if self.edge is None else self.edge
            low = here & (value < edge if self.edge is not None else value <= edge)
            whole = subjects[0].words if subjects else ""
            for n, inside in enumerate((low, here & ~low)):
                yield Group(
                    cause=self.causes[n],
                    item=self.items[n].format(whole=whole, edge=edge),
                    subjects=subjects,
                    advice=self.advice[n],
                    inside=inside,
                    beside=here & ~inside,
                )


SPLITS = (
    Split(
        causes=("lost part of a CCD",) * 2,
        items=("first half of {whole}", "second half of {whole}"),
        advice=("check its images for dead pixels",) * 2,
        wholes=_ccds,
        value=lambda ledger: ledger.part,
    ),
    Split(
        causes=("lost part of the field",) * 2,
        items=("first half of the field", "second half of the field"),
        advice=("check images and look directions of its CCDs",) * 2,
        wholes=_field,
        value=_across_field,
    ),
    Split(
        causes=("lost bright stars", "lost faint stars"),
        items=("{whole}, brighter than V {edge:.1f}", "{whole}, fainter than V {edge:.1f}"),
        advice=("check its images for saturation", "check gain, exposure and background of its images"),
        wholes=_strips_of_stars,
        value=lambda ledger: ledger.magnitude,
        edge=None,
    ),
    Split(
        causes=("lost part of a strip",) * 2,
        items=("first half of the lines of {whole}", "second half of the lines of {whole}"),
        advice=("check its images for missing lines, and row_period_s",) * 2,
        wholes=_strips,
        value=lambda ledger: ledger.along,
    ),
)


def lost_ccds(ledger: Ledger, limits: LossLimits = OF_TARGETS) -> list[int]:
    """CCDs that lost more than the share that good strips lose, over the strips that show anything.

    Those of which least was found are tested together, one more at a time, against all choices of as many.
    """
    every = _by_ccd(ledger)
    order = sorted(every, key=lambda ccd: (every[ccd][0] / every[ccd][1], -every[ccd][1]))
    lost: list[int] = []
    for k in range(1, len(order)):
        kept, n = (sum(every[ccd][part] for ccd in order[:k]) for part in (0, 1))
        if float(bdtrc(n - kept - 1, n, limits.share)) * comb(len(order), k) < limits.probability:
            lost = [ccd for ccd in order[:k] if 2 * every[ccd][0] < every[ccd][1]]
    return sorted(lost)


def _by_ccd(ledger: Ledger) -> dict[int, tuple[int, int]]:
    """Found, and all, of each CCD over the strips that show any: a strip that shows nothing says nothing of
    its CCDs.
    """
    shown = ledger.take(np.isin(ledger.strip, ledger.strip[ledger.found]))
    return {
        ccd: (int(shown.found[here].sum()), int(here.sum()))
        for ccd in np.unique(shown.ccd).tolist()
        for here in [shown.ccd == ccd]
    }


def lost_targets(
    images: Mapping[str, StripFiles], entries: Iterable[Entry], ledger: Ledger, explained: Sequence[Subject]
) -> Iterator[Finding]:
    """CCDs and strips of the ground of which too many targets were not found without those that `explained`
    concern, and targets that their own chips exclude. `images` are those of each strip; `entries` what was
    not matched.
    """
    left = ledger.take(~ledger.within(explained))
    dead = _dead_ccds(images, left)
    for ccd, strips in dead.items():
        cells = [Subject(Kind.CCD, strip=strip, ccd=ccd) for strip in strips]
        yield _dead_ccd(ccd, strips, left.subjects(~left.found & left.within(cells)))
    counts, lost = _by_ccd(left), lost_ccds(left)
    silent = [ccd for ccd, (kept, n) in counts.items() if not kept and n >= FEWEST and ccd not in dead]
    no_majority = bool(set(lost) & set(silent)) and 2 * len(silent) >= len(counts)
    displaced = silent if no_majority else [ccd for ccd in lost if ccd not in dead]
    if displaced:
        yield displaced_ccds(displaced, left, OF_TARGETS.what, refutes=no_majority)
    yield from _lost_strips(images, ledger, entries, explained)
    yield from _excluded(entries)


def _lost_strips(
    images: Mapping[str, StripFiles], ledger: Ledger, entries: Iterable[Entry], explained: Sequence[Subject]
) -> Iterator[Finding]:
    """Strips of which nothing was matched, not even alone."""
    lost: dict[str, list[Subject]] = {}
    for entry in entries:
        if entry.reason is Reason.NO_COMMON_ROTATION:
            lost.setdefault(entry.subject.strip, []).append(entry.subject)
    shown = {ledger.strips[n] for n in np.unique(ledger.strip[ledger.found]).tolist()}
    for strip_id, targets in lost.items():
        subject = Subject(Kind.STRIP, strip=strip_id)
        if strip_id in shown or len(targets) < FEWEST or subject in explained:
            continue
        flat = [is_flat(images[strip_id], ccd) for ccd in images[strip_id].ccds]
        if not shown and not all(flat):
            yield _lost_ground(sum(map(len, lost.values())))
            return
        yield lost_strip(subject, targets, all_flat=all(flat))


def _dead_ccds(images: Mapping[str, StripFiles], ledger: Ledger) -> dict[int, list[str]]:
    """Strips in which the image of a CCD has no content, by CCD, as targets that show one grey value tell."""
    dead: dict[int, list[str]] = {}
    for strip_id, ccd in ledger.take(ledger.is_of(Reason.ONE_GREY_VALUE)).cells():
        if ccd in images[strip_id].ccds and is_flat(images[strip_id], ccd):
            dead.setdefault(ccd, []).append(strip_id)
    return dead


def lost_stars(
    images: Mapping[str, StripFiles], ledger: Ledger, explained: Sequence[Subject]
) -> Iterator[Finding]:
    """CCDs in which too many bright stars of strips of the sky are missing without those that `explained`
    concern.
    """
    left = ledger.take(~ledger.within(explained))
    cells, dark = left.cells(), dict[int, list[str]]()
    for strip_id in left.strips:
        for ccd in images[strip_id].ccds:
            if not cells.get((strip_id, ccd), (0, 0))[0] and is_flat(images[strip_id], ccd, FLAT_SKY_COUNTS):
                dark.setdefault(ccd, []).append(strip_id)
    for ccd, strips in dark.items():
        yield _dead_ccd(ccd, strips)
    displaced = [ccd for ccd in lost_ccds(left, OF_STARS) if ccd not in dark]
    if displaced:
        no_majority = 2 * len(displaced) >= len(_by_ccd(left))
        yield displaced_ccds(displaced, left, "bright stars", refutes=no_majority)


def displaced_ccds(ccds: Sequence[int], ledger: Ledger, what: str, *, refutes: bool) -> Finding:
    """CCDs of which too much is lost; `what` was looked for."""
    counts, subjects = _by_ccd(ledger), [Subject(Kind.CCD, ccd=ccd) for ccd in ccds]
    kept, n = (sum(counts[ccd][k] for ccd in ccds) for k in (0, 1))
    others = sum(found for ccd, (found, _) in counts.items() if ccd not in ccds)
    return Finding(
        cause="images or look directions of a CCD",
        item=f"CCD{'s' if len(ccds) > 1 else ''} {', '.join(map(str, ccds))}",
        subjects=tuple(subjects),
        text=f"{kept} of {n} {what} found, {others} on other CCDs: check files in strips.csv; x_offset_mm, "
        "y_first_mm, rotation_mrad in remote_camera.toml.",
        file="remote_camera.toml",
        field="x_offset_mm, y_first_mm, rotation_mrad",
        refutes=refutes,
        explains=ledger.subjects(~ledger.found & ledger.within(subjects)),
    )


def _dead_ccd(ccd: int, strips: Sequence[str], targets: tuple[Subject, ...] = ()) -> Finding:
    return Finding(
        cause="dead detector or empty file",
        item=f"CCD {ccd} in strip{'s' if len(strips) > 1 else ''} {', '.join(strips)}",
        subjects=tuple(Subject(Kind.CCD, strip=strip, ccd=ccd) for strip in strips),
        text="its images hold a single grey value: check its files in strips.csv.",
        file="strips.csv",
        field="file",
        explains=targets,
    )


def lost_strip(strip: Subject, targets: Sequence[Subject], *, all_flat: bool) -> Finding:
    """A strip of which nothing was matched, not even alone."""
    if all_flat:
        cause, text = "empty images", "a single grey value in all images: check its files in strips.csv"
    else:
        cause = "images, cloud or clock"
        text = (
            "not even alone do they agree: check for cloud, mirrored or exchanged images, and utc_first_row"
        )
    return Finding(
        cause=cause,
        item=strip.words,
        subjects=(strip,),
        text=f"none of its {len(targets)} targets found; {text}.",
        file="strips.csv",
        explains=tuple(targets),
    )


def _lost_ground(n: int) -> Finding:
    return Finding(
        cause="orbit, times or coordinates",
        item="all strips of the ground",
        text=f"none of {n} targets found: check times and frame of the orbit, file and utc_first_row "
        "in strips.csv, targets.csv; or cloud.",
        file="orbit, strips.csv",
    )


def _excluded(entries: Iterable[Entry]) -> Iterator[Finding]:
    """Targets that their own chips exclude."""
    for entry in entries:
        if entry.reason is Reason.CHIP_TOO_SMALL:
            target = replace(entry.subject, ccd=-1)
            yield Finding(
                cause="pixel size of the chip",
                item=target.words,
                subjects=(target,),
                text=f"{entry.text}.",
                file="targets.csv",
                explains=(entry.subject,),
            )


def is_flat(images: StripFiles, ccd: int, most: float = FLAT_COUNTS) -> bool:
    """Whether the image of a CCD has no content in its middle: a standard deviation of at most `most`."""
    lines, samples = images.shape(ccd)
    try:
        middle = images.read(ccd, lines // 2, min(lines, lines // 2 + 64), 0, samples)
    except RawDataError:
        return False
    return float(np.std(middle.astype(float))) < most
