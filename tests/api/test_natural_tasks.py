"""What researchers and data people do next with vectors and results: tasks by public names, at first try."""

from __future__ import annotations

import copy
import logging
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import astropy.units as u
import dask.array as da
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from astropy.coordinates import SkyCoord
from astropy.time import Time
from scipy.spatial.transform import Rotation
from seen_by_astropy import directions_by_astropy, frame_of, places_below, states_of
from wrong_vectors import R_TRUE, SIGMA_C, SIGMA_S, Given, drawn_vectors, nees_of

import boresight as bs

ARCSEC = np.pi / 648000.0
NEES_LIMIT = 21.1  # chi-square, 3 degrees of freedom, 1 in 10 000


class At(NamedTuple):
    """What the tasks begin with."""

    given: Given  # four frames of 20 stars and 20 targets
    result: bs.Calibration  # of these
    calibrated: bs.Calibration  # of a dump of one strip, read back
    dump: Path
    orbit: pd.DataFrame  # states of a satellite
    out: Path


class Labelled:
    """An array that states its units as xarray does."""

    def __init__(self, values: np.ndarray, units: str = "") -> None:
        self.values, self.ndim = values, values.ndim
        self.attrs = {"units": units} if units else {}

    def __array__(self, dtype: object = None, copy: object = None) -> np.ndarray:
        return self.values

    def __iter__(self) -> object:
        return iter(self.values)


def same(a: bs.Calibration, b: bs.Calibration, rad: float = 1e-13) -> bool:
    """Whether two results have one matrix and one covariance, to rounding."""
    turn = (a.R_cs * b.R_cs.inv()).magnitude()
    return bool(turn < rad and np.allclose(a.cov_theta, b.cov_theta, rtol=1e-6, atol=0.0))


def right(result: bs.Calibration) -> bool:
    return result.verdict == "consistent" and nees_of(result.R_cs, result.cov_theta) < NEES_LIMIT


def one_frame(given: Given) -> Given:
    return Given(*(part[0] if isinstance(part, list) else part for part in given))


def calibrated_places(at: At, tables: list[pd.DataFrame], given: object = None) -> bs.Calibration:
    """The matrix from frames that see places (of `tables`, and so stated where none are `given`)."""
    rng = np.random.default_rng(8)
    parts = [frame_of(directions_by_astropy(at.orbit, table), rng) for table in tables]
    u_s, v_stars, w_c = (list(part) for part in zip(*parts))
    places = tables if given is None else given
    return bs.calibrate_vectors(u_s, v_stars, SIGMA_S, w_c, places, SIGMA_C, R_TRUE, orbit=at.orbit)


@pytest.fixture(scope="module")
def at(finished: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> At:
    given = drawn_vectors(np.random.default_rng(31), frames=4)
    orbit = states_of(finished[0])
    result, calibrated = bs.calibrate_vectors(*given), bs.read_result(finished[1])
    return At(given, result, calibrated, finished[0], orbit, tmp_path_factory.mktemp("tasks"))


def frames_of_unequal_length_with_one_sigma_a_vector(at: At) -> None:
    sizes = (5, 9, 14, 20)
    cut = [[part[k][:n] for k, n in enumerate(sizes)] for part in (at.given.u_s, at.given.v_stars)]
    assert right(bs.calibrate_vectors(*cut, [np.full(n, SIGMA_S) for n in sizes], *at.given[3:]))


def frames_of_unequal_length_as_nested_lists(at: At) -> None:
    cut = [[part[k][: 10 + k].tolist() for k in range(4)] for part in (at.given.u_s, at.given.v_stars)]
    sigmas = [[SIGMA_S] * (10 + k) for k in range(4)]
    assert right(bs.calibrate_vectors(*cut, sigmas, *at.given[3:]))


def a_covariance_that_is_wider_along_one_axis_widens_that_axis(at: At) -> None:
    wide = [np.broadcast_to(SIGMA_C**2 * np.diag([100.0, 1.0, 1.0]), (20, 3, 3)) for _ in range(4)]
    found = bs.calibrate_vectors(*at.given._replace(sigma_c=wide))
    ratio = found.sigma_arcsec / at.result.sigma_arcsec
    assert ratio[1] > 1.05 > 1.02 > ratio[0]  # what lies along x shows a rotation about y


def a_prior_that_is_wide_changes_nothing_and_a_tight_one_holds(at: At) -> None:
    wide = bs.calibrate_vectors(*at.given, sigma_R_cs0_rad=1.0)
    assert same(wide, at.result, rad=1e-9)
    tight = bs.calibrate_vectors(*at.given._replace(R_cs0=R_TRUE), sigma_R_cs0_rad=0.1 * ARCSEC)
    assert (tight.sigma_arcsec <= 0.1).all() and right(tight)


def a_prior_as_a_covariance_in_degrees(at: At) -> None:
    cov = (np.eye(3) * 0.02**2) * u.deg**2
    by_sigma = bs.calibrate_vectors(*at.given, sigma_R_cs0_rad=0.02 * u.deg)
    assert same(bs.calibrate_vectors(*at.given, sigma_R_cs0_rad=cov), by_sigma, rad=1e-12)


def a_fixed_axis_stays_where_it_is_and_the_others_are_free(at: At) -> None:
    found = bs.calibrate_vectors(*at.given._replace(R_cs0=R_TRUE), sigma_R_cs0_rad=[np.inf, np.inf, 0.0])
    assert abs(found.theta[2]) < 1e-8 and found.sigma_arcsec[2] < 1e-3
    assert found.sigma_arcsec[0] > 0.05 and right(found)


def one_target_and_a_prior(at: At) -> None:
    one = one_frame(at.given)
    few = one._replace(w_c=one.w_c[:1], v_targets=one.v_targets[:1], R_cs0=R_TRUE)
    found = bs.calibrate_vectors(*few, sigma_R_cs0_rad=100 * ARCSEC)
    assert found.verdict == "not checkable" and found.sigma_arcsec[2] == pytest.approx(100.0, rel=0.01)


def a_prior_that_the_vectors_contradict_refutes(at: At) -> None:
    off = Rotation.from_rotvec([0.0, 0.0, 1e-3]) * R_TRUE
    assert bs.calibrate_vectors(*at.given._replace(R_cs0=off), sigma_R_cs0_rad=1e-5).verdict == "refuted"


def targets_as_places_with_an_orbit(at: At) -> None:
    found = calibrated_places(at, [places_below(at.orbit, n) for n in (50, 60)])
    assert right(found) and len(found.targets) == 24


def targets_as_places_with_astropy_times_and_units(at: At) -> None:
    table = places_below(at.orbit, 60)
    rows = [
        row | {"time": Time(row["time"], scale="utc"), "height_m": row["height_m"] / 1e3 * u.km}
        for row in table.to_dict("records")
    ]
    assert same(calibrated_places(at, [table], given=[rows]), calibrated_places(at, [table]))


def errors_of_places_that_several_frames_list_count_once(at: At) -> None:
    tables = [places_below(at.orbit, 60).assign(time=str(at.orbit["time"][n])) for n in (59, 60, 61)]
    exact = calibrated_places(at, tables)
    of_5_m = [t.assign(sigma_east_m=5.0, sigma_north_m=5.0, sigma_up_m=5.0) for t in tables]
    moved = [t.assign(lat_deg=t["lat_deg"] + 1e-13 * n) for n, t in enumerate(of_5_m)]  # as many other places
    once, each = calibrated_places(at, of_5_m), calibrated_places(at, moved)
    assert once.sigma_arcsec[2] > 1.2 * each.sigma_arcsec[2] > exact.sigma_arcsec[2]


def heights_above_the_geoid(at: At) -> None:
    table = places_below(at.orbit, 60)
    below = calibrated_places(at, [table], given=[table.assign(height_kind="egm96")])
    off = (below.R_cs * calibrated_places(at, [table]).R_cs.inv()).magnitude()
    assert 1e-8 < off < 2e-5  # rad: some 30 m between geoid and ellipsoid, from 500 km, near the nadir


def places_without_an_orbit_are_refused_by_name(at: At) -> None:
    with pytest.raises(ValueError, match="orbit: found None, expected states of the satellite"):
        bs.calibrate_vectors(*at.given._replace(v_targets=[places_below(at.orbit, 60)] * 4))


def parts_of_one_instant_are_one_frame(at: At) -> None:
    times = pd.date_range("2026-03-01", periods=4, freq="min")
    assert same(bs.calibrate_vectors(*at.given, instants=times), at.result)
    one = one_frame(at.given)
    parts = [[part[:10], part[10:]] for part in (one.w_c, one.v_targets)]
    stars = [[one.u_s[:12], one.u_s[12:]], [one.v_stars[:12], one.v_stars[12:]]]
    cut = bs.calibrate_vectors(*stars, SIGMA_S, *parts, SIGMA_C, one.R_cs0, instants=["t0", "t0"])
    assert same(cut, bs.calibrate_vectors(*one), rad=1e-12)


def a_frame_that_clouds_hide(at: At) -> None:
    w_c, v_targets = [*at.given.w_c[:3], []], [*at.given.v_targets[:3], np.zeros((0, 3))]
    found = bs.calibrate_vectors(*at.given._replace(w_c=w_c, v_targets=v_targets))
    assert right(found) and found.not_used[["name", "reason"]].values.tolist() == [["3", "has no targets"]]


def a_frame_without_stars(at: At) -> None:
    u_s, v_stars = [*at.given.u_s[:3], []], [*at.given.v_stars[:3], []]
    found = bs.calibrate_vectors(*at.given._replace(u_s=u_s, v_stars=v_stars))
    assert right(found) and set(found.not_used["name"]) == {"3"}


def know_which_vectors_were_rejected(at: At) -> None:
    rng = np.random.default_rng(77)
    given = drawn_vectors(rng, frames=3, stars=2, targets=2)
    found = bs.calibrate_vectors(*given)
    for kind, table, column in (
        ("star", found.residuals("stars"), "star"),
        ("target", found.targets, "target"),
    ):
        lost = table[~table["kept"]]
        names = [f"{frame}/{number}" for frame, number in zip(lost["frame"], lost[column])]
        assert names and names == found.not_used.loc[found.not_used["kind"] == kind, "name"].tolist()
    text = found.not_used.query("kind == 'target'")["reason"].iloc[0]
    assert "that the other targets predict" in text


def join_residuals_with_own_tables(at: At) -> None:
    own = pd.DataFrame({"frame": np.repeat(range(4), 20), "target": np.tile(range(20), 4)})
    joined = own.merge(at.result.residuals(), on=["frame", "target"])
    assert len(joined) == 80 and np.isfinite(joined["residual_x_arcsec"]).all()


def save_and_read_back(at: At) -> None:
    again = bs.read_result(at.result.save(at.out / "saved"))
    assert np.array_equal(again.theta, at.result.theta) and np.array_equal(
        again.cov_theta, at.result.cov_theta
    )
    assert repr(again) == repr(at.result)
    for name in ("targets", "checks", "blind_spots", "not_used"):
        pd.testing.assert_frame_equal(getattr(again, name), getattr(at.result, name), check_dtype=False)
    pd.testing.assert_frame_equal(again.residuals("stars"), at.result.residuals("stars"))


def save_over_something_is_refused(at: At) -> None:
    (at.out / "full").mkdir()
    (at.out / "full" / "mine.txt").write_text("mine")
    with pytest.raises(ValueError, match="expected a new or empty folder"):
        at.result.save(at.out / "full")


def a_page_to_hand_on(at: At) -> None:
    page = at.result.report(at.out / "vectors.html").read_text()
    assert page.rstrip().endswith("</html>") and "<svg" in page and "consistent" in page
    assert 'src="http' not in page and "Blind spots" in page
    plt.close("all")


def export_to_spice(at: At) -> None:
    (file,) = at.result.export("spice", at.out / "kernels")
    assert "FRAME" in file.read_text()
    with pytest.raises(ValueError, match="from vectors"):
        at.result.export("rpc", at.out / "kernels")


def compare_two_results_from_vectors(at: At) -> None:
    other = bs.calibrate_vectors(*drawn_vectors(np.random.default_rng(32), frames=4))
    assert not bs.compare(at.result, other).differs
    moved = other.R_cs.inv() * Rotation.from_rotvec([0.0, 20 * ARCSEC, 0.0]) * other.R_cs
    turned = drawn_vectors(np.random.default_rng(33), frames=4)
    far = turned._replace(u_s=[moved.apply(part) for part in turned.u_s])
    assert bs.compare(at.result, bs.calibrate_vectors(*far)).differs


def a_result_without_strips_says_so(at: At) -> None:
    with pytest.raises(ValueError, match="from vectors"):
        at.result.geolocate("s01", 0, 1.0, 2.0)


def the_folder_of_a_result(at: At) -> None:
    assert {"installation.json", "sightings"} <= set(os.listdir(os.fspath(at.result)))


def progress_is_told(at: At) -> None:
    told: list[tuple[str, int, int]] = []
    bs.calibrate_vectors(*one_frame(at.given), progress=lambda *step: told.append(step))
    assert told[-1] == ("vectors", 1, 1)
    with pytest.raises(ValueError, match="progress: found 3"):
        bs.calibrate_vectors(*at.given, progress=3)  # type: ignore[arg-type]


def what_vectors_cannot_show_is_named(at: At) -> None:
    for found in (at.result, bs.calibrate_vectors(*one_frame(at.given))):
        unseen = found.blind_spots.query("is_unseen")["cause"]
        assert {f"attitude and aberration of all frames, about {axis} of c" for axis in "xyz"} <= set(unseen)


def results_in_other_processes(at: At) -> None:
    again = pickle.loads(pickle.dumps(at.result))
    assert same(again, at.result) and Path(again).is_dir()
    assert same(copy.deepcopy(at.result), at.result)


def the_same_bits_again_and_in_any_order_of_frames(at: At) -> None:
    assert np.array_equal(bs.calibrate_vectors(*at.given).theta, at.result.theta)
    back = [part[::-1] if isinstance(part, list) else part for part in at.given]
    assert same(bs.calibrate_vectors(*back), at.result)


def numbers_for_a_paper(at: At) -> None:
    table = at.result.table()
    assert table["sigma_arcsec"].to_numpy() == pytest.approx(at.result.sigma_arcsec)
    assert np.allclose(table[["correlation_x", "correlation_y", "correlation_z"]], table.iloc[:, 3:].T)
    assert at.result.R_cs.as_quat().shape == (4,)


def more_weight_by_leaving_a_frame_out(at: At) -> None:
    less = bs.what_if(at.result, {"0": np.inf})
    rest = bs.calibrate_vectors(*(part[1:] if isinstance(part, list) else part for part in at.given))
    assert np.allclose(np.sqrt(np.diag(less.covariance)) / ARCSEC, rest.sigma_arcsec, rtol=1e-3)


def a_result_of_a_dump_saved_elsewhere(at: At) -> None:
    again = bs.read_result(at.calibrated.save(at.out / "elsewhere"))
    assert np.array_equal(again.theta, at.calibrated.theta)


def progress_of_a_dump(at: At) -> None:
    with pytest.raises(ValueError, match="progress: found 'bar'"):
        bs.calibrate(at.dump, progress="bar")  # type: ignore[arg-type]


def a_height_with_its_unit(at: At) -> None:
    place = {"ccd": 1, "line": 9.0, "sample": 3.0, "dump": at.dump}
    a = at.calibrated.geolocate("s01", **place, height_m=0.5 * u.km)
    pd.testing.assert_frame_equal(a, at.calibrated.geolocate("s01", **place, height_m=500.0))


def a_field_of_view_in_radians(at: At) -> None:
    stars = bs.find_stars(at.dump / "exposures" / "e0001.png")
    a, b = bs.identify(stars, fov_deg=np.radians(18.6) * u.rad), bs.identify(stars, fov_deg=18.6)
    assert a and b and np.array_equal(a.hip, b.hip)
    with pytest.raises(ValueError, match=r"fov_deg: found values in 'm', expected numbers in deg"):
        bs.identify(stars, fov_deg=3.0 * u.m)


def debug_lines_are_our_own(at: At) -> None:
    assert logging.getLogger("rasterio").level == logging.INFO


def two_results_of_one_mission_one_from_vectors(at: At) -> None:
    assert bs.compare(at.result, at.calibrated).differs


def cut_a_result_by_hand(at: At) -> None:
    bad = at.result.targets.nlargest(3, "statistic")
    keep = [
        [row for row in range(20) if (k, row) not in set(zip(bad["frame"], bad["target"]))] for k in range(4)
    ]
    cut = [[part[k][keep[k]] for k in range(4)] for part in (at.given.w_c, at.given.v_targets)]
    assert right(bs.calibrate_vectors(*at.given[:3], *cut, *at.given[5:]))


def show_it_in_a_notebook(at: At) -> None:
    assert "<table" in at.result._repr_html_() and at.result.plot().get_legend() is not None
    plt.close("all")


def of_astropy(vectors: np.ndarray) -> object:
    return SkyCoord(*vectors.T, representation_type="cartesian").cartesian.xyz.T


def every_list(change: Callable[[list], object]) -> Callable[[Given], Given]:
    return lambda given: Given(*(change(part) if isinstance(part, list) else part for part in given))


# Other forms of the same vectors, of all frames or of one.
FORMS: dict[str, Callable[[Given], Given]] = {
    "a covariance for each vector": lambda given: given._replace(
        sigma_s=[np.broadcast_to(SIGMA_S**2 * np.eye(3), (20, 3, 3)) for _ in range(4)]
    ),
    "sigmas in arcseconds": lambda given: given._replace(sigma_s=(SIGMA_S * u.rad).to(u.arcsec)),
    "sigmas in degrees, one a vector": lambda given: given._replace(
        sigma_c=[np.full(20, np.degrees(SIGMA_C)) * u.deg for _ in range(4)]
    ),
    "one sigma a frame": lambda given: given._replace(sigma_c=[SIGMA_C] * 4),
    "one array of all frames": every_list(np.stack),
    "generators": every_list(iter),
    "directions from astropy": lambda given: given._replace(v_stars=list(map(of_astropy, given.v_stars))),
    "a matrix as nested lists": lambda given: given._replace(R_cs0=given.R_cs0.as_matrix().tolist()),
}
OF_ONE: dict[str, Callable[[Given], Given]] = {
    "labelled arrays that state their units": lambda one: one._replace(
        u_s=Labelled(one.u_s),
        v_stars=Labelled(one.v_stars),
        sigma_s=Labelled(np.full(20, np.degrees(SIGMA_S)), "deg"),
    ),
    "dask": lambda one: one._replace(u_s=da.from_array(one.u_s), w_c=da.from_array(one.w_c)),
    "tables": lambda one: one._replace(
        u_s=pd.DataFrame(one.u_s, columns=["x", "y", "z"]), sigma_s=pd.Series(np.full(20, SIGMA_S))
    ),
}


@pytest.mark.parametrize("form", [*FORMS, *OF_ONE])
def test_another_form_of_the_same_vectors_gives_the_same_result(form: str, at: At) -> None:
    if change := FORMS.get(form):
        found, expected = bs.calibrate_vectors(*change(at.given)), at.result
    else:
        one = one_frame(at.given)
        found, expected = bs.calibrate_vectors(*OF_ONE[form](one)), bs.calibrate_vectors(*one)
    assert same(found, expected, rad=1e-11 if "matrix" in form else 1e-13)


# All functions above that take what the tasks begin with alone.
ALONE = {"at": "At", "return": "None"}
TASKS = [one for one in list(globals().values()) if getattr(one, "__annotations__", None) == ALONE]


@pytest.mark.parametrize("what", TASKS, ids=lambda one: one.__name__)
def test_a_natural_task_is_done_at_first_try(what: Callable[[At], None], at: At) -> None:
    what(at)
