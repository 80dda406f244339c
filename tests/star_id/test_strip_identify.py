"""The vote for the mounting: a bold rotation is found, chance is refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.star_id.strip_stars.strip_names import (
    CommonRotation,
    Directions,
    NoRotation,
    StripField,
    _log10_chance,
    name_stars,
    vote_for_rotation,
)

PIXEL = 1e-6
RATE, LINES = 3.6e-3, 7.2  # rad/s, s: a scan of 26 mrad
LIMIT = np.array([9e-3, 9e-3, 9e-3])
LIMITS = {"magnitude_error": 1.5, "max_name_error": 1e-3}
THETA = np.array([-0.0061, 0.0074, -0.0052])


def sky(rng, stars, listed, others, theta=THETA):
    """Directions of a strip's detections, its field, and the catalogue's row of each detection (-1: none)."""
    R0 = Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True)
    t = rng.uniform(0.0, LINES, stars + others)
    y = rng.uniform(-0.0123, 0.0123, stars + others)
    x = np.where(np.arange(stars + others) % 2, -1e-3, 1e-3)
    u_c = np.column_stack([x, y, np.ones(len(y))])
    u_c /= np.linalg.norm(u_c, axis=1)[:, None]
    R_c0i = Rotation.from_rotvec(np.outer(-t, [0.0, RATE, 0.0])) * R0
    u_i = (Rotation.from_rotvec(theta) * R_c0i).inv().apply(u_c)
    v = rng.uniform(5.0, 9.0, stars + others)
    # catalogue: the listed ones, and stars all around
    around = 120
    across, beside = rng.uniform(-0.04, 0.02, around), rng.uniform(-0.022, 0.022, around)
    wide = np.column_stack([across, beside, np.ones(around)])
    field_i = R0.inv().apply(wide / np.linalg.norm(wide, axis=1)[:, None])
    noisy = u_c + np.column_stack([rng.normal(0.0, 0.4 * PIXEL, (len(u_c), 2)), np.zeros(len(u_c))])
    order = np.argsort(v, kind="stable")
    row = np.where(np.arange(stars + others) < listed, np.arange(stars + others), -1)[order]
    seen = Directions(
        u_c=noisy[order] / np.linalg.norm(noisy[order], axis=1)[:, None],
        R_ci=R_c0i.as_matrix()[order],
        brightness=v[order] - 21.0,
        attitude_c=np.zeros((len(v), 3, 0)),
        variance=np.full(len(v), PIXEL**2),
    )
    field = StripField(
        u_i=np.concatenate([u_i[:listed], field_i]),
        v_mag=np.concatenate([v[:listed], rng.uniform(5.0, 9.0, around)]),
        limit_rad=LIMIT,
        spread=(0.5 * PIXEL) ** 2 * np.eye(2),
        slack_rad=2.0 * PIXEL,
        strip_area=0.0246 * 0.026,
    )
    return seen, field, row


@pytest.mark.parametrize("seed", range(4))
def test_a_rotation_of_thousands_of_pixels_is_found_among_unlisted_stars_and_names_are_right(seed):
    seen, field, row = sky(np.random.default_rng(seed), stars=9, listed=9, others=30)
    found = vote_for_rotation(seen, field, 200, 1e-6)
    assert isinstance(found, CommonRotation) and found.stars >= 8
    # nine stars of 0.4 px over 24 000 px: 0.4 px, and a hundredth of a milliradian about the axis
    assert np.abs(found.theta_rad[:2] - THETA[:2]).max() < 3.0 * PIXEL
    assert abs(found.theta_rad[2] - THETA[2]) < 2e-4
    named = name_stars(seen, field, found.theta_rad, found.theta_root, **LIMITS)
    assert np.array_equal(row[named.row], named.star) and len(named.row) >= 8
    assert named.probability_wrong.max() < 1e-4


def test_stars_that_no_catalogue_lists_give_no_rotation():
    skies = (sky(np.random.default_rng(100 + n), 25, 0, 15)[:2] for n in range(12))
    refused = [vote_for_rotation(*one, 200, 1e-6) for one in skies]
    assert all(isinstance(one, NoRotation) for one in refused)
    # the bound holds: an excess of a factor of ten over chance in twelve trials would be one in a hundred
    assert min(one.log10_chance for one in refused) > -3.0


def test_the_bound_of_chance_holds_where_chance_agreement_is_common():
    """Few detections, loose tolerances: three strips in ten agree in three stars or four by chance."""
    strips, seldom = 150, 0.0
    for n in range(strips):
        seen, field, _ = sky(np.random.default_rng(n), 14, 0, 0)
        field = replace(field, u_i=field.u_i[:60], v_mag=field.v_mag[:60], slack_rad=300.0 * PIXEL)
        refused = vote_for_rotation(seen, field, 200, 1e-300)
        assert isinstance(refused, NoRotation)
        seldom += refused.log10_chance <= -1.0
    # 0.024 is the standard error of a share of 0.1; without the number of rotations tested it is 0.29
    assert seldom / strips < 0.1 + 3.0 * 0.024


def test_chance_of_one_rotation_is_that_of_points_drawn_in_its_box():
    """Twelve detections with five stars each in a box of unlike sides; two agree by construction."""
    spread = np.array([[9.0, 4.0], [4.0, 25.0]]) * 1e-10  # rad²
    _, field, _ = sky(np.random.default_rng(0), 3, 3, 0)
    field = replace(field, limit_rad=np.array([2e-4, 9e-4, 1e-3]), spread=spread, slack_rad=3e-5)
    values, axes = np.linalg.eigh(spread)
    long = 3e-5 + 4.0 * np.sqrt(values)  # semi-axes of the ellipse
    reach = np.sqrt((axes**2 * long**2).sum(axis=1))
    half = np.array([9e-4, 2e-4]) + reach  # a rotation about y moves along x
    draws = 20_000
    points = np.random.default_rng(6).uniform(-half, half, (draws, 10, 5, 2)) @ axes / long
    agree = ((points**2).sum(axis=3) < 1.0).any(axis=2).sum(axis=1)
    for more in (1, 2, 3):  # beyond the two
        share = np.mean(agree >= more)
        # a bound: stars of one detection may both agree; 4 standard errors of the share below
        stated = 10.0 ** _log10_chance(12, 60, 2 + more, 1, field)
        assert share - 4.0 * np.sqrt(share / draws) < stated < 1.6 * share, (more, share, stated)


def test_a_rotation_beyond_the_stated_limits_is_not_looked_for():
    seen, field, _ = sky(np.random.default_rng(1), 10, 10, 5, theta=np.array([0.012, 0.0, 0.0]))
    assert isinstance(vote_for_rotation(seen, field, 200, 1e-6), NoRotation)


def test_a_star_of_another_brightness_gets_no_name():
    seen, field, row = sky(np.random.default_rng(7), 9, 9, 0)
    wrong = replace(seen, brightness=seen.brightness + np.where(np.arange(9) == 4, 3.0, 0.0))
    named = name_stars(wrong, field, THETA, np.zeros((3, 3)), **LIMITS)
    assert 4 not in named.row and len(named.row) == 8
    assert np.array_equal(row[named.row], named.star)
