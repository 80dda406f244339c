"""A dump checked without calibrating it: its files, its images, what its strips see and miss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from boresight.gct_match.records import Target
from boresight.geometry.constants import WGS84
from boresight.geometry.footprint import outline_deg
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.ledger import Entry
from boresight.geometry.record import Bools, Floats, array, record, scalar
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.diagnosis.missing import in_view, misses, uncertainty_m
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.coordinate_slips import contradiction
from boresight.pipeline.files.dump import Dump, dump_or_faults
from boresight.pipeline.files.terrain_files import surface_of
from boresight.pipeline.run.executor import Executor
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.strip import StripTask, pushbroom_of, unreadable_chips
from boresight.pipeline.stages.strip_tasks import strips_to_match

__all__ = ["DumpCheck", "TargetCheck", "check_dump", "check_lines"]


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
    sky_strips: int = scalar("strips of the sky", default=0)
    footprints: dict[str, Floats] = scalar("outline (N, 2) of each strip: longitude and latitude, degrees")
    targets: tuple[TargetCheck, ...] = scalar("every target against the strips, those first that look wrong")


def check_dump(root: Path, settings: Settings, executor: Executor | None = None) -> DumpCheck:
    """Check a dump: its text files; if these are sound, its images and what its strips see."""
    found = dump_or_faults(root)
    faults = tuple(one for one in found if isinstance(one, RawDataError))
    if faults:
        return DumpCheck(root=str(root), faults=faults, facts=(), omissions=(), footprints={}, targets=())
    views = [_checked(one, settings, executor) for one in found if isinstance(one, Dump)]
    return views[0] if len(views) == 1 else _of_cameras(views)


def _of_cameras(views: Sequence[DumpCheck]) -> DumpCheck:
    """What is known of the dump of several cameras: each target as the camera sees it that sees it best."""
    best: dict[str, TargetCheck] = {}
    for target in (target for one in views for target in one.targets):
        before = best.get(target.target_id, target)
        ordered = sorted((before, target), key=lambda one: (not one.seen_by, one.worth_a_look[1]))
        seen_by = tuple(dict.fromkeys(name for one in (before, target) for name in one.seen_by))
        best[target.target_id] = replace(ordered[0], seen_by=seen_by)
    entries = {(entry.subject, entry.text): entry for one in views for entry in one.omissions}
    return replace(
        views[0],
        facts=tuple(dict.fromkeys(fact for one in views for fact in one.facts)),
        omissions=tuple(entries.values()),
        sky_strips=sum(one.sky_strips for one in views),
        footprints={name: outline for one in views for name, outline in one.footprints.items()},
        targets=tuple(sorted(best.values(), key=lambda one: one.worth_a_look)),
    )


def _checked(dump: Dump, settings: Settings, executor: Executor | None) -> DumpCheck:
    """The check of a dump as one of its cameras sees it."""
    tasks, omissions = strips_to_match(dump, settings, executor)
    outlines = _outlines(dump, tasks)
    first, last = dump.epoch.utc_from_seconds(dump.orbit.t_s[[0, -1]])
    facts = (
        f"mission {dump.mission}, orbit from {first[:19]} to {last[:19]} UTC",
        f"{len(dump.heads)} star camera(s) with {len(dump.exposures)} exposures",
        f"{len(dump.strips)} strips of {dump.line_camera.n_ccds} CCD(s), {len(tasks)} of them can be used"
        + (f" (camera {dump.camera})" if dump.camera else ""),
        f"{len(dump.targets)} targets, {len(dump.points)} strips with measured image points",
        *((f"{len(dump.sky_strips)} strips of the sky",) if dump.sky_strips else ()),
    )
    p_e = np.array([target.p_e for target in dump.targets]).reshape(-1, 3)
    missed = [
        (*misses(task, dump.targets), in_view(task, p_e), uncertainty_m(task))
        for task in tasks
        if dump.targets
    ]
    names = [task.strip.strip_id for task in tasks]
    targets = [
        _target(n, one, names, missed, contradiction(one, chip, dump.chips)[0])
        for n, (one, chip) in enumerate(zip(dump.targets, dump.chips))
    ]
    return DumpCheck(
        root=str(dump.root),
        faults=(),
        facts=facts,
        omissions=(*omissions, *unreadable_chips(dump.chips)),
        sky_strips=len(dump.sky_strips),
        footprints=outlines,
        targets=tuple(sorted(targets, key=lambda one: one.worth_a_look)),
    )


def check_lines(found: DumpCheck) -> list[str]:
    """The check as text: errors, facts, what would not be used, targets and their nearest misses."""
    lines = [f"error: {fault}" for fault in found.faults]
    if found.faults:
        return [*lines, f"{len(lines)} error(s) in the files of {found.root}; images were not checked"]
    lines = [*found.facts, *(f"not used: {entry.line}" for entry in found.omissions)]
    if n := len(found.targets):
        seen, maybe = sum(bool(t.seen_by) for t in found.targets), sum(t.may_be_seen for t in found.targets)
        counts = f"{seen} of {n} targets are in view, {maybe} may be, {n - seen - maybe} are not"
        lines.append(f"{counts}, by the pre-launch matrix and its uncertainty:")
    return [*lines, *("  " + one.text for one in found.targets)]


def _outlines(dump: Dump, tasks: Sequence[StripTask]) -> dict[str, Floats]:
    """Footprints (N, 2) of strips, longitude and latitude, degrees, at the mean height of the terrain."""
    if not tasks:
        return {}
    height = ConstantHeight(float(np.mean(surface_of(dump.terrain).height_range_m())))
    return {t.strip.strip_id: outline_deg(pushbroom_of(t), t.strip.ccd_lines, height) for t in tasks}


def _target(
    n: int,
    target: Target,
    names: Sequence[str],
    missed: Sequence[tuple[Floats, float, Bools, float]],
    contradicts: str,
) -> TargetCheck:
    lat, lon, _ = geodetic_from_ecef(target.p_e[None], WGS84)
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
