"""What the terminal shows of a calibration and of its validation, to the last printed digit."""

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.results import summary
from boresight.pipeline.results.summary import blind_lines, calibration_summary, unit_effect, verdict_lines
from boresight.pipeline.results.validate import CheckPoints, TruthErrors
from boresight.records.ledger import Entry, Kind, Reason, Subject

# A remote-sensing camera whose ends look 3 % and 4 % of the range, 0.05 in all, from its axis.
CAMERA = SimpleNamespace(
    n_ccds=1,
    n_px=lambda ccd: 2,
    directions_from_pixels=lambda ccd, px: np.array([[0.0, -0.01, 1.0], [0.03, 0.04, 1.0]]),
)


def calibration(**changed: Any) -> Any:
    """A calibration with numbers that no two rows have in common."""
    R_cs = Rotation.from_euler("xyz", [40, -65, 110], degrees=True)
    theta = {"R_cs": R_cs, "theta": np.array([1e-3, -2e-3, 3.5e-3]), "of_camera": lambda name: (R_cs, None)}
    sigma = {"sigma_theta": np.array([0.4541, 0.5153, 8.2676]) * ARCSEC, "chi2": 57.64, "dof": 69}
    counts = {
        "n_exposures": 42,
        "n_stars": 3719,
        "n_strips": 3,
        "n_targets": 36,
        "converged_covariance": True,
    }
    none = {
        "bias": None,
        "cameras": ("",),
        "between": lambda sigma_rad: (),
        "targets": SimpleNamespace(doubtful=()),
    }
    none |= dict.fromkeys(("heads", "references", "periodic"), ())
    estimate = SimpleNamespace(**theta | sigma | counts | none | changed)
    ranges_m = [np.array([510e3, np.nan, 560e3]), np.array([640e3])]  # one look sees none; mean 570 km
    strips = [SimpleNamespace(ground=SimpleNamespace(range_m=one)) for one in ranges_m]
    verdict = SimpleNamespace(checks=())
    return SimpleNamespace(
        estimate=estimate, verdict=verdict, omissions=(), rows=(), strips=strips, camera=CAMERA
    )


@pytest.fixture(autouse=True)
def plain_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(summary, "verdict_json", lambda verdict, rows=(): {"checks": [], "sentence": ""})
    monkeypatch.setattr(summary, "blind_spots_json", lambda _: [])


def test_numbers_of_the_summary_are_those_of_the_estimate() -> None:
    told = {"theta": np.array([1e-5, -2e-5, 3e-5]), "sigma": np.array([0.75, 1.5, 9.25]) * ARCSEC}
    between = SimpleNamespace(cameras=("nadir", "aft"), as_before_launch=True, p_value=0.25, **told)
    text = calibration_summary(calibration(between=lambda sigma_rad: (between,)))
    rows = {line[:26].rstrip(): line[26:].split() for line in text.splitlines()}
    assert rows["aft to nadir"] == ["+2.063", "-4.125", "+6.188"]
    assert rows["  1 sigma, arcsec"] == ["0.7500", "1.5000", "9.2500"]
    assert rows["1 sigma, arcsec"] == ["0.4541", "0.5153", "8.2676"]
    assert rows["theta, arcsec"] == ["+206.265", "-412.530", "+721.927"]  # 206264.806" in a radian
    turned = Rotation.from_rotvec([1e-3, -2e-3, 3.5e-3]).as_euler("ZXY") * 206264.806  # of axes
    z, x, y = turned
    assert rows["Z-X-Y angles, arcsec"] == [f"{x:+.3f}", f"{y:+.3f}", f"{z:+.3f}"]
    # 570 km, 2.7634 m an arc-second; about Z at the edge of the swath, 0.05 of it
    assert rows["1 sigma on the ground, m"] == ["1.25", "1.42", "1.14"]
    assert rows["from"] == "42 exposures with 3719 stars, 3 strips with 36 targets".split()
    assert rows["chi2 / dof"] == ["57.6", "/", "69"]
    assert rows["not used"] == ["nothing"]


def test_scans_of_the_sky_alone_have_no_metres() -> None:
    found = calibration()
    found.strips = [SimpleNamespace(ground=SimpleNamespace(range_m=np.full(3, np.nan)))]
    assert "ground, m" not in calibration_summary(found)


def test_each_head_has_the_sigma_of_its_own_axes() -> None:
    sigma = np.array([0.5, 1.25, 9.0, 2.5, 0.75, 11.0, 3.125, 6.5, 0.25]) * ARCSEC
    turned = [Rotation.from_euler("xyz", angles, degrees=True) for angles in ((40, -65, 110), (-75, 20, 35))]
    heads = [SimpleNamespace(name=name, R_cs=R) for name, R in zip(("port", "zenith", "star"), turned * 2)]
    correlated = np.outer(sigma, sigma) * (0.3 + 0.7 * np.eye(9))
    lines = calibration_summary(calibration(heads=tuple(heads), cov_heads=correlated)).splitlines()
    told = {line.split()[1]: (line, below) for line, below in pairwise(lines) if line[:5] == "head "}
    for name, R, expected in zip(told, turned * 2, ("0.5 1.25 9", "2.5 0.75 11", "3.125 6.5 0.25")):
        quaternion, below = told[name]
        shown = Rotation.from_quat([float(x) for x in quaternion.split()[2:]])
        np.testing.assert_allclose(shown.as_matrix(), R.as_matrix(), atol=1e-8)
        assert below.startswith("  1 sigma, arcsec")
        assert [float(x) for x in below[26:].split()] == [float(x) for x in expected.split()]
    assert list(told) == ["port", "zenith", "star"]


@pytest.mark.parametrize(
    ("effect_arcsec", "unit", "words"),
    [
        ((0.25, -2.75, 1.0), "ms", "1 ms: 2.8″ Y"),
        ((-4.0, 3.0, 1.0), "px", "1 px: 4″ X"),
        ((3.0, 1.0, -104.4), "px", "1 px: 104″ Z"),
        ((0.5, 0.0, 0.0), "times", "all of it: 0.5″ X"),
        ((5.5, -2.75, 9.0), "ms", "1 ms: 5.5″ X, 9″ Z"),
    ],
)
def test_a_blind_spot_is_told_by_the_axis_that_it_moves_most_and_by_all_above_1_sigma(
    effect_arcsec, unit, words
):
    spot = {"effect_rad": [one * ARCSEC for one in effect_arcsec], "unit": unit}
    assert unit_effect(spot, np.array([4.5, 3.5, 8.0]) * ARCSEC) == words


def test_a_blind_spot_without_effect_is_not_printed() -> None:
    spots = [
        {"cause": cause, "effect_rad": [0.0, one * ARCSEC, 0.0], "unit": "px", "is_unseen": True}
        for cause, one in (("place of the CCDs, along the track", 2.5), ("velocity of the orbit", 0.0))
    ]
    (line,) = blind_lines(spots, np.full(3, ARCSEC))
    assert line.split() == ["cannot", "show", "place", "of", "the", "CCDs", "(1", "px:", "2.5″", "Y)"]


def test_stars_of_scans_are_not_called_targets() -> None:
    nan = np.nan
    seen = {"targets": [[6e5, nan]], "stars": [[nan, nan], []], "targets and stars": [[nan], [5e5]]}
    for words, ranges_m in seen.items():
        strips = [SimpleNamespace(ground=SimpleNamespace(range_m=np.array(one))) for one in ranges_m]
        assert summary._seen(SimpleNamespace(n_targets=7), strips) == f"7 {words}"


def test_error_that_comes_back_is_told_harmonic_by_harmonic_in_seconds_of_arc_each_beside_its_sigma() -> None:
    told = 0.25 * np.arange(24.0).reshape(2, 4, 3)  # harmonic, row, axis; arc-seconds
    names = ("cosine_rad", "sigma_cosine_rad", "sine_rad", "sigma_sine_rad")
    rad = np.radians(told / 3600.0).swapaxes(0, 1)
    wave = SimpleNamespace(head="port", period_s=5918.25, **dict(zip(names, rad)))
    rows = calibration_summary(calibration(periodic=(wave,))).splitlines()[-9:-1]
    assert [row[:26].strip() for row in rows[::2]] == ["cosine 1", "sine 1", "cosine 2", "sine 2"]
    np.testing.assert_array_equal(np.array([row[26:].split() for row in rows], dtype=float), np.vstack(told))


def test_matrix_that_did_not_converge_is_not_to_be_used() -> None:
    assert "do not use this matrix" in calibration_summary(calibration(converged_covariance=False))
    assert "do not use" not in calibration_summary(calibration())


def target(name: str) -> Subject:
    return Subject(Kind.TARGET, strip="s1", id=name)


def test_targets_that_the_data_do_not_tell_apart_are_named() -> None:
    doubtful = SimpleNamespace(doubtful=((target("t3"), target("t9")),))
    text = calibration_summary(calibration(targets=doubtful))
    assert "one target in doubt       s1/t3 or s1/t9 is wrong; the data do not tell which" in text
    assert "doubt" not in calibration_summary(calibration())


def test_what_is_not_used_is_counted_by_cause_and_named() -> None:
    found, star = calibration(), Subject(Kind.STAR, exposure="e4", id="71683")
    unreadable = "e9.png: file: found no such file, expected an image"
    found.omissions = (
        Entry(target("t3"), Reason.TARGET_RESIDUAL, value=26.0, limit=13.8),
        Entry(star, Reason.STAR_RESIDUAL, value=30.0, limit=13.8, more=(20.0, 21.0)),
        Entry(target("t7"), Reason.LOW_CORRELATION, value=0.31, limit=0.6),
        Entry(Subject(Kind.EXPOSURE, exposure="e9"), Reason.UNREADABLE, unreadable, "e9.png"),
    )
    text = calibration_summary(found)
    assert "not used                  1 exposure: 1 file not usable" in text
    assert "1 star: 1 large residual" in text
    assert "2 targets: 1 gross error (5.1 sigma), 1 cloud or change" in text
    assert "  exposure e9: e9.png: file: found no such file, expected an image" in text
    assert "  target s1/t3: 5.1 sigma from the position that the other targets predict" in text


def test_refuting_checks_are_named_the_least_likely_first_with_what_to_look_at() -> None:
    alike = {"statistic": 3745.25, "expected": 2130, "look_at": ["the orbit", "the clocks"]}

    def check(kind: str, p_value: float, holds: bool, names: tuple = ()) -> dict[str, Any]:
        given = {"kind": kind, "p_value": p_value, "holds": holds, "fails": not holds, "names": names}
        return given | alike | {"is_caution": False}

    targets, stars = check("residuals of targets", 1e-9, False), check("residuals of stars", 0.5, True)
    equal = check("equal coordinates of targets", 0.0, False, (("t1", "t2"), ("t5", "t6", "t7")))
    lines = verdict_lines({"sentence": "refuted by two checks", "checks": [targets, stars, equal]})
    assert lines[0].split() == "verdict refuted by two checks".split()
    assert lines[1].startswith("  equal coordinates of targets: 3745.25, expected 2130")
    assert lines[2].strip() == "t1 = t2, t5 = t6 = t7"
    assert lines[3].strip() == "look at: the orbit; the clocks"
    assert lines[4] == "  residuals of targets: 3745.25, expected 2130 (p 1.0e-09)"


def points(along_m: list[float], across_m: list[float]) -> CheckPoints:
    ids = np.array([f"p{k}" for k in range(len(along_m))])
    other = dict.fromkeys(("lat_deg", "lon_deg", "up_m", "east_m", "north_m"), np.full(len(ids), 99.0))
    track = {"along_m": np.array(along_m), "across_m": np.array(across_m)}
    return CheckPoints(strip_id=ids, point_id=ids, **track, **other)


def test_errors_before_and_after_are_told_with_their_units_in_their_places() -> None:
    arcsec = {"error_rad": [0.5, -1.5, 6.0], "sigma_rad": [0.25, 1.0, 4.0]}
    arcsec |= {"before_rad": [-600.0, 1200.0, 3000.0]}
    ground = {"after": points([3.0, -4.0], [1.0, 7.0]), "before": points([300.0, -400.0], [100.0, 700.0])}
    angles = {name: np.array(values) * ARCSEC for name, values in arcsec.items()}
    errors = TruthErrors(nees=4.25, predicted=(), without=3, **angles, **ground)
    lines = summary.validation_summary(errors).splitlines()
    rows = {line[:26].strip(): [float(cell) for cell in line[26:].split()] for line in lines[1:6]}
    assert rows["before, arcsec"] == [-600.0, 1200.0, 3000.0]
    assert rows["after, arcsec"] == [0.5, -1.5, 6.0]
    assert rows["stated 1 sigma, arcsec"] == [0.25, 1.0, 4.0]
    assert rows["after, in sigmas"] == [2.0, -1.5, 1.5]
    assert rows["NEES (3 is expected)"] == [4.25]
    assert "2 check points" in lines[6] and lines[6].split()[-2:] == ["along", "across"]
    ground = {line.split()[0]: [float(cell) for cell in line.split()[1:]] for line in lines[7:9]}
    assert ground["after"] == pytest.approx([12.5**0.5, 5.0], abs=0.005)  # rms, two decimals
    assert ground["before"] == pytest.approx([125_000.0**0.5, 500.0], abs=0.005)
    assert lines[9].startswith("no position for 3 check points")
