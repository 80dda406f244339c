"""Pictures of targets that were not matched: what the strip shows where the calibrated model expects them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, get_type_hints

import cv2
import numpy as np
import pyarrow as pa

from boresight.gct_match.predict.template import chip_sides_px, predict_template
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.terrain import Surface
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.table_files import arrow_rows
from boresight.pipeline.files.terrain_files import surface_of
from boresight.pipeline.report.ground_map import MapScene
from boresight.pipeline.report.saved import EVIDENCE
from boresight.pipeline.stages.match_pictures import MatchPictures, match_pictures
from boresight.pipeline.stages.strip import StripTask, read_chip
from boresight.records.ledger import State
from boresight.records.record import Floats

__all__ = ["pictures_at", "unmatched_pictures"]

MOST = 200  # pictures of more make the page too large
SIDE_PX, SMALLEST_PX, MARGIN_PX = 96, 8, 16  # of the template, and of the strip around it


def unmatched_pictures(scenes: Sequence[MapScene], ground: pa.Table, dump: Dump) -> pa.Table:
    """Pictures as of matched targets (`evidence/matches.parquet`), of at most `MOST` that were not matched
    although a CCD shows their place. The chip as expected there, the strip at that place, their difference
    and their correlation within `MARGIN_PX`.
    """
    strips = {one.strip_id: one for scene in scenes for one in scene.strips}
    surface = surface_of(dump.terrain)
    rows: list[dict[str, Any]] = []
    for row in ground.to_pylist():
        if row["state"] != State.UNMATCHED or row["ccd"] < 0 or len(rows) == MOST:
            continue
        one, xy_px = strips[row["strip_id"]], np.array([row["sample_px"], row["line_px"]])
        pictures = pictures_at(one.task, one.model, row["target_id"], row["ccd"], xy_px, surface)
        if pictures is not None:
            own = {name: getattr(pictures, name) for name in get_type_hints(MatchPictures)}
            rows.append({name: row[name] for name in ("strip_id", "target_id", "ccd")} | own)
    return arrow_rows(rows, pa.schema(list(EVIDENCE["unmatched"].items())))


def pictures_at(
    task: StripTask, model: Pushbroom, target_id: str, ccd: int, xy_px: Floats, surface: Surface
) -> MatchPictures | None:
    """Template of a target and strip at `xy_px` (2,), sample and line, where `model` expects it; None where
    the chip or the strip shows nothing of it.
    """
    order = [target.target_id for target in task.targets]
    lines, samples = task.strip.images.shape(ccd)
    if not np.isfinite(xy_px).all():
        return None
    try:
        chip = read_chip(task.chips[order.index(target_id)])
        side = float(chip_sides_px([chip], model, ccd, xy_px[None], surface)[0])
        half = int(min(0.5 * SIDE_PX, 0.5 * side)) if np.isfinite(side) else 0
        x0, y0 = np.maximum(np.round(xy_px).astype(int) - half, 0).tolist()
        w, h = min(2 * half, samples - x0), min(2 * half, lines - y0)
        if min(w, h) < SMALLEST_PX:
            return None
        template = predict_template(chip, model, ccd, (x0, y0), (h, w), surface, task.settings)
        left, top = max(0, x0 - MARGIN_PX), max(0, y0 - MARGIN_PX)
        right, bottom = min(samples, x0 + w + MARGIN_PX), min(lines, y0 + h + MARGIN_PX)
        around = task.strip.images.read(ccd, top, bottom, left, right).astype(np.float32)
    except RawDataError:  # its omission says so
        return None
    expected = np.where(template.valid, template.image, np.mean(template.image)).astype(np.float32)
    x, y = x0 - left, y0 - top
    found = around[y : y + h, x : x + w]
    surface_px = cv2.matchTemplate(around, expected, cv2.TM_CCOEFF_NORMED)
    design = np.column_stack([expected.ravel(), np.ones(expected.size)])
    gain, offset = np.linalg.lstsq(design, found.ravel().astype(float), rcond=None)[0]
    residual = (found - (gain * expected + offset)).astype(np.float32)
    in_surface, unknown = np.array([x, y], dtype=float), np.full(2, np.nan)
    images = expected, found, residual, surface_px
    return match_pictures(*images, in_chip=xy_px - (x0, y0), in_surface=in_surface, off_px=unknown)
