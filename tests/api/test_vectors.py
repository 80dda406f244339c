"""`calibrate_vectors`: wrong inputs are named, wrong vectors do no harm, the result says how good it is."""

import numpy as np
import pandas as pd
import pytest
from recorded_numbers import assert_recorded, columns_of
from scipy.spatial.transform import Rotation
from wrong_vectors import R_TRUE, Given, drawn_vectors, nees_of

import boresight as bs

MOST_SIGMAS = 4.0  # of each axis: one in 5000 sets of correct errors exceeds it


def drawn(seed: int, **wrong: int) -> Given:
    return drawn_vectors(np.random.default_rng(seed), frames=1 + 3 * (seed % 2), **wrong)


def assert_right_or_refuted(given: Given) -> None:
    try:
        found = bs.calibrate_vectors(*given)
    except bs.DataNotSufficientError:
        return
    error = (found.R_cs * R_TRUE.inv()).as_rotvec() / np.sqrt(np.diag(found.cov_theta))
    assert found.verdict in ("refuted", "not checkable") or np.abs(error).max() < MOST_SIGMAS


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("kind", ["stars", "targets"])
@pytest.mark.parametrize("n", [1, 3])
def test_wrong_vectors_are_rejected_or_refute(seed: int, kind: str, n: int) -> None:
    assert_right_or_refuted(drawn(seed, **{kind: n}))


@pytest.mark.parametrize("seed", [5, 6])
def test_vectors_that_are_all_random_are_refused(seed: int) -> None:
    with pytest.raises(bs.DataNotSufficientError, match="frames have no attitude"):
        bs.calibrate_vectors(*drawn_vectors(np.random.default_rng(seed), all_random=True))


@pytest.mark.parametrize("seed", [7, 8, 9])
def test_targets_that_are_all_random_refute_or_are_refused(seed: int) -> None:
    given = drawn(seed)
    rng = np.random.default_rng(100 + seed)
    shuffled = [v[rng.permutation(len(v))] for v in given.v_targets]
    try:
        found = bs.calibrate_vectors(*given._replace(v_targets=shuffled))
    except bs.DataNotSufficientError:
        return
    assert found.verdict == "refuted"


def test_the_result_states_fit_verdict_checks_and_blind_spots() -> None:
    found = bs.calibrate_vectors(*drawn(9))
    assert found.verdict == "consistent"
    assert found.dof == 2 * found.residuals()["kept"].sum() - 3
    assert 0.001 < found.p_value < 0.999
    assert found.checks["holds"].all()
    assert found.checks["kind"].tolist()[:2] == ["residuals of stars", "residuals of targets"]
    unseen = found.blind_spots[found.blind_spots["is_unseen"]]
    assert any(cause.startswith("origin of the look vectors") for cause in unseen["cause"])
    assert len(found.residuals()) == len(found.residuals("stars")) == 80
    with pytest.raises(ValueError, match="of: found 'suns'"):
        found.residuals("suns")  # type: ignore[arg-type]


def test_a_wrong_focal_length_of_the_star_camera_is_named() -> None:
    given = drawn(11)
    stretched = [v * [1.0002, 1.0002, 1.0] for v in given.u_s]
    wrong = given._replace(u_s=[v / np.linalg.norm(v, axis=1, keepdims=True) for v in stretched])
    found = bs.calibrate_vectors(*wrong)
    assert found.verdict == "refuted"
    assert found.findings["cause"].iloc[0] == "focal length of the star camera"
    tables = {"findings ": found.findings, "checks ": found.checks, "blind ": found.blind_spots}
    assert_recorded(
        "vectors", {k: v for name, one in tables.items() for k, v in columns_of(one, name).items()}
    )


def with_nan(v: np.ndarray) -> np.ndarray:
    v = v.copy()
    v[3, 1] = np.nan
    return v


@pytest.mark.parametrize(
    "name, change, message",
    [
        ("u_s", lambda v: v * 1.01, r"u_s, row \d+: found a vector of length 1\.01, expected unit vectors"),
        ("w_c", lambda v: v * 5.0, r"w_c, row \d+: found a vector of length 5"),
        ("v_stars", lambda v: v * (1 + 2e-6), r"v_stars, row \d+: found a vector of length 1\.000002"),
        ("v_targets", with_nan, r"v_targets, row 3: found .*nan.*, expected finite numbers"),
        ("sigma_s", lambda s: -s, "sigma_s: found -8e-06, expected 1-sigma errors above 0"),
        ("sigma_c", lambda s: 0.0, "sigma_c: found 0.0, expected"),
        ("sigma_c", lambda s: np.nan, "sigma_c: found nan, expected"),
        (
            "sigma_s",
            lambda s: [1e-5] * 19,
            r"sigma_s: found shape \(19,\), expected a number or shape \(20,\)",
        ),
        ("v_stars", lambda v: v[:-1], "v_stars: found 19 vectors, expected 20, one for each of u_s"),
        ("u_s", lambda v: v[:, :2], r"u_s: found shape \(20, 2\), expected \(N, 3\)"),
        ("u_s", lambda v: "stars", "u_s: found 'stars', expected vectors"),
        ("u_s", lambda v: np.ma.masked_greater(v, 0.5), r"u_s.*: found an array with masked values"),
        ("u_s", lambda v: 1j * v, "u_s: found an array of shape .* and type complex128"),
        ("w_c", lambda v: [*v.tolist()[:-1], ["a", "b", "c"]], r"w_c.*expected numbers of shape \(N, 3\)"),
        ("u_s", lambda v: np.vstack([v[:-1], v[:1]]), "u_s, rows 0 and 19 of frame 0: found .*equal vectors"),
        ("R_cs0", lambda R: R.as_matrix() * 1.1, "R_cs0: found .*off the identity"),
        ("R_cs0", lambda R: -R.as_matrix(), r"R_cs0: found .*determinant -1"),
        ("R_cs0", lambda R: np.eye(2), r"R_cs0: found an array of shape \(2, 2\)"),
        ("R_cs0", lambda R: R.inv(), "R_cs0 takes c to s: give its inverse"),
        ("v_targets", lambda v: -v, "give -v_targets"),
    ],
)
def test_a_wrong_argument_is_named_with_what_was_found(name: str, change, message: str) -> None:
    given = drawn_vectors(np.random.default_rng(13))
    flat = given._replace(
        u_s=given.u_s[0], v_stars=given.v_stars[0], w_c=given.w_c[0], v_targets=given.v_targets[0]
    )
    with pytest.raises(ValueError, match=message) as caught:
        bs.calibrate_vectors(*flat._replace(**{name: change(getattr(flat, name))}))
    assert "\n" not in str(caught.value)


def test_lengths_that_the_noise_explains_are_accepted() -> None:
    given = drawn(14)
    rng = np.random.default_rng(15)
    noisy = [v + rng.normal(0.0, 8e-6, v.shape) for v in given.u_s]  # not made unit vectors again
    assert bs.calibrate_vectors(*given._replace(u_s=noisy, sigma_s=1.2e-5)).verdict == "consistent"


def test_too_few_vectors_are_refused_with_the_reason() -> None:
    given = drawn(16)
    few = [part[0][:2] for part in (given.u_s, given.v_stars)]
    with pytest.raises(bs.DataNotSufficientError, match="3 are needed"):
        bs.calibrate_vectors(*few, 8e-6, given.w_c[0], given.v_targets[0], 1.5e-6, R_TRUE)
    one = [part[0][:1] for part in (given.w_c, given.v_targets)]
    with pytest.raises(bs.DataNotSufficientError, match="not observable"):
        bs.calibrate_vectors(given.u_s[0], given.v_stars[0], 8e-6, *one, 1.5e-6, R_TRUE)
    two = [part[0][:2] for part in (given.w_c, given.v_targets)]
    found = bs.calibrate_vectors(given.u_s[0], given.v_stars[0], 8e-6, *two, 1.5e-6, R_TRUE)
    assert found.verdict == "not checkable"


def test_a_start_tens_of_degrees_off_is_refused_and_ten_is_no_obstacle() -> None:
    given = drawn(17)
    ten = Rotation.from_rotvec(np.radians(10.0) * np.array([0.6, 0.0, 0.8])) * R_TRUE
    found = bs.calibrate_vectors(*given._replace(R_cs0=ten))
    assert nees_of(found.R_cs, found.cov_theta) < 22.0  # chi-square, 3 degrees of freedom, 1 in 10 000
    with pytest.raises(ValueError, match="half of them"):
        bs.calibrate_vectors(*given._replace(R_cs0=Rotation.from_euler("x", 60, degrees=True) * R_TRUE))


@pytest.mark.parametrize("change", ["an upper half alone", "one side", "NaN", "the wrong sign"])
@pytest.mark.parametrize("name", ["sigma_s", "sigma_c", "sigma_R_cs0_rad"])
def test_a_covariance_of_any_size_is_symmetric_or_refused(name: str, change: str) -> None:
    given = drawn_vectors(np.random.default_rng(8))
    cov = np.diag([1.0, 2.0, 3.0]) * 1e-11 + 2e-12
    broken = {
        "an upper half alone": np.triu(cov),
        "one side": cov + np.array([[0.0, 0.0, 1e-12], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]),
        "NaN": np.where(np.eye(3)[::-1] > 0.0, np.nan, cov),
        "the wrong sign": -cov,
    }[change]
    for matrix, refused in ((cov, False), (cov.astype(np.float32), False), (broken, True)):
        value = 1e6 * matrix if name == "sigma_R_cs0_rad" else [np.broadcast_to(matrix, (20, 3, 3))]
        named = given._asdict() | {name: value}
        if refused:
            with pytest.raises(ValueError, match=f"^{name}( of frame 0)?: found"):
                bs.calibrate_vectors(**named)
        else:
            assert bs.calibrate_vectors(**named).dof > 30


@pytest.mark.parametrize("missing", [None, np.nan, pd.NaT, pd.NA])
def test_a_label_of_an_instant_is_not_missing(missing: object) -> None:
    given = drawn_vectors(np.random.default_rng(8), frames=3)
    with pytest.raises(ValueError, match=r"^instants: found .*, expected 3 labels, one for each frame"):
        bs.calibrate_vectors(*given, instants=["a", missing, missing])
