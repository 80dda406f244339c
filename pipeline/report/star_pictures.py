"""Pictures of the stars of a strip of the sky: the strip, the trace as it was fitted, and the difference."""

from __future__ import annotations

import numpy as np

from boresight.geometry.record import Floats
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.stages.match_pictures import NO_PICTURES, MatchPictures, trace_pictures
from boresight.pipeline.stages.sky_strip import NamedStars, SkyTask, strip_motion
from boresight.star_id.strip_stars.find import StripStars
from boresight.star_id.strip_stars.trace import Motion, trace_images, trace_radius

__all__ = ["star_pictures"]

# Pixels shown around the computed image of a star of a strip.
_MARGIN_PX = 2
_LEVEL_ROWS = 64  # above and below, from which a column's level is taken


def star_pictures(task: SkyTask, named: NamedStars) -> tuple[MatchPictures, ...]:
    """Pictures of the stars with names; none where the strip cannot be read any more."""
    motion, stars = strip_motion(task, task.R_cs0), named.found.take(named.rows)
    pictures = []
    for k, ccd in enumerate(stars.ccd.tolist()):
        own = motion.of(ccd, stars.xy_px[k, 1:])
        try:
            pictures.append(_pictures(task, stars, k, own))
        except RawDataError:
            pictures.append(NO_PICTURES)
    return tuple(pictures)


def _pictures(task: SkyTask, stars: StripStars, k: int, motion: Motion) -> MatchPictures:
    ccd, (x, y), images = int(stars.ccd[k]), stars.xy_px[k], task.strip.images
    lines, samples = images.shape(ccd)
    radius = trace_radius(motion, stars.psf_sigma_px) + _MARGIN_PX
    side = 2 * radius + 1
    left = int(np.clip(round(float(x)) - radius, 0, max(samples - side, 0)))
    top = int(np.clip(round(float(y)) - radius, 0, max(lines - side, 0)))
    first, last = max(top - _LEVEL_ROWS, 0), min(top + side + _LEVEL_ROWS, lines)
    read: Floats = np.asarray(images.read(ccd, first, last, left, left + side), dtype=np.float64)
    seen = read[top - first : top - first + side]
    middle = np.array([[x - left - radius, y - top - radius]])
    unit = trace_images(middle, motion, stars.psf_sigma_px, radius).value.reshape(side, side)
    fitted = np.median(read, axis=0) + stars.flux_dn[k] * unit
    return trace_pictures(seen, fitted[: seen.shape[0], : seen.shape[1]])
