"""A whole strip from the wrong installation matrix to places of its targets, and what must not be placed."""

import itertools
import time
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from small_strip import LINES, SURFACE, Case, SmallStrip

from boresight.features.exports.virtual_ccd import VirtualStrip
from boresight.gct_match import consistency
from boresight.gct_match.imaging.views import in_counts
from boresight.gct_match.match import match_strip
from boresight.gct_match.predict.scene import Scene, scene_of
from boresight.gct_match.predict.template import predict_template
from boresight.gct_match.predict.trajectories import displacements
from boresight.gct_match.records import Chip, StripMatches, Target
from boresight.gct_match.search.coarse import read_coarse
from boresight.gct_match.search.search_plan import _GRID, SearchPlan, _on_grid, extents, plan_search
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.records.ledger import Reason

SIGMA = np.full(3, 0.003)  # rad: what a mission says of a matrix that is wrong by (28)
SURE = np.full(3, 1e-5)  # rad: of one that is nearly right


def scene(case: Case, **changed: Any) -> Scene:
    """The case from its wrong matrix, but for what is given."""
    given = {"strip": case.strip, "pushbroom": case.pushbroom, "targets": case.targets, "chips": case.chips}
    given |= {"surface": SURFACE, "sigma_installation_rad": SIGMA, "settings": MatchSettings()}
    return scene_of(**given | changed)


def matched(case: Case, **changed: Any) -> StripMatches:
    return match_strip(scene(case, **changed))


def errors(case: Case, outcome: StripMatches) -> tuple[NDArray, NDArray]:
    p_e = {target.target_id: target.p_e for target in case.targets}
    error, nees = [], []
    for match in outcome.matches:
        sample, line = case.true.pixels_from_ground(match.ccd, p_e[match.target_id][None])
        error.append(match.xy_px - np.array([sample[0], line[0]]))
        nees.append(error[-1] @ np.linalg.solve(match.cov_px, error[-1]))
    return np.array(error), np.array(nees)


@pytest.fixture(scope="module")
def elsewhere(case: Case) -> SmallStrip:
    """The strip of another place: the ground rotated by half a revolution."""
    return SmallStrip({ccd: image[::-1, ::-1].copy() for ccd, image in case.strip.images.items()})


@pytest.fixture(scope="module")
def outcome_and_read_px(case: Case) -> tuple[StripMatches, int]:
    """The matches from the wrong matrix, and how many pixels of the strip were read for them."""
    case.strip.pixels_read = 0
    return matched(case), case.strip.pixels_read


@pytest.fixture(scope="module")
def outcome(outcome_and_read_px: tuple[StripMatches, int]) -> StripMatches:
    return outcome_and_read_px[0]


def test_all_targets_are_found_and_placed_to_a_hundredth_of_a_pixel(case: Case, outcome: StripMatches):
    error, nees = errors(case, outcome)
    assert {match.target_id for match in outcome.matches} == {target.target_id for target in case.targets}
    assert outcome.probability_chance < 1e-6
    assert np.abs(error).max() < 0.015  # px: 0.003 px of noise; the survey is exact
    assert np.mean(nees) / 2.0 < 2.5  # 12 sightings: the 99.9 % point of chi² of 24 is 2.1 of its mean


def test_vote_is_the_deviation_that_was_applied(case: Case, outcome: StripMatches):
    # 0.005 px of 12 targets at 1.2e-5 rad a pixel; the angle about z has a lever of 0.005 rad
    assert outcome.theta_vote[:2] == pytest.approx(case.theta[:2], abs=1e-6)
    assert outcome.theta_vote[2] == pytest.approx(case.theta[2], abs=2e-4)
    assert theta_between(case.true.R_cs, case.pushbroom.R_cs) == pytest.approx(case.theta, abs=1e-12)


def test_predictions_are_those_of_the_matrix_that_the_search_started_from(case: Case, outcome: StripMatches):
    match = next(m for m in outcome.matches if np.isfinite(m.predicted_px).all())
    p_e = next(t.p_e for t in case.targets if t.target_id == match.target_id)
    sample, line = case.pushbroom.pixels_from_ground(match.ccd, p_e[None])
    assert match.predicted_px == pytest.approx([sample[0], line[0]], abs=1e-3)  # px
    assert np.hypot(*(match.predicted_px - match.xy_px)) > 200.0  # the deviation (28) at this scale


def test_target_in_the_overlap_is_placed_in_both_ccds(case: Case):
    sample, line = np.array([360.0 + 30.0]), np.array([350.0])  # 60 px of overlap begin at 360
    p_e = case.true.ground_points(0, sample, line, SURFACE)[0]
    shown = min(case.targets, key=lambda t: np.linalg.norm(t.p_e - p_e))
    chip = next(c for c in case.chips if c.target_id == shown.target_id)
    inside = [ccd for ccd in (0, 1) if 8.0 < case.true.pixels_from_ground(ccd, shown.p_e[None])[0][0] < 411.0]
    settings = MatchSettings(smallest_template_px=16)
    alone = {"targets": [shown], "chips": [chip], "settings": settings}
    outcome = matched(case, pushbroom=case.true, **alone, sigma_installation_rad=SURE)
    assert sorted(m.ccd for m in outcome.matches) == inside


def test_targets_compared_in_groups_are_those_that_agree_together(case, outcome, monkeypatch):
    """Of very many, those that follow one another in time are compared: time and memory grow with them."""
    monkeypatch.setattr(consistency, "_MOST_TOGETHER", 5)
    matches = list(outcome.matches)
    wrong = replace(matches[3], xy_px=matches[3].xy_px + np.array([20.0, 0.0]))  # px; 0.5 px may differ
    every = [*matches[:3], wrong, *matches[4:]]
    kept, refused, theta = consistency.consistent_matches(scene(case), every, case.theta)
    assert [entry.subject.id for entry in refused] == [wrong.target_id]
    assert refused[0].xy_px == tuple(wrong.xy_px.tolist())
    assert [one.target_id for one in kept] == [m.target_id for m in matches if m.target_id != wrong.target_id]
    assert theta[:2] == pytest.approx(case.theta[:2], abs=1e-6)  # rad: as from all together
    assert theta[2] == pytest.approx(case.theta[2], abs=2e-4)


WINDOWS = np.full(3, 3e-5)  # rad: 2.5 px, which windows of 12 px hold, and boxes around them not


def test_places_predicted_within_a_window_are_measured_without_a_search(case: Case):
    near = {"pushbroom": case.true, "sigma_installation_rad": WINDOWS}
    plan = plan_search(around := scene(case, **near))
    assert max(window.radius_px for window in plan.windows) > 2 * MatchSettings().margin_px + 2
    case.strip.pixels_read = 0
    outcome = matched(case, **near)
    assert len({match.target_id for match in outcome.matches}) == len(case.targets)
    assert case.strip.pixels_read < searched_px(around, plan)  # of which a search reads all


def searched_px(scene: Scene, plan: SearchPlan) -> int:
    """Pixels of the strip that a search reads."""
    boxes = set(extents(scene.strip, plan.windows, max(plan.sides_px.values())))
    return sum((last - first) * (right - left) for _, (first, last), (left, right) in boxes)


@pytest.mark.parametrize("off_px", [7.0, 13.0])  # inside the window, but far; outside it
def test_displaced_strip_is_searched_although_its_places_seemed_known(case: Case, off_px: float):
    theta = np.array([off_px * 1.2e-5, 0.0, 0.0])  # 12 µrad a pixel
    model = case.true.with_installation(deviation_from_theta(theta).inv() * case.true.R_cs)
    outcome = matched(case, pushbroom=model, sigma_installation_rad=WINDOWS)
    error, _ = errors(case, outcome)
    assert len({match.target_id for match in outcome.matches}) == len(case.targets)
    assert np.abs(error).max() < 0.015  # px, as from any other matrix
    assert outcome.probability_chance < 1e-6  # of a search; 1 without


@pytest.mark.parametrize("count", [1, 2])
def test_so_few_targets_are_kept_where_others_gave_the_matrix(case: Case, elsewhere: SmallStrip, count: int):
    few = {"targets": case.targets[:count], "chips": case.chips[:count], "pushbroom": case.true}
    few |= {"sigma_installation_rad": np.full(3, 4e-5)}
    few |= {"settings": MatchSettings(probability_chance=1e-12)}  # which the vote of two does not reach
    alone = matched(case, **few)
    assert not alone.matches
    assert {refusal.reason for refusal in alone.refused} == {Reason.NO_COMMON_ROTATION}
    found = matched(case, **few, is_known=True)
    assert {match.target_id for match in found.matches} == {target.target_id for target in few["targets"]}
    assert np.abs(errors(case, found)[0]).max() < 0.015  # px
    assert not matched(case, **few, is_known=True, strip=elsewhere).matches


def test_cost_is_known_before_the_search_starts(case: Case, outcome_and_read_px: tuple[StripMatches, int]):
    plan = plan_search(around := scene(case))
    windows = outcome_and_read_px[1] - searched_px(around, plan)
    assert 0 < windows < 14 * 200 * 200


def test_strip_of_another_place_gives_no_match(case: Case, elsewhere: SmallStrip):
    outcome = matched(case, strip=elsewhere)
    assert outcome.matches == ()
    assert len(outcome.refused) == len(case.targets)
    assert all(refusal.reason is Reason.NO_COMMON_ROTATION for refusal in outcome.refused)
    assert np.isnan(outcome.theta_vote).all()


def test_unit_of_the_chips_moves_no_position(case: Case, outcome: StripMatches):
    chips = [
        replace(one, image=in_counts(gain * (one.image + 300.1), one.valid))
        for one, gain in zip(case.chips, itertools.cycle((1e-9, 0.013, 1e9)))
    ]
    found = matched(case, chips=chips)
    assert [one.target_id for one in found.matches] == [one.target_id for one in outcome.matches]
    for one, other in zip(found.matches, outcome.matches):
        assert np.abs(one.xy_px - other.xy_px).max() < 1e-3  # px: float32 has 24 bits


def of_pixel_size(chip: Chip, factor: float) -> Chip:
    a, b, c, d, e, f = chip.transform
    return replace(chip, transform=(factor * a, b, c, d, factor * e, f))


def test_chips_that_show_nothing_of_their_targets_are_refused_with_the_reason_and_the_others_kept(case: Case):
    chips = list(case.chips)
    water = np.random.default_rng(5).normal(20.0, 1.5, chips[3].image.shape)
    chips[3] = replace(chips[3], image=water.astype(np.float32))
    chips[4] = replace(chips[4], image=chips[5].image)  # another place
    chips[6], chips[7] = of_pixel_size(chips[6], 1e-4), of_pixel_size(chips[7], 3e-6)  # 0.3 mm and 10 um
    tracemalloc.start()
    outcome = matched(case, chips=chips)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    refused = {refusal.subject.id: refusal for refusal in outcome.refused}
    assert set(refused) == {"t03", "t04", "t06", "t07"}
    assert refused["t03"].reason is Reason.TOO_LITTLE_TEXTURE
    for name in ("t06", "t07"):
        assert refused[name].reason is Reason.CHIP_TOO_SMALL and "pixel size" in refused[name].text
    kept = {target.target_id for target in case.targets} - set(refused)
    assert {match.target_id for match in outcome.matches} == kept
    assert peak < 100e6  # bytes: the strip's coarse pictures and candidates


def test_template_of_a_chip_with_tiny_pixels_is_bounded_in_memory_and_time(case: Case):
    tiny = of_pixel_size(case.chips[0], 3e-6)
    start = time.process_time()
    template = predict_template(tiny, case.true, 0, (100, 100), (64, 64), SURFACE, MatchSettings())
    assert not template.valid.any()
    assert time.process_time() - start < 2.0  # s: a kernel as wide as the blur would take minutes


def test_pixels_of_chips_without_data_have_no_part_in_the_places(case: Case):
    def with_hole(chip: Chip, fill: float) -> Chip:
        rows, columns = np.indices(chip.image.shape) / np.array(chip.image.shape)[:, None, None]
        valid = columns + 0.4 * rows > 0.45  # without a corner, up to the middle of the chip
        return replace(chip, image=np.where(valid, chip.image, np.float32(fill)), valid=valid)

    outcomes = [matched(case, chips=[with_hole(one, fill) for one in case.chips]) for fill in (0.0, 6e4)]
    for outcome in outcomes:
        _, nees = errors(case, outcome)
        assert len(nees) >= len(case.targets) - 1 and nees.sum() < chi2(df=2 * len(nees)).ppf(0.9995)
    one, other = ({match.target_id: match.xy_px for match in outcome.matches} for outcome in outcomes)
    assert set(one) == set(other)
    assert all(np.array_equal(one[name], other[name]) for name in one)


def test_cloud_and_saturation_are_kept_out(case: Case):
    images = {}
    for ccd, image in case.strip.images.items():
        images[ccd] = image.astype(np.float32)
        images[ccd][200:330, 100:300] = np.nan  # a cloud mask
        images[ccd][400:420, :] = 4095.0  # blooming
    outcome = matched(case, strip=SmallStrip(images), settings=MatchSettings(saturation_dn=4000.0))
    error, _ = errors(case, outcome)
    assert len(outcome.matches) >= 8
    assert np.abs(error).max() < 0.03  # px
    assert len(outcome.matches) + len(outcome.refused) >= len(case.targets)


def test_target_outside_the_strip_is_listed(case: Case):
    far = Target("far", case.targets[0].p_e + np.array([0.0, 0.0, 90e3]), np.full(3, 0.1))
    chip = replace(case.chips[0], target_id="far")
    more = {"targets": [*case.targets, far], "chips": [*case.chips, chip], "sigma_installation_rad": SURE}
    outcome = matched(case, pushbroom=case.true, **more)
    reasons = {refusal.subject.id: refusal.reason for refusal in outcome.refused}
    assert reasons["far"] is Reason.OUTSIDE_REACH


def test_targets_and_chips_must_belong_together(case: Case):
    with pytest.raises(ValueError, match="do not belong"):
        matched(case, chips=case.chips[1:])


def test_displacement_is_linear_in_theta(case: Case):
    theta = np.array([2e-5, -3e-5, 4e-4])
    p_e = np.array([target.p_e for target in case.targets])
    ccd = np.array([n % 2 for n in range(len(p_e))])
    turned = case.true.with_installation(deviation_from_theta(theta) * case.true.R_cs)
    xy = np.array([np.column_stack(turned.pixels_from_ground(c, p[None]))[0] for c, p in zip(ccd, p_e)])
    d, design = displacements(case.true, p_e, ccd, xy)
    assert d == pytest.approx(design @ theta, abs=2e-3)  # px of 4: second order of an angle of 4e-4


def test_template_map_between_nodes_is_that_of_the_model(case: Case):
    chip, target = case.chips[0], case.targets[0]
    xy = np.column_stack(case.true.pixels_from_ground(0, target.p_e[None]))[0]
    origin = (int(xy[0]) - 40, int(xy[1]) - 40)
    whole = predict_template(chip, case.true, 0, origin, (81, 81), SURFACE, MatchSettings())
    corner = (origin[0] + 20, origin[1] + 17)
    part = predict_template(chip, case.true, 0, corner, (5, 5), SURFACE, MatchSettings())
    gradient = np.abs(np.diff(whole.image)).max()
    assert np.abs(whole.image[17:22, 20:25] - part.image).max() < 0.01 * gradient  # 0.01 px of misplacement


def test_template_looks_like_the_strip(case: Case):
    chip, target = case.chips[2], case.targets[2]
    xy = np.column_stack(case.true.pixels_from_ground(0, target.p_e[None]))[0]
    x, y = int(xy[0]) - 32, int(xy[1]) - 32
    template = predict_template(chip, case.true, 0, (x, y), (64, 64), SURFACE, MatchSettings())
    strip = case.strip.images[0][y : y + 64, x : x + 64]
    assert template.valid.all()
    assert np.corrcoef(template.image.ravel(), strip.ravel())[0, 1] > 0.99


def test_virtual_ccd_gives_the_same_places_as_the_raw_ones(case: Case, outcome: StripMatches):
    virtual = VirtualStrip(case.pushbroom, SURFACE)
    image = virtual.stitched(case.strip.read, dict.fromkeys(case.strip.ccds, LINES), (0, LINES))
    found = matched(case, strip=SmallStrip({0: image}), pushbroom=virtual.virtual)
    placed = {match.target_id: match for match in found.matches}
    nees = []
    for raw in outcome.matches:
        ground = case.pushbroom.ground_points(raw.ccd, raw.xy_px[:1], raw.xy_px[1:], SURFACE)
        there = np.column_stack(virtual.virtual.pixels_from_ground(0, ground))[0]
        match = placed[raw.target_id]
        cov = match.cov_px + raw.cov_px + np.eye(2) / 32.0**2 / 12.0  # stitching rounds to 1/32 px
        nees.append((match.xy_px - there) @ np.linalg.solve(cov, match.xy_px - there))
    assert sum(nees) < chi2(df=2 * len(nees)).ppf(0.9995)


def test_places_that_an_exposure_moves_together_are_kept(case: Case):
    # One star exposure is wrong by 6 px of 12 urad, four standard errors: what is seen near it moves alike.
    track = case.pushbroom.attitude
    turn = np.zeros((len(track.t_s), 3))
    turn[np.argmin(np.abs(track.t_s - 0.4))] = case.pushbroom.R_cs.inv().apply([0.0, 72e-6, 0.0])
    nodes = Rotation.from_rotvec(turn) * track.R_si_nodes
    moved = replace(case.pushbroom, attitude=replace(track, R_si_nodes=nodes))
    outcome = matched(case, pushbroom=moved)
    residual = np.array([match.residual_px for match in outcome.matches])
    assert len({match.target_id for match in outcome.matches}) == len(case.targets)
    assert np.ptp(residual, axis=0).max() > 5.0  # px


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_coarse_pictures_are_means_of_blocks(kind: type):
    image = np.random.default_rng(4).integers(0, 250, (203, 330)).astype(kind)
    coarse = read_coarse(SmallStrip({0: image}), 0, (3, 203), (1, 330), 8, MatchSettings())
    means = image[3:203, 1:329].reshape(25, 8, 41, 8).mean(axis=(1, 3))
    assert coarse.image.shape == (25, 41) and coarse.image.dtype == kind
    # grey values: three halvings of whole numbers round by 0.31 rms each, of which 16 and 4 are averaged
    sigma = 0.31 * np.sqrt(1 / 16 + 1 / 4 + 1) if kind is not np.float32 else 1e-5
    assert np.abs(coarse.image - means - (coarse.image - means).mean()).max() < 4.5 * sigma
    assert abs((coarse.image - means).mean()) < (0.4 if kind is not np.float32 else 1e-4)


def test_coarse_pictures_show_nothing_where_a_quarter_of_a_block_is_missing():
    image = np.full((32, 32), 7.0, dtype=np.float32)
    image[0:2, 0:4] = np.nan  # half of the first block
    image[8:10, 8:9] = np.nan  # an eighth of another
    coarse = read_coarse(SmallStrip({0: image}), 0, (0, 32), (0, 32), 4, MatchSettings())
    assert np.isnan(coarse.image[0, 0]) and np.isnan(coarse.image).sum() == 1
    assert coarse.image[2, 2] == pytest.approx(7.0)


def test_a_ccd_whose_image_begins_later_has_its_targets_on_its_own_lines(case: Case):
    later = 137
    images = {0: case.strip.images[0], 1: case.strip.images[1][later:]}
    rows = replace(case.pushbroom.rows, first_row={1: float(later)})
    pushbroom = replace(case.pushbroom, rows=rows)
    last = {"targets": case.targets[-4:], "chips": case.chips[-4:]}
    found = matched(case, strip=SmallStrip(images), pushbroom=pushbroom, **last)
    place = {target.target_id: target.p_e[None] for target in case.targets}
    assert {one.ccd for one in found.matches} == {0, 1} and len(found.matches) >= 4
    for one in found.matches:
        in_whole_image = np.concatenate(case.true.pixels_from_ground(one.ccd, place[one.target_id]))
        expected = in_whole_image - [0.0, later * one.ccd]
        assert one.xy_px == pytest.approx(expected, abs=0.015)  # px, as for the whole strip


def test_a_box_is_begun_earlier_by_whole_blocks_from_the_beginning_of_the_one_around_it():
    whole = (2, (5, 900), (-70, 700))
    for first_line, first_sample in ((5, -70), (68, -7), (69, -6), (333, 512)):
        ccd, lines, samples = _on_grid((2, (first_line, 400), (first_sample, 650)), whole)
        assert (ccd, lines[1], samples[1]) == (2, 400, 650)
        for (begun, _), first, begin in ((lines, first_line, 5), (samples, first_sample, -70)):
            assert (begun - begin) % _GRID == 0 and first - _GRID < begun <= first
