"""A dump checked without calibrating it: its files, its images, what its strips see and miss."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from boresight.gct_match.records import Target
from boresight.geometry.constants import ARCSEC, WGS84
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.line_camera import end_looks
from boresight.geometry.pushbroom import outline_deg
from boresight.pipeline.diagnosis.missing import wrong_convention
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.coordinate_slips import contradiction
from boresight.pipeline.files.dump import Dump, dump_or_faults
from boresight.pipeline.files.repeats import targets_once
from boresight.pipeline.files.star_side import Head, SolvedAttitudes, StarImages
from boresight.pipeline.files.terrain_files import mean_level, surface_of
from boresight.pipeline.run.cached import StageRunner
from boresight.pipeline.run.executor import Executor, InOrder
from boresight.pipeline.run.settings import Settings, calibration_settings
from boresight.pipeline.stages.head import Basis, HeadSightings
from boresight.pipeline.stages.strip import StripTask, misses, pushbroom_of, unreadable_chips
from boresight.pipeline.stages.strip_tasks import before_launch
from boresight.records.ledger import Entry, Kind, Reason
from boresight.records.record import Bools, Floats, array, record, scalar

__all__ = ["DumpCheck", "TargetCheck", "check_dump", "check_lines", "grouped_faults"]

FEW_EXPOSURES = 5  # star images looked at around each strip
MOST_EXPOSURES = 48  # and in all, where other readings of the tables are tried
MOST_RATIO = 5.0  # of a pixel's size across the track over that along it, and its inverse (set by hand)
MOST_TARGETS = 20  # listed on the terminal


@record(kw_only=True)
class TargetCheck:
    """One target against the strips, with the pre-launch installation matrix."""

    target_id: str = scalar("id")
    lon_lat_deg: Floats = array("2", "longitude and latitude")
    seen_by: tuple[str, ...] = scalar("ids of the strips whose footprint contains it")
    nearest: str = scalar("id of the strip that it misses by least; empty where it is seen or there is none")
    across_m: float = scalar("how far it misses that strip across the track, m")
    along_m: float = scalar("and along it")
    along_s: float = scalar("the same as time, s")
    uncertain_m: float = scalar("how far the pre-launch matrix may move that strip, m", default=0.0)
    contradiction: str = scalar("how its coordinates contradict its chip; empty: they do not", default="")

    @property
    def may_be_seen(self) -> bool:
        """Whether it is in no strip's footprint, but in one for another matrix within the uncertainty."""
        missed_m = float(np.hypot(self.across_m, self.along_m))
        return bool(self.nearest) and missed_m <= self.uncertain_m

    @property
    def worth_a_look(self) -> tuple[bool, float]:
        """Sorts targets: first those that contradict their chip, then by distance from the strips."""
        return not self.contradiction, -float(np.hypot(self.across_m, self.along_m))

    @property
    def text(self) -> str:
        """One line: in which chip it is not, seen by which strips, or the nearest miss."""
        place = self._place
        return f"{place}; {self.contradiction}" if self.contradiction else place

    @property
    def _place(self) -> str:
        if self.seen_by:
            return f"{self.target_id}   in view of {', '.join(self.seen_by)}"
        if not self.nearest:
            return f"{self.target_id}   no strip has a footprint"
        miss = f"{self.across_m / 1e3:.2f} km across the track, {self.along_m / 1e3:.2f} km along it"
        if self.across_m == self.along_m == 0.0:
            return f"{self.target_id}   may be in view of {self.nearest}, in a gap between its CCDs"
        if self.may_be_seen:
            return f"{self.target_id}   may be in view of {self.nearest}, beside it by {miss}"
        return f"{self.target_id}   misses {self.nearest} by {miss} ({self.along_s:.2f} s)"


@record(kw_only=True)
class DumpCheck:
    """What is known of a dump without calibrating it."""

    root: str = scalar("folder of the dump")
    faults: tuple[RawDataError, ...] = scalar("errors that stop a calibration, all at once")
    facts: tuple[str, ...] = scalar("mission, cameras, counts; one line each")
    omissions: tuple[Entry, ...] = scalar("exposures, strips and chips that would not be used")
    wrong: tuple[str, ...] = scalar("why a calibration cannot work, though the files can be read", default=())
    sky_strips: int = scalar("strips of the sky", default=0)
    footprints: dict[str, Floats] = scalar("outline (N, 2) of each strip: longitude and latitude, degrees")
    targets: tuple[TargetCheck, ...] = scalar("every target against the strips, those first that look wrong")


def check_dump(root: Path, settings: Settings, executor: Executor | None = None) -> DumpCheck:
    """Check a dump: its text files; if these are sound, its images and what its strips see."""
    found = dump_or_faults(root)
    faults = tuple(one for one in found if isinstance(one, RawDataError))
    if faults:
        return DumpCheck(root=str(root), faults=faults, facts=(), omissions=(), footprints={}, targets=())
    views = [_checked(one, settings, executor or InOrder()) for one in found if isinstance(one, Dump)]
    return views[0] if len(views) == 1 else _of_cameras(views)


def _of_cameras(views: Sequence[DumpCheck]) -> DumpCheck:
    """What is known of the dump of several cameras: each target as the camera sees it that sees it best."""
    best: dict[str, TargetCheck] = {}
    for target in (target for one in views for target in one.targets):
        before = best.get(target.target_id, target)
        near = min(before, target, key=lambda one: (not one.seen_by, not one.nearest, -one.worth_a_look[1]))
        seen_by = tuple(dict.fromkeys(name for one in (before, target) for name in one.seen_by))
        best[target.target_id] = replace(near, seen_by=seen_by)
    entries = {(entry.subject, entry.text): entry for one in views for entry in one.omissions}
    return replace(
        views[0],
        facts=tuple(dict.fromkeys(fact for one in views for fact in one.facts)),
        omissions=tuple(entries.values()),
        wrong=tuple(dict.fromkeys(text for one in views for text in one.wrong)),
        sky_strips=sum(one.sky_strips for one in views),
        footprints={name: outline for one in views for name, outline in one.footprints.items()},
        targets=tuple(sorted(best.values(), key=lambda one: one.worth_a_look)),
    )


def _checked(dump: Dump, settings: Settings, executor: Executor) -> DumpCheck:
    """The check of a dump as one of its cameras sees it, with a few star exposures around each strip."""
    dump = targets_once(dump, settings.match)
    few = _with_exposures(dump, _around_strips)
    heads, tasks, uncovered = before_launch(few, settings, executor)
    omissions = [*dump.omissions, *(one for head in heads for one in head.omissions), *uncovered]
    omissions += unreadable_chips(dump.chips)
    first, last = dump.epoch.utc_from_seconds(dump.orbit.t_s[[0, -1]])
    view = StripView.of(dump, tasks[0]) if tasks else None
    facts = (
        *([] if view is None else [view.text]),
        *(f"star camera {one.name}: {_field_of_view(one)}" for one in dump.heads),
        f"mission {dump.mission}, orbit from {first[:19]} to {last[:19]} UTC",
        f"{len(dump.heads)} star camera(s) with {len(dump.exposures)} exposures, "
        f"{sum(len(head.stars) for head in heads)} looked at have attitudes",
        f"{len(dump.strips)} strips of {dump.line_camera.n_ccds} CCD(s), {len(tasks)} of them can be used"
        + (f" (camera {dump.camera})" if dump.camera else ""),
        f"{len(dump.targets)} targets, {len(dump.points)} strips with measured image points",
        *((f"{len(dump.sky_strips)} strips of the sky",) if dump.sky_strips else ()),
    )
    p_e = np.array([target.p_e for target in dump.targets]).reshape(-1, 3)
    missed = [
        (*misses(task, dump.targets), _in_view(task, p_e), _uncertainty_m(task))
        for task in tasks
        if dump.targets
    ]
    names = [task.strip.strip_id for task in tasks]
    slips = [contradiction(one, chip, dump.chips) for one, chip in zip(dump.targets, dump.chips)]
    targets = [_target(n, one, names, missed, slips[n][0]) for n, one in enumerate(dump.targets)]
    found = DumpCheck(
        root=str(dump.root),
        faults=(),
        facts=facts,
        omissions=tuple(omissions),
        sky_strips=len(dump.sky_strips),
        footprints=_outlines(dump, tasks),
        targets=tuple(sorted(targets, key=lambda one: one.worth_a_look)),
    )
    wrong = [*_lost_files(dump, omissions), *([view.wrong] if view and view.wrong else [])]
    wrong += _what_is_not_seen(found, dump, heads, Counter(kind for _, kind in slips if kind))
    if wrong and all(head.stars for head in heads) and not any(one.seen_by for one in targets):
        every = before_launch(_with_exposures(dump, _evenly), settings, executor)[0]
        errors = calibration_settings(settings, dump.errors, dump.line_camera)
        runner, surface = StageRunner(None, executor), surface_of(dump.terrain)
        basis = Basis(dump, tuple(every), settings, errors, runner, surface)
        if meant := wrong_convention(basis):
            wrong.append(f"{meant.cause}, {meant.item}: {meant.text}")
    return replace(found, wrong=tuple(wrong))


def _in_view(task: StripTask, p_e: Floats) -> Bools:
    """Which places (N, 3), ITRS in m, some CCD of a strip shows."""
    model = pushbroom_of(task)
    seen = np.zeros(len(p_e), dtype=bool)
    for ccd, lines in task.strip.ccd_lines.items():
        sample, line = model.pixels_from_ground(ccd, p_e)
        inside = (sample >= -0.5) & (sample <= task.camera.n_px(ccd) - 0.5)
        seen |= inside & (line >= -0.5) & (line <= lines - 0.5)
    return seen


def _uncertainty_m(task: StripTask) -> float:
    """How far targets may lie from predicted places on the ground, m: the search's half-width."""
    t_s = pushbroom_of(task).instants(np.array([0.5 * (task.strip.lines - 1.0)]))
    height_m = float(np.linalg.norm(task.orbit.positions_e(t_s)[0])) - WGS84.semi_major_m
    return task.settings.sigmas * float(task.sigma_installation_rad.max()) * height_m


def _lost_files(dump: Dump, omissions: Sequence[Entry]) -> Iterator[str]:
    """Listed images that are missing or cannot be read."""
    exposures = [one for head in dump.star_images for one in head.exposures]
    lost = [f"{one.file}: no such file" for one in exposures if not one.path.is_file()]
    lost += [entry.line for entry in omissions if entry.reason is Reason.UNREADABLE]
    if lost:
        yield f"{lost[0]}" + (f" (and {len(lost) - 1} more files)" * (len(lost) > 1))


def _what_is_not_seen(
    found: DumpCheck, dump: Dump, heads: Sequence[HeadSightings], slips: Counter[str]
) -> Iterator[str]:
    """Star images, strips and targets of which nothing can be used."""
    for head in heads:
        of_exposures = [entry for entry in head.omissions if entry.subject.kind is Kind.EXPOSURE]
        not_identified = [entry for entry in of_exposures if entry.reason is not Reason.NOT_COVERED]
        if not_identified and not head.stars:
            yield (
                f"none of {len(not_identified)} exposures of {head.head.name} is identified: check "
                "focal_length_mm (`boresight identify IMAGE` measures it), pixel_size_um, distortion and "
                "bit_depth, and that images are not mirrored"
            )
    if not (found.footprints or dump.sky_strips):
        yield "no strip can be used"
    elif found.footprints and dump.targets and not any(t.seen_by or t.may_be_seen for t in found.targets):
        yield f"none of {len(dump.targets)} targets is in view of a strip"
    for kind, n in slips.most_common(1):
        if 2 * n > len(dump.targets):
            yield f"{n} of {len(dump.targets)} targets would lie in their chips with other {kind}"


def _with_exposures(dump: Dump, chosen: Callable[[Dump, Floats], set[int]]) -> Dump:
    """The dump with some of each star camera's images, by their times, s."""

    def thinned(source: StarImages) -> StarImages:
        kept = sorted(chosen(dump, np.array([one.t_s for one in source.exposures])))
        return replace(source, exposures=tuple(source.exposures[n] for n in kept))

    heads = (
        replace(one, source=thinned(one.source)) if isinstance(one.source, StarImages) else one
        for one in dump.heads
    )
    return replace(dump, heads=tuple(heads))


def _around_strips(dump: Dump, t_s: Floats) -> set[int]:
    """A few rows around each strip, the last before and the first after it among them."""
    kept: set[int] = set()
    for strip in (*dump.strips, *dump.sky_strips):
        begin, end = np.searchsorted(t_s, dump.span_s(strip))
        at = np.linspace(max(begin - 1, 0), min(end, len(t_s) - 1), FEW_EXPOSURES)
        kept |= set(at.round().astype(int).tolist())
    return kept


def _evenly(_: Dump, t_s: Floats) -> set[int]:
    return set(np.linspace(0, len(t_s) - 1, MOST_EXPOSURES).round().astype(int).tolist())


def _field_of_view(head: Head) -> str:
    if isinstance(head.source, SolvedAttitudes):
        return "attitudes"
    camera = head.source.camera
    across_deg = np.degrees(camera.fov_x_rad)
    pixel = camera.pixel_m / camera.focal_m / ARCSEC
    return f"{across_deg:.2f}° wide, {pixel:.3g} arcsec a pixel"


@record
class StripView:
    """What a strip sees of the ground at the height of its terrain."""

    strip_id: str = scalar("the strip")
    across_m: float = scalar("from pixel to pixel of a row")
    along_m: float = scalar("from row to row")
    swath_m: float = scalar("between the outermost pixels")
    altitude_m: float = scalar("of the satellite over the ellipsoid")
    field_rad: float = scalar("between the directions of the outermost pixels")

    @classmethod
    def of(cls, dump: Dump, task: StripTask) -> StripView:
        """That of a task, in the middle of its strip."""
        model, height = pushbroom_of(task), mean_level(dump.terrain)
        camera, ccds = model.camera, sorted(task.strip.ccd_lines)
        middle = 0.5 * task.strip.ccd_lines[ccds[0]]
        ends = np.concatenate(
            [
                model.ground_points(ccd, [0.0, camera.n_px(ccd) - 1.0], np.full(2, middle), height)
                for ccd in ccds
            ]
        )
        rows = model.ground_points(ccds[0], [0.0, 0.0], [middle, middle + 1.0], height)
        looks = end_looks(camera)
        first_s, last_s = dump.span_s(task.strip)
        at = task.orbit.positions_e(np.array([0.5 * (first_s + last_s)]))
        return cls(
            task.strip.strip_id,
            float(np.linalg.norm(ends[1] - ends[0])) / (camera.n_px(ccds[0]) - 1.0),
            float(np.linalg.norm(rows[1] - rows[0])),
            float(np.linalg.norm(ends[:, None] - ends, axis=2).max()),
            float(geodetic_from_ecef(at)[2][0]),
            float(np.arccos(np.clip(looks @ looks.T, -1.0, 1.0)).max()),
        )

    @property
    def text(self) -> str:
        """One line."""
        return (
            f"pixel {self.across_m:.3g} m across and {self.along_m:.3g} m along the track, swath "
            f"{self.swath_m / 1e3:.3g} km, altitude {self.altitude_m / 1e3:.0f} km, field of view "
            f"{np.degrees(self.field_rad):.3g}° (strip {self.strip_id})"
        )

    @property
    def wrong(self) -> str:
        """What contradicts itself; empty: nothing."""
        if not np.isfinite(self.across_m + self.along_m):
            return "the camera looks past the Earth: check quaternion_cs, axes of the orbit and its times"
        ratio = self.across_m / self.along_m
        if 1.0 / MOST_RATIO < ratio < MOST_RATIO:
            return ""
        return (
            f"a pixel is {self.across_m:.3g} m across the track and {self.along_m:.3g} m along it: check "
            "focal_length_m and pixel_pitch_um of the remote-sensing camera, row_period_s in strips.csv"
        )


def check_lines(found: DumpCheck) -> list[str]:
    """The check as text: errors, facts, what would not be used, targets and their nearest misses."""
    if found.faults:
        lines = [f"error: {text}" for text in grouped_faults(found.faults)]
        return [*lines, f"{len(found.faults)} error(s) in the files of {found.root}; images were not checked"]
    lines = [*found.facts, *(f"error: {text}" for text in found.wrong)]
    lines += [f"not used: {text}" for text in lines_grouped(found.omissions, lambda one: one.line, _like)]
    if n := len(found.targets):
        seen, maybe = sum(bool(t.seen_by) for t in found.targets), sum(t.may_be_seen for t in found.targets)
        counts = f"{seen} of {n} targets are in view, {maybe} may be, {n - seen - maybe} are not"
        lines.append(f"{counts}, by the pre-launch matrix and its uncertainty:")
    shown = found.targets[:MOST_TARGETS]
    lines += ["  " + one.text for one in shown]
    return [*lines, *([f"  and {n - len(shown)} more (--json, --out)"] if n > len(shown) else [])]


def grouped_faults(faults: Sequence[RawDataError]) -> list[str]:
    """The errors, those that differ by their row and value alone as one line."""
    return lines_grouped(faults, str, lambda one: (one.file, re.sub(r"\d+", "", one.field), one.expected))


def _like(entry: Entry) -> tuple[object, ...]:
    return entry.subject.kind, entry.reason, entry.file and Path(entry.file).suffix


T = TypeVar("T")


def lines_grouped(items: Sequence[T], line: Callable[[T], str], key: Callable[[T], object]) -> list[str]:
    """A line for each group of items of one key: its first item, and how many more there are."""
    groups: dict[object, list[T]] = {}
    for one in items:
        groups.setdefault(key(one), []).append(one)
    return [
        line(first) + (f" (and {len(more)} more like it)" if more else "") for first, *more in groups.values()
    ]


def _outlines(dump: Dump, tasks: Sequence[StripTask]) -> dict[str, Floats]:
    """Footprints (N, 2) of strips, longitude and latitude, degrees, at the mean height of the terrain."""
    if not tasks:
        return {}
    height = mean_level(dump.terrain)
    return {t.strip.strip_id: outline_deg(pushbroom_of(t), t.strip.ccd_lines, height) for t in tasks}


def _target(
    n: int,
    target: Target,
    names: Sequence[str],
    missed: Sequence[tuple[Floats, float, Bools, float]],
    contradicts: str,
) -> TargetCheck:
    lat, lon, _ = geodetic_from_ecef(target.p_e[None])
    distances = [float(np.hypot(*outside[n])) for outside, *_ in missed]
    seen = tuple(name for name, (_, _, shown, _) in zip(names, missed) if shown[n])
    best = int(np.argmin(distances)) if distances and not seen else -1
    across_m, along_m = missed[best][0][n].tolist() if best >= 0 else (0.0, 0.0)
    return TargetCheck(
        target_id=target.target_id,
        lon_lat_deg=np.degrees([lon[0], lat[0]]),
        seen_by=seen,
        nearest=names[best] if best >= 0 else "",
        across_m=across_m,
        along_m=along_m,
        along_s=along_m / missed[best][1] if best >= 0 else 0.0,
        uncertain_m=missed[best][3] if best >= 0 else 0.0,
        contradiction=contradicts,
    )
