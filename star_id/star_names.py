"""Names of bright stars: the IAU's, else Bayer's letter with the constellation, else the Hipparcos number.

scripts/build_star_names.py made the table.
"""

from __future__ import annotations

import csv
from functools import lru_cache
from importlib.resources import files

__all__ = ["star_name"]

# HIP, IAU name, Bayer designation; a field may be empty.
_FILE = files("boresight.star_id") / "data" / "star_names.csv"


def star_name(hip: int) -> str:
    """A star's name by its Hipparcos number: 'Alcyone', 'τ Phe' or 'HIP 42'."""
    return _names().get(hip) or f"HIP {hip}"


@lru_cache(maxsize=1)
def _names() -> dict[int, str]:
    rows = csv.DictReader(_FILE.read_text(encoding="utf-8").splitlines())
    return {int(row["hip"]): row["name"] or row["bayer"] for row in rows}
