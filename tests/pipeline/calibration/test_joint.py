"""Several dumps of one mission: each with its own result, and one matrix from all of them together."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import re
import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import ran
from fixture_strips import stopped_run, strip_of_fixture
from pytest import approx
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.constants import ARCSEC, EARTH_ROTATION_RATE, WGS84
from boresight.geometry.epoch import Epoch
from boresight.geometry.geodesy import ecef_from_geodetic
from boresight.geometry.gyro import GyroNoise
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.calibration.joint import calibrate_jointly
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.images.tiff import write_tiff
from boresight.pipeline.files.record_tables import plain
from boresight.pipeline.files.star_side import Exposure, StarImages
from boresight.pipeline.results.folder import store_of
from boresight.pipeline.results.reading import read_findings, read_saved_result
from boresight.pipeline.results.strip_model import open_calibrated, strip_model
from boresight.pipeline.run.digests import rounded_digest
from boresight.pipeline.run.executor import InOrder
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.run.several_dumps import _check_nothing_twice, dump_names, open_dumps
from boresight.records.ledger import Entry, Kind, Reason, Subject
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips
from boresight.simulator.drawn_gyro import with_gyro

NAMES = ["november", "a-little-later", "january"]  # in the order of time; not that of the alphabet


def said(*words: object) -> str:
    return ran(*words).stdout


@pytest.fixture(scope="module")
def dumps(made_once) -> list[Path]:
    """Two strips of the fixture as two dumps, and one that another mission of the cameras took two months
    later: other ground, other stars, another draw of every error. Read only.
    """

    def fill(folder: Path) -> None:
        for n, name in enumerate(NAMES[:2]):
            strip_of_fixture(folder / name, n + 1)
        changes = ["strips.count=1", "strips.lines=1000", "strips.only_around_targets_px=60.0"]
        changes += ["targets.per_strip=12", 'epoch_utc="2025-01-15T03:40:00"']
        options = [part for change in changes for part in ("--set", change)]
        told = said("simulate", "mini", folder / NAMES[2], "--seed", 2, *options)
        size = sum(file.stat().st_size for file in (folder / NAMES[2]).rglob("*") if file.is_file())
        assert f" {size / 1e6:.1f} MB in " in told
        # the same cameras to the last digit, which another processor rounds otherwise
        for camera in ("remote_camera.toml", "star_camera.toml"):
            shutil.copy(folder / NAMES[0] / camera, folder / NAMES[2] / camera)

    folder = made_once("dumps-of-a-mission", fill)
    return [folder / name for name in NAMES]


@pytest.fixture(scope="module")
def joint(dumps: list[Path], finished: tuple[Path, Path], demo: Path, made_once) -> Path:
    """The result of the three, named out of order. Units of the first two are found: the first is `finished`,
    and the demo has the exposures of the second.
    """

    def fill(folder: Path) -> None:
        out = folder / "result"
        stopped_run(out, dumps)
        stopped_run(out / NAMES[0], dumps[:1], finished[1])
        stopped_run(out / NAMES[1], dumps[1:2], demo / "demo-result")
        said("calibrate", dumps[2], dumps[0], dumps[1], "--out", out, "--workers", 1)

    return made_once("joint", fill) / "result"


def matrix(result: Path) -> dict:
    return json.loads((result / "installation.json").read_text())


def test_joint_matrix_is_the_calibration_of_all_strips_at_once(dumps: list[Path], joint: Path) -> None:
    # The union is made here by hand, from the units that the run left.
    opened = [open_dump(dump) for dump in dumps]
    strips = []
    for name, dump in zip(NAMES, opened):
        found = calibrate_dump(dump, Settings(), store_of(joint / name), InOrder())
        assert found.n_computed == 0
        later_s = float(dump.epoch.tai_s - opened[0].epoch.tai_s)
        for strip in found.strips:
            exposures = tuple(replace(e, t_s=e.t_s + later_s) for e in strip.exposures)
            ids = np.array([f"{name}/{target}" for target in strip.ground.target_id])
            ground = replace(strip.ground, t_s=strip.ground.t_s + later_s, target_id=ids)
            of_all = {"strip_id": f"{name}/{strip.strip_id}", "exposures": exposures, "ground": ground}
            strips.append(replace(strip, **of_all))
    whole = calibrate_strips(strips, opened[0].R_cs0, found.settings)
    content = matrix(joint)
    assert content["R_cs"] == whole.R_cs.as_matrix().tolist()
    assert content["covariance_rad2"] == whole.cov_theta.tolist()
    assert content["targets"] == whole.n_targets == sum(matrix(joint / name)["targets"] for name in NAMES)


def test_joint_covariance_is_not_below_that_of_an_independent_average(joint: Path) -> None:
    own = [np.array(matrix(joint / name)["covariance_rad2"]) for name in NAMES]
    averaged = np.linalg.inv(sum(np.linalg.inv(C) for C in own))
    shared = np.array(matrix(joint)["covariance_rad2"])
    # 1e-3: the dumps are linearised about matrices of their own.
    assert np.linalg.eigvalsh(shared - averaged)[0] > -1e-3 * np.linalg.eigvalsh(averaged)[0]
    assert np.trace(shared) > 1.01 * np.trace(averaged)
    assert all(np.all(np.diag(shared) < np.diag(C)) for C in own)


def test_joint_matrix_is_the_merged_one_of_the_drift(joint: Path) -> None:
    # Two ways to one answer: all strips at once, and information pairs of each dump with shared unknowns.
    drift, content = json.loads((joint / "drift.json").read_text()), matrix(joint)
    assert drift["results"] == NAMES and not drift["moved"]
    covariance = np.array(content["covariance_rad2"])
    merged, least = drift["merged"]["covariance_rad2"], np.diag(covariance).min()
    np.testing.assert_allclose(merged, covariance, atol=2e-3 * least, rtol=0)
    turn = theta_between(Rotation.from_matrix(drift["merged"]["R_cs"]), read_saved_result(joint).R_cs)
    assert np.all(np.abs(turn) < 0.01 * np.sqrt(np.diag(covariance)))


def test_every_dump_has_the_result_that_it_has_alone(joint: Path, finished: tuple[Path, Path]) -> None:
    # `finished` is the first of the dumps, calibrated on its own, from another folder.
    alone, names = finished[1], []
    for path in sorted(path for path in alone.rglob("*") if path.is_file() and "work" not in path.parts):
        if path.name not in ("run.json", "report.html", "boresight-result.json"):  # times, folders
            names.append(path.name)
            assert (joint / NAMES[0] / path.relative_to(alone)).read_bytes() == path.read_bytes(), path
    assert {"installation.json", "strips.parquet", "matches.parquet"} <= set(names)


NOT_COMPARED = ("run.json", "boresight-result.json")  # times; where the dumps lie from there


def test_the_same_bytes_in_whatever_order_and_by_whatever_workers(dumps, joint, tmp_path):
    again = tmp_path / "again"
    stopped_run(again, dumps)
    for name, dump in zip(NAMES, dumps):
        stopped_run(again / name, [dump], joint / name)
    for unit in (again / NAMES[0] / "work/exposures").iterdir():
        unit.unlink()  # made anew, by two processes
    said("calibrate", *dumps, "--out", again, "--workers", 2, "--no-report")
    compared = set()
    for path in sorted(path for path in again.rglob("*") if path.is_file() and path.name not in NOT_COMPARED):
        compared.add(str(path.relative_to(again)))
        assert (joint / path.relative_to(again)).read_bytes() == path.read_bytes(), path
    assert {"installation.json", "dumps.json", "drift.json", "drift.csv", "drift.png"} <= compared
    assert {"sightings/targets.parquet", *(f"{name}/sightings/stars.parquet" for name in NAMES)} <= compared


def test_status_report_and_archive_know_a_folder_of_dumps(joint: Path, tmp_path: Path) -> None:
    told = said("status", joint)
    assert [line for line in told.splitlines() if line.startswith("dump")] == [f"dump {n}" for n in NAMES]
    assert told.rstrip().endswith("all dumps together: finished, verdict consistent")
    page = joint / "report.html"
    before = page.read_text()
    said("report", joint)
    assert page.read_text() == before
    assert all(f'<a href="{name}/report.html">{name}</a>' in before for name in NAMES)
    assert before.count('<figure class="small-map"') == len(NAMES)
    shown = re.search(r'<data value="([^"]+)" data-source="installation.json" data-key="R_cs.0.1"', before)
    assert shown is not None and float(shown[1]) == matrix(joint)["R_cs"][0][1]
    assert said("archive", "add", joint, "--to", tmp_path).count("added") == len(NAMES)


def test_the_page_shows_the_budget_of_the_joint_covariance(joint: Path) -> None:
    assert read_findings(joint) == matrix(joint)["verdict"]["findings"]  # by the budget's file no others
    budget = json.loads((joint / "evidence" / "budget.json").read_text())["budget"]
    total = np.diag(matrix(joint)["covariance_rad2"])
    parts = {one["source"]: 100.0 * np.diag(one["covariance_rad2"]) / total for one in budget}
    # A share is a derivative by a step of a thousandth of a variance, which leaves out as much of it.
    assert sum(parts.values()) == approx(100.0, abs=0.1)  # %
    page = (joint / "report.html").read_text()
    row_of_budget = r'<tr><th scope="row">([^<]+)</th>(<td><data [^>]*"evidence/budget.json.*?)</tr>'
    rows = dict(re.findall(row_of_budget, page))
    assert list(rows) == list(parts)  # the largest first
    for source, row in rows.items():
        shown = [float(text) for text in re.findall(r">(-?[\d.]+)</data>", row)]
        assert shown == approx(parts[source], abs=0.05)
    alone = json.loads((joint / NAMES[0] / "evidence" / "context.json").read_text())["budget"]
    # Three dumps average what differs from dump to dump, and share what the camera does to all of them alike.
    own = {one["source"]: np.diag(one["covariance_rad2"])[2] for one in alone}
    share = own["distortion over the field"] / matrix(joint / NAMES[0])["covariance_rad2"][2][2]
    assert parts["distortion over the field"][2] > 100.0 * share


def test_a_joint_matrix_has_a_sheet_to_be_signed(joint: Path) -> None:
    page = (joint / "report.html").read_text()
    sheet = page[page.index('<div class="signed">') : page.index('<table class="approval">')]
    digest = hashlib.sha256((joint / "installation.json").read_bytes()).hexdigest()
    assert f"<td>{digest[:16]}</td>" in sheet
    shown = re.findall(r'data-key="covariance_rad2\.(\d)\.(\d)"[^>]*>([^<]+)</data>', sheet)
    assert len(shown) == 9
    for i, j, text in shown:
        exact = matrix(joint)["covariance_rad2"][int(i)][int(j)]
        assert float(text.replace("\N{MINUS SIGN}", "-")) == approx(exact, rel=1e-4)
    assert all(f'<tr><th scope="row">{role}</th>' in page for role in ("author", "reviewer", "approver"))


def test_a_required_accuracy_is_that_of_the_joint_matrix(joint: Path, tmp_path: Path) -> None:
    shutil.copytree(joint, tmp_path / "joint", ignore=shutil.ignore_patterns("work"))
    told = said("report", tmp_path / "joint", "--require-arcsec", 1, "--require-m", 500)
    assert "1 arcsec about each axis: not met about Z" in told and "500 m on the ground: met" in told
    page = (tmp_path / "joint" / "report.html").read_text()
    assert "about every axis: not met</strong> (about Z)" in page and "on the ground: met</strong>" in page


def test_joint_matrix_serves_each_of_its_dumps(dumps: list[Path], joint: Path, tmp_path: Path) -> None:
    said("export", joint, "--format", "aem,geojson,fits", "--dump", dumps[2], "--out", tmp_path)
    message = (tmp_path / "s01.aem").read_text()
    rows = [line.split() for line in message.splitlines() if re.match(r"\d{4}-\d\d-\d\dT", line)]
    assert len(rows) > 2
    q = np.array([[float(value) for value in row[1:5]] for row in rows])
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-9)
    says = r"--dump: found nothing, expected one of the 3 dumps of that result: november, "
    with pytest.raises(RawDataError, match=says):
        open_calibrated(joint, None)
    # The exposures' attitudes are the dump's own, the matrix is the joint one, and better: one dump of one
    # strip leaves 10 arcsec about Z.
    told = said("validate", joint, "--dump", dumps[2]).splitlines()
    sigma = next(line.split()[-3:] for line in told if "stated 1 sigma" in line)
    joint_sigma = np.sqrt(np.diag(matrix(joint)["covariance_rad2"])) / ARCSEC
    np.testing.assert_allclose(np.array(sigma, dtype=float), joint_sigma, atol=6e-5)  # as printed
    nees = next(float(line.split()[-1]) for line in told if "NEES" in line)
    assert nees < 16.27  # chi-square of 3: 999 of 1000
    assert any(line.startswith("geo-positioning at 2") for line in told)  # 20, or more seen by two CCDs
    assert not any("no position" in line for line in told)


def test_image_points_of_each_dump_are_placed_with_the_joint_matrix(dumps, joint, tmp_path):
    calibrated = open_calibrated(joint, dumps[2])
    strip = calibrated.dump.strips[0].strip_id
    (tmp_path / "pixels.csv").write_text("ccd,sample,line\n1,300.25,500.5\n")
    told = said("geolocate", joint, "--dump", dumps[2], "--strip", strip, "--pixels", tmp_path / "pixels.csv")
    (place,) = csv.DictReader(io.StringIO(told))
    lat, lon, height = (float(place[name]) for name in ("lat_deg", "lon_deg", "height_m"))
    p_e = ecef_from_geodetic(np.radians([lat]), np.radians([lon]), np.array([height]), WGS84)
    model = strip_model(calibrated, strip).pushbroom
    written = np.reshape(matrix(joint)["R_cs"], (3, 3))
    np.testing.assert_allclose(model.R_cs.as_matrix(), written, rtol=0.0, atol=4e-16)  # through a quaternion
    sample, line = model.pixels_from_ground(1, p_e)
    # Heights are written to the millimetre, 1/6000 of a pixel of the fixture.
    assert (sample[0], line[0]) == pytest.approx((300.25, 500.5), abs=1e-3)


def test_a_dump_that_does_not_suffice_is_counted_and_the_others_go_on(dumps, joint, tmp_path):
    blind, out = tmp_path / "blind", tmp_path / "result"
    shutil.copytree(dumps[1], blind)
    lines = (blind / "targets.csv").read_text().splitlines()
    far = lines[1].split(",")
    far[1], far[2] = "-60.0", "10.0"
    (blind / "targets.csv").write_text("\n".join([lines[0], ",".join(far)]) + "\n")
    stopped_run(out, [dumps[0], blind, dumps[2]])
    for folder, dump, name in zip((NAMES[0], "blind", NAMES[2]), (dumps[0], blind, dumps[2]), NAMES):
        stopped_run(out / folder, [dump], joint / name)
    told = said("calibrate", dumps[0], blind, dumps[2], "--out", out, "--workers", 1, "--no-report")
    assert "jointly from 2 dumps" in told and "0 targets matched in 1 strips" in told
    omissions = pq.read_table(out / "sightings/ledger.parquet").to_pylist()
    assert [(row["kind"], row["name"]) for row in omissions if row["kind"] == "dump"] == [("dump", "blind")]
    assert not (out / "blind/installation.json").exists()
    assert json.loads((out / "drift.json").read_text())["results"] == [NAMES[0], NAMES[2]]
    said("report", out)
    page = (out / "report.html").read_text()
    assert '<th scope="row">blind</th>' in page and "not calibrated: no target comes into view" in page
    of_blind = said("status", out).partition("dump blind")[2].partition("dump january")[0]
    assert of_blind.rstrip().endswith("the same `boresight calibrate` goes on")


def test_no_dump_that_suffices_is_no_result() -> None:
    told = {"a": "0 strips", "b": "no stars"}
    failed = [
        Entry(Subject(Kind.DUMP, dump=name), Reason.NOT_CALIBRATED, text) for name, text in told.items()
    ]
    with pytest.raises(DataNotSufficientError, match=r"none of 2 dumps .* a: 0 strips; b: no stars"):
        calibrate_jointly([], failed, Settings())


@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("dump.toml", 'mission = "mini"', 'mission = "maxi"',
            "dump.toml: mission: found maxi, expected mini"),
        ("dump.toml", "position_m = 2.0", "position_m = 1.0", "errors.sigma_position_m: found 1.0, .* 2.0"),
        ("star_camera.toml", "512.0", "512.5", r"star_camera.toml: star camera.principal_px.0: found 512.5"),
        ("remote_camera.toml", "focal_length_m = 10.0", "focal_length_m = 10.1",
            "camera.focal_m: found 10.1"),
        ("installation.toml", r"quaternion_cs = \[[^]]*\]", "quaternion_cs = [1.0, 0.0, 0.0, 0.0]",
            "pre-launch installation matrix: found"),
    ],
)  # fmt: skip
def test_dumps_of_other_cameras_are_refused_with_file_and_field(dumps, tmp_path, file, old, new, says):
    other = Path(shutil.copytree(dumps[2], tmp_path / "other"))
    text, found = re.subn(old, new, (other / file).read_text())
    assert found
    (other / file).write_text(text)
    for order in ([dumps[0], other], [other, dumps[0]]):
        with pytest.raises(RawDataError, match=says):
            open_dumps(order, Settings())
    if "position" in old:  # what the user states holds for all
        open_dumps([dumps[0], other], Settings(calibration=(("sigma_position_m", 2.0),)))


def test_cameras_that_differ_by_rounding_are_the_same(dumps: list[Path], tmp_path: Path) -> None:
    other = Path(shutil.copytree(dumps[2], tmp_path / "other"))
    file = other / "remote_camera.toml"
    text = file.read_text()
    for focal, is_same in (("10.000000000000002", True), ("10.00000001", False)):
        file.write_text(text.replace("focal_length_m = 10.0", f"focal_length_m = {focal}"))
        own, its = (rounded_digest(plain(open_dump(root).line_camera)) for root in (dumps[0], other))
        assert (own == its) is is_same  # results of both share the camera: `compare`, archives
        refused = pytest.raises(RawDataError, match=r"camera\.focal_m: found 10\.00000001")
        with nullcontext() if is_same else refused:
            open_dumps([dumps[0], other], Settings())


def test_a_dump_named_twice_or_copied_is_refused(dumps: list[Path], tmp_path: Path) -> None:
    with pytest.raises(RawDataError, match="november: DUMP: found named twice"):
        open_dumps([dumps[0], dumps[1], dumps[0] / ".." / NAMES[0]], Settings())
    copy = tmp_path / "copy"
    shutil.copytree(dumps[0], copy)
    with pytest.raises(RawDataError, match="strip s01: found the same instant as strip s01 of"):
        open_dumps([dumps[0], copy], Settings())


def test_other_images_of_one_instant_in_dumps_of_other_epochs_are_found(tmp_path: Path) -> None:
    """Instants count from the epoch of their dump; the same image in two dumps is one exposure."""

    def named(name: str, epoch: int, **exposures: tuple[float, str]) -> SimpleNamespace:
        exposed = []
        for key, (t_s, content) in exposures.items():
            (path := tmp_path / f"{name}-{key}.tif").write_bytes(starred(content))
            exposed.append(Exposure(exposure_id=key, file=path.name, path=path, t_s=t_s, exposure_s=0.1))
        camera = StarCamera(focal_m=0.1, pixel_m=1e-5, width_px=8, height_px=8, principal_px=(4.0, 4.0))
        head = SimpleNamespace(name="s", source=StarImages(camera, 8, tuple(exposed)))
        dump = SimpleNamespace(root=name, epoch=Epoch(epoch), strips=(), camera="", heads=(head,))
        return SimpleNamespace(name=name, dump=dump)

    def starred(content: str) -> bytes:
        write_tiff(tmp_path / "one.tif", np.full((8, 8), ord(content), dtype=np.uint8))
        return (tmp_path / "one.tif").read_bytes()

    first = named("may", 1_000, e1=(5.5, "a"), e2=(7.25, "b"))
    _check_nothing_twice([first, named("june", 1_003, e1=(5.5, "c"), e2=(7.25, "d"))])
    _check_nothing_twice([first, named("june", 1_003, e8=(0.5, "c"), e9=(4.25, "b"))])
    with pytest.raises(RawDataError, match="exposure e9: found the same instant as exposure e2 of may"):
        _check_nothing_twice([first, named("june", 1_003, e8=(0.5, "c"), e9=(4.25, "d"))])


def test_names_tell_dumps_apart_in_whatever_order_they_stand() -> None:
    roots = [Path("/data/2024/may"), Path("/data/2025/may"), Path("/data/2025/june"), Path("/data/work")]
    names = dump_names(roots)
    assert names == ["2024-may", "2025-may", "june", "data-work"]  # `work` is a folder of every result
    assert dump_names(roots[::-1]) == names[::-1]
    assert dump_names([Path("/A/May"), Path("/b/may")]) == ["A-May", "b-may"]  # one file to some systems


def visit(n: int, own: list, turns: int, site: np.ndarray) -> tuple:
    """A dump so many turns of the Earth after the first, as far as a joint calibration looks at it."""
    targets = {
        name: SimpleNamespace(target_id=name, p_e=site, sigma_m=np.full(3, 3.0), reference=None)
        for one in own
        for name in one.ground.target_id.tolist()
    }
    epoch = Epoch(round(turns * 2.0 * np.pi / EARTH_ROTATION_RATE))
    ground = {"ground_targets": targets, "target_files": "targets.csv"}
    mounting = {
        "R_cs0": BOLD,
        "sigma_installation_rad": np.full(3, 3e-3),
        "heads": (SimpleNamespace(name="s"),),
    }
    cameras = {"camera": "", "line_camera": SimpleNamespace(pixel_rad=1e-6), "star_camera": None}
    dump = SimpleNamespace(root=Path(f"d{n}"), epoch=epoch, **ground, **mounting, **cameras)
    assessment = SimpleNamespace(sighted=own, inputs=())
    found = SimpleNamespace(strips=own, assessment=assessment, settings=SETTINGS_USED, rows=())
    return SimpleNamespace(name=f"d{n}", dump=dump), found


def visits(place: np.ndarray) -> list:
    """Two dumps of four strips each over one calibration site. The campaign's Earth is at rest, so a whole
    number of its turns lies between the dumps.
    """
    plan = StripPlan(strips=8, sigma_position_m=1.0, sigma_target_m=3.0, same_targets=True)
    strips, _ = draw_strips(plan, CameraPair(BOLD), np.random.default_rng(21))
    sites = [np.zeros(3), place]
    return [[visit(n, strips[4 * n : 4 * n + 4], 60 * n, site) for n, site in enumerate(sites)], strips]


BOLD = Rotation.from_euler("xyz", [40, -65, 110], degrees=True)
NONE = dict.fromkeys(("sigma_clock_s", "sigma_vibration_rad", "sigma_distortion_rad"), 0.0)
SETTINGS_USED = CalibrationSettings(sigma_position_m=1.0, robust=False, **NONE)


def test_rows_of_a_gyro_count_from_the_epoch_of_all_dumps() -> None:
    cameras, rng = CameraPair(BOLD), np.random.default_rng(3)
    strips, truth = draw_strips(StripPlan(strips=2, exposures=2, exposure_margin_s=0.3), cameras, rng)
    noise = GyroNoise(random_walk_rad=1e-7, bias_walk_rad_s=1e-9, bias_rad_s=1e-6, white_rad=1e-9)
    strips = with_gyro(strips, truth, BOLD, noise, np.arange(-0.4, 2.25, 0.05), rng)
    dumps = [visit(n, [strip], 60 * n, np.zeros(3)) for n, strip in enumerate(strips)]
    for strip in calibrate_jointly(dumps, [], Settings()).strips:
        assert strip.gyro is not None
        assert strip.gyro.t_s[0] < strip.times_s[0] < strip.times_s[-1] < strip.gyro.t_s[-1]


def test_targets_that_two_dumps_list_alike_are_one_point_each() -> None:
    calibrated, strips = visits(np.zeros(3))
    found = calibrate_jointly(calibrated, [], Settings()).estimate
    whole = calibrate_strips(strips, BOLD, SETTINGS_USED)
    # The Earth's rotation is known to half a second, 4e-5 rad of an error of 3 m in 530 km: 1e-5 arcsec.
    assert np.all(np.abs(theta_between(found.R_cs, whole.R_cs)) < 1e-4 * ARCSEC)
    np.testing.assert_allclose(found.cov_theta, whole.cov_theta, rtol=1e-3, atol=1e-3 * found.cov_theta[0, 0])
    assert len(found.pairs.shared) == len(whole.pairs.shared) == 3 * 12


def test_targets_of_one_name_at_two_places_are_two_points() -> None:
    one = calibrate_jointly(visits(np.zeros(3))[0], [], Settings()).estimate
    two = calibrate_jointly(visits(np.array([10.0, 0.0, 0.0]))[0], [], Settings()).estimate
    assert len(two.pairs.shared) == 2 * len(one.pairs.shared)
    assert {name.split("/")[1] for name in two.pairs.shared} == {"d0", "d1"}
    # The survey's error, 3 m, rules: shared by all it does not average, by halves it does.
    assert two.cov_theta[1, 1] < 0.8 * one.cov_theta[1, 1]


@pytest.mark.parametrize("what", ["season", "jump", "rest"])
def test_a_season_of_the_mounting_over_dumps_of_a_year_is_distinguished_from_a_jump(what: str) -> None:
    plan = StripPlan(strips=8, sigma_position_m=1.0, sigma_target_m=1.0)
    strips, _ = draw_strips(plan, CameraPair(BOLD), np.random.default_rng(5))
    turns = [0, 41, 95, 150, 187, 240, 301, 340]
    season = 3.0 * ARCSEC * np.cos(2.0 * np.pi * np.array(turns) / 366.25)
    course = {"season": season, "jump": 3.0 * ARCSEC * (np.arange(8) > 3), "rest": np.zeros(8)}[what]
    calibrated = []
    for n, (strip, x) in enumerate(zip(strips, course)):
        u_c = deviation_from_theta(np.array([x, 0.0, 0.0])).apply(strip.ground.u_c)
        own = replace(strip, ground=replace(strip.ground, u_c=u_c))
        calibrated.append(visit(n, [own], turns[n], np.zeros(3)))
    found = calibrate_jointly(calibrated, [], Settings()).verdict.findings
    causes = {"season": ["mounting varies with the season, about x of c"], "rest": []}
    assert [one.cause for one in found] == causes.get(what, ["mounting moved, about x of c"])
