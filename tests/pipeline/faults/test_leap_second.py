"""A leap second inside a strip: labels, TAI seconds, and the matrix that comes out."""

from pathlib import Path

import numpy as np
import pytest
from astropy.time import Time
from edits import rows_of

from boresight.geometry.installation import theta_between
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly, named_scenario
from boresight.pipeline.results.folder import store_of
from boresight.pipeline.run.executor import InOrder
from boresight.pipeline.run.settings import Settings
from boresight.simulator.mission_records import Mission

# 1200 rows of 0.9 ms from 23:59:59.95 on, over 23:59:60, to 00:00:00.03 of the next year.
SCENARIO = [
    *('epoch_utc="2016-12-31T23:59:57"', "strips.count=1", "strips.first_s=2.95", "strips.lines=1200"),
    *("line_camera.ccds=1", "line_camera.rotation_urad=[12.0]", "targets.per_strip=12"),
    *("targets.check_points_per_strip=0", "strips.exposure_lead_s=0.3", "star_camera.rate_hz=4.0"),
    *("terrain.spacing_arcsec=30.0", "ground.texels_per_pixel=2.0", "targets.chip_size_px=64"),
]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Mission, Dump]:
    mission = fly(named_scenario("mini", SCENARIO), 4)
    root = tmp_path_factory.mktemp("leap") / "dump"
    write_dump(mission, root, created_by="a test")
    return mission, open_dump(root)


def labels(root: Path, table: str, column: str) -> list[str]:
    return [row[column] for row in rows_of(root / table)]


def test_times_across_a_leap_second_are_those_of_erfa(flown: tuple[Mission, Dump]) -> None:
    _, dump = flown
    utc = labels(dump.root, "exposures.csv", "utc_mid")
    assert {label[:19] for label in utc} >= {
        *("2016-12-31T23:59:59", "2016-12-31T23:59:60", "2017-01-01T00:00:00")
    }
    first = labels(dump.root, "strips.csv", "utc_first_row")[0]
    assert first.startswith("2016-12-31T23:59:59.")
    ours = np.array([exposure.t_s for exposure in dump.exposures] + [dump.strips[0].t_first_row_s])
    tai = Time([*utc, first], scale="utc").tai
    theirs = (tai - tai[0]).sec  # ERFA's day of 2016-12-31 has 86401 s
    # Two floats of a day: 2e-11 s.
    np.testing.assert_allclose(ours - ours[0], theirs, atol=1e-10)  # s
    assert np.diff(ours[:-1]) == pytest.approx(0.25, abs=1e-9)  # s: every quarter, leap second or not


def test_strip_across_a_leap_second_is_calibrated(flown: tuple[Mission, Dump], tmp_path: Path) -> None:
    mission, dump = flown
    found = calibrate_dump(dump, Settings(), store_of(tmp_path), InOrder())
    assert [o for o in found.omissions if o.subject.kind in ("exposure", "strip", "ccd")] == []
    error = theta_between(found.estimate.R_cs, mission.truth.R_cs)
    # A second would move the ground by 7 km, 3000 arcsec. Chi-square of 3: below 16.27 in 999 of 1000 runs.
    assert np.linalg.norm(error[:2]) < 5.0 * np.radians(1.0 / 3600.0)
    assert error @ np.linalg.solve(found.estimate.cov_theta, error) < 16.27
