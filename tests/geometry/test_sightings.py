"""The records that stages exchange: shapes are checked at birth, covariances invert on the tangent plane."""

import numpy as np
import pytest
from pytest import approx
from scipy.spatial.transform import Rotation

from boresight.geometry.sightings import (
    StarSightings,
    StripSightings,
    information_of_directions,
    isotropic_covariance,
)


def random_directions(count: int) -> np.ndarray:
    u = np.random.default_rng(5).normal(size=(count, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def star_sightings(**changed) -> StarSightings:
    u = random_directions(4)
    values = dict(
        exposure_id="0001",
        t_s=1.0,
        hip=np.arange(4),
        xy_px=np.zeros((4, 2)),
        u_s=u,
        u_i=u,
        cov_s=isotropic_covariance(u, 1e-5),
    )
    return StarSightings(**{**values, **changed})


def test_a_record_of_unequal_lengths_is_refused_by_name_and_shape():
    with pytest.raises(ValueError, match=r"StarSightings.u_i must have shape \(4, 3\), got \(5, 3\)"):
        star_sightings(u_i=random_directions(5))


def test_quest_information_is_the_projector_over_variance():
    u, sigma = random_directions(50), 3e-6
    information = information_of_directions(u, isotropic_covariance(u, sigma))
    expected = (np.eye(3) - u[:, :, None] * u[:, None, :]) / sigma**2
    assert information == approx(expected, rel=1e-12, abs=1e-3)  # rad^-2 beside 1e11


def test_information_is_the_pseudo_inverse_for_lopsided_covariances():
    u = random_directions(50)
    side = np.cross(u, [0.3, -0.5, 0.8])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(u, side)
    covariance = 9.0 * side[:, :, None] * side[:, None, :] + 0.25 * up[:, :, None] * up[:, None, :]
    assert information_of_directions(u, covariance) == approx(np.linalg.pinv(covariance), abs=1e-12)


def test_exposures_out_of_order_are_refused():
    late, early = star_sightings(t_s=2.0), star_sightings(t_s=1.0)
    with pytest.raises(ValueError, match="increasing order of time"):
        StripSightings(
            strip_id="7",
            exposures=(late, early),
            ground=None,
            R_oi_exposures=Rotation.identity(2),
            R_oi_targets=Rotation.identity(0),
        )  # type: ignore[arg-type]
