"""Targets that contradict the rest or were not found: which of them, and what they have in common."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import xlogy

from boresight.calib.finding import Finding
from boresight.calib.reliability import Contradiction
from boresight.gct_match.records import Reason
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef, local_axes_e
from boresight.geometry.record import record, scalar
from boresight.pipeline.diagnosis.left_out import (
    LOST_SHARE,
    PROBABILITY,
    Counts,
    counts_of,
    lost_ccds,
    over_strips,
)
from boresight.pipeline.diagnosis.loss_groups import LookedFor, lost_halves
from boresight.pipeline.diagnosis.sky_losses import LOST_SHARE as LOST_SHARE_SKY
from boresight.pipeline.diagnosis.sky_losses import PROBABILITY_LOST
from boresight.pipeline.errors import Omission, RawDataError
from boresight.pipeline.files.image_files import StripFiles
from boresight.pipeline.stages.point_slips import fitting_slip
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, compass, displaced_m, pushbroom_of

__all__ = [
    "Suspected",
    "displaced_ccds",
    "is_flat",
    "lost_parts",
    "lost_stars",
    "lost_strip",
    "lost_targets",
    "single_targets",
    "suspected_targets",
]

FEWEST = 3  # targets that make a pattern
SUSPECT_SHARE = 0.05  # of good data with wrong coordinates or chips; only compares groups
# Log likelihood that a share of suspected targets of its own must gain a group, to be one (set by hand).
GROUP_PENALTY = 3.0
FLAT_COUNTS = 2.0  # standard deviation of an image without content
FLAT_SKY_COUNTS = 0.1  # ... of the dark sky, whose noise alone is more
SHOWN = 4  # names in a sentence


@record(kw_only=True)
class Suspected:
    """A target whose own coordinates or chip are probably wrong."""

    target_id: str = scalar("id of the target")
    strip_id: str = scalar("strip that shows it")
    ccd: int = scalar("CCD that shows it, from 0")
    distance: float = scalar("from where the other targets place it, in standard errors")
    east_m: float = scalar("how far its stated place lies east of the one that the strip shows")
    north_m: float = scalar("the same to the north")
    sigma_m: float = scalar("1-sigma of its distance from there: of place, position, attitude and strip, m")
    slip: str = scalar("what would have to be read in the table, behind a semicolon", default="")
    is_point: bool = scalar("measured by others: without a chip", default=False)


def suspected_targets(
    suspects: Sequence[Contradiction],
    R_cs: Rotation,
    tasks: Sequence[StripTask],
    matched: Sequence[MatchedTargets],
) -> Iterator[Suspected]:
    """Where the targets on the ground among `suspects` lie; they were found about the matrix `R_cs`."""
    places = {(one.strip_id, n, c): xy for one in matched for n, c, xy in _places(one)}
    by_id = {task.strip.strip_id: replace(task, R_cs=R_cs) for task in tasks}
    for one in suspects:
        xy_px, task = places.get((one.strip_id, one.target_id, one.ccd)), by_id.get(one.strip_id)
        if xy_px is None or task is None:
            continue  # a star
        points = {target.target_id: target for target in task.points.targets}
        (east_m, north_m), sigma_m = _displaced(task, one, xy_px)
        point = points.get(one.target_id)
        yield Suspected(
            target_id=one.target_id,
            strip_id=one.strip_id,
            ccd=one.ccd,
            distance=one.distance,
            east_m=east_m,
            north_m=north_m,
            sigma_m=sigma_m,
            slip=fitting_slip(task, point, one.ccd, np.array(xy_px)) if point is not None else "",
            is_point=point is not None,
        )


def _displaced(
    task: StripTask, one: Contradiction, xy_px: tuple[float, ...]
) -> tuple[tuple[float, float], float]:
    """How far a stated place lies east and north of the true one, and the 1-sigma of that distance, m."""
    stated_m = np.array(displaced_m(task, one.target_id, one.ccd, xy_px))
    t_s = np.asarray(pushbroom_of(task).instants_of_lines(np.array([one.ccd]), np.array([xy_px[1]])))
    p_e = next(t.p_e for t in (*task.targets, *task.points.targets) if t.target_id == one.target_id)
    lat, lon, _ = geodetic_from_ecef(p_e[None], WGS84)
    axes_i = task.orbit.earth.matrices_ie(t_s)[0] @ local_axes_e(lat, lon)[0]
    off_m, covariance = one.displaced_m(stated_m, (task.orbit.R_oi(t_s).as_matrix()[0] @ axes_i)[:, :2])
    along = off_m / max(float(np.hypot(*off_m)), 1e-9)
    return (float(off_m[0]), float(off_m[1])), float(np.sqrt(along @ covariance @ along))


def _places(matched: MatchedTargets) -> Iterator[tuple[str, int, tuple[float, ...]]]:
    yield from zip(matched.target_id.tolist(), matched.ccd.tolist(), map(tuple, matched.xy_px.tolist()))
    yield from ((one.target_id, one.ccd, one.xy_px) for one in matched.contradicting)


def single_targets(
    suspected: Sequence[Suspected], counts: Counts, *, is_explained: bool = False
) -> Iterator[Finding]:
    """A finding for each target that is off and, where more than three of a strip, of a CCD or of a CCD in
    one strip are, one for that group; none for groups where a common cause is found already. `counts` are
    the targets found, and in view.
    """
    rest, cells = list(suspected), defaultdict[str, list[Suspected]](list)
    of_ccds = dict[int, list[Suspected]]()
    for group in _groups(suspected, counts):
        those, rest = _split(rest, group)
        strip_id, ccd = group
        if strip_id is not None and ccd is not None:
            cells[strip_id] += those
        elif ccd is not None:
            of_ccds[ccd] = those
        elif not is_explained:
            yield _of_strip(strip_id, those)
    if of_ccds and not is_explained:
        yield _of_ccds(of_ccds)
    for strip_id, those in cells.items() if not is_explained else ():
        yield _of_cells(strip_id, those)
    of_target: dict[str, list[Suspected]] = defaultdict(list)
    for one in rest:
        of_target[one.target_id].append(one)
    for target_id, those in of_target.items():
        worst = max(those, key=lambda one: one.distance)
        file, what = ("points.csv", "it") if worst.is_point else ("targets.csv", "its chip or coordinates")
        size = float(np.hypot(worst.east_m, worst.north_m))
        strips = [one.strip_id for one in those]
        yield Finding(
            cause="coordinates" if worst.is_point else "coordinates or chip",
            item=f"target {target_id} (strip{'s' if len(strips) > 1 else ''} {', '.join(strips)})",
            text=f"{what} lie{'s' if worst.is_point else ''} about {compass(worst.east_m, worst.north_m)} of "
            f"the true place ({worst.distance:.1f} σ)"
            + (worst.slip or f": check {file}{'' if worst.is_point else ' and the chip'}")
            + ".",
            value=size,
            sigma=worst.sigma_m,
            unit="m",
            file=file,
            field="lat_deg, lon_deg",
            targets=tuple(f"{strip_id}/{target_id}" for strip_id in strips),
        )


Group = tuple[str | None, int | None]  # strip and CCD; None: all


def _split(suspected: Sequence[Suspected], group: Group) -> tuple[list[Suspected], list[Suspected]]:
    """Those in a group, and the others."""
    strip_id, ccd = group
    inside = [strip_id in (None, one.strip_id) and ccd in (None, one.ccd) for one in suspected]
    return [x for x, is_in in zip(suspected, inside) if is_in], [
        x for x, is_in in zip(suspected, inside) if not is_in
    ]


def _groups(suspected: Sequence[Suspected], counts: Counts) -> list[Group]:
    """What more than three targets that are off have in common: all, strips, CCDs or CCDs in one strip,
    whichever explains most. The gain of a group is that of the likelihood if it has a share of its own, less
    a penalty.
    """
    kinds: list[set[Group]] = [
        {(None, None)},
        {(one.strip_id, None) for one in suspected},
        {(None, one.ccd) for one in suspected},
        {(one.strip_id, one.ccd) for one in suspected},
    ]
    best, most = list[Group](), 0.0
    for kind in kinds:
        sizes = {group: len(_split(suspected, group)[0]) for group in kind}
        crowded = sorted((group for group in kind if sizes[group] > FEWEST), key=lambda group: -sizes[group])
        gain = sum(_gain(sizes[group], _in_view(counts, group)) for group in crowded)
        if gain > most:
            best, most = crowded, gain
    return best


def _in_view(counts: Counts, group: Group) -> int:
    """Targets in view of a group."""
    strip_id, ccd = group
    return sum(n for (s, c), (_, n) in counts.items() if strip_id in (None, s) and ccd in (None, c))


def _gain(k: int, n: int) -> float:
    """Of the logarithm of the likelihood, if k of n targets are off with a share of their own."""
    n = max(k, n)
    own = float(xlogy(k, k / n / SUSPECT_SHARE) + xlogy(n - k, (1.0 - k / n) / (1.0 - SUSPECT_SHARE)))
    return own - GROUP_PENALTY


def _of_ccds(of_ccds: Mapping[int, Sequence[Suspected]]) -> Finding:
    """Targets of CCDs that contradict the rest in all strips: of two, perhaps, because they are exchanged."""
    those = [one for ccd in of_ccds for one in of_ccds[ccd]]
    images = "ccd in points.csv" if those[0].is_point else "files in strips.csv"
    fields = "rotation_mrad, x_offset_mm, y_first_mm"
    first, second = f"{fields} in remote_camera.toml", f"{images} exchanged"
    if len(of_ccds) == 2:
        first, second = second, first
    return Finding(
        cause="look directions of a CCD" if len(of_ccds) == 1 else "images or look directions of CCDs",
        item=" and ".join(f"CCD {ccd}" for ccd in sorted(of_ccds)),
        text=f"{len(those)} of {'its' if len(of_ccds) == 1 else 'their'} targets contradict the rest: check "
        f"{first}; or {second}.",
        file="remote_camera.toml",
        field=fields,
        targets=tuple(f"{one.strip_id}/{one.target_id}" for one in those),
    )


def _of_strip(strip_id: str | None, those: Sequence[Suspected]) -> Finding:
    """Targets of one strip, or of all, that contradict the rest."""
    names = tuple(f"{one.strip_id}/{one.target_id}" for one in those)
    more = " and more" if len(those) > SHOWN else ""
    shown = f"{', '.join([one.target_id for one in those][:SHOWN])}{more}"
    if strip_id is None:
        file = "points.csv" if those[0].is_point else "targets.csv"
        return Finding(
            cause="look directions or coordinates",
            item=f"{len(those)} targets of all strips",
            text="they contradict the rest, and no common cause explains them: check x_offset_mm, y_first_mm "
            f"in remote_camera.toml, and {file}.",
            file=f"remote_camera.toml, {file}",
            targets=names,
        )
    file = "points.csv" if those[0].is_point else "targets.csv"
    chips = "" if those[0].is_point else " and the chips"
    return Finding(
        cause="coordinates or chips",
        item=f"{len(those)} targets in strip {strip_id}",
        text=f"{shown} contradict the rest, and no common cause explains them: check {file}{chips}.",
        file=file,
        targets=names,
    )


def _of_cells(strip_id: str, those: Sequence[Suspected]) -> Finding:
    """Targets of CCDs in one strip that contradict the rest."""
    ccds = sorted({one.ccd for one in those})
    file, field = ("points.csv", "ccd") if those[0].is_point else ("strips.csv", "file")
    return Finding(
        cause="images of a CCD",
        item=f"{' and '.join(f'CCD {ccd}' for ccd in ccds)} in strip {strip_id}",
        text=f"{len(those)} targets contradict the rest: check {field} in {file}, CCDs may be exchanged.",
        file=file,
        field=field,
        targets=tuple(f"{strip_id}/{one.target_id}" for one in those),
    )


def lost_targets(
    tasks: Sequence[StripTask], matched: Sequence[MatchedTargets], explained: Sequence[str]
) -> Iterator[Finding]:
    """CCDs and strips of which too many targets were not found, but the items `explained`, and targets that
    their own chips exclude.
    """
    images = {task.strip.strip_id: task.strip.images for task in tasks}
    by_cell = counts_of(matched)
    counts, lost = over_strips(by_cell), lost_ccds(by_cell)
    empty = _flat_images(images, matched)
    silent = [
        ccd
        for ccd, (kept, n) in counts.items()
        if not kept and n >= FEWEST and ccd not in empty and f"CCD {ccd}" not in explained
    ]
    no_majority = bool(set(lost) & set(silent)) and 2 * len(silent) >= len(counts)
    displaced = [ccd for ccd in lost if ccd not in empty and f"CCD {ccd}" not in explained]
    for ccd, strips in empty.items():
        lost_there = [name for one in matched if one.strip_id in strips for name in _of_ccd(one, ccd)]
        yield _dead_ccd(ccd, strips, tuple(lost_there))
    if displaced or no_majority:
        ccds = silent if no_majority else displaced
        gone = tuple(name for one in matched for ccd in ccds for name in _of_ccd(one, ccd))
        yield displaced_ccds(ccds, counts, "targets", gone, refutes=no_majority)
    shown = any(len(one.target_id) for one in matched)
    for one in matched:
        names = [o.name for o in one.omissions if o.cause == Reason.NO_COMMON_ROTATION.replace("_", " ")]
        if not len(one.target_id) and len(names) >= FEWEST and f"strip {one.strip_id}" not in explained:
            flat = [is_flat(images[one.strip_id], ccd) for ccd in images[one.strip_id].ccds]
            if not shown and not all(flat):
                yield _lost_ground(sum(len(x.omissions) for x in matched))
                return
            yield lost_strip(one.strip_id, tuple(names), all_flat=all(flat))
        yield from _excluded(one.omissions)


def displaced_ccds(
    ccds: Sequence[int],
    counts: Mapping[int, tuple[int, int]],
    what: str,
    names: tuple[str, ...] = (),
    *,
    refutes: bool,
) -> Finding:
    """CCDs of which too much is lost; `what` was looked for, found and in view by `counts`."""
    kept, n = (sum(counts[ccd][k] for ccd in ccds) for k in (0, 1))
    others = sum(found for ccd, (found, _) in counts.items() if ccd not in ccds)
    return Finding(
        cause="images or look directions of a CCD",
        item=f"CCD{'s' if len(ccds) > 1 else ''} {', '.join(map(str, ccds))}",
        text=f"{kept} of {n} {what} found, {others} on other CCDs: check files in strips.csv; x_offset_mm, "
        "y_first_mm, rotation_mrad in remote_camera.toml.",
        file="remote_camera.toml",
        field="x_offset_mm, y_first_mm, rotation_mrad",
        refutes=refutes,
        targets=names,
    )


def lost_stars(
    images: Mapping[str, StripFiles],
    counts: Counts,
    lost: Collection[int],
    explained: Sequence[str],
) -> Iterator[Finding]:
    """CCDs `lost`, in which too many stars of strips of the sky are missing, but the items `explained`."""
    every = over_strips(counts)
    dark: dict[int, list[str]] = {}
    for (strip_id, ccd), (found, _) in counts.items():
        if not found and is_flat(images[strip_id], ccd, FLAT_SKY_COUNTS):
            dark.setdefault(ccd, []).append(strip_id)
    for ccd, strips in dark.items():
        yield _dead_ccd(ccd, strips)
    displaced = [ccd for ccd in lost if ccd not in dark and f"CCD {ccd}" not in explained]
    if displaced:
        no_majority = 2 * len(displaced) >= len(every)
        yield displaced_ccds(displaced, every, "bright stars", refutes=no_majority)


def lost_parts(
    tasks: Sequence[StripTask],
    matched: Sequence[MatchedTargets],
    stars: Sequence[LookedFor],
    R_cs: Rotation,
    explained: Sequence[str],
) -> Iterator[Finding]:
    """Halves of CCDs and of the field, and of stars in order of magnitude, of which too much was lost, but of
    the items `explained`; a CCD among these counts in no half.
    """
    ground = [_looked_for(replace(task, R_cs=R_cs), one) for task, one in zip(tasks, matched)]
    targets_left, stars_left = ([one.without(explained) for one in those] for those in (ground, stars))
    for found in (
        *lost_halves(targets_left, LOST_SHARE, PROBABILITY, "targets", fewest_strips=2),
        *lost_halves(stars_left, LOST_SHARE_SKY, PROBABILITY_LOST, "stars"),
    ):
        if not any(item in found.item for item in explained):
            yield found


def _looked_for(task: StripTask, matched: MatchedTargets) -> LookedFor:
    """The targets that a strip must show: those matched, and those in view that were not."""
    p_e = {one.target_id: one.p_e for one in task.targets}
    lost = [
        (name.rpartition("/")[2], int(number))
        for name, mark, number in (one.name.partition(", CCD ") for one in matched.omissions)
        if mark and number.isdigit() and name.rpartition("/")[2] in p_e
    ]
    ccd = np.array([*matched.ccd.tolist(), *(number for _, number in lost)], dtype=np.int64)
    model = pushbroom_of(task)
    predicted = [float(model.pixels_from_ground(number, p_e[name][None])[0][0]) for name, number in lost]
    sample = np.array([*matched.xy_px[:, 0].tolist(), *predicted])
    inside = np.isfinite(sample)
    last = np.array([task.camera.n_px(number) - 1.0 for number in ccd.tolist()])
    return LookedFor(
        strip_id=matched.strip_id,
        ccd=ccd[inside],
        part=sample[inside] / last[inside],
        magnitude=np.full(int(inside.sum()), np.nan),
        found=(np.arange(len(ccd)) < len(matched.ccd))[inside],
    )


def _dead_ccd(ccd: int, strips: Sequence[str], targets: tuple[str, ...] = ()) -> Finding:
    return Finding(
        cause="dead detector or empty file",
        item=f"CCD {ccd} in strip{'s' if len(strips) > 1 else ''} {', '.join(strips)}",
        text="its images hold a single grey value: check its files in strips.csv.",
        file="strips.csv",
        field="file",
        targets=targets,
    )


def _of_ccd(matched: MatchedTargets, ccd: int) -> list[str]:
    """Targets, "strip/target", of a CCD that were not matched."""
    return [o.name.partition(",")[0] for o in matched.omissions if o.name.rpartition(", CCD ")[2] == str(ccd)]


def _flat_images(images: Mapping[str, StripFiles], matched: Sequence[MatchedTargets]) -> dict[int, list[str]]:
    """Strips in which the image of a CCD has no content, by CCD, as targets that show one grey value tell."""
    found: dict[int, list[str]] = {}
    reason = Reason.ONE_GREY_VALUE.replace("_", " ")
    for one in matched:
        of = {o.name.rpartition(", CCD ")[2] for o in one.omissions if o.cause == reason}
        for ccd in sorted(int(number) for number in of if number.isdigit()):
            if ccd in images[one.strip_id].ccds and is_flat(images[one.strip_id], ccd):
                found.setdefault(ccd, []).append(one.strip_id)
    return found


def lost_strip(strip_id: str, targets: tuple[str, ...], *, all_flat: bool) -> Finding:
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
        item=f"strip {strip_id}",
        text=f"none of its {len(targets)} targets found; {text}.",
        file="strips.csv",
        targets=targets,
    )


def _lost_ground(n: int) -> Finding:
    return Finding(
        cause="orbit, times or coordinates",
        item="all strips of the ground",
        text=f"none of {n} targets found: check times and frame of the orbit, file and utc_first_row "
        "in strips.csv, targets.csv; or cloud.",
        file="orbit, strips.csv",
    )


def _excluded(omissions: Sequence[Omission]) -> Iterator[Finding]:
    """Targets that their own chips exclude."""
    causes = {
        Reason.CHIP_TOO_SMALL.replace("_", " "): "pixel size of the chip",
    }
    for one in omissions:
        if one.kind == "target" and one.cause in causes:
            name = one.name.partition(",")[0]
            strip_id, _, target = name.partition("/")
            yield Finding(
                cause=causes[one.cause],
                item=f"target {target} (strip {strip_id})",
                text=f"{one.reason}.",
                file="targets.csv",
                targets=(name,),
            )


def is_flat(images: StripFiles, ccd: int, most: float = FLAT_COUNTS) -> bool:
    """Whether the image of a CCD has no content in its middle: a standard deviation of at most `most`."""
    lines, samples = images.shape(ccd)
    try:
        middle = images.read(ccd, lines // 2, min(lines, lines // 2 + 64), 0, samples)
    except RawDataError:
        return False
    return float(np.std(middle.astype(float))) < most
