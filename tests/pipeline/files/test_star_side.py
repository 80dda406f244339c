"""The star side and the ground side of a dump at other levels: what is stated twice, or not, is refused."""

from pathlib import Path

import numpy as np
import pytest
import tomlkit
from edits import replaced, rows_of, write_rows
from handmade import ATTITUDE_HEAD, give_heads, write_handmade_dump

from boresight.geometry.star_camera import SmoothDistortion, StarCamera
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files import star_side
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.dump_schema import StarCameraFile
from boresight.pipeline.files.star_side import SolvedAttitudes, StarCentroids, star_camera_of
from boresight.pipeline.files.text_files import read_toml

HEAD = ATTITUDE_HEAD.format(rotation="head to inertial", removed="annual")
WHITE = """
[star_cameras.noise]
white_arcsec = [1, 1, 7]
correlated_arcsec = [0.5, 0.5, 4]
correlation_time_s = [1, 1, 2]
"""
POINTS = (
    "id,strip,ccd,sample,line,sigma_sample_px,sigma_line_px,lat_deg,lon_deg,height_m,height_kind,"
    "sigma_east_m,sigma_north_m,sigma_up_m\n"
)
POINT = "p1,s1,0,12.5,30,0.3,0.3,0.0,103.0,20,ellipsoidal,1,1,2\n"


@pytest.fixture
def attitudes(tmp_path: Path) -> Path:
    """The handmade dump with nadir-pointing attitudes for exposures, and one point for chips."""
    root = write_handmade_dump(tmp_path / "dump")
    images = open_dump(root)
    t_s = np.arange(19.0, 21.0, 0.1)
    R_si = images.R_cs0.inv() * images.orbit.R_oi(t_s)
    rows = [
        f"{utc.rstrip('Z')},{','.join(map(repr, q))}"
        for utc, q in zip(images.epoch.utc_from_seconds(t_s), R_si.inv().as_quat().tolist())
    ]
    (root / "str1.csv").write_text("\n".join(["utc,qx,qy,qz,qw", *rows]) + "\n")
    (root / "points.csv").write_text(POINTS + POINT)
    replaced(root / "dump.toml", 'targets = "targets.csv"', 'points = "points.csv"')
    give_heads(root, HEAD + WHITE)
    return root


def changed(root: Path, old: str, new: str, file: str = "dump.toml") -> Dump:
    replaced(root / file, old, new)
    return open_dump(root)


def test_attitudes_and_points_are_read(attitudes: Path) -> None:
    dump = open_dump(attitudes)
    (head,) = dump.heads
    assert isinstance(head.source, SolvedAttitudes) and len(head.source.rows.t_s) == 20
    assert np.allclose(head.noise.correlated_rad * 648_000 / np.pi, [0.5, 0.5, 4.0])
    assert dump.points[0].xy_px.tolist() == [[12.5, 30.0]] and dump.star_camera is None


def test_white_noise_is_stated_once(attitudes: Path) -> None:
    white_rad2 = np.diag(np.radians(np.array([1.0, 2.0, 7.0]) / 3600.0) ** 2)
    (head,) = changed(attitudes, "[1, 1, 7]", "[1, 2, 7]").heads
    np.testing.assert_allclose(head.source.usual_covariance_s(head.noise), white_rad2)
    with pytest.raises(RawDataError, match=r"noise\.white_arcsec of STR1.*neither in the rows nor here"):
        changed(attitudes, "white_arcsec = [1, 2, 7]\n", "")
    # rows of three sizes, most of them twice the white noise
    sigma = [{f"sigma_{axis}_arcsec": k * s for axis, s in zip("xyz", (1, 2, 7))} for k in (3, 2, 1, 2, 2)]
    rows = [row | sigma[n % 5] for n, row in enumerate(rows_of(attitudes / "str1.csv"))]
    write_rows(attitudes / "str1.csv", rows)
    (head,) = open_dump(attitudes).heads
    np.testing.assert_allclose(head.source.usual_covariance_s(head.noise), 4.0 * white_rad2)
    with pytest.raises(RawDataError, match=r"and in the rows of str1\.csv"):
        changed(attitudes, "[star_cameras.noise]\n", "[star_cameras.noise]\nwhite_arcsec = [1, 1, 7]\n")


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('aberration_removed = "annual"\n', "", "needs the key aberration_removed"),
        ('level = "attitudes"', 'level = "images"', "needs the key camera"),
        ('rotation = "head to inertial"\n', "", "rotation of str1.csv"),
        ('rotation = "head to inertial"', 'rotation = "inertial to head"', "likely|inverse rotation"),
        ("line_of_sight = [0.0, 0.0, 1.0]\n", "", "needs line_of_sight"),
        ("line_of_sight = [0.0, 0.0, 1.0]", "line_of_sight = [0.0, 0.6, 0.6]", "has length 0.8485, 1 within"),
        ("#installation", "installation", "exclude one another"),
        ('points = "points.csv"', "", "files.targets|nothing"),
        ("correlation_time_s = [1, 1, 2]\n", "", "come together"),
    ],
)
def test_contradicting_statements_are_refused(old: str, new: str, complaint: str, attitudes: Path) -> None:
    with pytest.raises(RawDataError, match=complaint):
        changed(attitudes, old, new)


def test_a_line_of_sight_that_meets_the_earth_is_refused(attitudes: Path) -> None:
    dump = open_dump(attitudes)
    assert isinstance(dump.heads[0].source, SolvedAttitudes)
    down = dump.R_cs0.inv().apply([0.0, 0.0, 1.0])  # where the camera looks, axes of the head
    stated = f"line_of_sight = {down.tolist()}"
    with pytest.raises(RawDataError, match=r"line_of_sight of STR1.*meets the Earth 0 deg off nadir"):
        changed(attitudes, "line_of_sight = [0.0, 0.0, 1.0]", stated)
    unused = changed(attitudes, '"annual"', '"annual and orbital"')
    assert np.allclose(unused.heads[0].line_of_sight_s, down)


@pytest.mark.parametrize(
    ("row", "complaint"),
    [
        (POINT.replace(",20,ell", ",21,ell").replace("s1,0", "s1,1"), "line 3, height_m"),
        (POINT, "line 3, id: found p1 again"),
        (POINT.replace("p1,s1", "p2,s9"), "strip: found s9"),
        (POINT.replace("p1,s1,0", "p2,s1,7"), "ccd"),
    ],
)
def test_points_that_contradict_are_refused(row: str, complaint: str, attitudes: Path) -> None:
    (attitudes / "points.csv").write_text(POINTS + POINT + row)
    with pytest.raises(RawDataError, match=complaint):
        open_dump(attitudes)


def test_centroids_stand_in_for_images(tmp_path: Path) -> None:
    root = write_handmade_dump(tmp_path / "dump")
    head = HEAD[: HEAD.index("attitudes = ")].replace('"attitudes"', '"centroids"')
    keys = 'camera = "star_camera.toml"\nexposures = "exposures.csv"\ncentroids = "stars.csv"\n'
    give_heads(root, head + keys)
    rows = "exposures/1.png,10.5,20.25,0.05,0.06,0.001,300\nexposures/1.png,3,4,0.1,0.1,0,900\n"
    (root / "stars.csv").write_text("file,x_px,y_px,sigma_x_px,sigma_y_px,cov_xy_px2,flux_dn\n" + rows)
    (head_read,) = open_dump(root).heads
    assert isinstance(head_read.source, StarCentroids)
    none, stars, *_ = head_read.source.lists
    assert none is None and stars is not None
    assert stars.xy_px.tolist() == [[3.0, 4.0], [10.5, 20.25]]  # brightest first
    assert np.allclose(stars.cov_px[1], [[0.0025, 0.001], [0.001, 0.0036]])
    replaced(root / "stars.csv", "0.06,0.001,", "0.06,0.00301,")  # more than 0.05 times 0.06
    with pytest.raises(RawDataError, match=r"line 2, sigma_x_px: found .*correlated by less than 1"):
        open_dump(root)


def test_a_foreign_lens_comes_back_from_its_file(tmp_path):
    size, coefficients = {"width_px": 1000, "height_px": 800}, np.random.default_rng(3).normal(size=(2, 7))
    lens = {
        "smooth": SmoothDistortion(degree=3, coefficients_px=coefficients, **size),
        "q1": -1e-4,
        "q3": 1e-8,
    }
    lens |= {"focal_m": 0.02, "principal_px": (510.0, 390.0), "projection": "equidistant"}
    camera = StarCamera(pixel_m=5e-6, **size, **lens)
    file, xy_px = tmp_path / "star_camera.toml", np.array([[3.0, 5.0], [700.0, 200.0]])
    file.write_text(tomlkit.dumps(star_side.star_camera_table(camera, 12)), "utf-8")
    read = star_camera_of(read_toml(file, StarCameraFile, str(file)), str(file))
    error = read.directions_from_pixels(xy_px) - camera.directions_from_pixels(xy_px)
    assert np.abs(error).max() < 1e-14  # rad: the pixel pitch is written with 14 digits
    replaced(file, "degree = 3", "degree = 4")
    with pytest.raises(RawDataError, match=r"smooth.columns_px.*12 coefficients"):
        star_camera_of(read_toml(file, StarCameraFile, str(file)), str(file))
