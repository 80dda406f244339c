"""What matrices take up of the errors of a pass, against calibrations of sightings with that error."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from drawn_heads import HeadPlan
from scipy.spatial.transform import Rotation
from test_heads import NOISE_A, NOISE_B, R_A, R_B, SHAKEN, seen_by

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.geometry.sightings import StripSightings
from boresight.records.record import Floats
from boresight.simulator.campaign import StripPlan

PLAN = StripPlan(strips=4, sigma_position_m=2.0, sigma_clock_s=1e-4, sigma_vibration_rad=0.1 * ARCSEC)
SETTINGS = CalibrationSettings(robust=False)


def flown() -> list[StripSightings]:
    plans = [HeadPlan("A", R_A, NOISE_A), HeadPlan("B", R_B, NOISE_B, shift_s=0.033)]
    return seen_by(plans, PLAN, np.random.default_rng(3))


def with_error(strip: StripSightings, error: Floats) -> StripSightings:
    """The strip as it is stated where true attitudes (rad, axes of s), position (m, along the track, to the
    right, down) and instants (s) are what was stated and `error` (7,).
    """
    turn = Rotation.from_rotvec(-error[:3])
    ground, R_oi = strip.ground, strip.R_oi_targets
    across = np.eye(3) - ground.u_i[:, :, None] * ground.u_i[:, None, :]
    moved = R_oi.inv().apply(np.tile(error[3:6], (len(ground.u_i), 1))) + error[6] * ground.v_rel_i
    u_i = ground.u_i + np.einsum("jab,jb->ja", across, moved) / ground.range_m[:, None]
    fitted = strip.fitted
    return replace(
        strip,
        ground=replace(ground, u_i=u_i / np.linalg.norm(u_i, axis=1, keepdims=True)),
        attitudes=replace(fitted, R_si=turn.as_matrix() @ fitted.R_si),
        others=tuple(replace(one, R_hi=one.R_sh.inv() * turn * one.R_sh * one.R_hi) for one in strip.others),
    )


def estimated(strips: list[StripSightings]) -> InstallationEstimate:
    found = calibrate_strips(strips, SHAKEN * R_A, SETTINGS)
    assert isinstance(found, InstallationEstimate)
    return found


@pytest.mark.parametrize("cut", [1, 3])
def test_matrices_of_all_heads_move_as_stated_with_an_error_of_one_pass(cut: int) -> None:
    strips = flown()
    whole, name, cuts = strips[1], strips[1].strip_id, np.arange(len(strips[1].ground.target_id)) % cut
    targets = [np.flatnonzero(cuts == n) for n in range(cut)]
    parts = [
        replace(
            whole, strip_id=f"{name}/{n}", ground=whole.ground.take(at), R_oi_targets=whole.R_oi_targets[at]
        )
        for n, at in enumerate(targets)
    ]
    others = [strips[0], *strips[2:]]
    before = estimated([*others, *parts])
    for axis, size in enumerate([*[2.0 * ARCSEC] * 3, *[5.0] * 3, 5e-4]):
        error = size * np.eye(7)[axis]
        after = estimated([*others, *(with_error(part, error) for part in parts)])
        moved = [theta_between(b.R_cs, a.R_cs) for a, b in zip(before.heads, after.heads)]
        for part, head in product(parts, range(2)):
            stated = before.taken_up[part.strip_id][3 * head : 3 * head + 3] @ error
            # The attitude at another instant is not made here: 0.06 deg/s, of 7.6 km/s from 500 km
            limit = 0.2 if axis == 6 else 0.01
            assert moved[head] == pytest.approx(stated, abs=limit * np.linalg.norm(moved[head]))
            assert np.linalg.norm(stated) > 1e-9  # rad; the height moves it by the least, 1.7e-8


def test_what_all_passes_have_in_common_is_taken_up_whole() -> None:
    # A rotation of all attitudes turns the matrices against it, whatever the weights.
    found = estimated(flown())
    whole = np.sum([G[:, :3] for G in found.taken_up.values()], axis=0)
    C = found.R_cs.as_matrix()
    assert whole == pytest.approx(-np.vstack([C, C]), abs=1e-6)
