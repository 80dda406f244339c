"""Groups of observations that scatter by more than their stated errors: a strip, a CCD, sky, ground, or all.

In the criterion of `reliability` an observation costs its statistic t, and the limit k at most, where it
counts as a gross error. With errors f times as large as stated it costs min(t / f², k) + 4 ln f, so that a
group gains

    G(f) = Σ min(t, k) - min(t / f², k) - 4 ln f.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from boresight.records.ledger import Kind, Subject
from boresight.records.record import Bools, Floats, Ints, Texts, record

__all__ = ["LEAST_FACTOR", "NoiseGroup", "noisiest"]

FACTORS: Floats = np.exp(np.linspace(0.0, np.log(100.0), 93))
LEAST_FACTOR = 1.5  # times the stated errors, from which that is a finding; of the matrix, it refutes
FEWEST = 5  # observations of a group


@record
class NoiseGroup:
    """A group of observations, and by how much its errors are larger than stated."""

    item: str
    subjects: tuple[Subject, ...]
    inside: Bools  # (J,)
    factor: float  # times the stated errors
    gain: float  # of the criterion


def noisiest(
    statistic: Floats, limit: float, tolerated: float, strip: Texts, ccd: Ints, is_star: Bools, inside: Bools
) -> NoiseGroup | None:
    """The group that gains most, of observations with these statistics (J,), of a CCD (J,) in a strip (J,);
    stated errors may be too small by the factor `tolerated`.
    """
    best: NoiseGroup | None = None
    squared = statistic / tolerated**2
    for item, subjects, own in _groups(strip, ccd, is_star):
        t = squared[own & inside]
        if len(t) < FEWEST:
            continue
        scaled = np.minimum(t / FACTORS[:, None] ** 2, limit).sum(axis=1)
        gain = scaled[0] - scaled - 4.0 * len(t) * np.log(FACTORS)
        n = int(np.argmax(gain))
        if FACTORS[n] > LEAST_FACTOR and (best is None or gain[n] > best.gain):
            best = NoiseGroup(item, subjects, own & inside, float(FACTORS[n]), float(gain[n]))
    return best


def _groups(strip: Texts, ccd: Ints, is_star: Bools) -> Iterator[tuple[str, tuple[Subject, ...], Bools]]:
    yield "all strips", (), np.ones(len(strip), dtype=bool)
    if is_star.any() and not is_star.all():
        yield from (("strips of the sky", (), is_star), ("strips of the ground", (), ~is_star))
    of_strips = [(Subject(Kind.STRIP, strip=name), strip == name) for name in np.unique(strip).tolist()]
    of_ccds = [(Subject(Kind.CCD, ccd=number), ccd == number) for number in np.unique(ccd).tolist()]
    for groups in (of_strips, of_ccds):
        yield from ((one.words, (one,), own) for one, own in groups if len(groups) > 1)
