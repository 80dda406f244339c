"""Ledgers written down in tests: rows of what strips must show."""

from collections.abc import Sequence

import numpy as np

from boresight.records.ledger import Kind, Ledger, Reason


def ledger_of(
    strips: Sequence[str],
    ccds: Sequence[int],
    reasons: Sequence[Reason],
    ids: Sequence[str] | None = None,
    *,
    part: Sequence[float] | float = 0.25,
    along: Sequence[float] | float = 0.5,
    magnitude: Sequence[float] | float = np.nan,
    kind: Kind = Kind.TARGET,
) -> Ledger:
    """A ledger of rows: strip, CCD, reason and id of each."""
    names, n = list(dict.fromkeys(strips)), len(ccds)
    return Ledger(
        kind=kind,
        strips=tuple(names),
        strip=np.array([names.index(name) for name in strips], dtype=np.int64),
        ccd=np.array(ccds, dtype=np.int64),
        id=np.array(ids if ids is not None else [f"t{k}" for k in range(n)], dtype=str),
        part=np.broadcast_to(np.asarray(part, dtype=float), n),
        along=np.broadcast_to(np.asarray(along, dtype=float), n),
        magnitude=np.broadcast_to(np.asarray(magnitude, dtype=float), n),
        reason=np.array([reason.number for reason in reasons], dtype=np.int64),
    )


def ledger_of_cells(cells: dict[tuple[str, int], tuple[int, int]], kind: Kind = Kind.TARGET) -> Ledger:
    """A ledger by how many were found, and how many must be, in each CCD of each strip."""
    lost = Reason.LOW_CORRELATION
    rows = [
        (strip, ccd, Reason.NONE if k < found else lost)
        for (strip, ccd), (found, n) in cells.items()
        for k in range(n)
    ]
    strips, ccds, reasons = zip(*rows)
    return ledger_of(strips, ccds, reasons, kind=kind)
