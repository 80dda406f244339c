"""The 1-sigma of predicted Earth orientation in the covariance, against rotations made by other tables."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import erfa
import numpy as np
import pytest
from command_line import ran
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.predicted_earth import correlation_of_predictions, earth_names, is_earth
from boresight.features.geolocate.positions import Pixels, ground_places
from boresight.geometry.constants import WGS84
from boresight.geometry.earth_orientation import EarthOrientationTable, expected_rotation_error_rad
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.geodesy import geodetic_from_ecef, unit_vectors
from boresight.geometry.installation import theta_between
from boresight.geometry.orbit import Orbit
from boresight.geometry.sightings import StripSightings
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.calibration.calibrate import DumpCalibration
from boresight.pipeline.files import dump_parts
from boresight.pipeline.files.orbit_and_earth import bundled_table
from boresight.pipeline.forecast.budget import uncertainty_budget
from boresight.pipeline.results.ground_moves import common_covariance, ground_moves
from boresight.pipeline.results.reading import SavedEarth, _earth, read_mounting, read_saved_result
from boresight.pipeline.results.strip_model import open_calibrated, strip_model
from boresight.pipeline.stages.strip import StripTask, ground_sightings, pushbroom_of
from boresight.records.record import Floats

pytestmark = pytest.mark.filterwarnings(
    "ignore::boresight.geometry.earth_orientation.EarthOrientationWarning"
)
UT1_S = 2e-3  # a change of UT1: 0.9 m on the equator
POLE_RAD = 1e-6
UT1_RAD_S = 2.0 * np.pi / 86_164.0989  # rotation of the Earth, IAU 2000


def old_table(days: float, orbit: Orbit, **changes: float) -> EarthOrientationTable:
    """The bundled table, last measured so many days before the orbit; its values changed by constants."""
    day = float(orbit.epoch.mjd_tai(0.0))
    table = bundled_table()
    moved = {name: getattr(table, name) + value for name, value in changes.items()}
    return replace(table, mjd_last_measured=day - days, **moved)


def with_table(task: StripTask, table: EarthOrientationTable, frame: str = "GCRF") -> StripTask:
    """The task with another table, its orbit stated in another frame: of the same positions by `task`."""
    orbit = task.orbit
    t_s = orbit.t_s
    position_m, velocity_m_s = (
        orbit.states_i(t_s) if frame == "GCRF" else (orbit.positions_e(t_s), orbit.velocities_e(t_s))
    )
    earth = EarthRotation.over(orbit.epoch, orbit.earth.t_start_s, orbit.earth.t_stop_s, table)
    states = {"positions_m": position_m, "velocities_m_s": velocity_m_s, "frame": frame}
    return replace(task, orbit=replace(orbit, earth=earth, **states))  # type: ignore[arg-type]


@pytest.mark.parametrize("frame", ["GCRF", "ITRF"])
@pytest.mark.parametrize("changes", [{"ut1_utc_s": UT1_S}, {"xp_rad": POLE_RAD}, {"yp_rad": POLE_RAD}])
def test_directions_move_as_those_of_another_table(frame, changes, calibration):
    task, matched = calibration.tasks[0], calibration.matched[0]
    old, moved = (with_table(task, old_table(30.0, task.orbit, **one), frame) for one in ({}, changes))
    t_s = np.array([0.5 * sum(task.orbit.span_s)])
    turn = (old.orbit.earth.rotations_ie(t_s).inv() * moved.orbit.earth.rotations_ie(t_s)).as_rotvec()[0]
    if "ut1_utc_s" in changes:  # the axis of rotation is within 0.3 arcsec of the pole of ITRS
        assert turn == pytest.approx([0.0, 0.0, UT1_S * UT1_RAD_S], abs=2e-6 * UT1_S * UT1_RAD_S)
    here, there = (ground_sightings(matched, one) for one in (old, moved))
    sigma = expected_rotation_error_rad(30.0, 0.0)
    assert old.orbit.earth.sigma_e_rad == pytest.approx(sigma, rel=0.05)  # the dump lies within a day
    expected = here.earth_i @ (turn / old.orbit.earth.sigma_e_rad)
    size = np.linalg.norm(there.u_i - here.u_i, axis=1).max()
    # 1e-3 of it: aberration by the satellite's velocity, and the second order
    assert np.abs(there.u_i - here.u_i - expected).max() < 1e-3 * size and size > 1e-8


def with_ground(strip: StripSightings, task: StripTask, calibration: DumpCalibration) -> StripSightings:
    ground = ground_sightings(calibration.matched[0], task)
    assert ground.target_id.tolist() == strip.ground.target_id.tolist()
    return replace(strip, ground=ground, earth=task.orbit.earth.prediction)


def estimated(strip: StripSightings, calibration: DumpCalibration) -> InstallationEstimate:
    settings = replace(calibration.settings, robust=False)
    found = calibrate_strips([strip], calibration.estimate.R_cs0, settings)
    assert isinstance(found, InstallationEstimate)
    return found


def test_predictions_of_far_dates_average_and_those_of_one_date_do_not(calibration: DumpCalibration) -> None:
    # Twice the same strip, of one date or of dates 60 years apart in two issues of the table.
    task, strip = calibration.tasks[0], calibration.strips[0]
    ground = with_ground(strip, of_ut1(with_table(task, bundled_table()), 1e-6), calibration).ground
    names = ("59000/59010", "81000/81010")
    grounds = [
        replace(ground, target_id=np.char.add(ground.target_id, "ab"[n]), t_s=ground.t_s + 1e5 * n)
        for n in (0, 1)
    ]
    pair = [replace(later(strip, 1e5 * n), strip_id=f"S{n}", ground=one) for n, one in enumerate(grounds)]
    twice = [
        [replace(one, earth=name) for one, name in zip(pair, which)]
        for which in ((names[0], names[0]), names)
    ]
    settings = replace(calibration.settings, robust=False, sigma_distortion_rad=0.0)
    free = np.zeros_like(ground.earth_i)
    without = [replace(one, ground=replace(one.ground, earth_i=free)) for one in twice[0]]
    of_all = [calibrate_strips(these, calibration.estimate.R_cs0, settings) for these in (without, *twice)]
    none, same, apart = (np.trace(one.cov_theta) for one in of_all if isinstance(one, InstallationEstimate))
    # 3 %: correlation of 1e-2 is left, and the estimate weighs the targets anew
    assert apart - none == pytest.approx(0.5 * (same - none), rel=0.03)


def later(strip: StripSightings, seconds: float) -> StripSightings:
    """The strip with its exposures dated later; strips of one time would be one pass."""
    exposures = tuple(replace(one, t_s=one.t_s + seconds) for one in strip.exposures)
    return replace(strip, exposures=exposures)


def of_ut1(task: StripTask, sigma_rad: float) -> StripTask:
    """The task with an error of UT1 alone."""
    last = round(float(task.orbit.epoch.mjd_tai(0.0))) - 30.0
    earth = replace(task.orbit.earth, sigma_e_rad=np.array([0.0, 0.0, sigma_rad]), mjd_last_measured=last)
    return replace(task, orbit=replace(task.orbit, earth=earth))


def test_of_an_earth_fixed_orbit_the_camera_turns_about_the_axis_of_the_earth(calibration):
    # Target and satellite turn together, and so does the matrix: its covariance gains the square of one
    # rotation about the Earth's axis, which ERFA and the strip's attitude give in frame c.
    task, strip = calibration.tasks[0], calibration.strips[0]
    fixed = with_table(task, bundled_table(), "ITRF")
    sigma = 3e-6
    without, with_it = (
        estimated(with_ground(strip, one, calibration), calibration) for one in (fixed, of_ut1(fixed, sigma))
    )
    t_s = float(strip.ground.t_s.mean())
    tt = task.orbit.epoch.tt_jd(np.array([t_s]))
    axis_i = erfa.bpn2xy(erfa.pnm06a(tt[0][0], tt[1][0]))
    pole_i = np.array([axis_i[0], axis_i[1], np.sqrt(1.0 - axis_i[0] ** 2 - axis_i[1] ** 2)])
    k = int(np.argmin([abs(exposure.t_s - t_s) for exposure in strip.exposures]))
    R_si = Rotation.from_matrix(calibration.attitudes.R_si[k])
    d = sigma * (without.R_cs * R_si).apply(pole_i)
    gain = with_it.cov_theta - without.cov_theta
    # 1 %: in the strip's second the satellite turns by a few mrad, and the estimate weighs the targets anew
    assert np.abs(gain - np.outer(d, d)).max() < 0.01 * np.abs(np.outer(d, d)).max()
    assert (with_it.R_cs * without.R_cs.inv()).magnitude() < 1e-7  # rad: the best unknown is nearly zero


def test_of_an_inertial_orbit_the_covariance_gains_the_shift_by_another_table(calibration):
    # For a small sigma the gain is that of the unchanged estimate: theta's own shift, squared.
    task, strip = calibration.tasks[0], calibration.strips[0]
    ut1_s = 1e-4  # 5 cm on the equator, a sixtieth of sigma in theta
    table = bundled_table()
    moved = with_table(task, replace(table, ut1_utc_s=table.ut1_utc_s + ut1_s))
    still = with_table(task, table)
    here, there = (estimated(with_ground(strip, one, calibration), calibration) for one in (still, moved))
    shift = theta_between(there.R_cs, here.R_cs)
    with_it = estimated(with_ground(strip, of_ut1(still, ut1_s * UT1_RAD_S), calibration), calibration)
    gain = with_it.cov_theta - here.cov_theta
    size = np.abs(np.outer(shift, shift)).max()
    assert size > 1e-4 * here.cov_theta[1, 1]
    # 1e-3 of it: the estimate weighs the targets anew, by the ratio above
    assert np.abs(gain - np.outer(shift, shift)).max() < 1e-3 * size


def test_measured_values_change_nothing_and_predicted_ones_are_a_source_of_the_budget(calibration):
    task, strip = calibration.tasks[0], calibration.strips[0]
    assert not strip.ground.earth_i.any()
    assert not any(map(is_earth, calibration.estimate.pairs.shared))
    old = with_ground(strip, with_table(task, old_table(300.0, task.orbit)), calibration)
    found = estimated(old, calibration)
    assert sum(map(is_earth, found.pairs.shared)) == 3
    assert np.all(found.sigma_theta > calibration.estimate.sigma_theta)
    settings = replace(calibration.settings, robust=False)
    shares = {one.source: one.covariance for one in uncertainty_budget([old], found.R_cs, settings)}
    assert sum(shares.values()) == pytest.approx(found.cov_theta, rel=0.02, abs=1e-3 * found.cov_theta.max())
    assert np.trace(shares["predicted Earth orientation"]) > 0.0


def test_a_result_of_predicted_values_is_written_and_read(finished, calibration, tmp_path, monkeypatch):
    old = old_table(300.0, calibration.tasks[0].orbit)
    monkeypatch.setattr(dump_parts, "bundled_table", lambda: old)
    out = tmp_path / "result"
    ran("calibrate", finished[0], "--out", out, "--workers", 1)
    saved = read_saved_result(out)
    assert np.all(np.diag(saved.cov_theta) > np.diag(calibration.estimate.cov_theta))
    mounting = read_mounting(out, "all")
    assert not any(map(is_earth, mounting.shared))
    # Where pixels lie on the ground: with the prediction that made the matrix its error cancels; with values
    # measured by now that of the matrix stays. Predicted 300 days ahead, UT1 is off by 8.4 m on the equator;
    # of this orbit, stated in ITRF, the camera's rotation by as much remains: 0.7 m from 530 km.
    same = sigma_of_places(out, finished[0])
    monkeypatch.setattr(dump_parts, "bundled_table", bundled_table)
    measured, plain = sigma_of_places(out, finished[0]), sigma_of_places(finished[1], finished[0])
    added = np.sqrt(np.sum(measured**2 - plain**2, axis=1))
    assert np.all((added > 0.3) & (added < 0.7))
    assert np.all(np.abs(same**2 - plain**2).sum(axis=1) < 0.01 * added**2)


def sigma_of_places(result: Path, dump: Path) -> Floats:
    """1-sigma (N, 2) along and across the track of some pixels of the dump's strip, m."""
    calibrated = open_calibrated(result, dump)
    model = strip_model(calibrated, calibrated.dump.strips[0].strip_id)
    pixels = Pixels(np.array([0, 1, 3]), np.array([10.0, 255.0, 500.0]), np.array([20.0, 1000.0, 1900.0]))
    places = ground_places(calibrated, model, pixels, ConstantHeight(200.0))
    return np.column_stack([places.sigma_along_m, places.sigma_across_m])


@pytest.mark.parametrize("frame", ["GCRF", "ITRF"])
@pytest.mark.parametrize("change", ["ut1_utc_s", "xp_rad", "yp_rad"])
def test_places_move_as_with_another_table(frame: str, change: str, calibration: DumpCalibration) -> None:
    # Places by two tables, by the matrix of each: what the matrix does, what the Earth does, and both.
    size = {"ut1_utc_s": UT1_S, "xp_rad": POLE_RAD, "yp_rad": -POLE_RAD}[change]
    task, strip = calibration.tasks[0], calibration.strips[0]
    old, moved = (with_table(task, old_table(30.0, task.orbit, **one), frame) for one in ({}, {change: size}))
    here, there = (estimated(with_ground(strip, one, calibration), calibration) for one in (old, moved))
    places = {
        (k, m): pushbroom_of(replace(one, R_cs=matrix.R_cs)).ground_points(
            3, np.array([480.0]), np.array([1500.0]), ConstantHeight(400.0)
        )
        for k, one in enumerate((old, moved))
        for m, matrix in enumerate((here, there))
    }
    model = pushbroom_of(replace(old, R_cs=here.R_cs))
    t_s = np.asarray(model.instants_of_lines(np.array([3]), np.array([1500.0])))
    moves = ground_moves(old.orbit, here.R_cs * model.attitude.R_si(t_s), t_s, places[0, 0])
    turn = (old.orbit.earth.rotations_ie(t_s).inv() * moved.orbit.earth.rotations_ie(t_s)).as_rotvec()[0]
    theta = theta_between(there.R_cs, here.R_cs)
    by_theta = moves.by_rotation[0] @ theta
    by_earth = moves.by_earth[0] @ (turn / old.orbit.earth.sigma_e_rad)
    for (k, m), p_e in places.items():
        found = on_track(old.orbit, t_s, places[0, 0], p_e - places[0, 0])
        # 1e-3: second order, and the aberration by the satellite's velocity
        assert found == pytest.approx(m * by_theta + k * by_earth, abs=1e-3 * np.abs(by_earth).max())
    if frame == "GCRF":
        assert np.linalg.norm(by_theta + by_earth) < 0.05 * np.linalg.norm(by_earth)  # it cancels
        # A small 1-sigma about the same axis: theta and the Earth's rotation as they have moved together.
        by_one = estimated(with_ground(strip, about(old, 1e-3 * turn), calibration), calibration)
        turned = [n for n, name in enumerate(by_one.pairs.shared) if is_earth(name)]
        together = by_one.theta_with_shared[:, turned].sum(axis=1)
        assert together == pytest.approx(1e-3 * theta, abs=2e-3 * np.abs(1e-3 * theta).max())


def about(task: StripTask, turn: Floats) -> StripTask:
    """The task with such 1-sigmas about the three axes of the Earth, rad, signs included."""
    return replace(task, orbit=replace(task.orbit, earth=replace(task.orbit.earth, sigma_e_rad=turn)))


def on_track(orbit: Orbit, t_s: Floats, p_e: Floats, moved: Floats) -> Floats:
    """Parts (2,) of a move along the track and to the right of it."""
    up = unit_vectors(*geodetic_from_ecef(p_e, WGS84)[1::-1])[0]
    along = orbit.velocities_e(t_s)[0]
    along = along - up * (along @ up)
    along = along / np.linalg.norm(along)
    return np.array([moved[0] @ along, moved[0] @ np.cross(along, up)])


def test_predictions_grow_apart_as_the_iers_states() -> None:
    # The difference of two days of one table is as uncertain as a prediction over the days between them; the
    # later table's is the earlier one's less the error of the day to which it was measured.
    last, days = 60_000, np.array([3, 40, 90])
    names = [f"{last}/{last + day}" for day in days]
    sigma = [expected_rotation_error_rad(float(day), 0.0) for day in days]
    R = correlation_of_predictions(names, names).reshape(3, 3, 3, 3)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        off = np.diag(R[a, :, b])
        found = sigma[a] ** 2 + sigma[b] ** 2 - 2.0 * off * sigma[a] * sigma[b]
        between = expected_rotation_error_rad(float(days[b] - days[a]), 0.0)
        assert found == pytest.approx(between**2, rel=1e-9)
    three = [*names[1:], f"{last + 40}/{last + 90}"]
    R = correlation_of_predictions(three, three).reshape(3, 3, 3, 3)
    s = np.array([sigma[1], sigma[2], expected_rotation_error_rad(50.0, 0.0)])
    left = np.array([-1.0, 1.0, -1.0])  # e(90) - e(40) - e of the later table: nothing
    for axis in range(3):
        C = R[:, axis, :, axis] * np.outer(s[:, axis], s[:, axis])
        assert abs(left @ C @ left) < 1e-9 * C.max()


def test_a_located_date_that_was_not_calibrated_shares_what_is_correlated(calibration):
    # Against draws of the errors of both dates: 200 000, each share good to 0.5 %.
    here, there = "60000/60020", "60000/60035"
    R = correlation_of_predictions((here, there), (here, there))
    saved = {"unknowns": earth_names((here, there)), "covariance": R.tolist()}
    read = _earth({"predicted_earth": saved | {"covariance_with_theta_rad": R[:3].tolist()}}, "")
    assert (read.predictions, read.covariance.shape) == ((here, there), (6, 6))
    a = np.random.default_rng(5).multivariate_normal(np.zeros(6), R, 200_000)
    by_a = np.array([[3.0, -1.0, 0.5], [0.2, 2.0, -4.0], [1.0, 0.0, 0.3]])  # theta by the errors
    theta = a[:, :3] @ by_a.T
    earth = SavedEarth(predictions=(here,), covariance=np.eye(3), with_theta_rad=by_a)
    result = SimpleNamespace(cov_theta=by_a @ by_a.T, earth=earth)
    rotation = SimpleNamespace(prediction=there)
    found = common_covariance(result, rotation)  # type: ignore[arg-type]
    drawn = np.cov(np.column_stack([theta, a[:, 3:]]).T)
    assert found == pytest.approx(drawn, abs=0.01 * np.abs(drawn).max())
