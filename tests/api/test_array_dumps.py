"""Dumps of arrays at other levels than images: look tables, lists of stars, attitudes.

The mounting of the example is bold: 168, -9 and 144 degrees about x, y and z; axes of solved attitudes are
turned further, so that none of them is the line of sight.
"""

import copy
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation
from tasks import arrays_of

import boresight as bs
from boresight.array_dump import orbit_text
from boresight.pipeline.files.text_files import toml_tables

MINI = bs.example("mini")
ARCSEC = np.pi / 648000.0
BOLD = Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True)  # star camera to the head's axes
SIGMAS = 4.0  # about each axis; one in 16 000 of right results is beyond
pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def truth() -> Rotation:
    path = MINI / "truth" / "installation.toml"
    return Rotation.from_quat(toml_tables(path, path.name)["quaternion_cs"])


def look_tables(camera: bs.LineCamera) -> bs.LookAngleCamera:
    """The same camera by tangents at every 16th sample."""
    tables = []
    for n in range(camera.n_ccds):
        samples = np.unique(np.append(np.arange(0.0, camera.n_px(n), 16.0), camera.n_px(n) - 1.0))
        u = camera.directions_from_pixels(n, samples)
        tables.append(bs.LookTable(camera.n_px(n), samples, u[:, 0] / u[:, 2], u[:, 1] / u[:, 2]))
    return bs.LookAngleCamera(tuple(tables))


def lists_of_stars(exposures: pd.DataFrame) -> pd.DataFrame:
    found = [bs.find_stars(image) for image in exposures["image"]]
    return exposures.drop(columns="image").assign(stars=found)


def solved(given: dict, R_hs: Rotation) -> list[dict]:
    """Attitudes about axes h that a star camera has solved from its images, with their covariances."""
    cov_s = np.diag([15.0, 15.0, 40.0]) ** 2  # arcsec², larger about the line of sight
    cov_h = R_hs.as_matrix() @ cov_s @ R_hs.as_matrix().T
    cov = {f"cov_{'xyz'[i]}{'xyz'[j]}_arcsec2": cov_h[i, j] for i in range(3) for j in range(i, 3)}
    rows = []
    for _, row in given["exposures"].iterrows():
        answer = bs.identify(row["image"], camera=given["star_camera"])
        assert answer
        q = (R_hs * answer.R_si).inv().as_quat()  # head to inertial
        rows.append({"time": row["time"], **dict(zip(("qx", "qy", "qz", "qw"), q)), **cov})
    return rows


def sigmas_off(result: bs.Calibration, R_cs: Rotation) -> np.ndarray:
    return np.abs((result.R_cs * R_cs.inv()).as_rotvec()) / ARCSEC / result.sigma_arcsec


@pytest.fixture(scope="module")
def read() -> dict:
    """Arguments of `dump_from_arrays`: the first strip of the example."""
    return arrays_of(MINI)


@pytest.fixture
def given(read: dict) -> dict:
    """The same, which a test may change."""
    return copy.deepcopy(read)


def test_look_tables_and_lists_of_stars_give_the_matrix_of_truth(given: dict) -> None:
    given["remote_camera"] = look_tables(given["remote_camera"])
    given["exposures"] = lists_of_stars(given["exposures"])
    dump = bs.dump_from_arrays(**given)
    assert isinstance(dump.line_camera, bs.LookAngleCamera)
    assert not list((Path(dump.root) / "exposures").iterdir())
    result = bs.calibrate(dump)
    assert (sigmas_off(result, truth()) < SIGMAS).all(), sigmas_off(result, truth())


@pytest.fixture(scope="module")
def attitudes(read: dict) -> dict:
    """The same with attitudes about bold axes, in which the aberration is left."""
    given = dict(read)
    given["attitudes"] = solved(given, BOLD)
    given["R_cs0"] = Rotation.from_matrix(given["R_cs0"]) * BOLD.inv()
    given["aberration_removed"] = "none"
    del given["exposures"], given["star_camera"]
    return given


def test_attitudes_about_bold_axes_give_the_matrix_of_truth(attitudes: dict) -> None:
    dump = bs.dump_from_arrays(**attitudes, line_of_sight_s=BOLD.apply([0.0, 0.0, 1.0]))
    result = bs.calibrate(dump)
    assert result.verdict == "consistent"
    off = sigmas_off(result, truth() * BOLD.inv())
    assert (off < SIGMAS).all(), off


def test_errors_of_attitudes_are_read_back_as_they_were_given(attitudes: dict) -> None:
    cov = np.array([[16.0, -9.0, 8.0], [-9.0, 81.0, 70.0], [8.0, 70.0, 2500.0]])  # arcsec²
    pairs = {f"cov_{'xyz'[i]}{'xyz'[j]}_arcsec2": cov[i, j] for i in range(3) for j in range(i, 3)}
    sigmas = {f"sigma_{axis}_arcsec": cov[n, n] ** 0.5 for n, axis in enumerate("xyz")}
    plain = pd.DataFrame(attitudes["attitudes"])[["time", "qx", "qy", "qz", "qw"]]
    for errors, expected in ((pairs, cov), (sigmas, np.diag(np.diag(cov)))):
        given = attitudes | {"attitudes": plain.assign(**errors), "line_of_sight_s": [0.0, 0.0, 1.0]}
        dump = bs.dump_from_arrays(**given)
        found = dump.heads[0].source.rows.covariance_s / ARCSEC**2
        np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=1e-12)


def test_a_line_of_sight_stated_wrongly_moves_the_matrix_as_its_blind_spot_says(attitudes: dict) -> None:
    """Axes of the head are bold, and its aberration is left in."""
    true_s, degrees = BOLD.apply([0.0, 0.0, 1.0]), 3.0
    right = bs.calibrate(bs.dump_from_arrays(**attitudes, line_of_sight_s=true_s))
    spots = right.blind_spots[right.blind_spots["cause"] == "line of sight of the attitudes"]
    assert len(spots) == 2 and spots["is_unseen"].all() and set(spots["unit"]) == {"deg"}
    for spot in spots.itertuples():
        across = np.array([float(one) for one in spot.item.partition("[")[2].strip("]").split(",")])
        assert abs(across @ true_s) < 0.02  # two digits are printed
        stated = true_s + np.radians(degrees) * across
        stated /= np.linalg.norm(stated)
        wrong = bs.calibrate(bs.dump_from_arrays(**attitudes, line_of_sight_s=stated))
        assert wrong.verdict == "consistent"  # nothing shows it
        moved = -(wrong.R_cs * right.R_cs.inv()).as_rotvec() / ARCSEC  # theta turns by -theta
        told = degrees * np.array([spot.effect_x_arcsec, spot.effect_y_arcsec, spot.effect_z_arcsec])
        # Second order in 3 deg: 0.05 of the change; matching begins elsewhere, 0.05 arc-second.
        assert np.abs(moved - told).max() < 0.1, (moved, told)


def test_exposures_without_ids_are_numbered_from_one(given: dict) -> None:
    rows = given["exposures"].drop(columns="id").to_dict("records")
    rows[4]["id"] = "named"
    dump = bs.dump_from_arrays(**given | {"exposures": rows})
    ids = pd.read_csv(Path(dump.root) / "exposures.csv")["id"].tolist()
    assert ids == [f"e00{n:02d}" if n != 5 else "named" for n in range(1, 15)]


def test_attitudes_with_aberration_need_a_line_of_sight(attitudes: dict) -> None:
    with pytest.raises(ValueError, match="line_of_sight_s: found None, expected a unit vector"):
        bs.dump_from_arrays(**attitudes)
    with pytest.raises(ValueError, match="line_of_sight_s: found"):
        bs.dump_from_arrays(**attitudes, line_of_sight_s=[0.0, 0.6, 0.6])


@pytest.mark.parametrize(
    "change, message",
    [
        ({"attitudes": [{}]}, "exposures, attitudes: found neither or both"),
        ({"attitudes": [{}], "exposures": None}, "aberration_removed: found None"),
        (
            {"sigma_R_cs0_rad": 30.0},
            "sigma_R_cs0_rad: found 30.0, expected a number or three, above 0 and at",
        ),
        (
            {
                "strips": [
                    {
                        "id": "s01",
                        "ccd": 0,
                        "time": "2024-11-20T03:40:02",
                        "row_period_s": 9e-4,
                        "image": np.ma.masked_equal(np.eye(300, 512, dtype=np.uint8), 1),
                    }
                ]
            },
            "strips, row 0, image: found an array with 300 masked pixels, expected raw counts",
        ),
        ({"remote_camera": 5}, "remote_camera: found 5, expected a LineCamera or a LookAngleCamera"),
        (
            {"terrain": (np.full((4, 4), -1e300), (1e-4, 0, 103, 0, -1e-4, 36), "EPSG:4326")},
            r"terrain, heights: found values to 1e\+300, expected at most 3e38",
        ),
        (
            {"exposures": [{"time": "2024-11-20T03:40:00", "exposure_s": 0.1, "stars": [{"x_px": 1.0}]}]},
            "exposures, row 0, stars: found columns x_px, expected also y_px",
        ),
    ],
)
def test_wrong_levels_are_named(change: dict, message: str, given: dict) -> None:
    with pytest.raises(ValueError, match=message):
        bs.dump_from_arrays(**given | change)


def test_messages_name_the_argument_its_row_and_unit(given: dict) -> None:
    km = [row | {name: row[name] / 1e3 for name in ("x_m", "y_m", "z_m")} for row in given["orbit"]]
    with pytest.raises(ValueError, match=r"orbit, row 0, x_m, y_m, z_m: found 69\d\d\.\d+ m .*metres"):
        bs.dump_from_arrays(**given | {"orbit": km})
    orbit, axes = pd.DataFrame(given["orbit"]), ["x_m", "y_m", "z_m"]
    orbit[axes] *= (4.9e7 / np.linalg.norm(orbit[axes], axis=1))[:, None]
    assert orbit_text("far", "ITRF", orbit)  # to 5e7 m
    orbit.loc[orbit.index[5:], axes] *= 5.1 / 4.9
    with pytest.raises(ValueError, match=r"orbit, row 5, x_m, y_m, z_m: found 5\.1e\+07 m"):
        orbit_text("far", "ITRF", orbit)
    targets = pd.DataFrame(given["targets"])
    targets.loc[3, "lat_deg"] = 102.9
    with pytest.raises(bs.RawDataError, match=r"^targets: row 3, lat_deg: found 102\.9, expected at most 90"):
        bs.dump_from_arrays(**given | {"targets": targets})
