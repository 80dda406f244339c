"""A strip of the sky with attitudes of a star tracker of 1, 1 and 8 arcsec, mounted so that the 8 move its
stars: every star is named rightly, and where no name can be sure, the attitudes are named as the cause.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from boresight.calib.estimate import InstallationEstimate
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly
from boresight.pipeline.files.text_tables import write_toml
from boresight.simulator.scenario import builtin_scenario

R_SH = Rotation.from_euler("xyz", [75.0, -40.0, 20.0], degrees=True)  # its boresight across the line of sight
FILES = {"remote_camera": "remote_camera.toml", "orbit": "orbit.oem", "strips": "strips.csv"}
NOISE = (1.0, 1.0, 8.0)
HEAD = """
[[star_cameras]]
name = "STR"
level = "attitudes"
installation = "str.toml"
attitudes = "str.csv"
frame = "GCRF"
rotation = "head to inertial"
aberration_removed = "annual and orbital"

[star_cameras.noise]
white_arcsec = {white}
"""


@pytest.fixture(scope="module")
def mission():
    return fly(builtin_scenario("sky"), 4)


@pytest.fixture(scope="module")
def images(mission, tmp_path_factory):
    """The dump without star exposures."""
    folder = tmp_path_factory.mktemp("sky")
    write_dump(replace(mission, exposures=()), folder, created_by="test")
    for name in ("exposures.csv", "star_camera.toml", "installation.toml"):
        (folder / name).unlink()
    return folder


def with_attitudes_of(mission, folder: Path, noise) -> Path:
    """The dump with the true attitudes of a head, with errors of `noise` arcsec, and that noise stated."""
    true = [mission.truth.exposure(one.exposure_id) for one in mission.exposures]
    errors = np.random.default_rng(8).normal(0.0, np.array(noise) * ARCSEC, (len(true), 3))
    R_hi = Rotation.from_rotvec(errors) * R_SH.inv() * Rotation.concatenate([one.R_si for one in true])
    table = pd.DataFrame(R_hi.inv().as_quat(), columns=["qx", "qy", "qz", "qw"])
    table.insert(0, "utc", mission.epoch.utc_from_seconds([one.t_s for one in true]))
    table.to_csv(folder / "str.csv", index=False)
    stated = {
        "quaternion_cs": (mission.installation.R_cs * R_SH).as_quat().tolist(),
        "sigma_rad": np.asarray(mission.installation.sigma_rad).tolist(),
    }
    write_toml(folder / "str.toml", stated)
    text = (folder / "dump.toml").read_text()
    begin, end = text.index("[files]"), text.index("[errors]")
    files = "".join(f'{k} = "{v}"\n' for k, v in FILES.items())
    errors_only = text[end:].partition("\n[")[0]
    (folder / "dump.toml").write_text(
        f"{text[:begin]}[files]\n{files}\n{errors_only}\n{HEAD.format(white=list(noise))}"
    )
    return folder


def test_every_star_has_its_own_name_and_the_matrix_its_covariance(mission, images):
    found = calibrate_dump(open_dump(with_attitudes_of(mission, images, NOISE)))
    assert isinstance(found.estimate, InstallationEstimate)
    error = theta_between(found.estimate.R_cs, mission.truth.R_cs * R_SH)
    assert error @ np.linalg.solve(found.estimate.cov_theta, error) < 16.3  # 99.9 % of chi-square, 3 angles
    (named,) = found.named
    places = {(s.ccd, s.hip): np.array([s.sample, s.line]) for s in mission.truth.sky_stars}
    seen = named.found.take(named.rows)
    assert len(named.rows) >= 10  # of some 15 that are single, sharp and in the catalogue
    for hip, ccd, xy in zip(named.places.places.hip.tolist(), seen.ccd.tolist(), seen.xy_px):
        assert np.abs(places[ccd, hip] - xy).max() < 2.0, hip  # px


def test_attitudes_too_noisy_for_any_name_are_named_as_the_cause(mission, images):
    with pytest.raises(
        DataNotSufficientError, match=r"noise of the star camera's attitudes displaces it most"
    ):
        calibrate_dump(open_dump(with_attitudes_of(mission, images, (25.0, 25.0, 60.0))))
