"""Tables over the rows: as good as they say, also where the tabulated function bends or jumps."""

import numpy as np
import pytest

from boresight.geometry.row_table import tabulated

LINES = np.random.default_rng(1).uniform(0.0, 26_000.0, 20_000)


class Counted:
    """A function of the line that remembers which lines it was asked for."""

    def __init__(self, function):
        self.function, self.calls = function, []

    def __call__(self, line):
        self.calls.append(np.array(line))
        return self.function(line)


def smooth(line):
    return np.stack([np.sin(line / 7000.0), 1e3 + line, np.exp(-line / 9000.0)])


def kinked(line):
    """A kink every 3000 lines, like an attitude between exposures."""
    return np.abs(np.mod(line + 100.0, 6000.0) - 3000.0)[None] / 3000.0 + np.sin(line / 7000.0)[None]


BENDS = np.arange(-100.0, 26_000.0, 3000.0)


def test_a_smooth_function_takes_few_nodes_and_keeps_its_tolerance():
    function = Counted(smooth)
    table = tabulated(function, 0.0, 26_000.0, 1e-10)
    assert not table.rough.any() and table.values.shape[1] < 3500
    function.calls.clear()
    assert np.abs(table.at(LINES) - smooth(LINES)).max() < 1e-10
    assert not function.calls  # the table answers alone
    assert np.abs(table.at(np.array([0.0, 26_000.0])) - smooth(np.array([0.0, 26_000.0]))).max() < 1e-10


def test_known_bends_are_not_smoothed_over():
    function = Counted(kinked)
    table = tabulated(function, 0.0, 26_000.0, 1e-11, BENDS)
    function.calls.clear()
    assert np.abs(table.at(LINES) - kinked(LINES)).max() < 1e-11
    at_bends = BENDS[1:] + np.array([[-1e-3], [0.0], [1e-3]])
    assert np.abs(table.at(at_bends.ravel()) - kinked(at_bends.ravel())).max() < 1e-11
    assert not function.calls


def test_unknown_bends_are_found_and_left_to_the_function():
    table = tabulated(kinked, 0.0, 26_000.0, 1e-9)
    assert 0 < table.rough.mean() < 0.05
    assert np.abs(table.at(LINES) - kinked(LINES)).max() < 1e-9


def test_each_quantity_has_its_own_tolerance():
    def two(line):
        return np.stack([1e6 * np.sin(line / 50.0), np.sin(line / 7000.0)])

    table = tabulated(two, 0.0, 5000.0, np.array([1.0, 1e-12]))
    lines = LINES[LINES < 5000.0]
    error = np.abs(table.at(lines) - two(lines)).max(axis=1)
    assert error[0] < 1.0 and error[1] < 1e-12


@pytest.mark.parametrize("last", [1.5, 40.0, 997.3])
def test_the_function_is_asked_within_the_stretch_alone(last):
    function = Counted(smooth)
    table = tabulated(function, 0.25, last, 1e-10, [-5.0, 0.3, last, 2000.0])
    asked = np.concatenate(function.calls)
    assert asked.min() >= 0.25 and asked.max() <= last
    lines = np.linspace(0.25, last, 77)
    assert table.covers(lines).all() and not table.covers(np.array([0.2, last + 0.1, np.nan])).any()
    assert np.abs(table.at(lines) - smooth(lines)).max() < 1e-10


def test_a_stretch_needs_a_length():
    with pytest.raises(ValueError, match="after the first"):
        tabulated(smooth, 5.0, 5.0, 1e-9)
