"""Attitudes of heads that leave aberration in: as a head solves them from a narrow field of stars."""

import astropy.units as units
import numpy as np
import pytest
from astropy.coordinates import get_body_barycentric_posvel
from astropy.time import Time
from lopsided import ATTITUDES, EPOCH, TIMES_S, VELOCITIES_I
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC, SPEED_OF_LIGHT
from boresight.geometry.starlight import with_all_aberration

BOLD = Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True)
FIELD = 1e-4 * np.array([[0.0, 0.0], [1.0, 0.2], [-0.6, 0.9], [-0.3, -1.1], [0.8, -0.7]])  # rad


def seen_by(u: np.ndarray, velocity_m_s: np.ndarray) -> np.ndarray:
    """Directions (N, 3) of stars for an observer who moves: Lorentz transformation of a photon's momentum."""
    beta = velocity_m_s / SPEED_OF_LIGHT
    gamma = 1.0 / np.sqrt(1.0 - beta @ beta)
    along = u @ beta
    moved = (u / gamma + beta + (gamma / (1.0 + gamma)) * along[:, None] * beta) / (1.0 + along)[:, None]
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


@pytest.mark.parametrize("removed", ["none", "annual", "annual and orbital"])
@pytest.mark.parametrize("k", range(len(TIMES_S)))
@pytest.mark.parametrize("R_hs", [Rotation.identity(), BOLD], ids=["z", "bold"])
def test_attitude_is_the_one_that_apparent_directions_give(removed: str, k: int, R_hs: Rotation) -> None:
    """Axes h of the head's attitudes, whose line of sight is z of s."""
    utc = Time(EPOCH.utc_from_seconds([TIMES_S[k]])[0], scale="utc")
    earth = get_body_barycentric_posvel("earth", utc)[1].xyz.to_value(units.m / units.s)
    u_s = np.column_stack([FIELD, np.ones(len(FIELD))])
    u_s /= np.linalg.norm(u_s, axis=1, keepdims=True)
    apparent = ATTITUDES[k].inv().apply(u_s)
    catalogue = seen_by(apparent, -(earth + VELOCITIES_I[k]))  # of velocities below 1e-4 c: to 1e-8
    seen = {"none": catalogue, "annual": seen_by(catalogue, earth), "annual and orbital": apparent}
    of_the_head = seen[removed]
    reported, _ = Rotation.align_vectors(u_s, of_the_head)
    R_hi, look, one = Rotation.concatenate([R_hs * reported]), R_hs.apply([0.0, 0.0, 1.0]), slice(k, k + 1)
    motion = (EPOCH, TIMES_S[one], VELOCITIES_I[one])
    got = with_all_aberration(R_hi, removed, *motion, line_of_sight_s=look)[0]
    across = (R_hs.inv() * got * ATTITUDES[k].inv()).as_rotvec()[:2]
    # 20 and 5 arc-seconds are put right; 1e-4 of the velocity squared and of the field are left
    assert np.abs(across).max() < 0.005 * ARCSEC
    turned = (reported * ATTITUDES[k].inv()).magnitude()
    assert removed == "annual and orbital" or turned > 0.8 * ARCSEC


def test_apparent_line_of_sight_takes_the_place_of_the_reported_one_by_the_smallest_rotation() -> None:
    """Three attitudes at unlike velocities of 0.1 c and more, at which an arc differs from its sine."""
    velocities = SPEED_OF_LIGHT * np.array([[0.3, -0.1, 0.05], [-0.02, 0.11, 0.06], [0.1, 0.2, -0.35]])
    R_si, axis_s = BOLD * ATTITUDES[:3], np.array([0.48, -0.6, 0.64])
    got = with_all_aberration(R_si, "annual", EPOCH, TIMES_S[:3], velocities, line_of_sight_s=axis_s)
    b = R_si.inv().apply(axis_s)
    a = np.vstack([seen_by(one[None], v) for one, v in zip(b, velocities)])
    np.testing.assert_allclose(got.apply(a), np.tile(axis_s, (3, 1)), atol=1e-13)  # rounding
    turned = (R_si.inv() * got).magnitude()
    np.testing.assert_allclose(turned, np.arccos(np.einsum("ni,ni->n", a, b)), atol=1e-13)
