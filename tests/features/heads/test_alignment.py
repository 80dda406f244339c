"""The alignment between two heads against the one that was drawn."""

import numpy as np
from drawn_campaigns import assert_chi_square, squared
from two_trackers import NOISE, R_SH, T, tracks

from boresight.features.heads.alignment import align_heads


def test_alignment_and_its_covariance_hold() -> None:
    nees, runs = 0.0, 30
    for seed in range(runs):
        found = align_heads(
            *tracks(np.random.default_rng(100 + seed)), (NOISE[0], NOISE[1]), {"hour": T / 3600}, 10.0
        )
        error = (found.R_sh * R_SH.inv()).as_rotvec()
        nees += squared(error, found.covariance_s)
        assert abs(found.angle_rad - np.arccos(R_SH.apply([0, 0, 1])[2])) < 6.0 * found.sigma_angle_rad
        drift = found.terms[0]
        assert np.all(np.abs(drift.value) < 5.0 * drift.sigma)
    assert_chi_square(nees, 3 * runs)


def test_time_offset_shows_when_the_satellite_slews() -> None:
    late = 0.012  # s
    noise = (NOISE[0], NOISE[1])
    slewing = align_heads(*tracks(np.random.default_rng(7), late, slew_rad_s2=1e-4), noise, {}, 10.0)
    assert abs(slewing.time_offset_s - late) < 4.0 * slewing.sigma_time_offset_s < 0.004
    steady = align_heads(*tracks(np.random.default_rng(7), late), noise, {}, 10.0)
    assert steady.sigma_time_offset_s > 0.05
