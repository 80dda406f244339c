"""The curve that stands for the distortion's residual."""

import numpy as np

from boresight.calib.distortion import (
    correlation,
    knot_weights,
    knots_touched,
    prior_information,
    unknown_names,
)
from boresight.simulator.campaign import CameraPair, DistortionCurve, StripPlan, installation_by_tilt

CAMERAS = CameraPair(installation_by_tilt(np.radians(15.0)))


def test_knots_hold_straight_lines_exactly_and_only_within_a_ccd():
    ccd = np.array([0, 0, 1, 1])
    sample = np.array([10.0, 900.0, 10.0, 6000.0])
    knots = knots_touched(ccd, sample, 1000.0)
    weights = knot_weights(ccd, sample, knots, 1000.0)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    value = np.array([500.0 * k for _, k in knots])
    np.testing.assert_allclose(weights @ value, sample)
    assert not np.any(weights[:2][:, [c == 1 for c, _ in knots]])


def test_drawn_curves_have_the_correlation_that_the_prior_states():
    rng = np.random.default_rng(3)
    plan = StripPlan(sigma_distortion_rad=1.0, distortion_length_px=1000.0)
    knots = tuple((1, k) for k in range(5))  # every 500 px
    drawn = np.array(
        [
            DistortionCurve.draw(plan, CAMERAS, rng).at(np.ones(5, dtype=np.int64), 500.0 * np.arange(5))[
                :, 0
            ]
            for _ in range(4000)
        ]
    )
    np.testing.assert_allclose(
        drawn.T @ drawn / 4000, correlation(knots), atol=0.09
    )  # 4 / sqrt(4000) and waves' own


def test_prior_is_found_again_by_the_unknowns_names_in_any_order():
    names = unknown_names(((0, 1), (0, 2), (2, 1)))
    order = np.array([4, 0, 5, 3, 1, 2])
    prior = prior_information(names)
    shuffled = prior_information(tuple(names[k] for k in order))
    np.testing.assert_allclose(shuffled, prior[np.ix_(order, order)], atol=1e-12)
    assert prior_information(()).shape == (0, 0)
