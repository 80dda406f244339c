"""Results of several dumps, written by hand, through the command: files, dates, verdicts, refusals."""

import csv
import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command_line import app
from drawn_pictures import OURS, kept_figures, shows_curves
from matplotlib.dates import date2num
from numpy.testing import assert_allclose
from recorded_numbers import assert_recorded, numbers_in
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from boresight.calib.calibration import calibrate_strips
from boresight.calib.distortion import prior_information
from boresight.calib.information import InformationPairs, solve_total
from boresight.features.drift import drift_files
from boresight.features.drift.matrix_drift import DriftSettings
from boresight.features.drift.mounting_drift import drift_of_results, named_results
from boresight.geometry.constants import ARCSEC, DAY_S
from boresight.geometry.epoch import Epoch
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.table_files import fixed_list
from boresight.pipeline.results.plan_forecast import settings_of_plan
from boresight.pipeline.results.reading import read_mounting
from boresight.simulator.campaign import CameraPair, DistortionCurve, StripPlan, draw_strips
from boresight.simulator.sky_campaign import draw_sky_strips

runner = CliRunner()
EPOCH = Epoch.from_utc("2024-01-10T03:00:00Z")
R_CS0 = Rotation.from_euler("xyz", [40, -65, 110], degrees=True)
THETA = np.array([3e-3, 2e-3, 1e-3])
SIGMA = np.array([0.15, 0.2, 0.6]) * ARCSEC
REST = DriftSettings(density_rad2_s=0.0)


def write_result(folder, t_s, theta, *, phase=0.0, camera="c0", mission="m", version="0.1.0", sigma=SIGMA):
    """A finished result, as far as a drift looks at it; theta (3,) rad against the pre-launch matrix."""
    R_cs = deviation_from_theta(theta) * R_CS0
    content = {
        "quaternion": R_cs.as_quat().tolist(),
        "theta_rad": list(theta),
        "covariance_rad2": np.diag(sigma**2).tolist(),
        "version": version,
    }
    (folder / "sightings").mkdir(parents=True)
    (folder / "evidence").mkdir()
    (folder / "installation.json").write_text(json.dumps(content))
    epoch_utc = EPOCH.utc_from_seconds(t_s)[0]
    (folder / "evidence/context.json").write_text(json.dumps({"mission": mission, "epoch_utc": epoch_utc}))
    exposures = {
        "exposure_id": ["e1", "e2"],
        "t_s": [0.0, 20.0],
        "R_si": fixed_list(np.tile(np.eye(3), (2, 1, 1))),
        "covariance_s": fixed_list(np.tile(1e-12 * np.eye(3), (2, 1, 1))),
        "usable": [True, True],
    }
    passes = {
        "strip_id": ["s1", "s2"],
        "utc_middle": EPOCH.utc_from_seconds([t_s, t_s + 20.0]),
        "argument_of_latitude_rad": [phase, phase + 0.02],
        "camera": [camera, camera],
    }
    pair = InformationPairs(np.array(["s1"]), np.diag(sigma**-2.0)[None], np.zeros((1, 3)), R_cs)
    strips = pa.table(pair.columns())
    tables = {"exposures": pa.table(exposures), "passes": pa.table(passes), "strips": strips}
    for name, table in tables.items():
        pq.write_table(table, folder / f"sightings/{name}.parquet")
    return folder


def drift_of(folders, settings):
    return drift_of_results(named_results(folders), settings)


def archive(root, months, rng, *, step_after=None, amplitude=0.0):
    """Monthly results; from month `step_after` + 1 on, theta x is 1" larger."""
    folders = []
    for k in range(months):
        theta = THETA + rng.normal(size=3) * SIGMA
        theta[0] += ARCSEC if step_after is not None and k > step_after else 0.0
        phase = rng.uniform(0.0, 2.0 * np.pi)
        theta[1] += amplitude * np.cos(phase)
        folders.append(write_result(root / f"m{k:02d}", 30 * DAY_S * k, theta, phase=phase))
    return folders


def test_a_step_of_one_arcsec_between_two_months_is_told_with_its_date(tmp_path):
    folders = archive(tmp_path, 12, np.random.default_rng(1), step_after=6)
    out = tmp_path / "out"
    with kept_figures(drift_files) as figures:
        ran = runner.invoke(app, ["drift", *map(str, reversed(folders)), "--out", str(out)])
    assert ran.exit_code == 0, ran.output
    assert "the mounting has moved" in ran.stdout
    content = json.loads((out / "drift.json").read_text())
    assert content["moved"] and content["step"]["p_value"] < 1e-6
    assert (content["step"]["after"], content["step"]["before"]) == (str(folders[6]), str(folders[7]))
    assert content["step"]["utc"][:10] == "2024-07-23"  # 2024-01-10 and 6.5 times 30 days
    low, high = content["step"]["utc_interval"]
    assert "2024-07-08" <= low[:10] < "2024-07-12" and "2024-08-03" < high[:10] <= "2024-08-07"
    # 1 sigma of the step along x is 0.15" sqrt(1/7 + 1/5) = 0.09"
    assert content["step"]["theta_rad"][0] / ARCSEC == pytest.approx(1.0, abs=0.3)
    rows = list(csv.DictReader((out / "drift.csv").open()))
    assert len(rows) == 36 and rows[0]["utc"] == "2024-01-10T03:00:10Z"
    assert shows_curves(out / "drift.png", OURS)
    recorded = {f"{n}": [float(row[n]) for row in rows] for n in rows[0] if n.endswith("arcsec")}
    assert_recorded("drift", recorded | {"printed": numbers_in(ran.stdout)})
    assert_drawn(figures[0].axes, rows, [content["step"]["utc"], *content["step"]["utc_interval"]])


def assert_drawn(panels, rows, step):
    """Each panel has the results of its axis with errors, the smoothed ones in their band, and the step."""
    best, low, high = (np.datetime64(one.rstrip("Z")) for one in step)
    for panel, name in zip(panels, "XYZ", strict=True):
        own = [row for row in rows if row["axis"].upper() == name]
        when = np.array([row["utc"].rstrip("Z") for row in own], dtype="datetime64[ns]")
        theta, sigma, smoothed, band = (
            np.array([float(row[f"{key}_arcsec"]) for row in own])
            for key in ("theta", "sigma", "smoothed", "smoothed_sigma")
        )
        (marks,) = panel.containers
        days = date2num(when)
        assert_allclose(np.array(marks.lines[0].get_data(orig=False)), [days, theta], rtol=1e-8)
        ends = np.array([piece[:, 1] for piece in marks.lines[2][0].get_segments()])
        assert_allclose(ends, np.column_stack([theta - sigma, theta + sigma]), rtol=1e-7, atol=1e-9)
        curve = panel.lines[1].get_data(orig=False)
        assert_allclose(np.array(curve), [days, smoothed], rtol=1e-8)
        edge = panel.collections[0].get_paths()[0].vertices
        for k, day in enumerate(days):
            at = edge[np.abs(edge[:, 0] - day) < 1e-6, 1]
            assert_allclose([at.min(), at.max()], smoothed[k] + band[k] * np.array([-1.0, 1.0]), atol=1e-8)
        assert_allclose(panel.lines[-1].get_xdata(orig=False), date2num(best), atol=1e-5)
        span = panel.patches[0].get_extents().transformed(panel.transData.inverted())
        assert_allclose([span.x0, span.x1], date2num([low, high]), atol=1e-5)


def test_a_mounting_at_rest_is_merged_and_gives_no_alarm(tmp_path):
    folders = archive(tmp_path, 8, np.random.default_rng(2))
    out = tmp_path / "out"
    ran = runner.invoke(app, ["drift", *map(str, folders), "--out", str(out)])
    assert ran.exit_code == 0 and "no sign that the mounting has moved" in ran.stdout, ran.output
    merged = json.loads((out / "drift.json").read_text())["merged"]
    assert_allclose(merged["covariance_rad2"], np.diag(SIGMA**2) / 8, atol=1e-20)
    # 4 sigma of the mean, each axis
    assert np.all(np.abs(np.array(merged["theta_rad"]) - THETA) < 4.0 * SIGMA / np.sqrt(8))
    again = theta_between(Rotation.from_quat(merged["quaternion"]), R_CS0)
    assert_allclose(again, merged["theta_rad"], atol=1e-14)


def test_numbers_of_a_walk_that_is_given_have_the_units_of_their_columns(tmp_path):
    """Three unlike results 30 days apart; the walk of 0.7" per root day is smoothed by hand."""
    theta = np.array([[0.4, -0.9, 1.7], [1.1, 0.3, -0.6], [-0.2, 1.6, 0.5]])  # arcsec about R_CS0
    sigma = np.array([[0.15, 0.4, 0.6], [0.9, 0.2, 0.35], [0.5, 0.7, 0.25]])  # arcsec
    for k in range(3):
        folder, of_one = tmp_path / f"m{k}", theta[k] * ARCSEC
        write_result(folder, 30 * DAY_S * k, of_one, sigma=sigma[k] * ARCSEC, phase=0.5 + 2 * k)
    folders = [str(tmp_path / f"m{k}") for k in range(3)]
    ran = runner.invoke(app, ["drift", *folders, "--out", str(tmp_path / "out"), "--density", "0.7"])
    assert ran.exit_code == 0, ran.output
    said = next(line for line in ran.stdout.splitlines() if line.startswith("random walk"))
    assert said.split(maxsplit=2)[2] == "0.7 arcsec per root day, as given"
    merged_variance = 1.0 / np.sum(sigma**-2.0, axis=0)
    mean = merged_variance * np.sum(theta / sigma**2, axis=0)
    said = next(line for line in ran.stdout.splitlines() if line.startswith("merged 1 sigma"))
    assert_allclose([float(cell) for cell in said.split()[-3:]], np.sqrt(merged_variance), atol=5e-5)
    smooth, smooth_variance = np.empty((3, 3)), np.empty((3, 3))
    for a in range(3):  # differences of the walk have the variance 0.7² 30 arcsec², its level is free
        steps = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0]])
        information = np.diag(sigma[:, a] ** -2.0) + steps.T @ steps / (0.7**2 * 30.0)
        covariance = np.linalg.inv(information)
        smooth[:, a] = covariance @ (theta[:, a] / sigma[:, a] ** 2)
        smooth_variance[:, a] = np.diag(covariance)
    rows = list(csv.DictReader((tmp_path / "out/drift.csv").open()))
    for n, row in enumerate(rows):
        k, a = divmod(n, 3)
        assert row["axis"].upper() == "XYZ"[a]
        # arcsec; 1e-4 leaves room for the axes of the mean, rotated by an arcsec, and for printed digits
        assert float(row["theta_arcsec"]) == pytest.approx(theta[k, a] - mean[a], abs=1e-4)
        assert float(row["smoothed_arcsec"]) == pytest.approx(smooth[k, a] - mean[a], abs=1e-4)
        own, walk = (values[k, a] - merged_variance[a] for values in (sigma**2, smooth_variance))
        assert float(row["sigma_arcsec"]) == pytest.approx(np.sqrt(own), abs=1e-4)
        assert float(row["smoothed_sigma_arcsec"]) == pytest.approx(np.sqrt(max(walk, 0.0)), abs=1e-4)
        assert float(row["argument_of_latitude_deg"]) == pytest.approx(
            np.degrees(0.5 + 2 * k + 0.01), abs=1e-3
        )


def test_a_results_own_targets_are_eliminated_and_its_distortion_is_kept(tmp_path):
    plan = StripPlan(
        strips=4, sigma_position_m=2.0, sigma_target_m=3.0, same_targets=True, sigma_distortion_rad=3e-7
    )
    strips, _ = draw_strips(plan, CameraPair(R_CS0), np.random.default_rng(6))
    found = calibrate_strips(strips, R_CS0, settings_of_plan(plan))
    grounds = [strip.ground for strip in strips]
    targets = {
        "target_id": np.concatenate([ground.target_id for ground in grounds]).tolist(),
        "t_s": np.concatenate([ground.t_s for ground in grounds]),
        "cov_target_i": fixed_list(np.concatenate([ground.cov_target_i for ground in grounds])),
        "u_i": fixed_list(np.concatenate([ground.u_i for ground in grounds])),
        "range_m": pa.array(np.concatenate([ground.range_m for ground in grounds])),
    }
    (tmp_path / "sightings").mkdir()
    pq.write_table(pa.table(targets), tmp_path / "sightings/targets.parquet")
    strips_table = pa.table(found.pairs.columns())
    pq.write_table(strips_table, tmp_path / "sightings/strips.parquet")
    pair = read_mounting(tmp_path, "one")
    assert pair.names.tolist() == ["one"] and len(found.pairs.shared) == len(pair.shared) + 3 * 12
    prior = prior_information(pair.shared)
    solved = solve_total(pair.F[0], pair.F_theta[0], prior, sigma_observable_rad=1.0)
    # Rounding; the targets' priors are those that the result was made with.
    assert_allclose(solved.covariance, found.cov_theta, rtol=1e-6, atol=1e-9 * found.cov_theta.max())
    (tmp_path / "sightings/targets.parquet").unlink()
    with pytest.raises(RawDataError, match=r"targets\.parquet"):
        read_mounting(tmp_path, "one")


def test_files_are_the_same_bytes_in_whatever_order_results_are_named(tmp_path):
    folders = [str(path) for path in archive(tmp_path, 5, np.random.default_rng(3))]
    for out, order in (("a", folders), ("b", [folders[k] for k in (3, 0, 4, 2, 1)])):
        assert runner.invoke(app, ["drift", *order, "--out", str(tmp_path / out)]).exit_code == 0
    for name in ("drift.json", "drift.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_an_orbit_term_is_fitted_when_asked_for(tmp_path):
    folders = archive(tmp_path, 12, np.random.default_rng(4), amplitude=2.0 * ARCSEC)
    assert drift_of(folders, REST).drift.moved
    ran = runner.invoke(
        app, ["drift", *map(str, folders), "--out", str(tmp_path / "out"), "--orbit-phase", "--density", "0"]
    )
    assert ran.exit_code == 0 and "no sign" in ran.stdout, ran.output
    term = json.loads((tmp_path / "out/drift.json").read_text())["orbit_phase"]
    # 1 sigma is 0.2" sqrt(2/12) = 0.08"
    assert term["cosine_rad"][1] / ARCSEC == pytest.approx(2.0, abs=0.35)


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"camera": "c1"}, RawDataError, "camera of version .*one mounting has one pair"),
        ({"mission": "other"}, RawDataError, "mission: found other"),
        ({"theta": THETA + 0.1}, DataNotSufficientError, "not one mounting, or not the same frames"),
        ({"t_s": 0.0}, DataNotSufficientError, "have the same time"),
    ],
)
def test_results_that_are_not_of_one_mounting_are_refused(tmp_path, change, error, says):
    first = write_result(tmp_path / "a", 0.0, THETA)
    other = write_result(tmp_path / "b", **({"t_s": DAY_S, "theta": THETA} | change))
    with pytest.raises(error, match=says):
        drift_of([first, other], REST)


def test_results_that_believe_another_distortion_are_refused(tmp_path):
    # Their unknowns are not the same ones: knots elsewhere, in other units.
    folders = []
    for k, length in enumerate((2000.0, 1500.0)):
        folder = write_result(tmp_path / f"m{k}", 30 * DAY_S * k, THETA)
        content = json.loads((folder / "installation.json").read_text())
        stated = {"sigma_distortion_rad": 3e-7, "distortion_length_px": length}
        (folder / "installation.json").write_text(json.dumps(content | {"settings": {"calibration": stated}}))
        F = np.diag([*SIGMA**-2.0, 1.0])[None]
        R_cs = deviation_from_theta(THETA) * R_CS0
        pair = InformationPairs(np.array(["s1"]), F, np.zeros((1, 4)), R_cs, ("distortion/x/0/1",))
        table = pa.table(pair.columns())
        pq.write_table(table, folder / "sightings/strips.parquet")
        folders.append(folder)
    with pytest.raises(RawDataError, match=r"distortion_length_px: found 1500.0, expected 2000.0"):
        drift_of(folders, REST)


def test_a_camera_is_compared_within_one_version_of_the_program_only(tmp_path):
    first = write_result(tmp_path / "a", 0.0, THETA)
    other = write_result(tmp_path / "b", DAY_S, THETA, camera="c1", version="0.2.0")
    assert not drift_of([first, other], REST).drift.moved


def test_a_result_named_twice_none_one_or_a_damaged_one_are_refused(tmp_path):
    first = write_result(tmp_path / "a", 0.0, THETA)
    other = write_result(tmp_path / "b", DAY_S, THETA)
    with pytest.raises(RawDataError, match="each result once"):
        drift_of([first, tmp_path / "b" / ".." / "a"], REST)
    with pytest.raises(DataNotSufficientError, match="0 results"):
        drift_of([], REST)
    with pytest.raises(DataNotSufficientError, match="1 results"):
        drift_of([first], REST)
    with pytest.raises(RawDataError, match="nowhere"):
        drift_of([first, tmp_path / "nowhere"], REST)
    (other / "sightings/passes.parquet").write_bytes(b"PAR1")
    with pytest.raises(RawDataError, match=r"passes\.parquet"):
        drift_of([first, other], REST)
    assert runner.invoke(app, ["drift", "--out", str(tmp_path / "out")]).exit_code == 2


def test_a_result_from_ground_and_sky_is_one_mounting_without_its_orbits_bias(tmp_path):
    plan = StripPlan(strips=4, sigma_position_m=2.0, sigma_clock_s=1e-4, sigma_distortion_rad=3e-7)
    rng = np.random.default_rng(8)
    curve = DistortionCurve.draw(plan, CameraPair(R_CS0), rng)
    strips = draw_strips(replace(plan, orbit_bias_m=(30.0, -20.0, 0.0)), CameraPair(R_CS0), rng, curve=curve)[
        0
    ]
    strips += draw_sky_strips(replace(plan, sigma_c_px=0.05), CameraPair(R_CS0), rng, curve=curve)
    found = calibrate_strips(strips, R_CS0, settings_of_plan(plan))
    (tmp_path / "sightings").mkdir()
    pq.write_table(pa.table(found.pairs.columns()), tmp_path / "sightings/strips.parquet")
    pair = read_mounting(tmp_path, "one")
    assert not any(name.startswith("bias/") for name in pair.shared)
    solved = solve_total(pair.F[0], pair.F_theta[0], prior_information(pair.shared), sigma_observable_rad=1.0)
    assert_allclose(solved.covariance, found.cov_theta, rtol=1e-6, atol=1e-9 * found.cov_theta.max())
    off = theta_between(deviation_from_theta(solved.theta) * pair.R_cs_ref, R_CS0)
    assert np.all(np.abs(off) < 4.0 * np.sqrt(np.diag(found.cov_theta)))  # 30 m would be 12"
