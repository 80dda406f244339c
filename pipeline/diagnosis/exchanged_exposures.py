"""Exposures with the image or time of another one: their attitudes do not fit those of the exposures beside.

The attitude of an exposure relative to the orbital frame lies near the straight way between those of its
neighbours. Where it does not, by far more than is usual in this dump, and the attitudes of two such exposures
put in each other's place do, the two are exchanged. Where no exchange helps, and the way is straight without
a few exposures, these have a wrong image or time. Where attitudes jump from one exposure to the next as far
as they move in all, none is in its place. A manoeuvre is none of these: its bend is seen by all exposures
after it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.finding import Finding
from boresight.geometry.constants import ARCSEC
from boresight.geometry.ledger import Kind, Subject
from boresight.geometry.record import Bools, Floats, Ints
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_side import SolvedAttitudes
from boresight.pipeline.stages.head import HeadSightings

__all__ = ["exchanged_exposures"]

FEWEST = 5  # exposures with two neighbours that say what is usual
UNUSUAL = 11.0  # times the lower quartile of the distances: of two exchanged, six stand out of ten
MOST_GAP = 3.0  # median times between exposures: neighbours further apart tell little
MOST_PAIRED = 12  # exposures of which every pair is tried, and that may be told as wrong alone
MOST_NAMED = 4  # exposures in one finding
LEAST_SIGMAS = 10.0  # of its own attitude, by which an exposure that is wrong alone is off the way
LEAST_JUMP_RAD = 180.0 * ARCSEC  # no vibration is as large: exposures that lie further off are not in order
LEAST_SHARE = 0.1  # of the angle from one exposure to the next, that attitudes without order are off the way
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
    run = _runs(t_s)
    apart, inner = _from_neighbours(R_si * R_oi.inv(), t_s, run)
    if inner.sum() < FEWEST:
        return []
    if _without_order(R_si, apart, inner):
        return [_finding(names, apart.max(), "attitudes jump from one to the next, by up to")]
    order, found = _exchanged(R_si, R_oi, t_s, names)
    sigma = np.sqrt(np.linalg.eigvalsh(head.attitudes.covariance_s[usable[order]])[:, -1])
    alone, off = _wrong_alone(R_si[order] * R_oi.inv(), t_s, sigma)
    if alone:
        off_by = "off the motion of the exposures beside, by up to"
        found.append(_finding([names[k] for k in alone], off, off_by))
    return found


def _finding(names: Sequence[str], off_rad: float, what: str) -> Finding:
    some = (
        list(names)
        if len(names) <= MOST_NAMED
        else [*names[: MOST_NAMED - 1], f"{len(names) - MOST_NAMED + 1} more"]
    )
    listed = " and ".join(part for part in (", ".join(some[:-1]), some[-1]) if part)
    return Finding(
        cause="files or times of exposures",
        item=f"exposure{'s' if len(names) > 1 else ''} {listed}",
        subjects=tuple(Subject(Kind.EXPOSURE, exposure=name) for name in names),
        text=f"{what} {_angle(off_rad)}: check file and utc_mid in exposures.csv.",
        file="exposures.csv",
        field="file",
    )


def _angle(rad: float) -> str:
    return f"{rad / ARCSEC:.3g}″" if rad < 600.0 * ARCSEC else f"{np.degrees(rad):.2g}°"


def _without_order(R_si: Rotation, apart: Floats, inner: Bools) -> bool:
    """Whether exposures lie as far off the way between their neighbours as these are from one another."""
    k = np.flatnonzero(inner)
    usual, steps = float(np.quantile(apart[k], 0.25)), (R_si[k + 1] * R_si[k].inv()).magnitude()
    return usual > max(LEAST_JUMP_RAD, LEAST_SHARE * float(np.median(steps)))


def _wrong_alone(R_so: Rotation, t_s: Floats, sigma: Floats) -> tuple[list[int], float]:
    """Exposures without which the way is straight, in order of time, and the largest distance off it, rad;
    none where it is not with `MOST_PAIRED` left out, or where two of them are neighbours: those may be
    the beginning of a manoeuvre.
    """
    left, off, run = np.arange(len(t_s)), 0.0, _runs(t_s)
    while True:
        apart, inner = _from_neighbours(R_so[left], t_s[left], run[left])
        limit = np.maximum(UNUSUAL * float(np.quantile(apart[inner], 0.25)), LEAST_SIGMAS * sigma[left])
        odd = np.flatnonzero(apart > limit)
        if not len(odd):
            alone = np.setdiff1d(np.arange(len(t_s)), left)
            beside = (np.diff(alone) == 1) & (run[alone[1:]] == run[alone[:-1]])
            return ([], 0.0) if beside.any() else (alone.tolist(), off)
        if len(t_s) - len(left) == MOST_PAIRED or inner.sum() <= FEWEST:
            return [], 0.0
        worst = odd[np.argsort(-apart[odd], kind="stable")][:MOST_PAIRED]
        tried = np.unique(np.add.outer(worst, (-1, 0, 1)).clip(0, len(left) - 1))
        rest = [
            np.sum(_from_neighbours(R_so[kept], t_s[kept], run[kept])[0])
            for kept in (np.delete(left, k) for k in tried)
        ]
        off = max(off, float(apart.max()))
        left = np.delete(left, tried[np.argmin(rest)])


def _exchanged(
    R_si: Rotation, R_oi: Rotation, t_s: Floats, names: Sequence[str]
) -> tuple[Ints, list[Finding]]:
    """Pairs of exposures in each other's place, and the order (K,) that puts them right."""
    order, found, run = np.arange(len(t_s)), list[Finding](), _runs(t_s)
    while True:
        apart, inner = _from_neighbours(R_si[order] * R_oi.inv(), t_s, run)
        limit = UNUSUAL * float(np.quantile(apart[inner], 0.25))
        odd = np.flatnonzero(apart > limit)
        pairs = combinations(odd[np.argsort(-apart[odd], kind="stable")][:MOST_PAIRED].tolist(), 2)
        fits = {pair: _apart_with(R_si, R_oi, t_s, order, pair) for pair in pairs}
        if not fits or min(fits.values()) > limit:
            return order, found
        a, b = min(fits, key=lambda pair: fits[pair])
        told = "exchanged, they fit the motion of the others, as stated they miss it by"
        found.append(_finding(sorted((names[a], names[b])), apart[[a, b]].max(), told))
        order[[a, b]] = order[[b, a]]


def _runs(t_s: Floats) -> Ints:
    """Number (K,) of the run that each exposure belongs to: between runs are long times without exposures."""
    step = np.diff(t_s)
    return np.concatenate([[0], np.cumsum(step > MOST_GAP * float(np.median(step)))])


def _from_neighbours(R_so: Rotation, t_s: Floats, run: Ints) -> Apart:
    """How far attitudes (K,) lie from the straight way between their neighbours, zero at the ends of runs."""
    apart, inner = np.zeros(len(t_s)), np.zeros(len(t_s), dtype=bool)
    inner[1:-1] = run[:-2] == run[2:]
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
    apart, _ = _from_neighbours(R_si[trial] * R_oi.inv(), t_s, _runs(t_s))
    around = np.add.outer(pair, (-1, 0, 1)).clip(0, len(apart) - 1)
    return float(apart[around].max())
