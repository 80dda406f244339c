"""The 1-sigma of predicted Earth orientation in the covariance, against rotations made by other tables."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import erfa
import numpy as np
import pytest
from command_line import app
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from boresight.calib.budget import uncertainty_budget
from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.shared_unknowns import EARTH
from boresight.geometry.earth_orientation import EarthOrientationTable, expected_rotation_error_rad
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.installation import theta_between
from boresight.geometry.orbit import Orbit
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.files import dump as dump_file
from boresight.pipeline.files.dump import bundled_table, open_dump
from boresight.pipeline.results.folder import store_of
from boresight.pipeline.results.reading import read_mounting, read_saved_result
from boresight.pipeline.stages.calibrate import DumpCalibration, calibrate_dump
from boresight.pipeline.stages.strip import StripTask, ground_sightings

UT1_S = 2e-3  # a change of UT1: 0.9 m on the equator
POLE_RAD = 1e-6
UT1_RAD_S = 2.0 * np.pi / 86_164.0989  # rotation of the Earth, IAU 2000


@pytest.fixture(scope="module")
def calibration(finished: tuple[Path, Path]) -> DumpCalibration:
    """The one-strip dump from its finished units."""
    return calibrate_dump(open_dump(finished[0]), store=store_of(finished[1]))


def old_table(days: float, orbit: Orbit, **changes: float) -> EarthOrientationTable:
    """The bundled table, last measured so many days before the orbit; its values changed by constants."""
    day = float(orbit.epoch.mjd_tai(0.0))
    table = bundled_table()
    moved = {name: getattr(table, name) + value for name, value in changes.items()}
    return replace(table, mjd_last_measured=day - days, **moved)


@pytest.mark.filterwarnings("ignore::boresight.geometry.earth_orientation.EarthOrientationWarning")
def with_table(task: StripTask, table: EarthOrientationTable, frame: str = "GCRF") -> StripTask:
    """The task with another table, its orbit stated in another frame: of the same positions by `task`."""
    orbit = task.orbit
    t_s = orbit.t_s
    position_m, velocity_m_s = (
        orbit.states_i(t_s) if frame == "GCRF" else (orbit.positions_e(t_s), orbit.velocities_e(t_s))
    )
    stated = Orbit(
        epoch=orbit.epoch,
        t_s=t_s,
        positions_m=position_m,
        velocities_m_s=velocity_m_s,
        frame=frame,  # type: ignore[arg-type]
        earth=EarthRotation.over(orbit.epoch, orbit.earth.t_start_s, orbit.earth.t_stop_s, table),
        method=orbit.method,
        degree=orbit.degree,
    )
    return replace(task, orbit=stated)


@pytest.mark.filterwarnings("ignore::boresight.geometry.earth_orientation.EarthOrientationWarning")
@pytest.mark.parametrize("frame", ["GCRF", "ITRF"])
@pytest.mark.parametrize("changes", [{"ut1_utc_s": UT1_S}, {"xp_rad": POLE_RAD}, {"yp_rad": POLE_RAD}])
def test_directions_move_as_those_of_another_table(
    frame: str, changes: dict[str, float], calibration: DumpCalibration
) -> None:
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
    return replace(strip, ground=ground)


def estimated(strip: StripSightings, calibration: DumpCalibration) -> InstallationEstimate:
    settings = replace(calibration.settings, robust=False)
    found = calibrate_strips([strip], calibration.estimate.R_cs0, settings)
    assert isinstance(found, InstallationEstimate)
    return found


def of_ut1(task: StripTask, sigma_rad: float) -> StripTask:
    """The task with an error of UT1 alone."""
    earth = replace(task.orbit.earth, sigma_e_rad=np.array([0.0, 0.0, sigma_rad]))
    return replace(task, orbit=replace(task.orbit, earth=earth))


@pytest.mark.filterwarnings("ignore::boresight.geometry.earth_orientation.EarthOrientationWarning")
def test_of_an_earth_fixed_orbit_the_camera_turns_about_the_axis_of_the_earth(
    calibration: DumpCalibration,
) -> None:
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


@pytest.mark.filterwarnings("ignore::boresight.geometry.earth_orientation.EarthOrientationWarning")
def test_of_an_inertial_orbit_the_covariance_gains_the_shift_by_another_table(
    calibration: DumpCalibration,
) -> None:
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


@pytest.mark.filterwarnings("ignore::boresight.geometry.earth_orientation.EarthOrientationWarning")
def test_measured_values_change_nothing_and_predicted_ones_are_a_source_of_the_budget(
    calibration: DumpCalibration,
) -> None:
    task, strip = calibration.tasks[0], calibration.strips[0]
    assert not strip.ground.earth_i.any()
    assert not set(EARTH) & set(calibration.estimate.pairs.shared)
    old = with_ground(strip, with_table(task, old_table(300.0, task.orbit)), calibration)
    found = estimated(old, calibration)
    assert set(EARTH) <= set(found.pairs.shared)
    assert np.all(found.sigma_theta > calibration.estimate.sigma_theta)
    settings = replace(calibration.settings, robust=False)
    shares = {one.source: one.covariance for one in uncertainty_budget([old], found.R_cs, settings)}
    assert sum(shares.values()) == pytest.approx(found.cov_theta, rel=0.02, abs=1e-3 * found.cov_theta.max())
    assert np.trace(shares["predicted Earth orientation"]) > 0.0


@pytest.mark.filterwarnings("ignore::boresight.geometry.earth_orientation.EarthOrientationWarning")
def test_a_result_of_predicted_values_is_written_and_read(
    finished: tuple[Path, Path], calibration: DumpCalibration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = old_table(300.0, calibration.tasks[0].orbit)
    monkeypatch.setattr(dump_file, "bundled_table", lambda: old)
    out = tmp_path / "result"
    ran = CliRunner().invoke(app, ["calibrate", str(finished[0]), "--out", str(out), "--workers", "1"])
    assert ran.exit_code == 0, ran.output
    saved = read_saved_result(out)
    assert np.all(np.diag(saved.cov_theta) > np.diag(calibration.estimate.cov_theta))
    mounting = read_mounting(out, "all")
    assert not set(EARTH) & set(mounting.shared)
