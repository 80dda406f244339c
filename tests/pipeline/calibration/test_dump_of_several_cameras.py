"""A dump of several remote-sensing cameras: a matrix each, from exposures that are counted once."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import invoked, ran
from edits import replaced
from fixture_strips import stopped_run
from scipy.spatial.transform import Rotation
from two_cameras import two_cameras

import boresight as bs
from boresight.geometry.installation import theta_between
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import open_cameras, open_dump


def refused(*words: object) -> str:
    done = invoked(*words)
    assert isinstance(done.exception, RawDataError), done.output
    return str(done.exception)


@pytest.fixture(scope="module")
def seen(finished: tuple[Path, Path], made_once) -> tuple[Path, Path]:
    """The first strip of `fixtures/mini` as two cameras see it, and its result; read only."""

    def fill(folder: Path) -> None:
        dump, out = two_cameras(finished[0], folder / "dump"), folder / "result"
        stopped_run(out, [dump])
        stopped_run(out / "left", [dump], finished[1])
        printed = ran("calibrate", dump, "--out", out, "--workers", 1)
        (folder / "printed").write_text(printed.stdout)

    folder = made_once("two-cameras", fill)
    return folder / "dump", folder / "result"


def content(result: Path) -> dict:
    return json.loads((result / "installation.json").read_text())


def test_each_camera_has_a_matrix_and_what_both_share_is_counted_once(seen, finished):
    joint, whole = content(seen[1]), content(finished[1])
    assert not {"R_cs", "quaternion", "theta_rad", "covariance_rad2"} & set(joint)
    assert [one["name"] for one in joint["cameras"]] == ["left", "right"]
    assert (joint["frames"], joint["stars"]) == (whole["frames"], whole["stars"])
    assert joint["rows"]["targets"]["listed"] == whole["rows"]["targets"]["listed"]
    covariance = np.array(joint["cameras_covariance_rad2"])
    for n, one in enumerate(joint["cameras"]):
        own = slice(3 * n, 3 * n + 3)
        np.testing.assert_array_equal(covariance[own, own], one["covariance_rad2"])
        # both cameras are parts of one: what the whole gives lies within their errors, 16 is 1e-3 at 3 dof
        off = theta_between(Rotation.from_quat(one["quaternion"]), Rotation.from_quat(whole["quaternion"]))
        assert off @ np.linalg.solve(covariance[own, own], off) < 16.3
    (between,) = joint["between_cameras"]
    assert between["cameras"] == ["left", "right"] and between["as_before_launch"]
    sigma = np.sqrt(np.diag(between["covariance_rad2"]))[0]
    assert sigma < 0.6 * np.sqrt(covariance[0, 0])  # the orbit across the track is common to both


def test_from_python_each_camera_has_its_matrix(seen: tuple[Path, Path], tmp_path: Path) -> None:
    result = Path(shutil.copytree(seen[1], tmp_path / "result"))
    found = bs.calibrate(seen[0], out=result)  # goes on from the finished result
    assert found.cameras == ("left", "right") and len(found.R_cs) == 2
    assert np.array_equal(found.cov_theta, content(seen[1])["cameras_covariance_rad2"])
    own = found.of_camera("right")
    assert own.R_cs.single and np.array_equal(own.theta, found.theta[3:]) and len(own.table()) == 3
    assert set(own.targets["strip_id"]) == {"right/s01-right"}
    between = found.between_cameras
    assert between[["a", "b"]].values.tolist() == [["left", "right"]]
    assert between["sigma_x_arcsec"][0] < 0.6 * found.sigma_arcsec[0]  # the orbit's error is common to both
    assert "R_cs of left: theta X" in repr(found) and len(found.table()) == 6
    assert found.export("spice", tmp_path / "kernels", dump=seen[0], camera="left")
    with pytest.raises(ValueError, match="name: found 'nadir', expected one of 'left', 'right'"):
        found.of_camera("nadir")
    with pytest.raises(ValueError, match="none with several dumps or cameras"):
        bs.calibrate(seen[0], strips="s01-left")


def test_two_dumps_of_one_instant_are_one_pass(finished: tuple[Path, Path], tmp_path: Path) -> None:
    dumps = [tmp_path / name for name in ("even", "odd")]
    head, *rows = (finished[0] / "strips.csv").read_text().splitlines()
    for n, dump in enumerate(dumps):
        shutil.copytree(finished[0], dump)
        own = [row for row in rows if int(row.split(",")[1]) % 2 == n]
        (dump / "strips.csv").write_text("\n".join([head, *own]) + "\n")
    out = tmp_path / "result"
    stopped_run(out, dumps)
    for dump in dumps:
        stopped_run(out / dump.name, [dump], finished[1])
    ran("calibrate", *dumps, "--out", out, "--workers", 1, "--no-report")
    joint, whole = content(out), content(finished[1])
    assert (joint["frames"], joint["stars"]) == (whole["frames"], whole["stars"])
    sigma, of_whole = (np.sqrt(np.diag(one["covariance_rad2"])) for one in (joint, whole))
    np.testing.assert_allclose(sigma, of_whole, rtol=0.05)  # positions that were measured once more
    off = np.array(joint["theta_rad"]) - whole["theta_rad"]
    assert np.all(np.abs(off) < 0.3 * of_whole)  # 1-sigma: noise of pixels that were measured once more


def test_console_and_page_show_a_matrix_for_each_camera(seen: tuple[Path, Path]) -> None:
    printed = (seen[1].parent / "printed").read_text()
    assert "R_cs of camera left =" in printed and "R_cs of camera right =" in printed
    assert "right to left" in printed and "as before launch" in printed
    page = (seen[1] / "report.html").read_text()
    assert "2 cameras of one satellite" in page and "right to left" in page


def test_pixels_of_a_camera_are_located_with_its_matrix(seen: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "pixels.csv").write_text("ccd,sample,line\n0,100,200\n")
    where = ("geolocate", seen[1], "--strip", "s01-right", "--pixels", tmp_path / "pixels.csv")
    assert len(ran(*where, "--camera", "right").stdout.splitlines()) == 2
    assert "found nothing, expected one of left, right" in refused(*where)
    assert "found middle, expected one of left, right" in refused(*where, "--camera", "middle")
    frames = tmp_path / "kernels"
    ran("export", seen[1], "--format", "spice", "--camera", "left", "--out", frames)
    x, y, z, w = content(seen[1])["cameras"][0]["quaternion"]
    assert (frames / "installation.tf").is_file() and w * w + x * x + y * y + z * z == pytest.approx(1.0)


def test_what_if_and_compare_take_one_of_several_cameras(seen: tuple[Path, Path]) -> None:
    left, right = content(seen[1])["cameras"]
    for one in (left, right):
        said = json.loads(ran("what-if", seen[1], "--camera", one["name"], "--json").stdout)["result"]
        now = np.array(said["covariance_now_rad2"])
        np.testing.assert_allclose(now, one["covariance_rad2"], rtol=0, atol=1e-6 * now.max())
    assert "found nothing, expected one of left, right" in refused("what-if", seen[1])
    told = ran("compare", seen[1] / "right", seen[1], "--camera", "right", "--json").stdout
    alone, by_itself = json.loads(told)["result"], content(seen[1] / "right")
    off = theta_between(*(Rotation.from_quat(one["quaternion"]) for one in (right, by_itself)))
    np.testing.assert_allclose(np.abs(alone["theta_c_rad"]), np.abs(off), rtol=0, atol=1e-9)
    assert alone["p_value"] > 1e-3  # the same observations, with those of the other camera


def test_a_dump_says_its_cameras_once_and_its_strips_name_them(seen, tmp_path):
    dump = Path(shutil.copytree(seen[0], tmp_path / "dump"))
    assert [view.camera for view in open_cameras(dump)] == ["left", "right"]
    with pytest.raises(RawDataError, match="2 cameras, expected one of left, right"):
        open_dump(dump)
    assert [strip.strip_id for strip in open_dump(dump, camera="right").strips] == ["s01-right"]
    strips, head = (dump / "strips.csv").read_text(), (dump / "dump.toml").read_text()
    only, one = head[: head.index("[[cameras]]")], '[files]\nremote_camera = "left.toml"'
    middle = strips.replace(",right\n", ",middle\n")
    for file, text, says in (
        ("strips.csv", middle, r"camera: found middle, expected one of .*: left, right"),
        (
            "dump.toml",
            head.replace("[files]", one),
            r"files.remote_camera and \[\[cameras\]\] exclude one another",
        ),
        ("dump.toml", only, "are both missing"),
        ("dump.toml", only.replace("[files]", one), "camera: found left, expected nothing"),
    ):
        (dump / "strips.csv").write_text(strips)
        (dump / file).write_text(text)
        with pytest.raises(RawDataError, match=says):
            open_cameras(dump)


def test_a_camera_may_have_an_installation_file_of_its_own(seen: tuple[Path, Path], tmp_path: Path) -> None:
    dump = Path(shutil.copytree(seen[0], tmp_path / "dump"))
    turned = Rotation.from_euler("xyz", [20.0, -5.0, 80.0], degrees=True)
    quaternion = f"quaternion_cs = {turned.as_quat().tolist()}"
    common = (dump / "installation.toml").read_text()
    (dump / "oblique.toml").write_text(re.sub(r"(?m)^quaternion_cs = .*$", quaternion, common))
    stated = 'file = "right.toml"'
    replaced(dump / "dump.toml", stated, f'{stated}\ninstallation = "oblique.toml"')
    left, right = open_cameras(dump)
    np.testing.assert_allclose(right.R_cs0.as_matrix(), turned.as_matrix(), atol=1e-12)  # rounding
    np.testing.assert_array_equal(left.R_cs0.as_quat(), open_cameras(seen[0])[0].R_cs0.as_quat())
