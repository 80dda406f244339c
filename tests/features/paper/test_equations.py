"""Every numbered equation of the paper holds, to rounding or to what an approximation neglects."""

import numpy as np
import pytest
from equations import GROUPS


@pytest.mark.parametrize("group", range(len(GROUPS)), ids=[group.__name__ for group in GROUPS])
def test_the_equations_of_the_paper_hold(group: int) -> None:
    seen: list[tuple[str, str, float, float]] = []

    def shown(number: str, what: str, difference: float, limit: float, unit: str = "") -> None:
        seen.append((number, what, difference, limit))

    GROUPS[group](np.random.default_rng(group + 1), shown)
    assert len(seen) >= 5
    assert [row for row in seen if not row[2] <= row[3]] == []
