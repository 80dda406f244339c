"""Exchanged files of two CCDs of a strip, or of two strips: what is missing on both is found with the image
of the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations, islice

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.finding import Finding
from boresight.pipeline.diagnosis.left_out import Counts, counts_of
from boresight.pipeline.diagnosis.sky_losses import as_bright_as_named, star_counts, stars_looked_for
from boresight.pipeline.errors import Omission
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.image_files import StripFiles
from boresight.pipeline.files.star_tables import survey_of
from boresight.pipeline.stages.sky_side import SkySide
from boresight.pipeline.stages.sky_strip import NamedStars, SkyTask
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, match_strip_targets
from boresight.star_id.strip_stars.find import StripStars

__all__ = ["exchanged_in_ground", "exchanged_in_sky", "exchanged_strips"]

MOST_PAIRS = 3  # of strips that are matched with each other's images; bounds their time
FEWEST = 3  # targets or stars that are found with the exchange
Found = Callable[[int, int], int]


def exchanged_in_ground(tasks: Sequence[StripTask], matched: Sequence[MatchedTargets]) -> Iterator[Finding]:
    """Pairs of CCDs of strips of the ground on which nothing matches, but with the image of the other."""
    for task, one in zip(tasks, matched):

        def found(a: int, b: int, task: StripTask = task) -> int:
            images = _exchanged(task.strip.images, a, b)
            if images.shape(a) != images.shape(b):
                return 0
            outcome = match_strip_targets(replace(task, strip=replace(task.strip, images=images)))
            return 0 if isinstance(outcome, Omission) else len(outcome.ccd)

        if len(one.ccd):
            yield from _findings(task.strip.strip_id, counts_of([one]), found, "targets")


def exchanged_strips(tasks: Sequence[StripTask], matched: Sequence[MatchedTargets]) -> Iterator[Finding]:
    """Pairs of strips of the ground of which nothing matches, but with the images of the other."""
    empty = [
        (task, len(one.omissions)) for task, one in zip(tasks, matched) if not len(one.ccd) and task.targets
    ]
    for (a, n_a), (b, n_b) in islice(combinations(empty, 2), MOST_PAIRS):
        if a.strip.images.shapes != b.strip.images.shapes:
            continue
        seen = 0
        for task, other in ((a, b), (b, a)):
            outcome = match_strip_targets(replace(task, strip=replace(task.strip, images=other.strip.images)))
            seen += 0 if isinstance(outcome, Omission) else len(outcome.ccd)
        if seen >= max(FEWEST, 0.5 * (n_a + n_b)):
            yield Finding(
                cause="files of two strips",
                item=f"strip {a.strip.strip_id} and strip {b.strip.strip_id}",
                text=f"exchanged, {seen} of {n_a + n_b} targets are found, as stated none: check file in "
                "strips.csv.",
                file="strips.csv",
                field="file",
            )


def exchanged_in_sky(
    dump: Dump, side: SkySide, named: Sequence[NamedStars], counts: Counts, R_cs: Rotation
) -> Iterator[Finding]:
    """Pairs of CCDs of strips of the sky whose bright stars all are on the other one."""
    if not counts:
        return
    bright = as_bright_as_named(survey_of(dump.star_catalogue), named)
    for task, one in zip(side.tasks, named):

        def found(a: int, b: int, task: SkyTask = task, stars: StripStars = one.found) -> int:
            other = replace(stars, ccd=np.where(stars.ccd == a, b, np.where(stars.ccd == b, a, stars.ccd)))
            again = star_counts(task, stars_looked_for(dump, task, other, bright, R_cs))
            return again[task.strip.strip_id, a][0] + again[task.strip.strip_id, b][0]

        own = {key: value for key, value in counts.items() if key[0] == task.strip.strip_id}
        yield from _findings(task.strip.strip_id, own, found, "bright stars")


def _findings(strip_id: str, counts: Counts, found: Found, what: str) -> Iterator[Finding]:
    empty = [ccd for (_, ccd), (kept, n) in sorted(counts.items()) if n and not kept]
    for a, b in combinations(empty, 2):
        n, seen = sum(counts[strip_id, ccd][1] for ccd in (a, b)), found(a, b)
        if seen >= max(FEWEST, 0.5 * n):
            yield Finding(
                cause="files of two CCDs",
                item=f"CCD {a} and CCD {b} in strip {strip_id}",
                text=f"exchanged, {seen} of {n} {what} are found, as stated none: check file in strips.csv.",
                file="strips.csv",
                field="file",
            )


def _exchanged(images: StripFiles, a: int, b: int) -> StripFiles:
    """The images of two CCDs, each as that of the other."""
    return StripFiles(
        {a: images.paths[b], b: images.paths[a]},
        {a: images.names[b], b: images.names[a]},
        {a: images.shapes[b], b: images.shapes[a]},
    )
