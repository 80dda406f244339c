"""Losses by place and brightness: halves of CCDs, halves of the field, faint and bright stars of a strip.

Whole CCDs and strips are counted elsewhere (`left_out`). Here a half has lost more than good data lose while
its other half has not: dead pixels, stray light, a shifted image; too little signal, or too much.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import bdtrc

from boresight.calib.finding import Finding
from boresight.geometry.record import Bools, Floats, Ints, record, scalar
from boresight.geometry.record import array as of_shape

__all__ = ["LookedFor", "lost_halves"]

HALVES = ("first", "second")  # of samples, or of CCDs in order of their numbers


@record(kw_only=True)
class LookedFor:
    """What must be found in a strip. Row n of every array is the same star or target."""

    strip_id: str = scalar("strip")
    ccd: Ints = of_shape("N", "CCD of the camera, from 0")
    part: Floats = of_shape("N", "place on it: 0 the first sample, 1 the last")
    magnitude: Floats = of_shape("N", "V magnitude; NaN: not a star")
    found: Bools = of_shape("N", "whether it was found there")

    def without(self, items: Collection[str]) -> LookedFor:
        """What is not on a CCD named among `items` ("CCD 2")."""
        rest = np.array([f"CCD {ccd}" not in items for ccd in self.ccd.tolist()], dtype=bool)
        return replace(
            self,
            ccd=self.ccd[rest],
            part=self.part[rest],
            magnitude=self.magnitude[rest],
            found=self.found[rest],
        )


def lost_halves(
    looked: Sequence[LookedFor], share: float, probability: float, what: str, fewest_strips: int = 1
) -> Iterator[Finding]:
    """Halves of which more was lost than the `share` of good data, all of them together named wrongly with
    `probability`; such of which fewer strips than `fewest_strips` lost half tell nothing: clouds.
    """
    shown = [one for one in looked if one.found.any()]
    if not shown:
        return
    found = np.concatenate([one.found for one in shown])
    strip = np.repeat(np.arange(len(shown)), [len(one.found) for one in shown])
    groups = list(_halves(shown))
    ccd = np.concatenate([one.ccd for one in shown])
    left: Bools = np.isin(ccd, ccd[found])  # a CCD without any is a finding of its own

    def p_value(half: Bools, other: Bools) -> float:
        """Of all halves together; 1 where not most of a half is lost, or its other half is, too."""
        kept, n, rest = int(found[half].sum()), int(half.sum()), found[other]
        per_strip = [half & (strip == k) for k in range(len(shown))]
        strips = sum(2 * found[here].sum() < here.sum() for here in per_strip)
        if 2 * kept >= n or 2 * rest.sum() <= len(rest) or strips < fewest_strips:
            return 1.0
        return min(1.0, float(bdtrc(n - kept - 1, n, share)) * len(groups))

    while True:
        tested = [(p_value(half & left, other & left), n) for n, (*_, half, other) in enumerate(groups)]
        p, best = min(tested)
        if p >= probability:
            return
        item, cause, advice, half, other = groups[best]
        kept, rest = found[half & left], found[other & left]
        yield Finding(
            cause=cause,
            item=item,
            text=f"{kept.sum()} of {len(kept)} {what} found, of the other half {rest.sum()} of {len(rest)}: "
            f"{advice}.",
            file="strips.csv",
            field="file",
            p_value=p,
        )
        left = left & ~half  # what it explains is not told again


def _halves(looked: Sequence[LookedFor]) -> Iterator[tuple[str, str, str, Bools, Bools]]:
    """Item, cause, what to look at, the half and the other half."""
    ccd, part, magnitude = (
        np.concatenate([getattr(one, name) for one in looked]) for name in ("ccd", "part", "magnitude")
    )
    names = np.repeat([one.strip_id for one in looked], [len(one.ccd) for one in looked])
    dead = "check its images for dead pixels"
    numbers = np.unique(ccd)
    for number in numbers.tolist():
        here, low = ccd == number, part < 0.5
        for n, half in enumerate((low, ~low)):
            yield (
                f"{HALVES[n]} half of CCD {number}",
                "lost part of a CCD",
                dead,
                here & half,
                here & ~half,
            )
    if len(numbers) > 1:
        low = np.searchsorted(numbers, ccd) + part < 0.5 * len(numbers)
        sides = "check images and look directions of its CCDs"
        for n, half in enumerate((low, ~low)):
            yield f"{HALVES[n]} half of the field", "lost part of the field", sides, half, ~half
    for name in np.unique(names).tolist():
        here = (names == name) & np.isfinite(magnitude)
        if here.any():
            middle = float(np.median(magnitude[here]))
            faint = magnitude > middle
            signal = "check gain, exposure and background of its images"
            yield (
                f"strip {name}, fainter than V {middle:.1f}",
                "lost faint stars",
                signal,
                here & faint,
                here & ~faint,
            )
            yield (
                f"strip {name}, brighter than V {middle:.1f}",
                "lost bright stars",
                "check its images for saturation",
                here & ~faint,
                here & faint,
            )
