"""Errors of the satellite that last longer than a pass: position, clock and attitudes as processes in time.

Passes within so many correlation times that an error of them is still correlated (`error_table`) are
eliminated together; constant errors of heads, independent about their axes, are correlated from pass to pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
from scipy import sparse
from scipy.linalg import block_diag

from boresight.calib.heads import HeadTie, of_heads
from boresight.calib.settings import CalibrationSettings
from boresight.calib.strips import PreparedStrip
from boresight.geometry.sightings import ExposureAttitudes, GroundSightings
from boresight.records.record import Floats, shape_of

__all__ = ["correlated_passes"]

REACH = 4.6  # correlation times between two passes from which on their correlation is below a hundredth


def correlated_passes(
    prepared: Sequence[PreparedStrip], settings: CalibrationSettings
) -> list[tuple[PreparedStrip, list[int]]]:
    """Passes that are eliminated together, joined to one, and which of `prepared` they are."""
    lasting_s = [error.time_s for one in prepared for error in one.lasting]
    longest = max([settings.position_time_s, settings.clock_time_s, *lasting_s])
    groups: list[list[int]] = []
    before: tuple[str, str, float] = "", "", -np.inf
    for n in sorted(range(len(prepared)), key=lambda n: (*_shared(prepared[n]), *_span_s(prepared[n]), n)):
        one, (first, last) = _shared(prepared[n]), _span_s(prepared[n])
        if not longest or one != before[:2] or not first - before[2] <= REACH * longest:
            groups.append([])
        groups[-1].append(n)
        before = *one, max(last, before[2]) if one == before[:2] else last
    groups = sorted(sorted(group) for group in groups)
    return [(_together([prepared[n] for n in group]), group) for group in groups]


def _shared(one: PreparedStrip) -> tuple[str, str]:
    """What passes that are joined have in common."""
    return one.carrier, one.earth


def _span_s(one: PreparedStrip) -> tuple[float, float]:
    t_s = one.ground.t_s
    return float(min(t_s, default=np.inf)), float(max(t_s, default=np.inf))


def _together(passes: list[PreparedStrip]) -> PreparedStrip:
    """Passes as one, each with attitudes of its own."""
    if len(passes) == 1:
        return passes[0]
    columns = (f.name for f in fields(PreparedStrip) if (shape_of(f) or ("",))[0] == "J")
    joined = {
        name: np.concatenate([getattr(one, name) for one in passes])
        for name in columns
        if name not in ("number", "weights", "attitude_s", "by_heads_s")
    }
    phi, ties = _with_lasting(
        passes, _blocks([one.attitude_s[:, :, : one.n_phi] for one in passes]), _ties(passes)
    )
    motion = _blocks([one.attitude_s[:, :, one.n_phi :] for one in passes])
    names = tuple(sorted({name for one in passes for name in one.of_heads}))
    return replace(
        passes[0],
        **joined,
        ground=GroundSightings.together([one.ground for one in passes]),
        attitudes=ExposureAttitudes.together([one.attitudes for one in passes]),
        weights=sparse.block_diag([one.weights for one in passes], format="csr"),
        number=np.repeat(np.arange(len(passes)), [len(one.v_s) for one in passes]),
        attitude_s=np.concatenate([phi, motion], axis=2),
        ties=ties,
        lasting=(),
        of_heads=names,
        by_heads_s=np.concatenate([of_heads(one.of_heads, one.by_heads_s, names) for one in passes]),
        n_phi=phi.shape[2],
    )


def _with_lasting(
    passes: Sequence[PreparedStrip], phi: Floats, ties: tuple[HeadTie, ...]
) -> tuple[Floats, tuple[HeadTie, ...]]:
    """Change (J, 3, P) of the targets' directions, and ties, by attitude unknowns of all passes that are
    independent, from those by unknowns that are correlated from pass to pass where they are one error.
    """
    ends = np.cumsum([one.n_phi for one in passes])
    found = [
        (error, end - len(one.lasting) + n)
        for one, end in zip(passes, ends)
        for n, error in enumerate(one.lasting)
        if error.time_s
    ]
    turn = np.eye(phi.shape[2])
    for key in {(error.head, error.name) for error, _ in found}:
        own = [(error, column) for error, column in found if (error.head, error.name) == key]
        first, last, time_s = np.array([(e.first_s, e.last_s, e.time_s) for e, _ in own]).T
        apart = np.maximum(first[:, None] - last, first - last[:, None])
        values, vectors = np.linalg.eigh(np.exp(-np.maximum(apart, 0.0) / time_s))
        columns = np.array([column for _, column in own])
        turn[np.ix_(columns, columns)] = vectors * np.sqrt(np.maximum(values, 0.0))
    return phi @ turn, tuple(replace(tie, by_phi=tie.by_phi @ turn) for tie in ties)


def _blocks(parts: Sequence[Floats]) -> Floats:
    """Columns (J, 3, m) of passes by themselves as columns (sum J, 3, sum m) of all."""
    joined = block_diag(*(one.reshape(3 * len(one), one.shape[2]) for one in parts))
    return np.asarray(joined.reshape(len(joined) // 3, 3, joined.shape[1]))


def _ties(passes: Sequence[PreparedStrip]) -> tuple[HeadTie, ...]:
    """Rows of the other heads, by the attitude unknowns of all passes."""
    ties, before, n_phi = [], 0, sum(one.n_phi for one in passes)
    for one in passes:
        after = n_phi - before - one.n_phi
        ties += [replace(tie, by_phi=np.pad(tie.by_phi, ((0, 0), (before, after)))) for tie in one.ties]
        before += one.n_phi
    return tuple(ties)
