"""Fisheyes of 80 to 175 deg: identified and calibrated to their edges, by formulas of other lenses."""

from dataclasses import replace

import numpy as np
import pytest
from foreign_lenses import HEIGHT, SIZE, WIDTH, ForeignLens
from frames import PLACES, directions_of, listed_stars
from scipy.spatial.transform import Rotation

from boresight.star_id.camera_calibration import SkyFrame, calibrate_camera
from boresight.star_id.field import FieldSolution, nominal_camera, solve_list
from boresight.star_id.fisheye import wide_lenses
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.identification.triangle_index import build_index
from boresight.star_id.settings import StarSettings

KINDS = {
    "equidistant": lambda angle: angle,
    "equisolid": lambda angle: 2.0 * np.sin(0.5 * angle),
    "stereographic": lambda angle: 2.0 * np.tan(0.5 * np.minimum(angle, 3.0)),
}
GRID = np.stack(np.meshgrid(np.linspace(0, WIDTH - 1, 13), np.linspace(0, HEIGHT - 1, 11)), axis=-1)
SETTINGS = StarSettings()


@pytest.fixture(scope="module")
def index():
    return build_index(PLACES, PLACES.epoch_jyear, (np.radians(20.0), np.radians(60.0)))


def seen(lens, R_si, seed, limit=4.6):
    """Stars to V `limit`, of which the faintest have the SNR 8."""
    rng = np.random.default_rng(seed)
    places = PLACES.take(np.flatnonzero(PLACES.v_mag < limit))
    brighter = replace(places, v_mag=places.v_mag + 7.0 - limit)  # of `listed_stars`, V = 7 has SNR 8
    return listed_stars(lens, R_si, brighter, rng)


def directions(camera):
    """Pixels of the detector that have a direction in a camera, and these directions."""
    xy = GRID.reshape(-1, 2)
    u_s = camera.directions_from_pixels(xy)
    usable = np.isfinite(u_s).all(axis=1)
    return xy[usable], u_s[usable]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("fov_deg", [80, 120, 170])
def test_a_fisheye_is_identified_to_its_edges(kind, fov_deg, index):
    lens, R_si = ForeignLens(fov_deg, KINDS[kind]), Rotation.random(random_state=fov_deg)
    stars = seen(lens, R_si, 1)
    found = solve_list(stars, SIZE, index, SETTINGS, fov_x_rad=np.radians(min(1.04 * fov_deg, 175.0)))
    assert isinstance(found, FieldSolution), found.reason
    # stars beyond 90 deg from the axis, in corners, have no place in the camera
    u_s = R_si.apply(directions_of(PLACES))
    ahead = (u_s[:, 2] > 0.01) & (PLACES.v_mag < 4.6)
    inside = lens.contains(lens.pixels_from_directions(u_s[ahead])).sum()
    assert found.matches > 0.93 * inside
    xy, known = directions(found.camera)
    off = lens.pixels_from_directions(R_si.apply(found.R_si.inv().apply(known))) - xy
    # two hundred stars of 0.02 to 0.2 px
    assert np.hypot(*off.T).max() < 0.6


@pytest.mark.parametrize("kind", KINDS)
def test_false_and_missing_stars_lead_to_no_other_lens(kind, index):
    """A third of the detections false, a fifth of all missing."""
    for seed in (21, 22):
        rng, lens = np.random.default_rng(seed), ForeignLens(150, KINDS[kind])
        R_si = Rotation.random(random_state=seed)
        stars = seen(lens, R_si, seed)
        n = len(stars.snr)
        snr = np.append(stars.snr, rng.choice(stars.snr[n // 2 :], n // 2))
        xy = np.vstack([stars.xy_px, rng.uniform(0.0, 1.0, (n // 2, 2)) * SIZE])
        kept = np.argsort(-snr, kind="stable")[rng.random(len(snr)) > 0.2]
        no = np.zeros(len(kept), dtype=bool)
        cov = (1.8 / snr[kept])[:, None, None] ** 2 * np.eye(2)
        same = {"flux_dn": snr[kept], "snr": snr[kept], "saturated": no, "blended": no}
        mixed = replace(stars, xy_px=xy[kept], cov_px=cov, **same)
        found = solve_list(mixed, SIZE, index, SETTINGS, fov_x_rad=np.radians(150.0))
        assert isinstance(found, FieldSolution), found.reason
        pixels, known = directions(found.camera)
        off = lens.pixels_from_directions(R_si.apply(found.R_si.inv().apply(known))) - pixels
        assert np.hypot(*off.T).max() < 0.6  # as of the stars alone


def test_a_mirrored_fisheye_is_said_to_be_one(index):
    lens, R_si = ForeignLens(150, KINDS["equisolid"]), Rotation.random(random_state=3)
    stars = seen(lens, R_si, 2).mirrored(WIDTH)
    found = solve_list(stars, SIZE, index, SETTINGS, fov_x_rad=np.radians(150.0))
    assert isinstance(found, FieldSolution) and found.mirrored
    nominal = nominal_camera(SIZE, np.radians(150.0))
    refused = calibrate_camera([SkyFrame("one", stars)], nominal, index, SETTINGS)
    assert isinstance(refused, NotIdentified) and "reverse the order of its columns" in refused.reason


LENSES = [("equisolid", 80), ("stereographic", 120), ("stereographic", 165), ("equisolid", 180)]


@pytest.mark.parametrize(("kind", "fov_deg"), LENSES)
def test_a_fisheye_is_calibrated_and_then_known(kind, fov_deg, index):
    """Before: `ValueError` for the equisolid lens of 80 deg, refused from 100 deg; edges of that of 180 deg
    lie behind the camera."""
    lens = ForeignLens(fov_deg, KINDS[kind])
    rotations = [Rotation.random(random_state=10 * fov_deg + k) for k in range(4)]
    frames = [SkyFrame(f"{k}", seen(lens, R_si, k)) for k, R_si in enumerate(rotations)]
    nominal = nominal_camera(SIZE, np.radians(min(0.97 * fov_deg, 175.0)))
    found = calibrate_camera(frames, nominal, index, SETTINGS)
    assert not isinstance(found, NotIdentified), found.reason
    assert len(found.frames_used) == 4
    xy, _ = directions(found.camera)
    off = np.hypot(*lens.error_px(found.camera, xy).T)
    assert off.max() < 0.1  # px
    assert np.isfinite(found.map_error_px(xy)).all()
    again = seen(lens, rotations[0], 7)
    known = solve_list(again, SIZE, index, SETTINGS, camera=found.camera)
    ahead = np.isfinite(found.camera.directions_from_pixels(again.xy_px)[:, 2])  # others have no name
    assert known.matches > 0.9 * ahead.sum()
    error = (rotations[0] * known.R_si.inv()).magnitude()
    assert error < 0.2 / lens.focal_px  # rad of 0.2 px


def test_a_field_that_no_camera_here_has_is_refused_with_its_reason(index):
    stars = seen(ForeignLens(150, KINDS["equidistant"]), Rotation.identity(), 1)
    found = solve_list(stars, SIZE, index, SETTINGS, fov_x_rad=np.radians(179.0))
    assert isinstance(found, NotIdentified) and "at most 175 deg" in found.reason


def test_lenses_from_which_fits_start_are_those_of_their_names():
    nominal = nominal_camera(SIZE, np.radians(100.0), "equidistant")
    angle = np.radians(np.linspace(0.5, 86.0, 100))
    u_s = np.column_stack([-np.sin(angle), 0.0 * angle, np.cos(angle)])
    focal_px = nominal.focal_m / nominal.pixel_m
    for camera, radius in zip(wide_lenses(nominal), (*KINDS.values(), np.tan)):
        if radius is np.tan:
            u_s, angle = u_s[:70], angle[:70]
        x = camera.pixels_from_directions(u_s)[:, 0] - camera.principal_px[0]
        np.testing.assert_allclose(x / focal_px, radius(angle), atol=3e-7)  # the series' next term
