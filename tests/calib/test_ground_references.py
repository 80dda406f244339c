"""An offset that all targets of one reference share: stated, it is honest; unstated, it is found or said."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from drawn_campaigns import BOLD, CAMERAS, assert_chi_square, nees_of_estimate
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.reliability import examine
from boresight.calib.settings import CalibrationSettings
from boresight.calib.verdict import Verdict, assess
from boresight.geometry.constants import ARCSEC
from boresight.geometry.sightings import GroundReferences, StripSightings
from boresight.records.record import Floats
from boresight.simulator.campaign import StripPlan, draw_strips

PLAN = StripPlan(
    exposures=6,
    exposure_margin_s=0.3,
    targets=12,
    sigma_position_m=1.0,
    sigma_clock_s=1e-5,
    sigma_vibration_rad=0.1 * ARCSEC,
    sigma_target_m=0.3,
)
MODEL = CalibrationSettings(sigma_position_m=1.0, sigma_clock_s=1e-5, sigma_distortion_rad=0.0)
SIGMA_M = np.array([3.0, 3.0, 2.0])
STRAIGHT = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # of east, north, up


def referenced(
    strip: StripSightings,
    offset_m: Floats,
    names: Sequence[str],
    sigma_m: Floats = SIGMA_M,
    place: Floats | None = None,
) -> StripSightings:
    """The strip whose targets are stated farther along each one's axes, (J, 3), m; the axes lie across the
    track, along it and up.
    """
    ground, J = strip.ground, len(names)
    axes_i = (strip.R_oi_targets.inv() * STRAIGHT).as_matrix()
    moved_i = np.einsum("jab,jb->ja", axes_i, np.broadcast_to(offset_m, (J, 3)))
    u_i = ground.u_i + moved_i / ground.range_m[:, None]
    references = GroundReferences(
        np.array(names, dtype=str),
        axes_i,
        np.tile(sigma_m, (J, 1)),
        np.zeros((J, 3)) if place is None else place,
    )
    u_i = u_i / np.linalg.norm(u_i, axis=1, keepdims=True)
    return replace(strip, ground=replace(ground, u_i=u_i, references=references))


def estimated(strips: Sequence[StripSightings]) -> InstallationEstimate:
    estimate = calibrate_strips(strips, BOLD, MODEL)
    assert isinstance(estimate, InstallationEstimate)
    return estimate


def told(strips: Sequence[StripSightings], estimate: InstallationEstimate) -> Verdict:
    reliability = examine(estimate, strips, MODEL, pixel_rad=CAMERAS.pixel_rad)
    return assess(estimate, strips, reliability=reliability)


def squared_errors(strips: int, runs: int, stated: bool) -> list[float]:
    found = []
    for run in range(runs):
        rng = np.random.default_rng([58, strips, run])
        drawn, offset_m = (
            draw_strips(replace(PLAN, strips=strips), CAMERAS, rng)[0],
            SIGMA_M * rng.normal(size=3),
        )
        sigma_m = SIGMA_M if stated else np.zeros(3)
        names = ["mosaic"] * PLAN.targets
        estimate = estimated([referenced(strip, offset_m, names, sigma_m) for strip in drawn])
        found.append(nees_of_estimate(estimate))
    return found


@pytest.mark.parametrize(("strips", "runs"), [(1, 40), (3, 20), (10, 8)])
def test_a_common_offset_that_is_stated_gives_an_honest_covariance(strips: int, runs: int) -> None:
    assert_chi_square(squared_errors(strips, runs, stated=True), 3)
    assert sum(squared_errors(strips, runs // 2, stated=False)) > 2.0 * 3 * (runs // 2)  # twice too small


def test_offsets_that_change_over_correlation_lengths_are_honest() -> None:
    runs, found = 20, []
    for run in range(runs):
        rng = np.random.default_rng([59, run])
        strips = draw_strips(replace(PLAN, strips=3), CAMERAS, rng)[0]
        place = [
            rng.uniform(0.0, 3.0, (PLAN.targets, 3)) * [1.0, 1.0, 0.0] + [100.0 * n, 0.0, 0.0]
            for n in range(3)
        ]
        every = np.concatenate(place)
        root = np.linalg.cholesky(np.exp(-np.linalg.norm(every[:, None] - every, axis=2)))
        offset_m = np.split(root @ rng.normal(size=(len(every), 3)) * SIGMA_M, 3)
        names = ["mosaic"] * PLAN.targets
        stated = [referenced(s, o, names, place=p) for s, o, p in zip(strips, offset_m, place)]
        estimate = estimated(stated)
        found.append(nees_of_estimate(estimate))
    assert_chi_square(found, 3)


def test_the_offset_of_one_of_two_references_is_estimated_with_its_sigma() -> None:
    offset_m = np.array([4.0, -5.0, 0.0])
    strips = draw_strips(replace(PLAN, strips=6), CAMERAS, np.random.default_rng(5))[0]
    names = np.array(["old", "new"])[np.arange(PLAN.targets) % 2]
    off = np.where((names == "old")[:, None], offset_m, 0.0)
    sigma_m = np.where((names == "old")[:, None], SIGMA_M, 0.0)
    stated = []
    for strip in strips:
        one = referenced(strip, off, names.tolist())
        assert one.ground.references is not None
        of = replace(one.ground.references, sigma_m=sigma_m)
        stated.append(replace(one, ground=replace(one.ground, references=of)))
    (offset,) = estimated(stated).references
    assert offset.name == "old" and np.all(offset.sigma_m[:2] < 0.3)
    assert np.all(np.abs(offset.value_m - offset_m) < 4.0 * offset.sigma_m)


def test_an_offset_that_is_not_stated_is_found_where_two_references_show_it() -> None:
    strips = draw_strips(replace(PLAN, strips=4, targets=20), CAMERAS, np.random.default_rng(6))[0]
    names = np.array(["old", "new"])[np.arange(20) % 2].tolist()
    off = np.where((np.array(names) == "old")[:, None], [6.0, 0.0, 0.0], 0.0)
    moved = [referenced(strip, off, names, np.zeros(3)) for strip in strips]
    verdict = told(moved, estimated(moved))
    assert verdict.findings[0].cause == "datum of the targets, east"
    assert abs(abs(verdict.findings[0].value) - 6.0) < 4.0 * verdict.findings[0].sigma
    sound = [referenced(strip, np.zeros(3), names, np.zeros(3)) for strip in strips]
    assert not told(sound, estimated(sound)).findings


def test_where_one_reference_is_all_its_offset_is_said_not_to_be_seen() -> None:
    strips = draw_strips(replace(PLAN, strips=3), CAMERAS, np.random.default_rng(7))[0]
    alone = [referenced(strip, np.zeros(3), ["mosaic"] * PLAN.targets) for strip in strips]
    (offset,) = estimated(alone).references
    assert np.all(offset.sigma_m[:2] > 0.9 * SIGMA_M[:2])
