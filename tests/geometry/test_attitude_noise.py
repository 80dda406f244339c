"""Covariance of a head's attitude errors, against errors that are drawn about the head's own axes."""

import numpy as np
import pytest
from lopsided import HEADS

DRAWS = 40_000
T_S = np.array([0.0, 0.9, 4.3])


@pytest.mark.parametrize("name", HEADS)
def test_covariance_is_that_of_drawn_errors(name: str) -> None:
    noise, rng = HEADS[name], np.random.default_rng(1)
    drawn = np.empty((DRAWS, len(T_S), 3))
    for axis in range(3):
        state = noise.correlated_rad[axis] * rng.standard_normal(DRAWS)
        constant = noise.constant_rad[axis] * rng.standard_normal(DRAWS)
        for k, step in enumerate(np.diff(T_S, prepend=T_S[0])):
            kept = np.exp(-step / noise.correlation_time_s[axis])
            fresh = noise.correlated_rad[axis] * np.sqrt(1.0 - kept**2) * rng.standard_normal(DRAWS)
            state = kept * state + fresh
            drawn[:, k, axis] = state + constant
    drawn_s = noise.R_sn.apply(drawn.reshape(-1, 3)).reshape(DRAWS, -1)
    stated = noise.coloured_covariance_s(T_S).reshape(9, 9)
    error = np.sqrt((np.outer(np.diag(stated), np.diag(stated)) + stated**2) / DRAWS)  # Wishart
    assert (np.abs(drawn_s.T @ drawn_s / DRAWS - stated) < 4.5 * error).all()


@pytest.mark.parametrize("name", HEADS)
def test_white_part_has_the_stated_error_about_each_axis_of_the_head(name: str) -> None:
    noise = HEADS[name]
    for axis in range(3):
        of_the_head = noise.R_sn.apply(np.eye(3)[axis])  # in frame s
        variance = of_the_head @ noise.white_covariance_s @ of_the_head
        assert variance == pytest.approx(noise.white_rad[axis] ** 2)


@pytest.mark.parametrize("span_s", [0.05, 0.7, 9.0, 60.0])
@pytest.mark.parametrize("name", HEADS)
def test_noise_of_a_pass_and_its_constants_are_the_noise(name: str, span_s: float) -> None:
    noise = HEADS[name]
    t_s = 100.0 + np.linspace(0.0, span_s, 400)
    rest, constants, errors = noise.within(t_s[0], t_s[-1], name)
    split = rest.coloured_covariance_s(t_s) + (constants @ constants.T)[:, None, :]
    stated = noise.coloured_covariance_s(t_s)
    assert np.allclose(split[0, :, 0], stated[0, :, 0], rtol=1e-12)  # of a single instant
    means = [np.linalg.eigvalsh(one.mean(axis=(0, 2))) for one in (split, stated)]
    assert np.allclose(*means, rtol=0.01)  # of the mean over the pass
    assert len(errors) == constants.shape[1] and {error.head for error in errors} <= {name}
