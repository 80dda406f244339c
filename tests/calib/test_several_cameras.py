"""Several cameras of one satellite: a matrix each, and the rotations between them, from the same passes."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from drawn_campaigns import TABLE_1, assert_chi_square, draw_other_camera, squared
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.calib.calibration import calibrate_strips, strip_pairs
from boresight.calib.estimate import InstallationEstimate, NotObservable
from boresight.calib.information import InformationPairs
from boresight.calib.reliability import examine
from boresight.calib.settings import CalibrationSettings
from boresight.calib.verdict import Outcome, Verdict, assess
from boresight.geometry.installation import theta_between
from boresight.geometry.sightings import StripSightings
from boresight.records.ledger import Subject
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips

NADIR = CameraPair(Rotation.from_euler("xyz", [40, -65, 110], degrees=True))
# A second camera with a third of the field, twice as large pixels, and axes of its own.
OBLIQUE = CameraPair(
    Rotation.from_euler("xyz", [25, -9, 81], degrees=True) * NADIR.R_cs, pixel_rad=2e-6, ccd_px=2048, n_ccds=2
)
CAMERAS = {"nadir": NADIR, "oblique": OBLIQUE}
R_CS = {name: camera.R_cs for name, camera in CAMERAS.items()}
PIXELS = {name: camera.pixel_rad for name, camera in CAMERAS.items()}
PLAN = replace(TABLE_1, strips=3, exposures=8, exposure_margin_s=0.3, targets=12, sigma_target_m=0.3)
MODEL = CalibrationSettings()


def campaign(seed: int, plan: StripPlan = PLAN) -> list[StripSightings]:
    rng = np.random.default_rng([57, seed])
    strips, truth = draw_strips(plan, NADIR, rng)
    others = draw_other_camera(strips, truth, plan, OBLIQUE, "oblique", rng)
    return [*(replace(strip, camera="nadir") for strip in strips), *others]


def estimated(strips: list[StripSightings], model: CalibrationSettings = MODEL) -> InstallationEstimate:
    estimate = calibrate_strips(strips, R_CS, model)
    assert isinstance(estimate, InstallationEstimate)
    return estimate


@cache
def first() -> InstallationEstimate:
    return estimated(campaign(0))


def told(strips: list[StripSightings], estimate: InstallationEstimate) -> Verdict:
    reliability = examine(estimate, strips, MODEL, pixel_rad=PIXELS)
    return assess(estimate, strips, sigma_installation_rad=np.full(6, 1e-3), reliability=reliability)


def test_the_covariance_of_both_matrices_and_of_the_rotation_between_them_is_honest() -> None:
    runs, of_both, of_between = 30, [], []
    for seed in range(runs):
        found = estimated(campaign(seed))
        assert found.cameras == ("nadir", "oblique")
        off = theta_between(found.R_cs, Rotation.concatenate(list(R_CS.values()))).ravel()
        of_both.append(squared(off, found.cov_theta))
        (between,) = found.between()
        off = theta_between(between.R_ab, NADIR.R_cs * OBLIQUE.R_cs.inv())
        of_between.append(squared(off, between.covariance))
    for squares, dof in ((of_both, 6), (of_between, 3)):
        assert_chi_square(squares, dof)


def test_each_matrix_is_as_well_known_as_alone_and_the_rotation_between_them_better() -> None:
    # attitudes and position are the most of it
    strips = campaign(0, replace(PLAN, sigma_s_px=2.0, targets=40))
    found = estimated(strips)
    alone = [estimated([strip for strip in strips if strip.camera == name]) for name in CAMERAS]
    assert [one.cameras for one in alone] == [("",), ("",)]
    sigma = np.split(found.sigma_theta, 2)
    for one, of_one in zip(alone, sigma):
        np.testing.assert_allclose(of_one, one.sigma_theta, rtol=0.1)  # a little is learned of the attitudes
        assert np.all(of_one <= 1.001 * one.sigma_theta)
    (between,) = found.between()
    apart = alone[0].cov_theta + (lift := between.R_ab.as_matrix()) @ alone[1].cov_theta @ lift.T
    np.testing.assert_allclose(between.sigma**2, np.diag(between.covariance))
    ratio = between.sigma / np.sqrt(np.diag(apart))
    assert ratio[0] < 0.3 and np.all(ratio < 0.95), ratio  # about the line of sight targets decide


def test_exposures_of_both_cameras_are_counted_once() -> None:
    assert (first().n_exposures, first().n_strips) == (24, 6)
    assert first().dof == 2 * first().n_targets - 6


def test_a_sound_campaign_is_consistent_and_a_moved_ccd_is_named_with_its_camera() -> None:
    strips = campaign(0, replace(PLAN, targets=30))
    found = estimated(strips)
    verdict, of_cameras = told(strips, found), (found.cov_theta[:3, :3], found.cov_theta[3:, 3:])
    assert verdict.outcome is Outcome.CONSISTENT
    worst = max(of_cameras, key=lambda cov: np.linalg.norm(cov, 2))  # of the camera that is known worse
    assert verdict.weakest_sigma_rad**2 == pytest.approx(np.linalg.norm(worst, 2))
    assert verdict.weakest_axis_c @ worst @ verdict.weakest_axis_c == pytest.approx(np.linalg.norm(worst, 2))
    moved = []
    for strip in strips:
        off = 2e-5 * (strip.ground.ccd == 1) * (strip.camera == "oblique")  # ten pixels along x
        u_c = strip.ground.u_c + np.outer(off, [1.0, 0.0, 0.0])
        u_c /= np.linalg.norm(u_c, axis=1, keepdims=True)
        moved.append(replace(strip, ground=replace(strip.ground, u_c=u_c)))
    finding = told(moved, estimated(moved)).findings[0]
    subject = finding.subjects[0]
    assert subject == Subject(subject.kind, camera="oblique", ccd=subject.ccd)
    assert finding.cause == "place of a CCD, along the track"


def test_distortions_are_those_that_each_camera_states() -> None:
    of_one = replace(MODEL, sigma_distortion_rad=3e-6)
    found = estimated(campaign(0), replace(MODEL, of_cameras=(("oblique", of_one),)))
    nadir, oblique = np.split(found.sigma_theta / first().sigma_theta, 2)
    assert np.all(nadir < 1.05) and oblique.max() > 4.0


def test_pairs_of_several_cameras_are_read_back() -> None:
    pairs, _ = strip_pairs(campaign(0), R_CS, MODEL)
    back = InformationPairs.from_numbers(pairs.names, *pairs.numbers())
    assert back.cameras == pairs.cameras and back.shared == pairs.shared
    np.testing.assert_array_equal(back.F, pairs.F)
    quaternions = back.R_cs_ref.as_quat(), pairs.R_cs_ref.as_quat()
    np.testing.assert_allclose(*quaternions, rtol=0, atol=5e-16)  # normalised once more: the last bit
    with pytest.raises(ValueError, match="do not add"):
        pairs.merged(replace(pairs, cameras=("a", "b")))


def test_rotations_between_three_cameras_have_the_covariance_of_finite_turns() -> None:
    rng, R = np.random.default_rng(9), Rotation.random(3, random_state=1)
    R0 = Rotation.from_rotvec(0.02 * rng.normal(size=(3, 3))) * R
    L, sigma, h = 1e-2 * rng.normal(size=(9, 9)), 1e-2 * rng.uniform(1.0, 3.0, 9), 1e-6  # rad
    shared = np.zeros((9, len(first().shared_values)))
    changed = {"cameras": ("a", "b", "c"), "theta": np.ones(9), "theta_with_shared": shared}
    found = replace(first(), R_cs=R, R_cs0=R0, cov_theta=L @ L.T, **changed)
    turned = [Rotation.from_rotvec(-h * turn) * R for turn in np.eye(9).reshape(9, 3, 3)]  # by -theta
    for one, (a, b) in zip(found.between(sigma), ((0, 1), (0, 2), (1, 2)), strict=True):
        moved = [-(S[a] * S[b].inv() * one.R_ab.inv()).as_rotvec() / h for S in turned]
        C = np.transpose(moved) @ np.stack([L @ L.T, np.diag(sigma**2)]) @ moved
        off = -(R[a] * R[b].inv() * R0[b] * R0[a].inv()).as_rotvec()
        np.testing.assert_allclose(one.theta, off, rtol=1e-9)
        np.testing.assert_allclose(one.covariance, C[0], rtol=0.0, atol=1e-7)  # of 1e-3 rad²: 2nd order in h
        assert one.p_value == pytest.approx(chi2(3).sf(squared(off, C.sum(axis=0))), rel=1e-4)


def test_a_camera_without_a_matrix_or_without_targets_is_named() -> None:
    strips = campaign(0)
    with pytest.raises(ValueError, match="strips of the cameras nadir, oblique need a matrix each"):
        calibrate_strips(strips, NADIR.R_cs, MODEL)
    with pytest.raises(ValueError, match="'oblique', of which no matrix"):
        calibrate_strips(strips, {"nadir": NADIR.R_cs}, MODEL)
    bare = [
        replace(s, ground=s.ground.take(rows), R_oi_targets=s.R_oi_targets[rows])
        for s in strips[3:4]
        if (rows := np.arange(1)) is not None
    ]
    found = calibrate_strips([*strips[:3], *bare], R_CS, MODEL)
    assert isinstance(found, NotObservable) and "of oblique" in found.reason
