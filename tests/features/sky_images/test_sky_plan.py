"""Fields chosen to calibrate a camera: what they foretell comes, and no other choice is much better."""

from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from frames import PAPER_CAMERA, Sensor, listed_stars, star_frame
from scipy.spatial.transform import Rotation

from boresight.features.sky_images import sky_plan
from boresight.features.sky_images.field_plan import _outline, _pieces, _wanted
from boresight.features.sky_images.sky_plan import StarImageModel, plan_pointings
from boresight.star_id.camera_calibration import SkyFrame, calibrate_camera
from boresight.star_id.camera_fit import detector_grid
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.field import solve_field, solve_stars
from boresight.star_id.finding.psf import Psf
from boresight.star_id.identification.triangle_index import build_index
from boresight.star_id.settings import StarSettings

TRUTH = replace(PAPER_CAMERA, principal_px=(2571.3, 1893.2))
ROUGH = replace(PAPER_CAMERA, focal_m=0.101, p1=0.0, p2=0.0, q1=0.0, q2=0.0)  # what a plan may know
SETTINGS = StarSettings()
# as in `listed_stars`: errors of 1.8 px over the SNR, no star saturated
LISTED = StarImageModel(
    psf=Psf(1.25, 1.25, (0.0, 0.0), 5120, 3840),
    noise_dn=2.0,
    gain_e_per_dn=1e9,
    full_dn=np.inf,
    flux_of_v0_dn=71.0 * 10**2.8,
    faintest_dn=53.0,
)


@pytest.fixture(scope="module")
def index():
    places = hipparcos_stars(8.0).places
    return build_index(places, places.epoch_jyear, (np.radians(15.0), np.radians(24.0)))


@pytest.fixture(scope="module")
def plan(index):
    candidates = Rotation.random(150, random_state=np.random.default_rng(31))
    return plan_pointings(ROUGH, LISTED, index, SETTINGS, candidates, 10)


def test_each_pointing_adds_and_ten_are_worth_many_at_random(plan):
    sigma = np.array([pointing.sigma_px for pointing in plan.pointings])
    assert (np.diff(sigma) < 0.0).all()
    assert sigma[-1] < 0.6 * plan.random_sigma_px[-1]  # three times as many frames at random
    assert min(pointing.stars for pointing in plan.pointings) > 50


def test_the_error_that_is_foretold_is_the_error_that_comes(plan, index):
    places, stated = hipparcos_stars(8.0).places, []
    for seed in (32, 33, 34):
        rng = np.random.default_rng(seed)
        frames = [
            SkyFrame(str(k), listed_stars(TRUTH, pointing.R_si, places, rng, brightest=np.inf))
            for k, pointing in enumerate(plan.pointings)
        ]
        found = calibrate_camera(frames, ROUGH, index, SETTINGS)
        stated.append(found.model_sigma_px(detector_grid(found.camera)).max())
    # a tenth: the plan's camera is 1 % off, so stars near the edges come and go; the median, since noise
    # looks like a smooth distortion of the lens in one of twenty
    assert plan.pointings[-1].sigma_px == pytest.approx(np.median(stated), rel=0.1)


def test_a_choice_is_nearly_the_best_there_is(index, monkeypatch):
    candidates = Rotation.random(12, random_state=np.random.default_rng(33))
    compute, known = sky_plan._information, {}

    def information(*given):  # of a candidate, which stands in 55 of the 220 choices
        key = given[-1].as_quat().tobytes()
        if key not in known:
            known[key] = compute(*given)
        return known[key]

    monkeypatch.setattr(sky_plan, "_information", information)
    best = min(
        plan_pointings(ROUGH, LISTED, index, SETTINGS, candidates[list(three)], 3).pointings[-1].sigma_px
        for three in combinations(range(12), 3)
    )
    chosen = plan_pointings(ROUGH, LISTED, index, SETTINGS, candidates, 3)
    assert best <= chosen.pointings[-1].sigma_px * (1.0 + 1e-9)
    assert chosen.pointings[-1].sigma_px < 1.1 * best


def test_one_image_tells_how_a_camera_sees_stars(index):
    rng, sensor = np.random.default_rng(34), Sensor(e_per_dn=5.0)
    R_si = Rotation.random(random_state=rng)
    image, _ = star_frame(TRUTH, R_si, hipparcos_stars(8.0).places, sensor, rng)
    seen = StarImageModel.of(solve_field(image, index, SETTINGS, camera=TRUTH), index)
    assert seen.psf.sigma_px == pytest.approx(sensor.sigma_px, rel=0.02)
    assert seen.noise_dn == pytest.approx(np.hypot(sensor.read_noise_dn, 12**-0.5), rel=0.03)
    assert seen.gain_e_per_dn == pytest.approx(sensor.e_per_dn, rel=0.3)  # of 40 stars' residuals
    assert seen.flux_of_v0_dn == pytest.approx(sensor.flux_at_v7_dn * 10**2.8, rel=0.05)
    assert seen.full_dn == pytest.approx(255.0 - sensor.background_dn, abs=1.0)


def test_what_cannot_be_planned_is_refused(index):
    with pytest.raises(ValueError, match="frames must be 1 to the number of candidates, 2, got 3"):
        plan_pointings(ROUGH, LISTED, index, SETTINGS, Rotation.random(2, random_state=1), 3)
    rng = np.random.default_rng(1)
    stars = listed_stars(TRUTH, Rotation.random(random_state=rng), hipparcos_stars(8.0).places, rng)
    bare = solve_stars(stars.xy_px, (5120, 3840), index, SETTINGS, camera=TRUTH)
    with pytest.raises(ValueError, match="solved from an image"):
        StarImageModel.of(bare, index)


def test_the_outline_on_the_map_is_the_edge_of_the_detector():
    R_si = Rotation.from_euler("xyz", [50.0, -20.0, 200.0], degrees=True)
    ra, dec = np.radians(_outline(TRUTH, R_si))
    u_i = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    xy = TRUTH.pixels_from_directions(R_si.apply(u_i)) + 0.5  # from the corner of the first pixel
    x, y = xy.T / [[TRUTH.width_px], [TRUTH.height_px]]
    # On one of the four edges and not beyond the others; the corners are on it. 1e-7 of a side (0.0005 px):
    # the distortion is removed by iteration.
    assert np.minimum.reduce([abs(x), abs(x - 1.0), abs(y), abs(y - 1.0)]).max() < 1e-7
    assert np.abs([x - 0.5, y - 0.5]).max() < 0.5 + 1e-7
    for corner in ([0, 0], [0, 1], [1, 0], [1, 1]):
        assert np.hypot(x - corner[0], y - corner[1]).min() < 1e-7


def test_an_outline_that_leaves_the_map_comes_back_in_another_piece():
    # Its middle looks along +X: at right ascension 0, where the map ends.
    R_si = Rotation.from_euler("xyz", [10.0, -90.0, 0.0], degrees=True)
    outline = _outline(TRUTH, R_si)
    pieces = _pieces(outline)
    assert len(pieces) > 1 and all(np.ptp(ra) < 180.0 for ra, _ in pieces)
    assert np.array_equal(np.hstack(pieces), outline)


@pytest.mark.parametrize(
    ("wanted_px", "says"),
    [
        (0.15, "3 images reach 0.15 px"),
        (0.5, "1 images reach 0.5 px"),
        # the error falls with the root of the number of images: 3 (0.1 / 0.03)^2 = 33.3
        (0.03, "MISSED: 3 images reach 0.1000 px, not 0.03; some 34 would"),
    ],
)
def test_images_that_a_wanted_error_needs_are_those_of_the_plan_or_as_many_as_its_law_says(wanted_px, says):
    plan = SimpleNamespace(pointings=[SimpleNamespace(sigma_px=sigma) for sigma in (0.4, 0.2, 0.1)])
    assert _wanted(plan, wanted_px) == (says, not says.startswith("MISSED"))  # type: ignore[arg-type]
