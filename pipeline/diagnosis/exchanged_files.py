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
from boresight.geometry.ledger import Entry, Ledger
from boresight.pipeline.diagnosis.sky_losses import as_bright_as_named, crossings, stars_found
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.images.tiff import StripFiles
from boresight.pipeline.files.star_tables import survey_of
from boresight.pipeline.files.strip_table import Strip
from boresight.pipeline.stages.sky_side import SkySide
from boresight.pipeline.stages.sky_strip import NamedStars, SkyTask
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, match_strip_targets
from boresight.star_id.strip_stars.find import StripStars

__all__ = ["exchanged_in_ground", "exchanged_in_sky", "exchanged_strips"]

MOST_PAIRS = 3  # of strips that are matched with each other's images; bounds their time
FEWEST = 3  # targets or stars that are found with the exchange
Found = Callable[[int, int], int]


def exchanged_in_ground(
    tasks: Sequence[StripTask], matched: Sequence[MatchedTargets], ledger: Ledger
) -> Iterator[Finding]:
    """Pairs of CCDs of strips of the ground on which nothing matches, but with the image of the other."""
    for task, one in zip(tasks, matched):

        def found(a: int, b: int, task: StripTask = task) -> int:
            images = _exchanged(task.strip.images, a, b)
            if images.shape(a) != images.shape(b):
                return 0
            outcome = match_strip_targets(replace(task, strip=replace(task.strip, images=images)))
            return 0 if isinstance(outcome, Entry) else len(outcome.ccd)

        if len(one.ccd):
            yield from _findings(task.strip, ledger, found, "targets")


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
            seen += 0 if isinstance(outcome, Entry) else len(outcome.ccd)
        if seen >= max(FEWEST, 0.5 * (n_a + n_b)):
            yield Finding(
                cause="files of two strips",
                item=f"{a.strip.subject.words} and {b.strip.subject.words}",
                subjects=(a.strip.subject, b.strip.subject),
                text=f"exchanged, {seen} of {n_a + n_b} targets are found, as stated none: check file in "
                "strips.csv.",
                file="strips.csv",
                field="file",
            )


def exchanged_in_sky(
    dump: Dump, side: SkySide, named: Sequence[NamedStars], ledger: Ledger, R_cs: Rotation
) -> Iterator[Finding]:
    """Pairs of CCDs of strips of the sky whose bright stars all are on the other one."""
    if not len(ledger.ccd):
        return
    bright = as_bright_as_named(survey_of(dump.star_catalogue), named)
    for task, one in zip(side.tasks, named):

        def found(a: int, b: int, task: SkyTask = task, stars: StripStars = one.found) -> int:
            other = replace(stars, ccd=np.where(stars.ccd == a, b, np.where(stars.ccd == b, a, stars.ccd)))
            expected = crossings(task, bright, R_cs)
            seen = stars_found(dump, task, other, expected)
            return int(seen[np.isin(expected.ccd, (a, b))].sum())

        yield from _findings(task.strip, ledger, found, "bright stars")


def _findings(strip: Strip, ledger: Ledger, found: Found, what: str) -> Iterator[Finding]:
    counts = ledger.of_strip(strip.strip_id).cells()
    empty = [ccd for (_, ccd), (kept, _) in counts.items() if not kept]
    for a, b in combinations(empty, 2):
        n, seen = sum(counts[strip.strip_id, ccd][1] for ccd in (a, b)), found(a, b)
        if seen >= max(FEWEST, 0.5 * n):
            yield Finding(
                cause="files of two CCDs",
                item=f"CCD {a} and CCD {b} in {strip.subject.words}",
                subjects=(strip.ccd_subject(a), strip.ccd_subject(b)),
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
