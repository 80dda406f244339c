"""What a person should look at first: patterns in what a calibration rejected or left unexplained.

Each finding names a cause and the items that it concerns, and states the numbers that were measured. These
need the images; what the estimate and the dump alone show is in the verdict.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from boresight.calib.estimate import TargetResiduals
from boresight.calib.finding import Finding
from boresight.gct_match.records import Reason
from boresight.geometry.line_camera import end_looks
from boresight.geometry.record import Floats
from boresight.pipeline.errors import Omission, RawDataError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.report.ground_map import (
    OUT_OF_VIEW,
    REJECTED,
    UNMATCHED,
    USED,
    Scene,
    StripOnGround,
)
from boresight.pipeline.stages.calibrate import Calibration
from boresight.pipeline.stages.reasons import doubts
from boresight.pipeline.stages.strip import compass, match_targets, pushbroom_of

__all__ = ["findings"]

FEWEST = 3  # observations that make a pattern
MOST_STRIPS_AGAIN = 4  # strips without any match that are searched again
SMALL_SHARE = 0.4  # of the swath: targets within less are reported
FLAT_COUNTS = 2.0  # standard deviation of an image without content
SHOWN = 5  # names in a sentence

Look = tuple[str, float, float]  # target, mean and standard deviation of the strip around it


def findings(
    dump: Dump, calibration: Calibration, scenes: Sequence[Scene], ground: pa.Table
) -> list[Finding]:
    """All findings, the most specific first; none where nothing stands out."""
    rows = [row for row in ground.to_pylist() if row["state"] != OUT_OF_VIEW]
    strips = {one.strip_id: one for scene in scenes for one in scene.strips}
    share = _share_of_swath(dump, calibration)
    return [
        *calibration.verdict.findings,
        *_displaced_strips(calibration, strips, dump.sigma_installation_rad),
        *silent_ccds(rows, {key: _is_flat(strips[key[0]], key[1]) for key in _lost_ccds(rows)}),
        *single_targets(rows),
        *doubtful(calibration.estimate.targets),
        *(cloud for strip_id, one in strips.items() for cloud in clouds(strip_id, _looks(one, rows))),
        *spread(share),
    ]


def single_targets(rows: Sequence[Mapping[str, Any]]) -> Iterator[Finding]:
    """Targets whose own chip or coordinates contradict the rest; at most `FEWEST` of a strip, more are no
    matter of single targets.
    """
    of_strip = defaultdict(list)
    for row in rows:
        if row["cause"] in SINGLE_CAUSES:
            of_strip[row["strip_id"]].append(row)
    for strip_id, those in of_strip.items():
        for row in those if len(those) <= FEWEST else ():
            text = row["reason"]
            if row["state"] == REJECTED and np.isfinite(row["residual_m"]):
                east_m, north_m = -row["residual_east_m"], -row["residual_north_m"]
                text += f"; its chip or coordinates lie about {compass(east_m, north_m)} of the true place"
            yield Finding(
                cause=SINGLE_CAUSES[row["cause"]],
                item=f"target {row['target_id']} (strip {strip_id})",
                text=f"{text}.",
                targets=(f"{strip_id}/{row['target_id']}",),
            )


SINGLE_CAUSES = {
    "inconsistent": "coordinates or chip",
    "target residual": "coordinates or chip",
    "chip too small": "pixel size of the chip",
}


def doubtful(targets: TargetResiduals) -> Iterator[Finding]:
    """Targets of which one has a gross error; they are kept, with less weight."""
    for names, text in zip(targets.doubtful, doubts(targets)):
        yield Finding(cause="gross error", item=f"one target of {len(names)}", text=text)


def _lost_ccds(rows: Sequence[Mapping[str, Any]]) -> list[tuple[str, int]]:
    """(strip, CCD) of every CCD whose targets were all lost in that strip."""
    states = defaultdict(set)
    for row in rows:
        if row["ccd"] >= 0:
            states[(row["strip_id"], row["ccd"])].add(row["state"])
    return sorted(key for key, found in states.items() if found == {UNMATCHED})


def silent_ccds(
    rows: Sequence[Mapping[str, Any]], is_flat: Mapping[tuple[str, int], bool]
) -> Iterator[Finding]:
    """CCDs in which no target was matched. `is_flat`: of each (strip, CCD) that lost all its targets, whether
    its image has no content.
    """
    for ccd in sorted({ccd for _, ccd in is_flat}):
        here = [row for row in rows if row["ccd"] == ccd]
        flat = [strip for (strip, one), dead in is_flat.items() if one == ccd and dead]
        lost = [row for row in here if (row["strip_id"], ccd) in is_flat]
        if flat:
            names = tuple(f"{r['strip_id']}/{r['target_id']}" for r in lost if r["strip_id"] in flat)
            yield Finding(
                cause="dead detector or empty file",
                item=f"CCD {ccd} in {_strips(flat)}",
                text=f"its image holds a single grey value; none of its {len(names)} targets was matched. "
                f"Check the images of CCD {ccd} in strips.csv.",
                targets=names,
            )
        elif len(lost) == len(here) >= FEWEST and len({row["strip_id"] for row in rows} - {""}) > 1:
            yield Finding(
                cause="images or look directions",
                item=f"CCD {ccd}",
                text=f"none of its {len(here)} targets was matched in {_strips([s for s, _ in is_flat])}. "
                f"Check the images of CCD {ccd} in strips.csv and its place in remote_camera.toml.",
                targets=tuple(f"{r['strip_id']}/{r['target_id']}" for r in lost),
            )


def _strips(names: Sequence[str]) -> str:
    found = sorted(set(names))
    more = f" and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
    return f"strip{'s' if len(found) > 1 else ''} {', '.join(found[:SHOWN])}{more}"


def _is_flat(one: StripOnGround, ccd: int) -> bool:
    images = one.task.strip.images
    if ccd not in images.ccds:
        return False
    lines, samples = images.shape(ccd)
    try:
        middle = images.read(ccd, lines // 2, min(lines, lines // 2 + 64), 0, samples)
    except RawDataError:
        return False
    return float(np.std(middle.astype(float))) < FLAT_COUNTS


def _looks(one: StripOnGround, rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Look]]:
    """What the strip shows at targets that were used and at those that were not matched; nothing is read
    where all were matched.
    """
    seen: dict[str, list[Look]] = {USED: [], UNMATCHED: []}
    own = [row for row in rows if row["strip_id"] == one.strip_id and np.isfinite(row["line_px"])]
    if all(row["state"] != UNMATCHED for row in own):
        return seen
    for row in own:
        if row["state"] in seen:
            window = _window(one, row)
            if window is not None:
                seen[row["state"]].append((row["target_id"], *window))
    return seen


def clouds(strip_id: str, seen: Mapping[str, Sequence[Look]]) -> Iterator[Finding]:
    """Unmatched targets where the strip is brighter and flatter than at the targets that were matched."""
    if len(seen[USED]) < FEWEST or not seen[UNMATCHED]:
        return
    brightness, contrast = np.median([look[1:] for look in seen[USED]], axis=0)
    cloudy = [name for name, b, c in seen[UNMATCHED] if b > brightness + contrast and c < 0.5 * contrast]
    if cloudy:
        more = f" and {len(cloudy) - SHOWN} more" if len(cloudy) > SHOWN else ""
        yield Finding(
            cause="cloud or snow",
            item=f"strip {strip_id}",
            text=f"it is bright and without contrast at {len(cloudy)} target{'s' if len(cloudy) > 1 else ''} "
            f"that {'were' if len(cloudy) > 1 else 'was'} not matched: {', '.join(cloudy[:SHOWN])}{more}.",
            targets=tuple(f"{strip_id}/{name}" for name in cloudy),
            is_fault=False,
        )


def _window(one: StripOnGround, row: Mapping[str, Any]) -> tuple[float, float] | None:
    """Mean and standard deviation of the strip within 16 px of a target."""
    images, ccd = one.task.strip.images, row["ccd"]
    if ccd not in images.ccds:
        return None
    lines, samples = images.shape(ccd)
    x, y = (
        int(np.clip(row[f"{name}_px"], 16, size - 17))
        for name, size in (("sample", samples), ("line", lines))
    )
    try:
        window = images.read(ccd, max(0, y - 16), y + 17, max(0, x - 16), x + 17).astype(float)
    except (RawDataError, ValueError):
        return None
    return float(window.mean()), float(window.std())


def _displaced_strips(
    calibration: Calibration, strips: Mapping[str, StripOnGround], sigma_rad: Floats
) -> Iterator[Finding]:
    """Strips without any match, searched again as if there were no other strip."""
    cause, n_again = Reason.NO_COMMON_ROTATION.replace("_", " "), 0
    for matched in calibration.matched:
        lost = [o for o in matched.omissions if o.cause == cause]
        one = strips.get(matched.strip_id)
        if len(matched.target_id) or len(lost) < FEWEST or one is None or n_again == MOST_STRIPS_AGAIN:
            continue
        n_again += 1
        names = tuple(o.name for o in lost)
        again = match_targets(replace(one.task, sigma_installation_rad=np.asarray(sigma_rad, dtype=float)))
        if isinstance(again, Omission) or len(again.target_id) < FEWEST:
            flat = [_is_flat(one, ccd) for ccd in one.task.strip.images.ccds]
            yield lost_strip(one.strip_id, names, all_flat=all(flat))
            continue
        sample, line = np.median(again.xy_px - again.predicted_px, axis=0).tolist()
        motion = one.task.orbit.velocities_e(one.model.instants(np.zeros(1)))[0]
        yield displaced_strip(
            one.strip_id,
            names,
            (len(again.target_id), sample, line),
            later_ms=line / _lines_per_ms(one, again.target_id.tolist(), again.ccd.tolist()),
            motion_m_s=float(np.linalg.norm(motion)),
            sigma_position_m=calibration.settings.sigma_position_m,
        )


def lost_strip(strip_id: str, targets: tuple[str, ...], *, all_flat: bool) -> Finding:
    """A strip of which nothing was matched, not even alone."""
    if all_flat:
        cause, text = "empty images", "its images hold a single grey value"
    else:
        cause = "images, cloud or clock"
        text = "not even alone do its targets agree on one shift: check that its images are those of this "
        text += "strip, neither mirrored nor in reverse order, its times (utc_first_row), and for cloud"
    return Finding(
        cause=cause,
        item=f"strip {strip_id}",
        text=f"none of its {len(targets)} targets was matched; {text}.",
        targets=targets,
    )


def displaced_strip(
    strip_id: str,
    targets: tuple[str, ...],
    shift: tuple[int, float, float],
    *,
    later_ms: float,
    motion_m_s: float,
    sigma_position_m: float,
) -> Finding:
    """A strip whose targets are not where the matrix of the others expects them, but agree on a shift.

    `shift` is the number of targets that agree, and their shift in samples and lines; `later_ms` by how much
    the rows would be dated too late if that were a matter of time.
    """
    n, sample, line = shift
    late, along_m = "late" if later_ms > 0 else "early", 1e-3 * abs(later_ms) * motion_m_s
    is_time = abs(line) > 3.0 * abs(sample)
    text = (
        f"it was not used: {n} of its targets agree on places {line:+.1f} lines and {sample:+.1f} samples "
        "from where the matrix of the other strips expects them. "
    )
    if is_time:
        text += (
            f"If that is a matter of time, its rows are dated {abs(later_ms):.1f} ms too {late} (the stated "
            f"error of position makes {1e3 * sigma_position_m / motion_m_s:.1f} ms, 1σ, of that uncertain): "
            "check the clock (utc_first_row in strips.csv, time_of_row), then the orbit "
            f"({along_m:.0f} m along the track)."
        )
    else:
        text += (
            "A wrong time moves them along the lines only: check the attitudes and the orbit at that time, "
            "then the mounting, and the times of the exposures."
        )
    cause = "clock or orbit" if is_time else "attitude, orbit or mounting"
    return Finding(cause=cause, item=f"strip {strip_id}", text=text, targets=targets)


def _lines_per_ms(one: StripOnGround, targets: Sequence[str], ccds: Sequence[int]) -> float:
    """By how many lines targets appear later if the rows are dated 1 ms earlier, the attitude's motion and
    all else included.
    """
    strip = one.task.strip
    earlier = pushbroom_of(replace(one.task, strip=replace(strip, t_first_row_s=strip.t_first_row_s - 1e-3)))
    p_e = one.p_e
    points = [(ccd, p_e[target][None]) for target, ccd in zip(targets, ccds)]
    then, now = (
        np.array([model.pixels_from_ground(k, p)[1][0] for k, p in points]) for model in (earlier, one.model)
    )
    return float(np.median(then - now))


def _share_of_swath(dump: Dump, calibration: Calibration) -> float:
    """Part of the swath's width that the used targets span."""
    kept = calibration.estimate.targets.kept
    y = [strip.ground.u_c[:, 1] / strip.ground.u_c[:, 2] for strip in calibration.strips]
    swath = end_looks(dump.line_camera)
    width = float(np.ptp(swath[:, 1] / swath[:, 2]))
    return float(np.ptp(np.concatenate(y))) / width if width > 0.0 and kept.any() else 1.0


def spread(share: float) -> Iterator[Finding]:
    """Targets that use a small part of the swath."""
    if share < SMALL_SHARE:
        yield Finding(
            cause="targets in one part of the swath",
            item="all strips",
            text=f"all targets lie within {share:.0%} of the width of the swath: they hardly determine the "
            "rotation about the boresight (Z). Add targets near both ends of the swath.",
            is_fault=False,
        )
