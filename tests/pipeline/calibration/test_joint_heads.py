"""Several dumps with two star trackers each: one matrix of each tracker from all of them."""

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command_line import ran
from handmade_sentinel2 import write_sentinel2
from recorded_numbers import assert_recorded, columns_of
from scipy.spatial.transform import Rotation

from boresight.features.operators.imported_mission import ImportedMission, ImportedStrip, write_imported
from boresight.features.operators.sentinel2_import import sentinel2_mission
from boresight.features.operators.sentinel2_product import read_sentinel2
from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.constants import ARCSEC, WGS84
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.star_side import SolvedAttitudes
from boresight.pipeline.files.text_tables import write_toml
from boresight.pipeline.results.reading import read_mounting
from boresight.pipeline.stages.coverage import rows_of_heads

HEADER = "id,strip,ccd,sample,line,sigma_sample_px,sigma_line_px,lat_deg,lon_deg,height_m,height_kind,"
HEADER += "sigma_east_m,sigma_north_m,sigma_up_m\n"
MOVED = Rotation.from_rotvec(np.array([60.0, -40.0, 110.0]) * ARCSEC)  # both trackers, by the launch
ALONE = Rotation.from_rotvec(np.array([-25.0, 70.0, 50.0]) * ARCSEC)  # the second one beside that


def truth(dump: Dump) -> tuple[Pushbroom, tuple[Rotation, Rotation]]:
    """The camera as it is, carried by the first tracker, and the true matrices of both."""
    one, two = dump.heads
    assert isinstance(one.source, SolvedAttitudes)
    rows, matrices = one.source.rows, (MOVED * one.R_cs0, MOVED * two.R_cs0)
    motion = {"orbit": dump.orbit, "attitude": AttitudeTrack(rows.t_s, rows.R_si, dump.orbit)}
    of_camera = {"camera": dump.line_camera, "rows": dump.strips[0].clock, "R_cs": matrices[0]}
    return Pushbroom(**motion, **of_camera, earth=dump.orbit.earth, effects=dump.light), matrices


def points(dump: Dump, model: Pushbroom, lines: np.ndarray, first: int, strip_id: str = "B04") -> str:
    """Noiseless points over both detectors, in the strip that begins with line `first`."""
    rows = []
    for ccd in (0, 1):
        sample, line = (a.ravel() for a in np.meshgrid([0.0, 8.0, 15.0, 23.0], lines))
        places = model.ground_points(ccd, sample, line, ConstantHeight(30.0))
        lat, lon, height = geodetic_from_ecef(places, WGS84)
        for n, (s, r, *place) in enumerate(zip(sample, line, np.degrees(lat), np.degrees(lon), height)):
            lat_deg, lon_deg, height_m = map(float, place)
            rows.append(
                f"p{ccd}.{lines[0]:.0f}.{n},{strip_id},{ccd},{float(s)!r},{float(r) - first!r},0.05,0.05,"
                f"{lat_deg!r},{lon_deg!r},{height_m!r},ellipsoidal,0.1,0.1,0.1\n"
            )
    return HEADER + "".join(rows)


def imported(root: Path) -> tuple[ImportedMission, Dump]:
    """The handmade product, and a dump of it with one point."""
    mission = sentinel2_mission([read_sentinel2(write_sentinel2(root), root, "B04")], "test")
    write_imported(root / "plain", mission)
    (root / "plain" / "points.csv").write_text(HEADER + "a,B04,1,3,100,1,1,10,20,50,ellipsoidal,1,1,1\n")
    return mission, open_dump(root / "plain")


def part(strip: ImportedStrip, first: int, lines: int) -> ImportedStrip:
    """So many lines of a strip, from one on."""
    return replace(strip, t_first_row_s=strip.t_first_row_s + first * strip.row_period_s, lines=lines)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[Rotation, Rotation]]:
    """The joint result of two dumps, and the true matrices."""
    root = tmp_path_factory.mktemp("heads")
    mission, plain = imported(root)
    model, matrices = truth(plain)
    half = plain.strips[0].lines // 4
    for name, first in (("early", 0), ("late", half)):
        strips = tuple(part(one, first, half) for one in mission.strips)
        lines = first + np.linspace(50.0, half - 50.0, 5)
        write_imported(root / name, replace(mission, strips=strips), points(plain, model, lines, first))
        quaternion = (ALONE * plain.heads[1].R_cs0).as_quat().tolist()
        stated = {"quaternion_cs": quaternion, "sigma_rad": [1e-3] * 3}
        write_toml(root / name / "installation_STR2.toml", stated)
    # finding: the table of Earth orientation is made by hand
    ran("calibrate", root / "early", root / "late", "--out", root / "result", status=5)
    return root / "result", matrices


def test_strip_that_only_the_second_tracker_covers_says_how_it_can_be_used(found, tmp_path):
    result, _ = found
    shutil.copytree(result.parent / "early", tmp_path / "dump")
    rows = (tmp_path / "dump" / "STR1.csv").read_text().splitlines(keepends=True)
    (tmp_path / "dump" / "STR1.csv").write_text("".join([rows[0], *rows[-40:]]))  # the end of the record
    with pytest.raises(DataNotSufficientError, match=r"STR2 covers them: first in \[\[star_cameras\]\]"):
        calibrate_dump(open_dump(tmp_path / "dump"))


@pytest.fixture(scope="module")
def blinded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Dump, tuple[Rotation, Rotation]]:
    """A result of two strips, the first tracker with attitudes around the first strip alone; the dump and the
    true matrices.
    """
    root = tmp_path_factory.mktemp("blinded")
    mission, plain = imported(root)
    model, matrices = truth(plain)
    half = plain.strips[0].lines // 4
    begin = {"early": 0, "late": 2 * half}
    strips = tuple(
        replace(part(one, n, half), strip_id=name) for name, n in begin.items() for one in mission.strips
    )
    lines = np.linspace(50.0, half - 50.0, 5)
    rows = [points(plain, model, n + lines, n, name).removeprefix(HEADER) for name, n in begin.items()]
    write_imported(root / "dump", replace(mission, strips=strips), HEADER + "".join(rows))
    csv = root / "dump" / "STR1.csv"
    head, *attitudes = csv.read_text().splitlines(keepends=True)
    csv.write_text("".join([head, *attitudes[: len(attitudes) // 2]]))
    ran("calibrate", root / "dump", "--out", root / "result", status=5)  # as above
    return root / "result", open_dump(root / "dump"), matrices


def test_strip_that_only_the_second_tracker_covers_is_carried_by_it(blinded, tmp_path):
    result, dump, matrices = blinded
    installation = json.loads((result / "installation.json").read_text())
    assert installation["targets"] == 80  # 40 in each strip
    (tmp_path / "pixels.csv").write_text("ccd,sample,line\n0,3.25,50.5\n0,20.5,120.75\n")
    asked = ("--dump", dump.root, "--strip", "late", "--pixels", tmp_path / "pixels.csv")
    told = pd.read_csv(io.StringIO(ran("geolocate", result, *asked).stdout))
    assert_recorded("places_of_two_heads", columns_of(told))
    t_s = dump.heads[1].source.rows.t_s[3:7]  # rounded otherwise they are the same instants
    of_heads = dict(zip((head.name for head in dump.heads), matrices))
    assert rows_of_heads(dump, t_s[[0, -1]] + [5e-8, -5e-8], of_heads)[-1].t_s.tolist() == t_s.tolist()
    assert_matrices(installation, matrices)
    assert not [one for one in calibrate_dump(dump).omissions if one.subject.kind == "strip"]


def assert_matrices(installation: dict, matrices: tuple[Rotation, Rotation]) -> None:
    """Noiseless: what is left is second order in the 100 arc-seconds, and the priors' pull."""
    for n, (one, R_cs) in enumerate(zip(installation["heads"], matrices)):
        off = (Rotation.from_matrix(one["R_cs"]) * R_cs.inv()).as_rotvec() / ARCSEC
        assert np.all(np.abs(off) < 0.1 * sigma(installation, n)), (one["name"], off)


def sigma(installation: dict, head: int) -> np.ndarray:
    variance = np.diag(np.array(installation["heads_covariance_rad2"]))
    return np.sqrt(variance[3 * head : 3 * head + 3]) / ARCSEC


def test_both_matrices_come_out_of_all_dumps_together(found):
    result, matrices = found
    joint = json.loads((result / "installation.json").read_text())
    assert [one["name"] for one in joint["heads"]] == ["STR1", "STR2"]
    assert_matrices(joint, matrices)


def test_errors_of_heads_that_come_back_with_the_orbit_are_told(found, tmp_path):
    result, _ = found
    shutil.copytree(result.parent / "early", tmp_path / "dump")
    head = tmp_path / "dump" / "dump.toml"
    stated = "[star_cameras.noise]\nperiodic_arcsec = [6.0, 4.0, 9.0]\nperiod_s = 5920.0\nharmonics = 2"
    head.write_text(head.read_text().replace("[star_cameras.noise]", stated))
    said = ran("calibrate", tmp_path / "dump", "--out", tmp_path / "result", "--no-report", status=5)
    told = json.loads((tmp_path / "result" / "installation.json").read_text())["periodic_errors"]
    assert [(one["head"], one["period_s"]) for one in told] == [("STR1", 5920.0), ("STR2", 5920.0)]
    assert all(f"head {name}" in said.output for name in ("STR1", "STR2"))
    for one in told:
        sigma = np.array([one["sigma_cosine_rad"], one["sigma_sine_rad"]])
        prior = np.array(one["stated_rad"]) / np.sqrt(2.0)
        # half a minute of one orbit tells of one phase of the difference of the two heads alone
        assert sigma.shape == (2, 2, 3) and np.all(sigma < prior * (1 + 1e-9)) and np.all(sigma > 0.5 * prior)
    read_mounting(tmp_path / "result", "alone")  # whose prior has a row for these unknowns


def test_joint_sigmas_are_below_those_of_each_dump(found):
    result, _ = found
    joint = json.loads((result / "installation.json").read_text())
    for name in ("early", "late"):
        alone = json.loads((result / name / "installation.json").read_text())
        for head in (0, 1):
            assert np.all(sigma(joint, head) < sigma(alone, head))
