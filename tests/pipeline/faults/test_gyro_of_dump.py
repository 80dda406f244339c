"""A gyro in a dump, from its file to matrix and places."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from fault_dumps import FIXTURES, flown, scenario_of
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.calib.verdict import Outcome
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.pipeline.calibration.calibrate import DumpCalibration, calibrate_dump
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.text_tables import write_csv
from boresight.pipeline.results.reading import read_saved_result
from boresight.pipeline.results.strip_model import Calibrated, strip_model
from boresight.pipeline.results.writing import write_result
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.run.unit_store import UnitStore
from boresight.simulator.mission_records import Mission

R_GS = Rotation.from_euler("xyz", [20.0, 70.0, -50.0], degrees=True)
WALK_ARCSEC = 0.05
TABLE = """
[gyro]
file = "gyro.csv"
quantity = "angles"
unit = "arcsec"
quaternion_sg = {axes}
random_walk_arcsec = {walk}
bias_walk_arcsec_s = 1e-4
white_arcsec = 0.001
"""


@dataclass
class Flight:
    """A dump of attitudes of two heads and measured points, with a gyro, and what is true."""

    root: Path
    R_cs: Rotation

    def with_gyro(self, axes: Rotation | None) -> Dump:
        """The dump with a table of a gyro that has these axes; None: without."""
        text = (self.root / "dump.toml").read_text().split("\n[gyro]")[0]
        table = "" if axes is None else TABLE.format(axes=axes.as_quat().tolist(), walk=WALK_ARCSEC)
        (self.root / "dump.toml").write_text(text + table)
        return open_dump(self.root)


def test_two_star_exposures_a_strip_and_a_gyro_need_no_assumed_motion(demo: Path, tmp_path: Path) -> None:
    mission, root = flown(scenario_of("ground"), 1), tmp_path / "mini"
    shutil.copytree(FIXTURES / "mini", root)
    write_gyro(root, mission)
    head, *rows = (root / "exposures.csv").read_text().splitlines()
    few = [row for k, row in enumerate(rows) if k % (len(rows) // 3) in (2, 11)]
    (root / "exposures.csv").write_text("\n".join([head, *few]) + "\n")
    flight = Flight(root, mission.truth.R_cs)
    store = UnitStore(shutil.copytree(demo / "demo-result" / "work", tmp_path / "work"))
    without, found = (calibrate_dump(flight.with_gyro(axes), store=store) for axes in (None, R_GS.inv()))
    assert [one.cause for one in without.verdict.findings] == ["motion between exposures"]
    assert not found.verdict.findings and len(found.stars) == 6
    assert np.all(sigma(found) < 0.95 * sigma(without))
    error = theta_between(found.estimate.R_cs, flight.R_cs)
    assert error @ np.linalg.solve(found.estimate.cov_theta, error) < chi2(df=3).ppf(0.999)
    # The model of a strip has the motion between the two exposures that the gyro alone has seen.
    off = {}
    for name, one in (("without", without), ("with", found)):
        result, dump = tmp_path / name, flight.with_gyro(R_GS.inv() if name == "with" else None)
        result.mkdir()
        write_result(result, one, Settings())
        saved = read_saved_result(result)
        calibrated = Calibrated(
            result=saved, folder=result, dump=dump, sigma_terrain_m=0.0, exposure_margin_s=3.0
        )
        track = strip_model(calibrated, "s02").track
        t_s = dump.epoch.seconds_from_utc(mission.epoch.utc_from_seconds([x.t_s for x in mission.exposures]))
        inside = np.flatnonzero((t_s >= track.t_s[0]) & (t_s <= track.t_s[-1]))
        true = [mission.truth.exposure(mission.exposures[n].exposure_id).R_si for n in inside]
        errors = (track.R_si(t_s[inside]) * Rotation.concatenate(true).inv()).as_rotvec() / ARCSEC
        off[name] = np.sqrt(np.mean(np.square(errors), axis=0))
    # arcsec across: 0.3 of the exposures, 0.05 of the gyro; without it the satellite's motion is left
    assert np.all(off["with"][:2] < 0.5) and np.any(off["without"][:2] > 2.0 * off["with"][:2])


@pytest.fixture(scope="module")
def of_points(sound: Path, tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """Not to be changed."""
    root = Path(shutil.copytree(sound, tmp_path_factory.mktemp("flown") / "dump"))
    mission = flown(scenario_of("points"), 1)
    write_gyro(root, mission)
    return Flight(root, mission.truth.R_cs)


@pytest.fixture
def flight(of_points: Flight, tmp_path: Path) -> Flight:
    return Flight(shutil.copytree(of_points.root, tmp_path / "dump"), of_points.R_cs)


def write_gyro(root: Path, mission: Mission) -> None:
    """The true turns from exposure to exposure, with a bias and a random walk."""
    true = [mission.truth.exposure(one.exposure_id) for one in mission.exposures]
    t_s, R_si = np.array([one.t_s for one in true]), Rotation.concatenate([one.R_si for one in true])
    dt = np.diff(t_s)[:, None]
    turns = -R_GS.apply((R_si[1:] * R_si[:-1].inv()).as_rotvec()) / ARCSEC
    walk = WALK_ARCSEC * np.sqrt(dt) * np.random.default_rng(3).normal(size=turns.shape)
    turns += dt * [3.0, -2.0, 1.0] + walk
    turns[dt[:, 0] > 1.0] = 0.0  # between the strips nothing is known
    rows = zip(mission.epoch.utc_from_seconds(t_s), [[0.0] * 3, *turns.tolist()])
    write_csv(root / "gyro.csv", ["utc", *"xyz"], [[t, *turn] for t, turn in rows])


def sigma(found: DumpCalibration) -> np.ndarray:
    return np.sqrt(np.diag(found.estimate.cov_theta))


def test_a_gyro_makes_the_matrix_better_and_its_covariance_holds(flight: Flight) -> None:
    without, dump = calibrate_dump(flight.with_gyro(None)), flight.with_gyro(R_GS.inv())
    assert [head.gyro is None for head in dump.heads] == [
        False,
        True,
    ]  # it has the axes of the reference head
    found = calibrate_dump(dump)
    assert found.verdict.outcome is Outcome.CONSISTENT
    error = theta_between(found.estimate.R_cs, flight.R_cs)
    assert error @ np.linalg.solve(found.estimate.cov_theta, error) < chi2(df=3).ppf(0.999)
    assert np.all(sigma(found) < sigma(without))
    assert found.verdict.findings == ()


def test_a_gyro_that_stops_between_attitudes_is_not_used_and_that_is_said(flight: Flight) -> None:
    text = (flight.root / "gyro.csv").read_text().splitlines()
    (flight.root / "gyro.csv").write_text("\n".join([*text[:5], *text[11:]]))
    found = calibrate_dump(flight.with_gyro(R_GS.inv()))
    said = [one.detail for one in found.omissions if "gyro" in one.detail]
    assert len(said) == 1
    assert "strip s01" in said[0]
