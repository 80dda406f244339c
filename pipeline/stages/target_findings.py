"""Targets that contradict the rest or were not found: which of them, and what they have in common."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.finding import Finding
from boresight.calib.reliability import Contradiction
from boresight.gct_match.records import Reason
from boresight.geometry.record import record, scalar
from boresight.pipeline.errors import Omission, RawDataError
from boresight.pipeline.files.image_files import StripFiles
from boresight.pipeline.stages.left_out import counts_of_ccds, lost_ccds
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, compass, displaced_m

__all__ = ["Suspected", "is_flat", "lost_strip", "lost_targets", "single_targets", "suspected_targets"]

FEWEST = 3  # targets that make a pattern
FLAT_COUNTS = 2.0  # standard deviation of an image without content
SHOWN = 4  # names in a sentence


@record(kw_only=True)
class Suspected:
    """A target whose own coordinates or chip are probably wrong."""

    target_id: str = scalar("id of the target")
    strip_id: str = scalar("strip that shows it")
    distance: float = scalar("from where the other targets place it, in standard errors")
    east_m: float = scalar("how far its stated place lies east of the one that the strip shows")
    north_m: float = scalar("the same to the north")


def suspected_targets(
    suspects: Sequence[Contradiction],
    R_cs: Rotation,
    tasks: Sequence[StripTask],
    matched: Sequence[MatchedTargets],
) -> Iterator[Suspected]:
    """Where the targets on the ground among `suspects` lie, by the matrix `R_cs`."""
    places = {(one.strip_id, n, c): xy for one in matched for n, c, xy in _places(one)}
    by_id = {task.strip.strip_id: replace(task, R_cs=R_cs) for task in tasks}
    for one in suspects:
        xy_px, task = places.get((one.strip_id, one.target_id, one.ccd)), by_id.get(one.strip_id)
        if xy_px is None or task is None or all(t.target_id != one.target_id for t in task.targets):
            continue  # a star, or a point measured by others
        east_m, north_m = displaced_m(task, one.target_id, one.ccd, xy_px)
        yield Suspected(
            target_id=one.target_id,
            strip_id=one.strip_id,
            distance=one.distance,
            east_m=east_m,
            north_m=north_m,
        )


def _places(matched: MatchedTargets) -> Iterator[tuple[str, int, tuple[float, ...]]]:
    yield from zip(matched.target_id.tolist(), matched.ccd.tolist(), map(tuple, matched.xy_px.tolist()))
    yield from ((one.target_id, one.ccd, one.xy_px) for one in matched.contradicting)


def single_targets(suspected: Sequence[Suspected]) -> Iterator[Finding]:
    """A finding for each target, and for strips of which more than three are off, one for the strip."""
    of_strip: dict[str, list[Suspected]] = defaultdict(list)
    for one in suspected:
        of_strip[one.strip_id].append(one)
    crowded = {strip_id for strip_id, those in of_strip.items() if len(those) > FEWEST}
    for strip_id in sorted(crowded):
        names = [one.target_id for one in of_strip[strip_id]]
        more = " and more" if len(names) > SHOWN else ""
        yield Finding(
            cause="coordinates or chips",
            item=f"{len(names)} targets in strip {strip_id}",
            text=f"{', '.join(names[:SHOWN])}{more} contradict the rest, and no common cause explains them: "
            "check targets.csv and the chips.",
            file="targets.csv",
            targets=tuple(f"{strip_id}/{name}" for name in names),
        )
    of_target: dict[str, list[Suspected]] = defaultdict(list)
    for one in suspected:
        if one.strip_id not in crowded:
            of_target[one.target_id].append(one)
    for target_id, those in of_target.items():
        worst = max(those, key=lambda one: one.distance)
        size = float(np.hypot(worst.east_m, worst.north_m))
        strips = [one.strip_id for one in those]
        yield Finding(
            cause="coordinates or chip",
            item=f"target {target_id} (strip{'s' if len(strips) > 1 else ''} {', '.join(strips)})",
            text=f"its chip or coordinates lie about {compass(worst.east_m, worst.north_m)} of the true "
            f"place ({worst.distance:.1f} σ): check targets.csv and the chip.",
            value=size,
            sigma=size / worst.distance,
            unit="m",
            file="targets.csv",
            field="lat_deg, lon_deg",
            targets=tuple(f"{strip_id}/{target_id}" for strip_id in strips),
        )


def lost_targets(
    tasks: Sequence[StripTask], matched: Sequence[MatchedTargets], explained: Sequence[str]
) -> Iterator[Finding]:
    """CCDs and strips of which too many targets were not found, but the items `explained`, and targets that
    their own chips exclude.
    """
    images = {task.strip.strip_id: task.strip.images for task in tasks}
    counts, lost = counts_of_ccds(matched), lost_ccds(matched)
    empty = _flat_images(images, matched)
    silent = [ccd for ccd, (kept, n) in counts.items() if not kept and n >= FEWEST and ccd not in empty]
    no_majority = bool(set(lost) & set(silent)) and 2 * len(silent) >= len(counts)
    displaced = [ccd for ccd in lost if ccd not in empty and f"CCD {ccd}" not in explained]
    for ccd, strips in empty.items():
        yield Finding(
            cause="dead detector or empty file",
            item=f"CCD {ccd} in strip{'s' if len(strips) > 1 else ''} {', '.join(strips)}",
            text="its images hold a single grey value: check its files in strips.csv.",
            file="strips.csv",
            field="file",
            targets=tuple(name for one in matched if one.strip_id in strips for name in _of_ccd(one, ccd)),
        )
    if displaced or no_majority:
        ccds = silent if no_majority else displaced
        yield _displaced_ccds(ccds, counts, matched, refutes=no_majority)
    for one in matched:
        names = [o.name for o in one.omissions if o.cause == Reason.NO_COMMON_ROTATION.replace("_", " ")]
        if not len(one.target_id) and len(names) >= FEWEST and f"strip {one.strip_id}" not in explained:
            flat = [is_flat(images[one.strip_id], ccd) for ccd in images[one.strip_id].ccds]
            yield lost_strip(one.strip_id, tuple(names), all_flat=all(flat))
        yield from _excluded(one.omissions)


def _displaced_ccds(
    ccds: Sequence[int],
    lost: Mapping[int, tuple[int, int]],
    matched: Sequence[MatchedTargets],
    *,
    refutes: bool,
) -> Finding:
    kept, n = (sum(lost[ccd][k] for ccd in ccds) for k in (0, 1))
    others = sum(int(np.sum(~np.isin(one.ccd, ccds))) for one in matched)
    return Finding(
        cause="images or look directions of a CCD",
        item=f"CCD{'s' if len(ccds) > 1 else ''} {', '.join(map(str, ccds))}",
        text=f"{kept} of {n} targets found, and {others} on other CCDs: check its files in strips.csv, and "
        "x_offset_mm, y_first_mm in remote_camera.toml.",
        file="remote_camera.toml",
        field="x_offset_mm, y_first_mm",
        refutes=refutes,
        targets=tuple(name for one in matched for ccd in ccds for name in _of_ccd(one, ccd)),
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


def is_flat(images: StripFiles, ccd: int) -> bool:
    """Whether the image of a CCD has no content in its middle."""
    lines, samples = images.shape(ccd)
    try:
        middle = images.read(ccd, lines // 2, min(lines, lines // 2 + 64), 0, samples)
    except RawDataError:
        return False
    return float(np.std(middle.astype(float))) < FLAT_COUNTS
