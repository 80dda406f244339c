"""The law of rounding: inputs moved by 1e-12 of themselves move no result by more than 1e-3 of its 1-sigma
error, and no error by more than 1e-3 of itself. `pytest -s` prints the largest moves."""

from itertools import pairwise

import numpy as np

NUDGE = 1e-12
MOST = 1e-3


def nudged(values, seed, by=NUDGE):
    """Values that rounding of another processor could give: each moved by up to `by` of itself."""
    values = np.asarray(values, dtype=np.float64)
    return values * (1.0 + by * np.random.default_rng(seed).uniform(-1.0, 1.0, values.shape))


def apart(one, other):
    """Largest move of a value in its error, and of an error in itself, between two results: (values (N,),
    1-sigma errors (N,)) each."""
    (value, sigma), (moved, its_sigma) = ([np.ravel(part) for part in result] for result in (one, other))
    assert value.shape == moved.shape, "another number of results"
    return float(np.abs((moved - value) / sigma).max()), float(np.abs(its_sigma / sigma - 1.0).max())


def assert_unmoved(name, result_of, inputs, seeds=(1, 2)):
    """`result_of` an input is as that of the input nudged: `inputs` are functions of a seed, None: not
    nudged."""
    moves = [apart(result_of(case(None)), result_of(case(seed))) for case in inputs for seed in seeds]
    in_sigmas, of_sigma = np.max(moves, axis=0)
    print(f"\n{name}: {len(moves)} inputs, moved by {in_sigmas:.1e} sigma, errors by {of_sigma:.1e}")
    assert in_sigmas <= MOST and of_sigma <= MOST


def largest_jump(result_of, points=12, least=1e-10):
    """The larger of both moves, as in `apart`, across the step of `least` where results of an input that
    depends on a number from 0 to 1 move most: the interval with the larger move is halved."""
    places = np.linspace(0.0, 1.0, points)
    results = [result_of(place) for place in places]
    moves = [max(apart(a, b)) for a, b in pairwise(results)]
    n = int(np.argmax(moves))
    low, high, first, last = places[n], places[n + 1], results[n], results[n + 1]
    while high - low > least:
        middle = 0.5 * (low + high)
        between = result_of(middle)
        if max(apart(first, between)) > max(apart(between, last)):
            high, last = middle, between
        else:
            low, first = middle, between
    return max(apart(first, last))
