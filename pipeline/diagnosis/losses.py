"""Losses: groups of what strips must show of which more is missing than good data lose.

A row of the `Ledger` is a target or a bright star in a CCD of a strip, found or not. Every group, a CCD or
some of them, half of a CCD, half of the field, faint or bright stars of a strip, is held against one binomial
test. What another cause explains is a mask: a group is explained if its loss is chance without it.

The catalogue and the estimated matrix tell where each bright star crosses which detector, and no cloud hides
it. What was left out is searched again, each CCD by itself: the tests of inputs need where it was measured.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import comb
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import bdtrc

from boresight.calib.finding import Finding
from boresight.geometry.sightings import GroundSightings, StripSightings
from boresight.geometry.starlight import SurveyedStars, apparent_star_directions
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.images.tiff import StripFiles
from boresight.pipeline.files.star_tables import survey_of
from boresight.pipeline.stages.sky_side import SkySide, name_in_sky_strips, scatter_px
from boresight.pipeline.stages.sky_strip import NOT_STATED_PX, NamedStars, SkyTask
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, match_strip_targets, pushbroom_of
from boresight.records.ledger import Entry, Kind, Ledger, Reason, Subject, list_words
from boresight.records.record import Bools, Floats, Ints, RowRecord, array, record, scalar
from boresight.star_id.strip_stars.find import StripStars

__all__ = [
    "OF_STARS",
    "OF_TARGETS",
    "Crossings",
    "as_bright_as_named",
    "crossings",
    "displaced_ccds",
    "displaced_stars",
    "ground_ledger",
    "is_flat",
    "lost_ccds",
    "lost_groups",
    "lost_stars",
    "lost_strip",
    "lost_targets",
    "named_alone",
    "names",
    "repeated_lines",
    "searched_alone",
    "star_ledger",
    "stars_found",
    "with_left_out",
]

FEWEST = 3  # targets or stars that make a pattern, or agree by themselves
# Why targets are not found that a strip does not show, whatever their coordinates and chips are.
NOT_SHOWN = (
    Reason.NO_COMMON_ROTATION,
    Reason.FEW_VALID_PIXELS,
    Reason.NO_CORRELATION,
    Reason.NOT_CONVERGED,
    Reason.UNCERTAIN_POSITION,
    Reason.PROBABLY_WRONG,
    Reason.AT_WINDOW_EDGE,
    Reason.LOW_CORRELATION,
)
FLAT_COUNTS = 2.0  # standard deviation of an image without content
MOST_REPEATED = 0.2  # of the lines of an image that repeat the one before: a detector's noise leaves none
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


@record
class Group:
    """Observations that one cause would take away, and those beside them that it would leave."""

    loss: Finding = scalar("that they are lost, without the numbers; its text: what to look at")
    inside: Ints = scalar("rows of the ledger")
    beside: Ints = scalar("rows of the ledger")


def ground_ledger(tasks: Sequence[StripTask], matched: Sequence[MatchedTargets], R_cs: Rotation) -> Ledger:
    """Targets in view of strips of the ground, matched or not, the latter where `R_cs` expects them."""
    rows: list[tuple[Any, ...]] = []
    for n, (task, strip) in enumerate(zip(tasks, matched)):
        ends = [(task.camera.n_px(ccd) - 1.0, task.strip.lines - 1.0) for ccd in range(task.camera.n_ccds)]
        missing = [entry for entry in strip.omissions if entry.subject.ccd >= 0]
        places = task.places
        model = pushbroom_of(replace(task, R_cs=R_cs)) if missing else None
        for name, ccd, xy_px in zip(strip.target_id.tolist(), strip.ccd.tolist(), strip.xy_px.tolist()):
            rows.append((n, ccd, name, xy_px[0] / ends[ccd][0], xy_px[1] / ends[ccd][1], np.nan, 0))
        for entry in missing:
            ccd, name = entry.subject.ccd, entry.subject.id
            place: Floats = np.full(2, np.nan)
            if model is not None and name in places:
                place = np.concatenate(model.pixels_from_ground(ccd, places[name].p_e[None])) / ends[ccd]
            rows.append((n, ccd, name, float(place[0]), float(place[1]), np.nan, entry.reason.number))
    strips = [strip.strip_id for strip in matched]
    return Ledger.of(Kind.TARGET, strips, tuple(zip(*rows))) if rows else Ledger.of(Kind.TARGET, strips)


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
        kept, rest = (found[rows[left[rows]]] for rows in (group.inside, group.beside))
        counts = f"{kept.sum()} of {len(kept)} {limits.what} found"
        text = f"{counts}, of the other half {rest.sum()} of {len(rest)}: {group.loss.text}."
        yield replace(group.loss, text=text, p_value=tested[best])
        left[group.inside] = False  # what it explains is not told again


def _p_value(ledger: Ledger, group: Group, left: Bools, limits: LossLimits) -> float:
    """Of one group; 1 where not most of it is lost, or what lies beside it is, too."""
    inside, beside = (rows[left[rows]] for rows in (group.inside, group.beside))
    found, rest = ledger.found[inside], ledger.found[beside]
    kept, n = int(found.sum()), len(inside)
    if 2 * kept >= n or 2 * rest.sum() <= len(rest):
        return 1.0
    counts = np.bincount(ledger.strip[inside]), np.bincount(ledger.strip[inside], found)
    if np.sum(2 * counts[1] < counts[0]) < limits.fewest_strips:
        return 1.0
    return float(bdtrc(n - kept - 1, n, limits.share))


def _wholes(kind: Kind, ledger: Ledger) -> list[tuple[tuple[Subject, ...], Bools]]:
    """What halves are of, and its rows: CCDs, strips, or the field of several CCDs."""
    ccds = np.unique(ledger.ccd).tolist()
    if kind is Kind.CCD:
        return [((Subject(Kind.CCD, ccd=ccd),), ledger.ccd == ccd) for ccd in ccds]
    if kind is Kind.STRIP:
        return [((Subject(kind, strip=s),), ledger.strip == n) for n, s in enumerate(ledger.strips)]
    return [((), np.ones(len(ledger.ccd), dtype=bool))] if len(ccds) > 1 else []


def _across_field(ledger: Ledger) -> Floats:
    numbers = np.unique(ledger.ccd)
    return np.asarray((np.searchsorted(numbers, ledger.ccd) + ledger.part) / len(numbers))


@dataclass(frozen=True)
class Split:
    """A way to cut what strips must show in halves: a row for each kind of loss."""

    causes: tuple[str, str]  # what is lost, of the lower and of the upper half
    items: tuple[str, str]  # the halves in words: "{whole}", and "{edge}" between them
    advice: tuple[str, str]  # what to look at
    of: Kind  # what is cut: each CCD, each strip, or the field of the camera
    value: Callable[[Ledger], Floats]  # (N,) by which it is cut
    at_median: bool = False  # of what has a value; else at 0.5

    def groups(self, ledger: Ledger) -> Iterator[Group]:
        """Both halves of each whole."""
        value = self.value(ledger)
        for subjects, here in _wholes(self.of, ledger):
            rows = np.flatnonzero(here & np.isfinite(value))
            if not len(rows):
                continue
            edge = float(np.median(value[rows])) if self.at_median else 0.5
            low = value[rows] <= edge if self.at_median else value[rows] < edge
            halves = rows[low], rows[~low]
            whole = subjects[0].words if subjects else ""
            for n, inside in enumerate(halves):
                item = self.items[n].format(whole=whole, edge=edge)
                told: dict[str, Any] = {"subjects": subjects, "file": "strips.csv", "field": "file"}
                loss = Finding(cause=self.causes[n], item=item, text=self.advice[n], **told)
                yield Group(loss, inside, halves[1 - n])


def _halves(cause: str, whole: str, advice: str, of: Kind, value: Callable[[Ledger], Floats]) -> Split:
    """Halves of which either may be lost by one cause."""
    items = f"first half of {whole}", f"second half of {whole}"
    return Split((cause, cause), items, (advice, advice), of, value)


SPLITS = (
    _halves("lost part of a CCD", "{whole}", "check its images for dead pixels", Kind.CCD, lambda a: a.part),
    _halves(
        "lost part of the field",
        "the field",
        "check images and look directions of its CCDs",
        Kind.DUMP,
        _across_field,
    ),
    Split(
        causes=("lost bright stars", "lost faint stars"),
        items=("{whole}, brighter than V {edge:.1f}", "{whole}, fainter than V {edge:.1f}"),
        advice=("check its images for saturation", "check gain, exposure and background of its images"),
        of=Kind.STRIP,
        value=lambda a: a.magnitude,
        at_median=True,
    ),
    _halves(
        "lost part of a strip",
        "the lines of {whole}",
        "check its images for missing lines, and row_period_s",
        Kind.STRIP,
        lambda a: a.along,
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
    """Found, and all, of each CCD over the strips that show any: others say nothing of their CCDs."""
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
    dead = _dead_ccds(images, left.take(left.is_of(Reason.ONE_GREY_VALUE)).cells(), FLAT_COUNTS)
    for one in dead.values():
        yield replace(one, explains=left.subjects(~left.found & left.within(one.subjects)))
    counts, lost = _by_ccd(left), lost_ccds(left)
    silent = [ccd for ccd, (kept, n) in counts.items() if not kept and n >= FEWEST and ccd not in dead]
    no_majority = bool(set(lost) & set(silent)) and _may_be_right(silent, counts, dead)
    displaced = silent if no_majority else [ccd for ccd in lost if ccd not in dead]
    if displaced:
        yield displaced_ccds(displaced, left, OF_TARGETS.what, refutes=no_majority)
    yield from _lost_strips(images, ledger, entries, explained)
    for entry in entries:
        if entry.reason is Reason.CHIP_TOO_SMALL:
            target, of = replace(entry.subject, ccd=-1), (entry.subject,)
            yield Finding.about(
                "pixel size of the chip", target, f"{entry.text}.", "targets.csv", explains=of
            )


def _lost_strips(
    images: Mapping[str, StripFiles], ledger: Ledger, entries: Iterable[Entry], explained: Sequence[Subject]
) -> Iterator[Finding]:
    """Strips of which nothing was matched, not even alone."""
    lost: dict[str, list[Subject]] = {}
    for entry in entries:
        if entry.reason in NOT_SHOWN:
            lost.setdefault(entry.subject.strip, []).append(entry.subject)
    shown = {ledger.strips[n] for n in np.unique(ledger.strip[ledger.found]).tolist()}
    for strip_id, targets in lost.items():
        subject = Subject(Kind.STRIP, strip=strip_id)
        if strip_id in shown or len({one.id for one in targets}) < FEWEST or subject in explained:
            continue
        flat = [is_flat(images[strip_id], ccd) for ccd in images[strip_id].ccds]
        if not shown and not all(flat):
            yield Finding(
                cause="orbit, times or coordinates",
                item="all strips of the ground",
                text=f"none of {sum(map(len, lost.values()))} targets found: check times and frame of the "
                "orbit, file and utc_first_row in strips.csv, targets.csv; or cloud.",
                file="orbit, strips.csv",
            )
            return
        yield lost_strip(subject, targets, all_flat=all(flat))


def _dead_ccds(
    images: Mapping[str, StripFiles], cells: Iterable[tuple[str, int]], most: float
) -> dict[int, Finding]:
    """CCDs of some cells (strip, CCD) whose images have no content, by number: see `is_flat`."""
    flat: dict[int, list[str]] = {}
    for strip_id, ccd in cells:
        if ccd in images[strip_id].ccds and is_flat(images[strip_id], ccd, most):
            flat.setdefault(ccd, []).append(strip_id)
    return {
        ccd: Finding(
            cause="dead detector or empty file",
            item=f"CCD {ccd} in strip{'s' if len(strips) > 1 else ''} {', '.join(strips)}",
            subjects=tuple(Subject(Kind.CCD, strip=strip, ccd=ccd) for strip in strips),
            text="its images hold a single grey value: check its files in strips.csv.",
            file="strips.csv",
            field="file",
        )
        for ccd, strips in flat.items()
    }


def lost_stars(
    images: Mapping[str, StripFiles], ledger: Ledger, explained: Sequence[Subject]
) -> Iterator[Finding]:
    """CCDs that lack too many bright stars of the sky without those that `explained` concern."""
    left = ledger.take(~ledger.within(explained))
    every = [(strip_id, ccd) for strip_id in left.strips for ccd in images[strip_id].ccds]
    seen = {cell for cell, (found, _) in left.cells().items() if found}
    dark = _dead_ccds(images, [cell for cell in every if cell not in seen], FLAT_SKY_COUNTS)
    yield from dark.values()
    displaced = [ccd for ccd in lost_ccds(left, OF_STARS) if ccd not in dark]
    if displaced:
        no_majority = _may_be_right(displaced, _by_ccd(left), dark)
        yield displaced_ccds(displaced, left, "bright stars", refutes=no_majority)


def _may_be_right(displaced: Sequence[int], shown: Iterable[int], dead: Iterable[int]) -> bool:
    """Whether the CCDs that lack their targets may be the ones that look where they should: no less than a
    third of those `shown` that are not `dead`. CCDs of one row of the focal plane err together, so that two
    do not outvote one.
    """
    return 3 * len(displaced) >= len(set(shown) - set(dead))


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


def lost_strip(strip: Subject, targets: Sequence[Subject], *, all_flat: bool) -> Finding:
    """A strip of which nothing was matched, not even alone."""
    cause, text = "images, cloud or clock", "not even alone do they agree: check for cloud, mirrored or "
    text += "exchanged images, and utc_first_row"
    if all_flat:
        cause, text = "empty images", "a single grey value in all images: check its files in strips.csv"
    text = f"none of its {len(targets)} targets found; {text}."
    return Finding.about(cause, strip, text, "strips.csv", explains=tuple(targets))


def repeated_lines(tasks: Sequence[StripTask]) -> Iterator[Finding]:
    """Strips of the ground of which many lines show the line before once more. Where most strips are such,
    places in them are off alike by part of a line, and the matrix with them.
    """
    shares = {task.strip.subject: _share_repeated(task.strip.images) for task in tasks}
    repeated = tuple(strip for strip, share in shares.items() if share > MOST_REPEATED)
    if repeated:
        share = min(shares[strip] for strip in repeated)
        yield Finding(
            cause="repeated lines",
            item=list_words([strip.words for strip in repeated]),
            subjects=repeated,
            text=f"{share:.0%} of their lines are equal to the one before: check how the images were made.",
            file="strips.csv",
            field="file",
            refutes=2 * len(repeated) > len(shares),
        )


def _share_repeated(images: StripFiles) -> float:
    """The least share, of the CCDs of a strip, of lines in its middle that repeat the one before; 0: none."""
    try:
        middles = [_middle(images, ccd) for ccd in images.ccds]
    except RawDataError:
        return 0.0
    shown = [image for image in middles if len(image) > 1 and np.std(image.astype(float)) >= FLAT_COUNTS]
    return min((float((one[1:] == one[:-1]).all(axis=1).mean()) for one in shown), default=0.0)


def is_flat(images: StripFiles, ccd: int, most: float = FLAT_COUNTS) -> bool:
    """Whether the image of a CCD has no content in its middle: a standard deviation of at most `most`."""
    try:
        return float(np.std(_middle(images, ccd).astype(float))) < most
    except RawDataError:
        return False


def _middle(images: StripFiles, ccd: int) -> Any:
    lines, samples = images.shape(ccd)
    return images.read(ccd, lines // 2, min(lines, lines // 2 + 64), 0, samples)


# Most searches of single CCDs and targets that a run makes for what was not found; bounds their time.
MOST_SEARCHES = 4


def with_left_out(
    strips: Sequence[StripSightings], more: Sequence[StripSightings]
) -> tuple[StripSightings, ...]:
    """`strips` with the observations of `more`; strips of the same id are one."""
    found = {strip.strip_id: strip for strip in strips}
    for strip in more:
        if before := found.get(strip.strip_id):
            ground = GroundSightings.together([before.ground, strip.ground])
            R_oi = Rotation.concatenate([before.R_oi_targets, strip.R_oi_targets])
            strip = replace(before, ground=ground, R_oi_targets=R_oi)
        found[strip.strip_id] = strip
    return tuple(found.values())


def searched_alone(
    tasks: Sequence[StripTask], ccds: Sequence[int], sigma_rad: Floats
) -> list[MatchedTargets]:
    """Targets of the CCDs `ccds` in each of the first strips, searched in that CCD alone and as widely as
    `sigma_rad` (3,), the 1-sigma of the matrix, axes of c.
    """
    found: list[MatchedTargets] = []
    for ccd in ccds[:MOST_SEARCHES]:
        having = [task for task in tasks if ccd in task.strip.images.ccds]
        for task in having[: max(1, MOST_SEARCHES // len(ccds))]:
            strip = replace(task.strip, images=task.strip.images.of([ccd]))
            wide = replace(task, strip=strip, sigma_installation_rad=sigma_rad, is_known=False)
            one = match_strip_targets(wide)
            if not isinstance(one, Entry) and len(one.target_id) >= FEWEST:
                found.append(one)
    return found


NODES = 33  # lines between which a star's way is straight
FAINTEST = 0.95  # of the stars that were named, in order of magnitude: brighter ones are looked for
NEAR_SIGMAS = 5.0  # of where the matrix places a star: a detection is that star, as in giving names
BESIDE_RAD = 1e-3  # beyond the corners of the image, in which stars are looked for
FEWEST_DISPLACED = 2  # missing stars of a strip that are looked for elsewhere on their CCDs
FAR_PX = 100.0  # from its place, within which a missing star is looked for (set by hand)
ALIKE_MAG = 0.5  # between the brightness of a star and of a detection that may be it
EDGE_PX = 8.0  # from the ends of detector and strip within which a star is not counted


@record
class Crossings(RowRecord):
    """Catalogue stars that cross detectors of a strip. Row n of every array is the same crossing."""

    star: Ints = array("N", "row of the catalogue")
    ccd: Ints = array("N", "CCD of the camera, from 0")
    xy_px: Floats = array("N, 2", "where: (sample, line)")


def crossings(task: SkyTask, survey: SurveyedStars, R_cs: Rotation) -> Crossings:
    """Where single stars of a catalogue cross the detectors of a strip by the matrix `R_cs`."""
    lines: Floats = np.linspace(0.0, max(task.strip.lines - 1.0, 1.0), NODES, dtype=np.float64)
    t_s = task.instants(lines)
    p_i, v_i = task.orbit.states_i(t_s[[NODES // 2]])
    places = survey.places
    u_i = apparent_star_directions(places, task.epoch, float(t_s[NODES // 2]), p_i[0], v_i[0])
    R_ci = (R_cs * task.track.R_si(t_s)).as_matrix()
    ahead = np.flatnonzero(survey.single & ((u_i @ R_ci[:, 2].T).max(axis=1) > np.cos(_reach(task))))
    u_c = np.einsum("lab,sb->lsa", R_ci, u_i[ahead])
    found: list[tuple[Ints, Ints, Floats]] = []
    for ccd in task.strip.images.ccds:
        sample, across = (
            part.reshape(NODES, len(ahead))
            for part in task.camera.samples_from_directions(ccd, u_c.reshape(-1, 3))
        )
        node, star = np.nonzero(across[:-1] * across[1:] <= 0.0)
        part = across[node, star] / (across[node, star] - across[node + 1, star])
        line = lines[node] + part * (lines[node + 1] - lines[node])
        at = sample[node, star] + part * (sample[node + 1, star] - sample[node, star])
        last = task.camera.n_px(ccd) - 1.0, task.strip.lines - 1.0
        inside = (at > EDGE_PX) & (at < last[0] - EDGE_PX) & (line > EDGE_PX) & (line < last[1] - EDGE_PX)
        rows = ahead[star[inside]]
        found.append((rows, np.full(len(rows), ccd), np.column_stack([at, line])[inside]))
    return Crossings(*(np.concatenate(part) for part in zip(*found)))


def _reach(task: SkyTask) -> float:
    """Angle from the camera's axis beyond which no pixel looks."""
    ends = [
        task.camera.directions_from_pixels(ccd, np.array([0.0, task.camera.n_px(ccd) - 1.0]))
        for ccd in task.strip.images.ccds
    ]
    return float(np.arccos(np.concatenate(ends)[:, 2].min())) + BESIDE_RAD


def as_bright_as_named(dump: Dump, named: Sequence[NamedStars]) -> SurveyedStars:
    """Stars of the catalogue as bright as those that were named in any strip: none, if none was."""
    survey = survey_of(dump.star_catalogue)
    magnitudes = np.concatenate([one.places.places.v_mag for one in named] or [np.zeros(0)])
    faintest = np.quantile(magnitudes, FAINTEST) if len(magnitudes) else -np.inf
    return survey.take(np.flatnonzero(survey.places.v_mag <= faintest))


def stars_found(dump: Dump, task: SkyTask, found: StripStars, expected: Crossings) -> Bools:
    """Which of the stars (N,) that must be in a strip have a detection where they must be."""
    seen = np.zeros(len(expected.ccd), dtype=bool)
    for stars, _, near in _near(dump, task, found, expected):
        seen[stars] = near.any(axis=1)
    return seen


def _near(
    dump: Dump, task: SkyTask, found: StripStars, expected: Crossings
) -> Iterator[tuple[Ints, Ints, Bools]]:
    """For each CCD of a strip its stars (N,), its detections (M,), and which (N, M) lie where the others must
    by a right matrix: attitudes, stated scatter, and the unstated.
    """
    variance = np.einsum("kaka->ka", task.covariance_c)  # rad², axes of c
    attitude = np.sqrt(np.max(variance[:, :2].max(axis=1) + variance[:, 2] * _reach(task) ** 2))
    sigma_px = (scatter_px(dump, task), NOT_STATED_PX, float(attitude) / task.camera.pixel_rad)
    near_px = NEAR_SIGMAS * float(np.linalg.norm(sigma_px))
    for ccd in task.strip.images.ccds:
        stars, rows = np.flatnonzero(expected.ccd == ccd), np.flatnonzero(found.ccd == ccd)
        yield stars, rows, np.abs(expected.xy_px[stars, None] - found.xy_px[rows]).max(axis=2) < near_px


def star_ledger(dump: Dump, side: SkySide, named: Sequence[NamedStars], R_cs: Rotation) -> Ledger:
    """Bright stars of each strip, found or not; without rows where no strip of the sky has a name."""
    strips = tuple(task.strip.strip_id for task in side.tasks)
    if not any(len(stars.rows) for stars in named):
        return Ledger.of(Kind.STAR, strips)
    bright = as_bright_as_named(dump, named)
    every = [crossings(task, bright, R_cs) for task in side.tasks]
    of_strips = zip(side.tasks, named, every)
    found = [stars_found(dump, task, stars.found, expected) for task, stars, expected in of_strips]
    number = np.repeat(np.arange(len(every)), [len(expected.ccd) for expected in every])
    seen, camera = Crossings.together(every), side.tasks[0].camera
    last = np.array([camera.n_px(ccd) - 1.0 for ccd in range(camera.n_ccds)])
    lines = np.array([max(task.strip.lines - 1.0, 1.0) for task in side.tasks])
    part, along = seen.xy_px[:, 0] / last[seen.ccd], seen.xy_px[:, 1] / lines[number]
    ids = [f"{bright.name} {n}" for n in bright.places.hip[seen.star].tolist()]
    reason = np.where(np.concatenate(found), 0, Reason.NOT_IN_PLACE.number)
    columns = number, seen.ccd, ids, part, along, bright.places.v_mag[seen.star], reason
    return Ledger.of(Kind.STAR, strips, columns)


def named_alone(dump: Dump, side: SkySide, named: Sequence[NamedStars], ledger: Ledger) -> list[NamedStars]:
    """Stars of CCDs with too many missing or without a sure name, named by those alone: all together, or else
    each by itself.
    """
    having = {ccd for one in named for ccd in one.found.ccd[one.rows].tolist()}
    silent = {ccd for ccd, (_, n) in _by_ccd(ledger).items() if n >= FEWEST and ccd not in having}
    if not (lost := sorted(silent.union(lost_ccds(ledger, OF_STARS)))):
        return []
    for ccds in dict.fromkeys([tuple(lost), *((ccd,) for ccd in lost)]):
        of_ccds = replace(side, found=tuple(one.take(np.isin(one.ccd, ccds)) for one in side.found))
        if found := [one for one in _named(dump, of_ccds) if len(one.rows) >= FEWEST]:
            return found
    return []


def displaced_stars(
    dump: Dump, side: SkySide, named: Sequence[NamedStars], ledger: Ledger, R_cs: Rotation
) -> list[NamedStars]:
    """Missing stars of strips with the detections, of their brightness and farther off than a right matrix
    allows, that may be them: the tests of inputs say whether one error explains several.
    """
    missing = ledger.strip[~ledger.found]
    if len(missing) < FEWEST_DISPLACED:
        return []
    bright, every = as_bright_as_named(dump, named), []
    for n, (task, one) in enumerate(zip(side.tasks, named)):
        if not len(one.rows) or np.sum(missing == n) < FEWEST_DISPLACED:
            continue
        expected = crossings(task, bright, R_cs)
        level = float(np.median(_magnitude(one.found.flux_dn[one.rows]) - one.places.places.v_mag))
        pairs = list[tuple[int, int]]()
        for stars, rows, near in _near(dump, task, one.found, expected):
            lost, free = stars[~near.any(axis=1)], rows[~near.any(axis=0)]
            pairs += _of_brightness(expected, lost, one.found, free, bright, level)
        if len(pairs) >= FEWEST_DISPLACED:
            row, star = np.array(pairs).T
            one = replace(one, probability_wrong=np.zeros(len(row)), omissions=())
            every.append(replace(one, rows=row, places=bright.take(star)))
    return every


def _magnitude(flux_dn: Floats) -> Floats:
    return -2.5 * np.log10(flux_dn)


def _of_brightness(
    expected: Crossings, lost: Ints, found: StripStars, free: Ints, bright: SurveyedStars, level: float
) -> list[tuple[int, int]]:
    """Detection and star of the catalogue, for each of the crossings `lost` the nearest of the detections
    `free` that is as bright.
    """
    magnitude = _magnitude(found.flux_dn[free]) - level
    pairs: dict[int, int] = {}
    for n in lost.tolist():
        star = int(expected.star[n])
        off_px = np.hypot(*(found.xy_px[free] - expected.xy_px[n]).T)
        alike = (np.abs(magnitude - bright.places.v_mag[star]) < ALIKE_MAG) & (off_px < FAR_PX)
        if alike.any():
            pairs.setdefault(int(free[np.argmin(np.where(alike, off_px, np.inf))]), star)
    return list(pairs.items())


def _named(dump: Dump, side: SkySide) -> tuple[NamedStars, ...]:
    """Names by the pre-launch matrix."""
    return name_in_sky_strips(dump, side, dump.R_cs0, dump.sigma_installation_rad, known=False)


def names(dump: Dump, strip: SkySide) -> int:
    """How many stars of one strip of the sky have names by the pre-launch matrix."""
    return len(_named(dump, strip)[0].rows)
