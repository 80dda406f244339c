"""Interior orientation: parameters do to the camera what they say, the gauge is none of the mounting's, and a
wrong camera is found from the sky and from the ground with an honest covariance.
"""

from dataclasses import replace

import numpy as np
import pytest
from drawn_campaigns import BOLD, assert_chi_square
from four_ccds import four_ccds, map_difference_px
from scipy.spatial.transform import Rotation
from scipy.special import gamma, kv

from boresight.calib.settings import CalibrationSettings
from boresight.features.interior.interior_estimate import calibrate_interior
from boresight.features.interior.interior_files import _table
from boresight.features.interior.interior_parameters import STAGGER, InteriorModel, InteriorPriors, _priors
from boresight.geometry.constants import ARCSEC
from boresight.geometry.line_camera import LineCamera
from boresight.simulator.campaign import CameraPair, LinePair, StripPlan, draw_sky_strips, draw_strips

NODES = np.linspace(0.0, 6143.0, 9)


def camera(tables=True):
    """Four staggered CCDs behind 10 m, rotated, with a table of distortion as of a laboratory."""
    table = {"distortion_samples": NODES, "distortion_offsets_m": 2e-9 * (NODES - 3067.0)} if tables else {}
    return LineCamera(10.0, four_ccds([table] * 4))


def true_camera(seed, assumed):
    """The assumed camera 1e-4 off in focal length, 3 px in the CCDs' places, 0.1 mrad in their rotation and
    2 px in a smooth distortion.
    """
    rng = np.random.default_rng(seed)
    model = InteriorModel.of(assumed, InteriorPriors(curve_length_px=3500.0))
    values = np.zeros(len(model.names))
    for n, name in enumerate(model.names):
        kind = name.split("/")[0]
        size = {"focal": 1e-4, "shift_along": 3.0, "shift_across": 3.0, "rotation": 1e-4}.get(kind, 0.0)
        values[n] = size * rng.choice([-1.0, 1.0]) * rng.uniform(0.7, 1.3)
    for axis in ("along", "across"):
        phase, waves = rng.uniform(0.0, 2.0 * np.pi, 2), 2.0 * np.pi * np.array([1.3, 2.7])
        for c in range(4):
            places = (c + model.knots[c][:, None] / 6143.0) / 4.0  # of the field
            smooth = 2.0 * np.cos(waves * places + phase).sum(axis=1)  # 2 px rms
            for k in range(len(smooth)):
                values[model.names.index(f"curve_{axis}/{c}/{k}")] = smooth[k]
    return model.corrected(values)


@pytest.mark.parametrize("turned_rad", [(0.0,) * 4, (0.04, -0.03, 0.05, -0.02)])
@pytest.mark.parametrize("tables", [True, False])
def test_the_corrected_camera_looks_where_the_parameters_say(tables, turned_rad):
    plain = camera(tables)
    ccds = tuple(replace(ccd, rotation_rad=turn) for ccd, turn in zip(plain.ccds, turned_rad))
    model = InteriorModel.of(replace(plain, ccds=ccds), InteriorPriors(stagger_s=1e-5))
    values = model.basis @ np.random.default_rng(3).standard_normal(model.basis.shape[1])
    corrected = model.corrected(values)
    for c in range(4):
        sample = np.random.default_rng(c).uniform(0.0, 6143.0, 300)
        change = corrected.directions_from_pixels(c, sample) - model.camera.directions_from_pixels(c, sample)
        told = model.look_change(np.full(300, c), sample) @ values
        assert np.abs(told).max() > 1e-6  # a pixel and more
        np.testing.assert_allclose(change, told, rtol=0, atol=2e-8)  # 0.02 px: second order in 1e-3 and 20 px


def test_a_scale_moves_all_points_of_a_ccd_away_from_its_principal_point():
    table = {"distortion_samples": NODES, "distortion_offsets_m": 2e-7 * (NODES - 3067.0)}
    plain = LineCamera(10.0, four_ccds([table] * 4))
    model, scale = InteriorModel.of(plain, InteriorPriors()), 0.01
    values = np.array([scale * (name == "scale/2") for name in model.names])
    before, after = plain.ccds[2], model.corrected(values).ccds[2]
    centre, sample = before.focal_plane(np.array([before.principal_sample])), np.linspace(0.0, 6143.0, 50)
    expected = centre + (1.0 + scale) * (before.focal_plane(sample) - centre)
    np.testing.assert_allclose(after.focal_plane(sample), expected, atol=1e-9)  # m; the scale is 0.6 mm


def test_the_prior_of_a_lens_is_a_matern_process_over_the_field():
    priors = InteriorPriors(3e-4, 5.0, 2e-4, 1e-4, 3.0, 4000.0, 7e-6)
    line, knots = camera(), (np.linspace(0.0, 6143.0, 4),) * 4
    names, root = _priors(priors, line, knots, True)
    sigma = dict(zip(names, np.sqrt(np.diag(root @ root.T))))
    sizes = {"focal": 3e-4, "shift_along/1": 5.0, "shift_across/1": 5.0, "rotation/1": 2e-4, "scale/1": 1e-4}
    for name, size in (sizes | {"stagger/1": 7e-6, "curve_along/1/2": 3.0, "curve_across/3/0": 3.0}).items():
        assert sigma[name] == pytest.approx(size, rel=1e-8), name
    own = [n for n, name in enumerate(names) if name.startswith("curve_across/")]
    place = np.concatenate([ccd.focal_plane(k)[:, 1] / ccd.pixel_m for ccd, k in zip(line.ccds, knots)])
    d = np.sqrt(5.0) * (np.abs(place[:, None] - place) + 1e-3) / 4000.0  # a Bessel function has no value at 0
    expected = 9.0 * 2.0**-1.5 / gamma(2.5) * d**2.5 * kv(2.5, d)
    np.testing.assert_allclose((root @ root.T)[np.ix_(own, own)], expected, atol=1e-5)  # px²; by that 1e-3 px


def test_detectors_at_one_place_of_the_field_have_one_distortion():
    both = InteriorModel.of(replace(camera(), ccds=(camera().ccds[1],) * 2), InteriorPriors())
    curves = [n for n, name in enumerate(both.names) if name.startswith("curve_along/")]
    one, other = np.split(both.basis[curves], 2)
    assert np.abs(one - other).max() < 1e-3 and np.abs(one).max() > 0.1  # px


def test_the_gauge_leaves_nothing_that_a_rotation_does():
    model = InteriorModel.of(camera(), InteriorPriors())
    values = model.basis @ np.random.default_rng(4).standard_normal(model.basis.shape[1])
    difference, rows = map_difference_px(model.corrected(values), model.camera)
    change = model.look_change(rows[:, 0].astype(int), rows[:, 1]) @ values / model.camera.pixel_rad
    # The rotation taken off is zero by constraint but for its quadrature, 2e-3 of some 12 px.
    assert np.abs(difference - change[:, :2]).max() < 0.05
    assert np.linalg.matrix_rank(model.basis) == model.basis.shape[1]
    assert {gauge.reason for gauge in model.gauges} >= {
        f"rotation about {axis} of the installation matrix" for axis in "XYZ"
    }


def test_delays_of_rows_need_strips_of_different_rates():
    assert STAGGER in InteriorModel.of(camera(), InteriorPriors(stagger_s=1e-5), stagger=False).gauges
    model = InteriorModel.of(camera(), InteriorPriors(stagger_s=1e-5))
    assert STAGGER not in model.gauges
    rows = [n for n, name in enumerate(model.names) if name.startswith("stagger/")]
    assert np.abs(model.basis[rows]).max() > 1e-6
    np.testing.assert_allclose(model.basis[rows].sum(axis=0), 0.0, atol=1e-13)  # s; CCDs of equal size


SKY = StripPlan(
    strips=6, targets=80, stars=60, sigma_c_px=0.05, sigma_vibration_rad=0.1 * ARCSEC, sigma_clock_s=1e-5
)
GROUND = replace(
    SKY, strips=20, targets=24, exposures=5, sigma_c_px=0.3, sigma_position_m=2.0, sigma_clock_s=1e-4
)


RUNS = 8


def estimated(kind, seed):
    """Estimate of a wrong camera, and the map error left in the gauge, px, at (CCD, sample)."""
    assumed = camera()
    true = true_camera(seed, assumed)
    cameras = CameraPair(BOLD, line=LinePair(true, assumed))
    rng = np.random.default_rng(100 + seed)
    strips = draw_sky_strips(SKY, cameras, rng) if kind == "sky" else draw_strips(GROUND, cameras, rng)[0]
    settings = CalibrationSettings(sigma_clock_s=(SKY if kind == "sky" else GROUND).sigma_clock_s)
    found = calibrate_interior(strips, BOLD, assumed, settings)
    error, rows = map_difference_px(found.camera, true, 60)
    before, _ = map_difference_px(assumed, true, 60)
    return found, error, before, rows


@pytest.mark.parametrize("kind", ["sky", "ground"])
def test_a_wrong_camera_is_found_with_an_honest_covariance(kind):
    nees = 0.0
    for seed in range(RUNS):
        found, error, before, rows = estimated(kind, seed)
        assert np.sqrt(np.mean(before**2)) > 2.0  # px
        assert np.sqrt(np.mean(error**2)) < {"sky": 0.15, "ground": 0.25}[kind]
        ccd, sample = rows[:, 0].astype(int), rows[:, 1]
        change = found.model.look_change(ccd, sample)[:, :2].reshape(len(ccd) * 2, -1)
        covariance = change @ found.covariance @ change.T / found.camera.pixel_rad**2
        sigma = found.map_sigma_px(ccd, sample)
        np.testing.assert_allclose(sigma.ravel() ** 2, np.diag(covariance), rtol=1e-9)
        values, vectors = np.linalg.eigh(covariance)  # the widest ten: beyond, the curves' knots have few
        nees += np.sum((vectors[:, -10:].T @ error.ravel()) ** 2 / values[-10:])
    assert_chi_square(nees, 10 * RUNS)  # 0.55 to 1.59: a factor of 1.4 in sigma is 2.0 or 0.5


def test_a_delay_of_a_ccds_rows_is_found_from_scans_in_both_directions():
    assumed, delay_s = camera(), 2e-5  # 0.29 px of a scan at 14.5 mrad/s, forward in one, back in the other
    rng = np.random.default_rng(9)
    strips = []
    for n, strip in enumerate(draw_sky_strips(SKY, CameraPair(BOLD, line=LinePair(assumed, assumed)), rng)):
        late = np.where(strip.ground.ccd == 2, delay_s, 0.0)
        rate_c = np.array([0.0, (-0.0145, 0.0145)[n % 2], 0.0])
        # Rows of CCD 2 are stated before their true instants; so is the nominal attitude there.
        R_oi = Rotation.from_rotvec(np.outer(late, rate_c)) * strip.R_oi_targets
        stated = replace(strip.ground, t_s=strip.ground.t_s - late)
        strips.append(replace(strip, ground=stated, R_oi_targets=R_oi))
    settings = CalibrationSettings(sigma_clock_s=1e-5)
    found = calibrate_interior(strips, BOLD, assumed, settings, InteriorPriors(stagger_s=5e-5))
    rows = [found.model.names.index(f"stagger/{c}") for c in range(4)]
    expected = np.array([-0.25, -0.25, 0.75, -0.25]) * delay_s  # less the mean, which is the row clock's
    sigma = np.sqrt(np.diag(found.covariance)[rows])
    assert np.all(np.abs(found.values[rows] - expected) < 4.0 * sigma)
    assert sigma.max() < 0.4 * delay_s


def test_columns_that_a_terminal_has_no_room_for_stand_below_with_their_names():
    sizes = (35, 35, 36, 35, 10, 60, 3)  # after a name of 6: 80 columns, 81, and what is left
    columns = [["", "CCD 0", "CCD 10"], *([f"{n}" * size, "a", f"b{n}"] for n, size in enumerate(sizes))]
    parts = np.reshape(_table(columns), (-1, 3))
    assert [[len(line) for line in part] for part in parts] == [[80] * 3, [44] * 3, [55] * 3, [73] * 3]
    assert all([line[:6].strip() for line in part] == columns[0] for part in parts)
    cells = [column for part in parts for column in zip(*(line[6:].split() for line in part))]
    assert cells == [tuple(column) for column in columns[1:]]
