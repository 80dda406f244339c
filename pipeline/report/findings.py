"""What a person should look at first: patterns in what a calibration rejected or left unexplained.

Each finding names a cause and the items that it concerns, and states the numbers that were measured. These
need the images; what the estimate and the dump alone show is in the verdict.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import pyarrow as pa

from boresight.calib.finding import Finding
from boresight.geometry.line_camera import end_looks
from boresight.pipeline.calibration.calibrate import DumpCalibration
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.report.ground_map import MapScene, StripOnGround
from boresight.records.ledger import Kind, State, Subject, count_words, list_words

__all__ = ["findings"]

FEWEST = 3  # observations that make a pattern
SMALL_SHARE = 0.4  # of the swath: targets within less are reported
SHOWN = 5  # names in a sentence

Look = tuple[str, float, float]  # target, mean and standard deviation of the strip around it


def findings(
    dump: Dump, calibration: DumpCalibration, scenes: Sequence[MapScene], ground: pa.Table
) -> list[Finding]:
    """What looks wrong in the images and targets of a calibration, the most specific first; may be empty."""
    rows = [row for row in ground.to_pylist() if row["state"] != State.OUT_OF_VIEW]
    strips = {one.strip_id: one for scene in scenes for one in scene.strips}
    return [
        *calibration.verdict.findings,
        *(cloud for strip_id, one in strips.items() for cloud in clouds(strip_id, _looks(one, rows))),
        *spread(_share_of_swath(dump, calibration)),
    ]


def _looks(one: StripOnGround, rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Look]]:
    """What the strip shows at targets that were used and at those that were not matched; nothing is read
    where all were matched.
    """
    seen: dict[str, list[Look]] = {State.USED: [], State.UNMATCHED: []}
    own = [row for row in rows if row["strip_id"] == one.strip_id and np.isfinite(row["line_px"])]
    if all(row["state"] != State.UNMATCHED for row in own):
        return seen
    for row in own:
        if row["state"] in seen and (window := _window(one, row)) is not None:
            seen[row["state"]].append((row["target_id"], *window))
    return seen


def clouds(strip_id: str, seen: Mapping[str, Sequence[Look]]) -> Iterator[Finding]:
    """Unmatched targets where the strip is brighter and flatter than at the targets that were matched."""
    if len(seen[State.USED]) < FEWEST or not seen[State.UNMATCHED]:
        return
    strip = Subject(Kind.STRIP, strip=strip_id)
    brightness, contrast = np.median([look[1:] for look in seen[State.USED]], axis=0)
    cloudy = [
        name for name, b, c in seen[State.UNMATCHED] if b > brightness + contrast and c < 0.5 * contrast
    ]
    if cloudy:
        text = f"it is bright and without contrast at {count_words(len(cloudy), 'target')} that "
        text += f"{'were' if len(cloudy) > 1 else 'was'} not matched: {list_words(cloudy, SHOWN)}."
        targets = tuple(Subject(Kind.TARGET, strip=strip_id, id=name) for name in cloudy)
        yield Finding.about("cloud or snow", strip, text, explains=targets, is_fault=False)


def _window(one: StripOnGround, row: Mapping[str, Any]) -> tuple[float, float] | None:
    """Mean and standard deviation of the strip within 16 px of a target."""
    images, ccd = one.task.strip.images, row["ccd"]
    if ccd not in images.ccds:
        return None
    lines, samples = images.shape(ccd)
    x, y = (int(np.clip(row[name], 16, n - 17)) for name, n in (("sample_px", samples), ("line_px", lines)))
    with suppress(RawDataError, ValueError):
        window = images.read(ccd, max(0, y - 16), y + 17, max(0, x - 16), x + 17).astype(float)
        return float(window.mean()), float(window.std())
    return None


def _share_of_swath(dump: Dump, calibration: DumpCalibration) -> float:
    """Part of the swath's width that the used targets span."""
    kept = calibration.estimate.targets.kept
    y = [strip.ground.u_c[:, 1] / strip.ground.u_c[:, 2] for strip in calibration.strips]
    swath = end_looks(dump.line_camera)
    width = float(np.ptp(swath[:, 1] / swath[:, 2]))
    return float(np.ptp(np.concatenate(y))) / width if width > 0.0 and kept.any() else 1.0


def spread(share: float) -> Iterator[Finding]:
    """A finding if the targets use a small `share` of the swath."""
    if share < SMALL_SHARE:
        yield Finding(
            cause="targets in one part of the swath",
            item="all strips",
            text=f"they span {share:.0%} of its width and hardly determine the rotation about the boresight "
            "(Z): add targets near both ends.",
            is_fault=False,
        )
