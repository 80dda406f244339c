"""Where a strip may break, and which instants its exposures cover, against values written down by hand."""

import numpy as np
import pytest

from boresight.calib.hypotheses import _breaks
from boresight.calib.pass_attitude import _covered

LINES = np.array([0.0, 10.0, 10.2, 40.0, 100.0, 220.0])  # px; 10.2 is the row of 10.0


@pytest.mark.parametrize(("most", "expected_px"), [(9, [25.0, 70.0]), (1, [25.0]), (0, [])])
def test_a_strip_breaks_midway_between_rows_with_two_on_either_side(most, expected_px):
    assert _breaks(LINES, most) == expected_px


@pytest.mark.parametrize(
    ("times_s", "covered_s", "beyond_s"),
    [
        ([0.0, 2.0, 5.0], [-1.0, 6.5], [-1.01, 6.51]),  # half the first step, half the last
        ([3.0], [2.5, 3.5], [2.49, 3.51]),  # one exposure: half a second
        ([], [], [0.0, 3.0]),
    ],
)
def test_exposures_cover_half_a_step_beyond_their_ends(times_s, covered_s, beyond_s):
    found = _covered(np.array(times_s), np.array([*covered_s, *beyond_s]))
    assert found.tolist() == [True] * len(covered_s) + [False] * len(beyond_s)
