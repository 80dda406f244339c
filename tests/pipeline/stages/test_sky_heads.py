"""Strips of the sky in which the reference star camera is blind: another head carries them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.pipeline.calibration.calibrate import DumpCalibration, calibrate_dump
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly
from boresight.pipeline.files.text_files import toml_tables
from boresight.pipeline.files.text_tables import write_toml
from boresight.pipeline.run.cached import StageRunner
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.head import HeadSightings, sight_head
from boresight.simulator.mission_records import Mission
from boresight.simulator.scenario import SkyScan, builtin_scenario

R_HS = Rotation.from_euler("zyx", [110.0, -35.0, 50.0], degrees=True)  # the second head on the first
LAUNCH = Rotation.from_rotvec(np.array([-150.0, 260.0, 90.0]) * ARCSEC)  # of the second, unknown to the dump


def two_scans() -> Mission:
    """Two scans of the Pleiades across one another."""
    scenario = builtin_scenario("sky")
    (first,) = scenario.sky_strips.scans
    scans = (first, SkyScan(first.ra_deg, first.dec_deg, first.at_s + 40.0, 90.0))
    return fly(replace(scenario, sky_strips=replace(scenario.sky_strips, scans=scans)), 3)


def sighted(dump: Dump) -> HeadSightings:
    return sight_head(dump, dump.heads[0], Settings(), StageRunner())


def give_second_scan_to_another_head(folder: Path, R_cs: Rotation) -> Rotation:
    """Rewrites the dump: the exposures of the second scan are attitudes of a second head, whose true matrix
    is returned. The attitudes are those that the images gave, with their covariances.
    """
    dump = open_dump(folder)
    seen, middle = sighted(dump), 0.5 * sum(strip.t_first_row_s for strip in dump.sky_strips)
    late = [k for k, one in enumerate(seen.stars) if one.t_s > middle and seen.attitudes.usable[k]]
    exposures = pd.read_csv(folder / "exposures.csv", dtype=str)
    utc = exposures.set_index("id")["utc_mid"]
    A = R_HS.as_matrix()
    rows = []
    for k in late:
        quaternion = (R_HS * Rotation.from_matrix(seen.attitudes.R_si[k])).as_quat()
        covariance = A @ seen.attitudes.covariance_s[k] @ A.T / ARCSEC**2
        rows.append([utc[seen.stars[k].exposure_id], *quaternion, *covariance[np.triu_indices(3)]])
    pairs = [f"cov_{axes}_arcsec2" for axes in ("xx", "xy", "xz", "yy", "yz", "zz")]
    table = pd.DataFrame(rows, columns=["utc", "qx", "qy", "qz", "qw", *pairs])
    table.to_csv(folder / "second.csv", index=False)
    kept = {one.exposure_id for k, one in enumerate(seen.stars) if one.t_s < middle}
    exposures[exposures["id"].isin(kept)].to_csv(folder / "exposures.csv", index=False)
    true = R_cs * R_HS.inv()
    stated = {"quaternion_cs": (LAUNCH.inv() * true).as_quat().tolist(), "sigma_rad": [3e-3] * 3}
    write_toml(folder / "second.toml", stated)
    head = toml_tables(folder / "dump.toml", "")
    images = {name: head["files"].pop(name) for name in ("star_camera", "installation", "exposures")}
    images["camera"] = images.pop("star_camera")
    second = {"installation": "second.toml", "attitudes": "second.csv", "frame": "GCRF"}
    second |= {"rotation": "inertial to head", "aberration_removed": "annual and orbital"}
    first = {"name": "first", "level": "images", **images}
    head["star_cameras"] = [first, {"name": "second", "level": "attitudes", **second}]
    write_toml(folder / "dump.toml", head)
    return true


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[DumpCalibration, tuple[Rotation, Rotation]]:
    """The calibration, and the true matrices of both heads."""
    folder, mission = tmp_path_factory.mktemp("heads") / "dump", two_scans()
    write_dump(mission, folder, created_by="test")
    second = give_second_scan_to_another_head(folder, mission.truth.R_cs)
    return calibrate_dump(open_dump(folder)), (mission.truth.R_cs, second)


def test_the_strip_that_only_the_second_head_covers_is_carried_by_it(found):
    calibration, truth = found
    assert [task.carrier for task in calibration.sky.tasks] == ["first", "second"]
    assert not [one for one in calibration.omissions if one.subject.kind == "strip"]
    assert min(len(one.rows) for one in calibration.named) >= 8
    estimate = calibration.estimate
    error = np.concatenate([theta_between(one.R_cs, R_cs) for one, R_cs in zip(estimate.heads, truth)])
    assert error @ np.linalg.solve(estimate.cov_heads, error) < 22.5  # 99.9 % of chi-square, six angles
    # 10 stars of half an arc-second; before launch the second head's matrix is known to 600"
    sigma = np.sqrt(np.diag(estimate.cov_heads)) / ARCSEC
    assert np.all(sigma[[0, 1, 3, 4]] < 0.5), sigma


def test_the_carrier_s_attitudes_are_turned_by_the_matrices_that_were_found(found):
    calibration, (_, second) = found
    task, other = calibration.sky.tasks[1], calibration.strips[1].others[0]
    R_ci = calibration.estimate.R_cs * task.R_si
    off = (R_ci * (second * other.R_hi).inv()).magnitude()
    # sigma about the line of sight is some 5"; by the matrices stated before launch they are 313" off
    np.testing.assert_allclose(off, 0.0, atol=15.0 * ARCSEC)


def test_a_head_without_attitudes_around_a_strip_tells_nothing_there(found):
    calibration, _ = found
    (other,) = calibration.strips[0].others
    assert not len(other.t_s)
    assert calibration.estimate.agreement.dof == 0
