"""Exposures whose files are exchanged: their attitudes fit the motion of the others the other way round.

The attitude of an exposure relative to the orbital frame lies near the straight way between those of its
neighbours. Where it does not, by far more than is usual in this dump, and the attitudes of two such exposures
put in each other's place do, the two are exchanged. A manoeuvre is not: no exchange makes it smooth.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.finding import Finding
from boresight.geometry.constants import ARCSEC
from boresight.geometry.record import Bools, Floats, Ints
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_side import SolvedAttitudes
from boresight.pipeline.stages.head import HeadSightings

__all__ = ["exchanged_exposures"]

FEWEST = 5  # exposures with two neighbours that say what is usual
UNUSUAL = 11.0  # times the lower quartile of the distances: of two exchanged, six stand out of ten
MOST_GAP = 3.0  # median times between exposures: neighbours further apart tell little
MOST_PAIRED = 12  # exposures of which every pair is tried
Apart = tuple[Floats, Bools]  # (K,) rad, and whether the exposure has two neighbours near enough


def exchanged_exposures(dump: Dump, heads: Sequence[HeadSightings]) -> list[Finding]:
    """Findings about pairs of exposures of star cameras that take images."""
    imaging = [head for head in heads if not isinstance(head.head.source, SolvedAttitudes)]
    return [finding for head in imaging for finding in _of_head(dump, head)]


def _of_head(dump: Dump, head: HeadSightings) -> list[Finding]:
    usable = np.flatnonzero(head.attitudes.usable)
    if len(usable) < FEWEST + 2:
        return []
    t_s = np.array([head.stars[k].t_s for k in usable])
    R_oi = dump.orbit.R_oi(t_s)
    names = [head.stars[k].exposure_id for k in usable.tolist()]
    R_si = Rotation.from_matrix(head.attitudes.R_si[usable])
    order, found = np.arange(len(usable)), list[Finding]()
    while True:
        apart, inner = _from_neighbours(R_si[order] * R_oi.inv(), t_s)
        if inner.sum() < FEWEST:
            return found
        limit = UNUSUAL * float(np.quantile(apart[inner], 0.25))
        odd = np.flatnonzero(apart > limit)
        pairs = combinations(odd[np.argsort(-apart[odd])][:MOST_PAIRED].tolist(), 2)
        fits = {pair: _apart_with(R_si, R_oi, t_s, order, pair) for pair in pairs}
        if not fits or min(fits.values()) > limit:
            return found
        a, b = min(fits, key=lambda pair: fits[pair])
        first, second = sorted((names[a], names[b]))
        found.append(
            Finding(
                cause="files or times of exposures",
                item=f"exposures {first} and {second}",
                text=f"exchanged, they fit the motion of the others, as stated they miss it by "
                f"{apart[[a, b]].max() / ARCSEC:.3g}″: check file and utc_mid in exposures.csv.",
                file="exposures.csv",
                field="file",
            )
        )
        order[[a, b]] = order[[b, a]]


def _from_neighbours(R_so: Rotation, t_s: Floats) -> Apart:
    """How far attitudes (K,) lie from the straight way between their neighbours, zero at the ends of runs."""
    apart, inner = np.zeros(len(t_s)), np.zeros(len(t_s), dtype=bool)
    step = np.diff(t_s)
    inner[1:-1] = np.maximum(step[:-1], step[1:]) <= MOST_GAP * float(np.median(step))
    k = np.flatnonzero(inner)
    way = (R_so[k + 1] * R_so[k - 1].inv()).as_rotvec()
    part = (t_s[k] - t_s[k - 1]) / (t_s[k + 1] - t_s[k - 1])
    between = Rotation.from_rotvec(part[:, None] * way) * R_so[k - 1]
    apart[k] = (R_so[k] * between.inv()).magnitude()
    return apart, inner


def _apart_with(R_si: Rotation, R_oi: Rotation, t_s: Floats, order: Ints, pair: tuple[int, int]) -> float:
    """How far two exposures and their neighbours lie from the way at most, with the two exchanged."""
    trial = order.copy()
    trial[list(pair)] = trial[list(pair[::-1])]
    apart, _ = _from_neighbours(R_si[trial] * R_oi.inv(), t_s)
    around = np.add.outer(pair, (-1, 0, 1)).clip(0, len(apart) - 1)
    return float(apart[around].max())
