"""What is wrong with an input of a dump, and an input moved by one unit.

Hypotheses that the estimate's own derivatives do not give (effects on light, the aberration that a head has
left in, the velocity of the satellite, the clock of the star camera) are two evaluations of a prediction.
Who reads the dump makes them; `hypotheses` turns them into changes of the residuals.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from boresight.geometry.ledger import Subject
from boresight.geometry.record import Floats, record, scalar

__all__ = ["SIZES", "InputError", "MovedInput"]

SIZES = ("too large", "too small")  # a positive and a negative size in words


@record(kw_only=True)
class InputError:
    """One kind of error of one input."""

    cause: str = scalar('what is wrong: "clock of a strip"')
    item: str = scalar('what it concerns, in words: "strip s02"', default="")
    subjects: tuple[Subject, ...] = scalar("the same as subjects; empty: all", default=())
    unit: str = scalar("of its size")
    words: tuple[str, str] = scalar(
        "a positive and a negative size in words, behind the number", default=SIZES
    )
    file: str = scalar("file of the dump that states the input")
    field: str = scalar("field of that file", default="")
    most: float = scalar("largest size that is possible", default=np.inf)
    usual: float = scalar("usual size", default=1.0)
    usual_of: str = scalar("key under [errors] that states it; empty: set by hand", default="")
    rarity: float = scalar("how much rarer it is than what is stated wrong by hand", default=1.0)


@record(kw_only=True)
class MovedInput(InputError):
    """What one unit too much of an input does, strip by strip; a strip that is not named does not move."""

    directions_i: Mapping[str, Floats] = scalar(
        "by strip: change (J, 3) of the targets' known directions, GCRS", default_factory=dict
    )
    turns_s: Mapping[str, Floats] = scalar(
        "by strip: right-handed rotation (K, 3) of the exposures' attitudes, axes of s, rad",
        default_factory=dict,
    )
