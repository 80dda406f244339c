"""From raw pixels to named stars with covariances, the whole way."""

import numpy as np
import pytest
from frames import PAPER_CAMERA, Sensor, render, star_frame
from frames import SMALL_CAMERA as CAMERA
from plain_attitude import plain_attitude
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.geometry.epoch import Epoch
from boresight.geometry.sightings import StarSightings
from boresight.geometry.star_camera import StarCamera
from boresight.geometry.starlight import apparent_star_directions
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.identification.triangle_index import build_index, equivalent_fov
from boresight.star_id.observer import Observer
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import _half_sides, sight_stars

EPOCH = Epoch.from_utc("2026-03-01T00:00:00Z")
P_I, V_I = np.array([6.9e6, 0.0, 0.0]), np.array([0.0, 1000.0, 7500.0])
OBSERVER = Observer(EPOCH, 12.5, P_I, V_I)
SETTINGS = StarSettings(gain_e_per_dn=40.0)


@pytest.fixture(scope="module")
def index():
    fov = equivalent_fov(CAMERA.width_px, CAMERA.height_px, CAMERA.focal_m / CAMERA.pixel_m)
    return build_index(hipparcos_stars(8.0).places, 2026.2, fov)


def exposure(R_si, rng, sensor):
    """A frame whose stars stand where the moving satellite sees them."""
    stars = hipparcos_stars(8.0).places
    u_s = R_si.apply(apparent_star_directions(stars, EPOCH, 12.5, P_I, V_I))
    near = np.flatnonzero(u_s[:, 2] > np.cos(CAMERA.field_radius_rad))
    xy = CAMERA.pixels_from_directions(u_s[near])
    inside = CAMERA.contains(xy)
    flux = sensor.flux_at_v7_dn * 10 ** (-0.4 * (stars.v_mag[near] - 7.0))
    return render(xy[inside], flux[inside], CAMERA.width_px, CAMERA.height_px, sensor, rng)


def test_an_exposure_gives_the_attitude_within_its_covariance(index):
    rng, total, dof = np.random.default_rng(5), 0.0, 0
    for _ in range(6):
        R_si = Rotation.random(random_state=rng)
        image = exposure(R_si, rng, Sensor(hot_pixels=50, gradient_dn=6.0))
        sightings = sight_stars("0001", image, CAMERA, index, OBSERVER, SETTINGS)
        assert isinstance(sightings, StarSightings), sightings
        assert len(sightings.hip) > 20
        attitude = plain_attitude(sightings.u_s, sightings.u_i, sightings.cov_s)
        delta_s = (attitude.R_si * R_si.inv()).as_rotvec()
        total += delta_s @ np.linalg.solve(attitude.cov_s, delta_s)
        dof += 3
    low, high = chi2(df=dof).ppf([5e-4, 1 - 5e-4])
    assert low < total < high


def test_an_image_of_noise_is_not_identified(index):
    rng = np.random.default_rng(1)
    image = np.clip(rng.normal(20, 2, (960, 1280)), 0, 255).astype(np.uint8)
    answer = sight_stars("dark", image, CAMERA, index, OBSERVER, SETTINGS)
    assert isinstance(answer, NotIdentified)
    assert "dark" in answer.reason and "4 are needed" in answer.reason


def test_no_star_that_the_catalogue_doubts_is_handed_on(index):
    rng = np.random.default_rng(11)
    R_si = Rotation.random(random_state=rng)
    sightings = sight_stars("1", exposure(R_si, rng, Sensor()), CAMERA, index, OBSERVER, SETTINGS)
    catalogue = hipparcos_stars(8.0)
    row = np.searchsorted(catalogue.places.hip, sightings.hip)
    assert catalogue.usable_for_calibration[row].all()


def test_the_papers_camera_is_sighted_at_full_size():
    places = hipparcos_stars(8.0).places
    fov = equivalent_fov(5120, 3840, PAPER_CAMERA.focal_m / PAPER_CAMERA.pixel_m)
    rng = np.random.default_rng(2)
    R_si = Rotation.random(random_state=rng)
    image, truth = star_frame(PAPER_CAMERA, R_si, places, Sensor(hot_pixels=2000), rng)
    index = build_index(places, places.epoch_jyear, fov)
    still = Observer(EPOCH, 0.0, P_I, np.zeros(3))
    sightings = sight_stars("full", image, PAPER_CAMERA, index, still, SETTINGS)
    row = {hip: k for k, hip in enumerate(truth.hip)}
    miss = sightings.xy_px - truth.xy_px[[row[h] for h in sightings.hip]]
    assert np.hypot(*miss.T).max() < 1.5  # px: no wrong name among more than a hundred
    assert len(sightings.hip) > 80


def test_half_sides_are_those_of_the_farthest_corner():
    focal_m, pixel_m, middle = 0.05, 7e-6, (310.4, 611.7)
    camera = StarCamera(focal_m=focal_m, pixel_m=pixel_m, width_px=1100, height_px=900, principal_px=middle)
    far_px = max(middle[0] + 0.5, 1099.5 - middle[0]), max(middle[1] + 0.5, 899.5 - middle[1])
    np.testing.assert_allclose(_half_sides(camera), np.array(far_px) * pixel_m / focal_m, rtol=1e-12)


def test_the_equivalent_field_of_a_4_by_3_image_is_its_own_and_of_others_that_of_their_area():
    width, focal_px = 1600, 1234.5
    whole = np.degrees(2.0 * np.arctan2(0.5 * width, focal_px))
    assert np.degrees(equivalent_fov(width, 1200, focal_px)) == pytest.approx(whole, rel=1e-12)
    assert np.degrees(equivalent_fov(600, 3200, focal_px)) == pytest.approx(whole, rel=1e-12)
