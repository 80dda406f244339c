"""Findings: what is probably wrong with the inputs of a calibration, with its size and the remedy."""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from boresight.records.ledger import Subject
from boresight.records.record import Floats, array, record, scalar

__all__ = ["MOST_WORDS", "Finding"]

MOST_WORDS = 30  # of cause, item and text together


@record(kw_only=True)
class Finding:
    """One cause, told once, however many observations it explains."""

    cause: str = scalar('what is probably the matter: "clock of a strip"')
    item: str = scalar('what it concerns, in words: "strip s02"')
    text: str = scalar("sentence: how much, in which file and field, what to do; `MOST_WORDS` with the above")
    value: float = scalar("size of the error, stated less true, in `unit`; NaN: not measured", default=np.nan)
    sigma: float = scalar("1-sigma of `value`", default=np.nan)
    unit: str = scalar('of `value` and `sigma`: "ms"; empty: not measured', default="")
    file: str = scalar('file of the dump that states the input: "strips.csv"', default="")
    field: str = scalar('field of that file: "utc_first_row"', default="")
    refutes: bool = scalar("the matrix is not to be used", default=False)
    is_fault: bool = scalar("an input is probably wrong; otherwise the data are only weak", default=True)
    effect_rad: Floats = array(
        "T", "by how much it moves theta, axes of c; NaN: unknown", default_factory=lambda: np.full(3, np.nan)
    )
    effect_sigma: float = scalar("the same in 1-sigma of theta; NaN: unknown", default=np.nan)
    p_value: float = scalar("probability of as much where nothing is wrong; NaN: not a test", default=np.nan)
    rivals: tuple[str, ...] = scalar(
        'other causes, "cause, item", that explain as much: `text` names them behind "or"', default=()
    )
    subjects: tuple[Subject, ...] = scalar("what it concerns; empty: the whole dump", default=())
    explains: tuple[Subject, ...] = scalar("observations that it explains", default=())

    @classmethod
    def about(cls, cause: str, it: Subject, text: str, file: str = "", field: str = "", **more: Any) -> Self:
        """About one subject, with its words."""
        return cls(cause=cause, item=it.words, subjects=(it,), text=text, file=file, field=field, **more)
