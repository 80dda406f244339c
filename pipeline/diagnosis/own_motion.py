"""Attitudes against their own motion: rows that are no attitude of a satellite that moves as the others tell.

Before anything else is looked at, the attitudes of every head are held against a motion that a satellite can
make (`diagnosis.stretches`). Where they are likelier with larger errors than stated, the proportion of
these from axis to axis tells the cause: errors of the instants, errors of all axes alike, or the stated ones
several times. Single rows that do not fit are reported singly, as exchanged where two of them fit in each
other's place, and as shifted where all fit at the times of other rows. A slow error, or a lag of all rows, is
motion too: others tell of it. Where a gyro covers the rows, that is the motion, and what else is smooth
contradicts it: a lag of the attitudes, or a wrong gyro.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation
from scipy.special import bdtrc, chdtrc

from boresight.calib.finding import Finding
from boresight.calib.verdict import VerdictSettings
from boresight.geometry.constants import ARCSEC
from boresight.geometry.gyro import GyroRecord
from boresight.pipeline.diagnosis.stretches import FACTORS, Stretch, stretches
from boresight.pipeline.files.star_side import Head, SolvedAttitudes
from boresight.pipeline.stages.head import HeadSightings
from boresight.records.ledger import Kind, Subject
from boresight.records.record import Floats, Ints, array, record, scalar

__all__ = ["against_own_motion"]

CERTAIN = 12.0  # logarithm of a likelihood ratio: one of 100,000 sound heads
LEAST_EXCESS = 1.3  # times the stated error, from which larger errors are reported
REFUTES = 2.0  # times the stated error, from which the covariance of the matrix no longer holds
FEWEST_FAST = 8  # rows of a stretch; in shorter ones a motion may be as fast as rows follow one another
MOSTLY = 0.8  # of the rows that are every second one
MOST_ALONE, MOST_NAMED = 12, 4  # rows that may be wrong alone; names in one finding
ALIKE = 3.0  # of that logarithm, within which another kind of error explains as much
FAR_SIGMAS, FAR_RAD = 5.0, np.radians(0.1)  # between two heads: of their mountings, and by wrong times beside
APART = 4.0  # times the scatter about them, by which instants are in two groups
ALLOWED = 6.0  # of the logarithm, by which chance makes one stretch of rows likelier with a smooth error
LAGS_S = np.array([1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 1.0])  # of attitudes against a gyro, that are tried
LEAST_UNEVEN_S = 1e-3  # rms by which instants lie off even ones, from which even ones are tried
LEAST_SHARE = 0.25  # of rows whose instants are off
LEAST_OFF = 0.3  # of the largest difference, from which an instant is off
IN_ARCSEC = 600.0  # angles below are stated in seconds of arc
SHIFTS = (1, -1, 2, -2, 3, -3)  # rows by which attitudes may be shifted against their times
TRIED = np.exp(np.linspace(-4.0, 12.0, 65))  # sizes of an excess, times the stated error
DEFAULTS = VerdictSettings()  # limits of the verdict where none are given


@dataclass(frozen=True)
class Excess:
    """A kind of error beyond the stated one."""

    cause: str  # "{}" is what has it
    text: str  # "{}" is its size
    unit: str
    si: float  # of one unit
    by_axis: Callable[[Stretch], Floats]  # (3,) 1-sigma about each axis by one SI unit, in stated ones


OF_TIMES = Excess(  # any other may be a motion that is faster than the rows
    "times of {}",
    "as they turn, their instants scatter by {:.3g} ms",
    "ms",
    1e-3,
    lambda part: np.abs(part.rate) / part.own,
)
EXCESSES = (
    OF_TIMES,
    Excess(
        "errors of {}",
        "attitudes jump from one to the next, by {:.3g}″, more than stated",
        "″",
        ARCSEC,
        lambda part: 1.0 / part.own,
    ),
    Excess(
        "errors of {}",
        "attitudes scatter by {:.2g} times the stated errors more",
        "times",
        1.0,
        lambda part: np.ones(3),
    ),
)


@record(kw_only=True)
class Attitudes:
    """The usable attitudes of one head, in order of time."""

    head: HeadSightings = scalar("the head")
    names: tuple[str, ...] = array("K", "exposures")
    t_s: Floats = array("K", "instants, TAI seconds since the epoch")
    R_si: Rotation = array("K", "GCRS to the head")
    gyro: GyroRecord | None = scalar("a gyro, in the axes of the head", default=None)
    covariance_s: Floats = array("K, 3, 3", "of each by itself, rad²")
    limits: VerdictSettings = scalar("of the verdict")
    modes: dict[Any, Any] = scalar("of stretches that were looked at, by instants and covariances")

    @classmethod
    def of(cls, head: HeadSightings, reference: Head, limits: VerdictSettings) -> Attitudes:
        """Those of a head; the reference head has the gyro."""
        usable = np.flatnonzero(head.attitudes.usable)
        return cls(
            head=head,
            names=tuple(head.stars[k].exposure_id for k in usable.tolist()),
            t_s=np.array([head.stars[k].t_s for k in usable]),
            R_si=Rotation.from_matrix(head.attitudes.R_si[usable].reshape(-1, 3, 3)),
            covariance_s=head.attitudes.covariance_s[usable],
            limits=limits,
            modes={},
            gyro=reference.gyro and reference.gyro.in_axes(head.head.R_cs0.inv() * reference.R_cs0),
        )

    def stretches(self, rows: Ints) -> list[Stretch]:
        """Stretches of some rows (K,)."""
        noise = self.head.head.noise if self.is_solved else None
        return list(stretches(self.t_s, self.R_si, self.covariance_s, noise, rows, self.gyro, self.modes))

    def against_gyro(self, late_s: float = 0.0) -> dict[int, tuple[float, float]]:
        """Of stretches that the gyro covers, by their first row: how likely they are with a smooth error as
        fits best and without any, as logarithms, if every row was `late_s` later than stated.
        """
        told = self.gyro and replace(self.gyro, t_s=self.gyro.t_s - late_s)
        parts = replace(self, gyro=told).stretches(np.arange(len(self.t_s)))
        return {int(part.rows[0]): part.smooth_fit() for part in parts if part.by_gyro}

    @property
    def is_solved(self) -> bool:
        """Whether the head solved them itself."""
        return isinstance(self.head.head.source, SolvedAttitudes)

    @property
    def is_misfit(self) -> bool:
        """Whether the stars of single exposures contradict one another: their camera or images are wrong, and
        the attitudes scatter as the stars change.
        """
        of, limits = self.head.attitudes, self.limits
        n, lost = len(of.kept), int(np.sum(~of.kept))
        chi2, dof = of.chi2[of.usable].sum(), of.dof[of.usable].sum()
        p_value = min(
            bdtrc(lost - 1, n, limits.share_stars_rejected) if lost else 1.0,
            chdtrc(dof, chi2 / limits.sigma_understated**2),
        )
        return not self.is_solved and n > 0 and bool(p_value < np.exp(-CERTAIN))

    @property
    def what(self) -> str:
        """What the head delivers."""
        return "attitudes" if self.is_solved else "exposures"


def against_own_motion(heads: Sequence[HeadSightings], limits: VerdictSettings = DEFAULTS) -> list[Finding]:
    """Findings about the attitudes of all heads whose attitudes are, by and large, those of one satellite;
    `limits` tell whether the stars of single exposures contradict one another.
    """
    every = [Attitudes.of(head, heads[0].head, limits) for head in heads]
    if any(_are_apart(every[0], other) for other in every[1:]):
        return []  # a file or a convention is wrong, and errors are about other axes than stated
    if every[0].gyro is not None and (of_gyro := _of_gyro(every)):
        return of_gyro
    return [finding for of_head in every for finding in _of_head(of_head)]


def _of_gyro(every: Sequence[Attitudes]) -> list[Finding]:
    """What smooth differences from a gyro tell: a lag of a head, or of the gyro where all heads have it; or
    that the gyro is wrong, where no lag explains them.
    """
    late = {one.head.head.name: _lag(one) for one in every if _beyond_chance(one.against_gyro()) > CERTAIN}
    if not late:
        return []
    if any(np.isnan(size) for size in late.values()):
        text = "does not turn as the attitudes do: check quaternion_sg, unit and quantity in dump.toml."
        return [_about_gyro("a gyro", text, "quaternion_sg")]
    if len(late) == len(every) > 1:
        size_ms = 1e3 * float(np.mean(list(late.values())))
        when = "late" if size_ms > 0.0 else "early"
        text = f"dated {abs(size_ms):.3g} ms {when} against all heads: check the times in its file."
        return [_about_gyro("times of a gyro", text, "file", size_ms)]
    found = []
    for one in (one for one in every if one.head.head.name in late):
        size_ms = -1e3 * late[one.head.head.name]
        text = f"dated {abs(size_ms):.3g} ms {'early' if size_ms < 0.0 else 'late'} against the gyro"
        found.append(_of_all(one, "times of {}", f"{text}: check {{}}.", size_ms, "ms"))
    return found


def _beyond_chance(fits: Mapping[int, tuple[float, float]]) -> float:
    """By how much smooth errors make all stretches likelier than chance does, as a logarithm."""
    return sum(max(best - none - ALLOWED, 0.0) for best, none in fits.values())


def _lag(of_head: Attitudes) -> float:
    """How many seconds late rows must be to turn as the gyro does; NaN where that does not explain them."""
    stated = of_head.against_gyro()

    def gain(late_s: float) -> float:
        fits = of_head.against_gyro(late_s)
        most = fits if 2 * len(fits) > len(stated) else {}
        return sum((none - stated[row][1] for row, (_, none) in most.items()), start=0.0)

    tried = np.concatenate([-LAGS_S[::-1], [0.0], LAGS_S])
    best = int(np.clip(np.argmax([gain(size) for size in tried.tolist()]), 1, len(tried) - 2))
    around = tried[[best - 1, best + 1]]
    size = float(minimize_scalar(lambda late_s: -gain(late_s), bounds=around, method="bounded").x)
    return size if gain(size) > 0.0 and _beyond_chance(of_head.against_gyro(size)) <= CERTAIN else np.nan


def _about_gyro(cause: str, text: str, field: str, size_ms: float = np.nan) -> Finding:
    return Finding(
        cause=cause,
        item="gyro",
        text=text,
        value=size_ms,
        unit="ms" if np.isfinite(size_ms) else "",
        file="dump.toml",
        field=f"gyro.{field}",
        refutes=True,
    )


def _are_apart(one: Attitudes, other: Attitudes) -> bool:
    """Whether attitudes of two heads at the nearest instants differ by more than their mountings may."""
    if not len(one.t_s) or not len(other.t_s):
        return False
    a, b = one.head.head, other.head.head
    nearest = np.abs(one.t_s[:, None] - other.t_s).argmin(axis=1)
    apart = (a.R_cs0 * one.R_si * (b.R_cs0 * other.R_si[nearest]).inv()).magnitude()
    sigma = np.linalg.norm([a.sigma_installation_rad, b.sigma_installation_rad])
    return bool(np.median(apart) > FAR_RAD + FAR_SIGMAS * sigma)


def _of_head(of_head: Attitudes) -> list[Finding]:
    every = np.arange(len(of_head.t_s))
    parts = of_head.stretches(every)
    told = _excess(of_head, parts) or _uneven(of_head, parts)
    if told and told[0].unit != OF_TIMES.unit and of_head.is_misfit:
        return []
    if told is None and max(_gains(parts).values(), default=-1.0) < 0.0:
        return []  # no row whose absence would gain; of two that are wrong one hides the other in part
    groups, in_order, gained = _exchanged(of_head, parts)
    alone, gain = _alone(in_order)
    more = _excess(in_order, in_order.stretches(np.setdiff1d(every, alone)))
    if groups and (more or gained + gain < _alone(of_head)[1] + CERTAIN):  # another order explains no more
        groups, in_order, gained, (alone, gain) = [], of_head, 0.0, _alone(of_head)
        more = _excess(of_head, of_head.stretches(np.setdiff1d(every, alone)))
    price = 2.0 * CERTAIN * sum(len(group) - 1 for group in groups)  # some pair nearly fits by chance
    of_all = max((one for one in (told, _shifted(of_head)) if one), key=lambda one: one[1], default=None)
    if of_all and of_all[1] > gained + gain - price:
        return [of_all[0]]
    rest = np.setdiff1d(every, alone)
    missed = "exchanged they fit, as stated they miss it by"
    found = [_finding(of_head, group, rest, missed) for group in groups]
    if alone:
        found.append(_finding(of_head, alone, rest, "off the motion of the others, by up to"))
    return [*found, *([more[0]] if more else [])]


# --- Single rows


def _gains(parts: Sequence[Stretch]) -> dict[int, float]:
    """By how much the attitudes of some stretches are likelier if one of their rows says nothing, by row."""
    return {row: gain for one in parts for row, gain in zip(one.rows.tolist(), one.gains_without().tolist())}


def _limit(of_head: Attitudes) -> float:
    """Of such a gain, with which a row does not fit."""
    return CERTAIN + float(np.log(max(len(of_head.t_s), 1)))


def _one_by_one(of_head: Attitudes) -> list[tuple[int, float]]:
    """Rows left out one after another, those first without which the others are likeliest, and the gains."""
    left, taken = np.arange(len(of_head.t_s)), list[tuple[int, float]]()
    while len(taken) < MOST_ALONE and (gains := _gains(of_head.stretches(left))):
        row = max(gains, key=lambda row: gains[row])
        taken.append((row, gains[row]))
        left = np.setdiff1d(left, [row])
    return taken


def _alone(of_head: Attitudes) -> tuple[list[int], float]:
    """Rows that do not fit, and by how much the others are likelier without them. One hides another: rows
    are left out as long as that gains in all, and put back where they fit after all.
    """
    taken, every = _one_by_one(of_head), np.arange(len(of_head.t_s))
    price = _limit(of_head) - CERTAIN
    gained = np.cumsum([0.0, *(gain - price for _, gain in taken)])
    n = int(np.argmax(gained))
    if gained[n] < CERTAIN:
        return [], 0.0
    alone = [row for row, _ in taken[:n]]
    for row in tuple(alone):
        without = [one for one in alone if one != row]
        if _gains(of_head.stretches(np.setdiff1d(every, without))).get(row, np.inf) < _limit(of_head):
            alone = without
    return sorted(alone), float(gained[n])


def _exchanged(of_head: Attitudes, parts: Sequence[Stretch]) -> tuple[list[list[int]], Attitudes, float]:
    """Groups of rows that fit in each other's place, the attitudes with these put right, and by how much they
    are likelier; of the pairs that do not fit, the best is exchanged, again and again.
    """
    order: Ints = np.arange(len(of_head.t_s))
    gained = 0.0
    gains = {} if of_head.is_solved else _gains(parts)
    doubtful = sorted(sorted(gains, key=lambda row: -gains[row])[:MOST_ALONE])
    now = _likelihood(parts)
    while True:
        orders = [_exchange(order, pair) for pair in combinations(doubtful, 2)]
        fits = [_likelihood(_in_order(of_head, one).stretches(np.arange(len(one)))) for one in orders]
        best = max(range(len(fits)), key=lambda n: fits[n], default=-1)
        if best < 0 or fits[best] - now < _limit(of_head):
            return _cycles(order), _in_order(of_head, order), gained
        gained, now, order = gained + fits[best] - now, fits[best], orders[best]


def _exchange(order: Ints, pair: tuple[int, int]) -> Ints:
    changed = order.copy()
    changed[list(pair)] = order[list(pair[::-1])]
    return changed


def _in_order(of_head: Attitudes, order: Ints) -> Attitudes:
    return replace(of_head, R_si=of_head.R_si[order], covariance_s=of_head.covariance_s[order])


def _cycles(order: Ints) -> list[list[int]]:
    """Rows that an order puts in one another's place, group by group."""
    each = np.arange(len(order))
    n, group = connected_components(coo_array((np.ones(len(order)), (each, order))))
    return [rows for k in range(n) if len(rows := np.flatnonzero(group == k).tolist()) > 1]


def _likelihood(parts: Sequence[Stretch]) -> float:
    """Logarithm, of some stretches with errors as stated."""
    return float(sum(part.log_likelihoods(FACTORS[:1]).sum() for part in parts))


def _off(of_head: Attitudes, row: int, rows: Ints) -> float:
    """How far a row lies from the straight way between the nearest of the `rows` around it, rad."""
    others = rows[rows != row]
    k = int(np.clip(np.searchsorted(others, row), 1, len(others) - 1))
    a, b = others[k - 1], others[k]
    part = (of_head.t_s[row] - of_head.t_s[a]) / (of_head.t_s[b] - of_head.t_s[a])
    way = (of_head.R_si[b] * of_head.R_si[a].inv()).as_rotvec()
    return float((of_head.R_si[row] * (Rotation.from_rotvec(part * way) * of_head.R_si[a]).inv()).magnitude())


# --- All rows


def _excess(of_head: Attitudes, parts: Sequence[Stretch]) -> tuple[Finding, float] | None:
    """The finding about errors beyond the stated ones, and by how much attitudes are likelier with them."""
    if not parts:
        return None
    likelihoods = [part.log_likelihoods() for part in parts]
    gains, sizes, largest = [], [], []
    for kind in EXCESSES:
        by_axis = [kind.by_axis(part) for part in parts]
        sizes_si = TRIED / float(np.median([one.max() for one in by_axis]))
        factors = [np.hypot(1.0, sizes_si[:, None] * one) for one in by_axis]
        total = np.sum(
            [
                np.interp(np.log(factor), np.log(FACTORS), fit) - fit[0]
                for of_part, fits in zip(factors, likelihoods)
                for factor, fit in zip(of_part.T, fits)
            ],
            axis=0,
        )
        best = int(np.argmax(total))
        gains.append(float(total[best]))
        sizes.append(float(sizes_si[best]))
        largest.append(float(max(of_part[best].max() for of_part in factors)))
    by_gyro = all(part.by_gyro for part in parts)
    if not by_gyro and np.median([len(part.rows) for part in parts]) < FEWEST_FAST:
        fast = max(gain for kind, gain in zip(EXCESSES, gains) if kind is not OF_TIMES)
        gains = [gain - fast if kind is OF_TIMES else 0.0 for kind, gain in zip(EXCESSES, gains)]
    best = int(np.argmax(gains))
    if gains[best] < CERTAIN or largest[best] < LEAST_EXCESS:
        return None
    alike = [EXCESSES[n] for n, gain in enumerate(gains) if n != best and gain > gains[best] - ALIKE]
    told = _told_of_all(of_head, parts, EXCESSES[best], sizes[best], largest[best])
    others = dict.fromkeys(kind.cause.format(of_head.what) for kind in alike)
    rivals = [cause for cause in others if cause != told.cause]
    text = f"{told.text[:-1]}; or {' or '.join(rivals)}." if rivals else told.text
    return replace(told, text=text, rivals=tuple(f"{cause}, {told.item}" for cause in rivals)), gains[best]


def _uneven(of_head: Attitudes, parts: Sequence[Stretch]) -> tuple[Finding, float] | None:
    """The finding about instants with which the attitudes are far less likely than with evenly spaced ones:
    a few rows that are as uneven as their times could be a motion, but not one that even times undo.
    """
    t_s, rows, found = of_head.t_s, np.arange(len(of_head.t_s)), [(0.0, 0.0)]
    if not len(t_s):
        return None
    now = _likelihood(parts)
    for even in _even_instants(t_s, parts):
        off = np.abs(even - t_s)
        off_s = float(np.sqrt(np.mean(off**2)))
        if off_s > LEAST_UNEVEN_S and np.mean(off > LEAST_OFF * off.max()) > LEAST_SHARE:  # not single rows
            found.append((_likelihood(replace(of_head, t_s=even).stretches(rows)) - now, off_s))
    gain, off_s = max(found)
    if gain < _limit(of_head):
        return None
    step_s = _common_step(t_s, off_s)
    multiples = f", all of them multiples of {step_s:.4g} s" if step_s else ""
    text = f"evenly spaced they fit, as stated they scatter by {1e3 * off_s:.3g} ms{multiples}: check {{}}."
    return _of_all(of_head, "times of {}", text, 1e3 * off_s, "ms"), gain


def _shifted(of_head: Attitudes) -> tuple[Finding, float] | None:
    """The finding about attitudes that stand so many rows from their times, and by how much they are likelier
    there, if they are: at gaps between stretches a shift carries rows from one to the next.
    """
    n, found = len(of_head.t_s), [(0.0, 0)]
    for shift in SHIFTS:
        rows = np.arange(max(-shift, 0), n - max(shift, 0))  # that have an attitude then
        moved = _likelihood(_in_order(of_head, np.roll(np.arange(n), -shift)).stretches(rows))
        stated = (_likelihood(of_head.stretches(without)) for without in (rows, rows + shift))
        found.append((moved - max(stated), shift))
    gain, shift = max(found)
    if gain < _limit(of_head):
        return None
    where = f"{abs(shift)} row{'s' * (abs(shift) > 1)} {'early' if shift < 0 else 'late'}"
    text = f"they stand {where}: shifted back all fit, as stated those at gaps do not: check {{}}."
    return _of_all(of_head, "times of {}", text, float(shift), "rows"), gain


def _even_instants(t_s: Floats, parts: Sequence[Stretch]) -> list[Floats]:
    """Evenly spaced instants (K,) along every stretch: with rows missing in long steps, and with none."""
    found = [t_s.copy(), t_s.copy()]
    for part in parts:
        steps = np.diff(part.t_s)
        for even, of_steps in zip(found, (np.maximum(np.round(steps / np.median(steps)), 1.0), steps**0.0)):
            number = np.concatenate([[0.0], np.cumsum(of_steps)])
            even[part.rows] = np.polyval(np.polyfit(number, part.t_s, 1), number)
    return found


def _of_all(
    of_head: Attitudes, cause: str, text: str, size: float, unit: str, *, refutes: bool = True, **more: Any
) -> Finding:
    """About all rows of a head; `cause` has a place for what it delivers, `text` for field and file."""
    head = of_head.head.head
    file, field = head.times_in
    return Finding(
        cause=cause.format(of_head.what),
        item=head.subject.words if of_head.is_solved else "all exposures",
        subjects=(head.subject,) if of_head.is_solved else (),
        text=text.format(f"{field} in {file}"),
        value=size,
        unit=unit,
        file=file,
        field=field,
        refutes=refutes,
        **more,
    )


def _told_of_all(
    of_head: Attitudes, parts: Sequence[Stretch], kind: Excess, size_si: float, largest: float
) -> Finding:
    text, sigma = kind.text.format(size_si / kind.si), np.nan
    if kind is OF_TIMES and (groups := _two_groups(parts, size_si)):
        early, size_si, sigma = groups
        n = sum(len(part.rows) for part in parts)
        alternate = 2.0 * np.sum(np.diff(early) == 2) > MOSTLY * n
        which = "every second one is" if alternate else f"{len(early)} of {n} are"
        text = f"{which} dated {1e3 * size_si:.3g} ms earlier than the others"
    elif kind is OF_TIMES and (step_s := _common_step(of_head.t_s, size_si)):
        text += f", all of them multiples of {step_s:.4g} s"
    is_weak = kind is not OF_TIMES and of_head.head.head.noise_is_assumed
    noise = "its stated noise" if of_head.is_solved else "its images and the star camera"
    look_at = "check {}." if kind is OF_TIMES else f"check {{}}, and {noise}."
    return _of_all(
        of_head,
        kind.cause,
        f"{text}: {look_at}",
        size_si / kind.si,
        kind.unit,
        refutes=largest >= REFUTES and not is_weak,
        sigma=sigma / kind.si,
        is_fault=not is_weak,
    )


def _common_step(t_s: Floats, scatter_s: float) -> float:
    """The step of which all instants are multiples, if they scatter as ones that were cut to it; else 0."""
    step_s = 1e-6 * float(np.gcd.reduce(np.round(1e6 * (t_s - t_s[0])).astype(np.int64)))
    return step_s if 0.5 < step_s / (np.sqrt(12.0) * scatter_s) < 2.0 else 0.0


def _two_groups(parts: Sequence[Stretch], spread_s: float) -> tuple[Ints, float, float] | None:
    """Rows that are dated early, against the others by how much, its 1-sigma, s; None: not in two groups."""
    known = [part.instants(spread_s) for part in parts]
    early_s = np.concatenate([np.linalg.solve(F + np.eye(len(x)) / spread_s**2, x) for F, x in known])
    order = np.sort(early_s)
    cut = order[int(np.argmax(np.diff(order)))]
    few = early_s <= cut
    both = (early_s[few], early_s[~few])
    within = np.hypot(*(np.std(part) * np.sqrt(part.size / few.size) for part in both))
    if float(early_s[~few].mean() - early_s[few].mean()) < APART * within:
        return None
    ends = np.cumsum([0, *(len(part.rows) for part in parts)])
    late = [(~few[a:b]).astype(float) for a, b in pairwise(ends.tolist())]
    information = float(sum(one @ F @ one for one, (F, _) in zip(late, known)))
    size_s = float(sum(one @ x for one, (_, x) in zip(late, known))) / information
    return np.concatenate([part.rows for part in parts])[~few], size_s, 1.0 / np.sqrt(information)


def _finding(of_head: Attitudes, rows: Sequence[int], others: Ints, what: str) -> Finding:
    """About single rows, which do not fit `others`."""
    off_rad = max(_off(of_head, row, others) for row in rows)
    names, source = [of_head.names[row] for row in rows], of_head.head.head.source
    some = names if len(names) <= MOST_NAMED else names[: MOST_NAMED - 1]
    some = [*some, f"{len(names) - len(some)} more"] if len(some) < len(names) else some
    listed = " and ".join(part for part in (", ".join(some[:-1]), some[-1]) if part)
    file, field = (source.file, "utc") if isinstance(source, SolvedAttitudes) else ("exposures.csv", "file")
    off = f"{off_rad / ARCSEC:.3g}″" if off_rad < IN_ARCSEC * ARCSEC else f"{np.degrees(off_rad):.2g}°"
    return Finding(
        cause="files or times of exposures",
        item=f"exposure{'s' if len(names) > 1 else ''} {listed}",
        subjects=tuple(Subject(Kind.EXPOSURE, exposure=name) for name in names),
        text=f"{what} {off}: check {field} and {'utc_mid' if field == 'file' else 'quaternion'} in {file}.",
        file=file,
        field=field,
    )
