"""Further tasks of people who know names and docstrings alone, with values given by mistake."""

import datetime
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import astropy.units as units
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import rasterio
from astropy.time import Time
from matplotlib.axes import Axes
from scipy.spatial.transform import Rotation

import boresight as bs
from boresight import accepted
from boresight.features.planning import campaign_plan

MINI = Path(__file__).parents[2] / "fixtures" / "mini"
EXPOSURE = MINI / "exposures" / "e0001.png"


@pytest.fixture(scope="module")
def pixels() -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(EXPOSURE) as file:
            return file.read(1)


def test_masked_pixels_hold_no_star_and_are_counted(pixels: np.ndarray) -> None:
    stars = bs.find_stars(pixels)
    x, y = (round(one) for one in stars.xy_px[1])
    hidden = np.zeros(pixels.shape, dtype=bool)
    hidden[y - 6 : y + 7, x - 6 : x + 7] = True
    found = bs.find_stars(np.ma.masked_array(pixels, hidden))
    assert found.masked == 169 and "169 masked pixels" in repr(found)
    assert np.hypot(*(found.xy_px - stars.xy_px[1]).T).min() > 6.0
    assert np.isfinite(found.saturation_dn) and found.saturated.any()  # counts stay counts
    assert len(bs.find_stars(np.ma.masked_array(pixels))) == len(stars)
    with pytest.raises(ValueError, match="image: found an array of which all is masked"):
        bs.find_stars(np.ma.masked_array(pixels, np.ones_like(hidden)))


@pytest.mark.parametrize("as_nan", [True, False])
def test_masked_pixels_within_stars_do_not_displace_them(pixels: np.ndarray, as_nan: bool) -> None:
    """A pixel beside the middle of each of forty stars is masked: taken as sky it displaced them by up to
    seven of their errors."""
    stars = bs.find_stars(pixels)
    some = np.flatnonzero(~stars.saturated & ~stars.blended)[:40]
    column, row = np.rint(stars.xy_px[some]).astype(int).T
    hidden = np.zeros(pixels.shape, dtype=bool)
    hidden[row, column + 1] = True
    found = bs.find_stars(np.where(hidden, np.nan, pixels) if as_nan else np.ma.masked_array(pixels, hidden))
    moved = np.hypot(*(found.xy_px[:, None] - stars.xy_px[some]).T).min(axis=1)
    assert (moved / stars.sigma_px[some]).max() < 2.5  # what a pixel tells: half an error, 1.6 at most


@pytest.mark.parametrize("kind", ["stars", "solution"])
def test_a_plot_takes_every_form_of_its_image_and_no_other_image(pixels: np.ndarray, kind: str) -> None:
    stars = bs.find_stars(pixels)
    shown = stars if kind == "stars" else bs.identify(stars, camera=bs.open_dump(MINI).star_camera)
    for image in (pixels, EXPOSURE, np.dstack([pixels] * 3), np.where(pixels > 200, np.nan, pixels)):
        assert isinstance(shown.plot(image=image), Axes)
        plt.close("all")
    with pytest.raises(ValueError, match=r"image: found shape \(500, 1024\), expected the image of these"):
        shown.plot(image=pixels[:500])
    plt.close("all")


def test_a_plan_takes_numbers_of_numpy_and_its_forecast_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign_plan, "DRAWS", 1)  # how often a strip is drawn is not what is tested
    monkeypatch.setattr(campaign_plan, "PLAN_DRAWS", 10)
    plan = {"strips": {"count": np.int64(6)}, "targets": {"sigma_px": np.float32(0.25)}}
    forecast = bs.forecast(plan)
    plain = bs.forecast({"strips": {"count": 6}, "targets": {"sigma_px": 0.25}})
    assert forecast.table.equals(plain.table)
    lines = forecast.plot().get_lines()
    assert [line.get_label() for line in lines if line.get_label() in "XYZ"] == ["X", "Y", "Z"]
    assert np.array_equal(
        lines[0].get_ydata(), forecast.table.query("axis == 'X'")["sigma_arcsec"].to_numpy()
    )
    plt.close("all")


def test_what_is_not_matched_says_why() -> None:
    found = bs.match_template(
        np.ones((64, 64)), np.random.default_rng(1).normal(size=(200, 200)), start_px=(90, 90)
    )
    assert not found and repr(found) == f"not matched: {found.sentence}"


def test_a_file_in_place_of_a_folder_is_said() -> None:
    with pytest.raises(bs.RawDataError, match=r"found a file, expected a folder with a dump\.toml"):
        bs.open_dump(MINI / "dump.toml")
    with pytest.raises(ValueError, match=r"settings: .*expected the path of a TOML file, or Settings"):
        bs.calibrate(MINI, settings={"run": {"rounds": 1}})  # type: ignore[arg-type]


def test_an_instant_is_the_same_in_all_its_forms() -> None:
    noon, India = datetime.datetime(2024, 11, 20, 12, 0, 0, 250000), datetime.timedelta(hours=5, minutes=30)
    forms = ["2024-11-20T12:00:00.25", noon, np.datetime64(noon), Time("2024-11-20T12:00:37.25", scale="tai")]
    forms += [(noon + India).replace(tzinfo=datetime.timezone(India)), pd.Timestamp(noon, tz="UTC")]
    assert {pd.Timestamp(accepted.utc_of(one, "time")) for one in forms} == {pd.Timestamp(noon)}


R_ANY = Rotation.from_euler("xyz", [40, -65, 110], degrees=True).as_matrix()
# By a reader and its limits: what is still accepted, and what is refused.
EDGES: dict[str, tuple[Callable[[Any], Any], list[Any], list[Any]]] = {
    "rotation": (
        lambda one: accepted.rotation_of(one, "R_cs0").as_matrix(),
        [R_ANY.round(7)],
        [R_ANY.round(5), -R_ANY, R_ANY[:2], [Rotation.identity()] * 2],
    ),
    "number": (
        lambda one: accepted.number_of(one, "x", -0.5, 2.0),
        [-0.5, 2],
        [-0.501, 2.001, True, "1", np.nan],
    ),
    "count": (lambda one: accepted.count_of(one, "n", 1, 9), [1, 9], [0, 10, 2.0, True]),
    "site": (
        accepted.site_of,
        [(90, 360, -500), (-90, -360, 9000)],
        [(90.1, 0, 0), (0, 361, 0), (0, 0, -501)],
    ),
}


@pytest.mark.parametrize("name", EDGES)
def test_a_limit_is_accepted_and_what_is_beyond_is_not(name: str) -> None:
    read, inside, outside = EDGES[name]
    for one in inside:
        assert np.allclose(read(one), one, atol=1e-7)
    for one in outside:
        with pytest.raises(ValueError, match="expected"):
            read(one)


def test_numbers_of_stated_units_are_converted_and_covariances_by_the_square() -> None:
    assert accepted.number_of(0.5 * units.deg, "fov_rad") == pytest.approx(np.pi / 360.0)
    found = accepted.floats_of(np.diag([1.0, 4.0]) * units.arcmin**2, "cov_arcsec", "(2, 2)")
    assert np.allclose(found, np.diag([3600.0, 14400.0]))
    assert np.allclose(accepted.floats_of([[1.0, 2.0]] * units.km, "p_m", "(1, 2)"), [[1000.0, 2000.0]])


def test_masked_pixels_of_a_floating_chip_are_no_numbers() -> None:
    chip = np.ma.masked_less(np.linspace(0.0, 1.0, 12).reshape(3, 4), 0.5)
    given = accepted.pixels_of(lambda: chip, "targets, row 0, chip", "grey values")
    assert np.array_equal(np.isnan(given), np.ma.getmaskarray(chip))
