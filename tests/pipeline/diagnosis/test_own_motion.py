"""Attitudes that contradict their own motion are named; sound ones and manoeuvres are left alone."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.constants import ARCSEC
from boresight.geometry.gyro import GyroNoise, GyroRecord
from boresight.geometry.sightings import exposure_without_stars, solved_attitudes
from boresight.pipeline.diagnosis.own_motion import _common_step, _off, against_own_motion
from boresight.pipeline.files.star_side import SolvedAttitudes
from boresight.pipeline.stages.head import HeadSightings
from boresight.records.ledger import Kind, Subject

N, STEP_S = 26, 2.4
TIMES_S = 311.0 + STEP_S * np.arange(N)
NAMES = [f"x{k:02d}" for k in range(N)]
ORBIT = SimpleNamespace(R_oi=lambda t_s: Rotation.from_rotvec(np.outer(t_s, [2e-4, -1.0e-3, 3e-4])))
MOUNTED = {
    "R_cs0": Rotation.identity(),
    "sigma_installation_rad": 0.0,
    "times_in": ("exposures.csv", "utc_mid"),
}
HEAD = SimpleNamespace(name="STR7", source=None, noise=None, noise_is_assumed=False, gyro=None, **MOUNTED)
MOUNTING = Rotation.from_euler("xyz", [-35.0, 70.0, 115.0], degrees=True)


def attitudes(seed: int, sigma_arcsec: float = 4.0, turn_s: float | None = None) -> Rotation:
    """R_si of a camera that turns at a steady rate in the orbital frame, or begins to turn at an instant."""
    rng = np.random.default_rng(seed)
    rate = np.array([4e-4, -7e-4, 2e-4])
    turned = np.maximum(TIMES_S - turn_s, 0.0) if turn_s is not None else TIMES_S
    noise = Rotation.from_rotvec(sigma_arcsec * ARCSEC * rng.normal(size=(N, 3)))
    return noise * MOUNTING * Rotation.from_rotvec(np.outer(turned, rate)) * ORBIT.R_oi(TIMES_S)


def findings(R_si: Rotation, usable: np.ndarray | None = None, sigma_rad: float = 4.0 * ARCSEC, beside=None):
    stars = tuple(exposure_without_stars(name, t) for name, t in zip(NAMES, TIMES_S.tolist()))
    solved = solved_attitudes(R_si, np.tile(sigma_rad**2 * np.eye(3), (N, 1, 1)))
    if usable is not None:
        solved = replace(solved, usable=usable)
    heads = [HeadSightings(head=HEAD, stars=stars, attitudes=solved, omissions=())]
    if beside is not None:  # attitudes of a second head
        other = SimpleNamespace(**vars(HEAD) | {"name": "STR8"})
        heads.append(replace(heads[0], head=other, attitudes=solved_attitudes(beside, solved.covariance_s)))
    return against_own_motion(heads)


def in_place(**files: int) -> np.ndarray:
    """Which exposure's file each row has: its own, but for some."""
    order = np.arange(N)
    for name, other in files.items():
        order[NAMES.index(name)] = other
    return order


@pytest.mark.parametrize(
    ("order", "items"),
    [
        (in_place(x03=8, x08=3), ["exposures x03 and x08"]),
        (in_place(x05=6, x06=5), ["exposures x05 and x06"]),
        (in_place(x02=4, x04=2), ["exposures x02 and x04"]),
        (in_place(x02=5, x05=2, x18=21, x21=18), ["exposures x02 and x05", "exposures x18 and x21"]),
        (in_place(x03=7, x07=20, x20=3), ["exposures x03, x07 and x20"]),
        (np.roll(np.arange(N), 1), ["exposure x00"]),  # all late by one: the first comes from elsewhere
    ],
)
def test_exposures_in_each_others_place_are_named(order, items):
    told = findings(attitudes(len(items))[order])
    assert sorted(one.item for one in told) == items
    assert {(one.file, one.field) for one in told} == {("exposures.csv", "file")}


@pytest.mark.parametrize(("draws", "turn_s"), [(200, None), (50, TIMES_S[6] + 0.3)])  # or a manoeuvre
def test_exposures_in_order_have_no_finding(draws, turn_s):
    assert [findings(attitudes(seed, turn_s=turn_s)) for seed in range(draws)] == [[]] * draws


@pytest.mark.parametrize("wrong", [0, 24])
def test_one_wrong_attitude_is_named_alone(wrong):
    R_si = attitudes(1).as_matrix()
    R_si[wrong] = R_si[wrong] @ Rotation.from_rotvec([0.01, 0.02, -0.01]).as_matrix()
    (told,) = findings(Rotation.from_matrix(R_si))
    assert told.item == f"exposure {NAMES[wrong]}"
    assert told.text.startswith("off the motion")
    sound = attitudes(2)
    R_si[wrong] = R_si[wrong] @ Rotation.from_rotvec([0.6, 1.2, -0.6]).as_matrix()
    (told,) = findings(Rotation.from_matrix(R_si), beside=sound)  # by 84°; all other rows fit both heads
    assert told.item == f"exposure {NAMES[wrong]}"
    assert findings(Rotation.from_matrix(R_si), beside=Rotation.from_rotvec([0.6, 1.2, -0.6]) * sound) == []


@pytest.mark.parametrize("seed", range(20))
def test_exposures_without_order_are_told_together(seed):
    (told,) = findings(attitudes(seed)[np.random.default_rng(seed).permutation(N)])
    assert (told.cause, told.item) == ("times of exposures", "all exposures")
    assert told.refutes


def test_an_attitude_of_few_stars_may_be_further_off():
    R_si = attitudes(1).as_matrix()
    R_si[6] = R_si[6] @ Rotation.from_rotvec([0.0, 120.0 * ARCSEC, 0.0]).as_matrix()
    assert findings(Rotation.from_matrix(R_si))
    assert findings(Rotation.from_matrix(R_si), sigma_rad=15.0 * ARCSEC) == []


def test_exposures_without_attitude_are_passed_over():
    (told,) = findings(attitudes(2)[in_place(x03=9, x09=3)], np.arange(N) != 5)
    assert told.item == "exposures x03 and x09"


# --- Attitudes that a head solved itself

RATES_DEG_S = {"ground": 0.061, "scan": 0.38}
NOISE = AttitudeNoise(
    white_rad=np.array([1.0, 1.0, 8.0]) * ARCSEC,
    correlated_rad=np.array([0.5, 0.7, 4.0]) * ARCSEC,
    correlation_time_s=np.array([0.8, 0.8, 0.8]),
    constant_rad=np.array([0.3, 0.3, 2.0]) * ARCSEC,
    R_sn=Rotation.from_euler("zyx", [20.0, -130.0, 65.0], degrees=True),
)
ROWS = SolvedAttitudes(rows=None, file="STR7.csv", aberration_removed="none", line_of_sight_s=np.eye(3)[2])


GYRO = GyroNoise(
    random_walk_rad=0.02 * ARCSEC, bias_walk_rad_s=1e-3 * ARCSEC, bias_rad_s=1e-3, white_rad=0.001 * ARCSEC
)


def gyro_of(true, t_s, rng) -> GyroRecord:
    """A gyro that has a bias and a random walk, from before the first of instants to after the last."""
    at = np.arange(t_s[0] - 2.0, t_s[-1] + 2.0, 0.05)
    steps = GYRO.random_walk_rad * np.sqrt(0.05) * rng.normal(size=(len(at), 3)) + 0.05 * 2e-6
    R_si = true(at)
    return GyroRecord(
        t_s=at, R_sz=Rotation.from_rotvec(np.cumsum(steps, axis=0)) * R_si * R_si[0].inv(), noise=GYRO
    )


def record_of(
    seed, rate, *, strips=3, rows=14, late_s=0.0, scatter=1.0, step_s=0.2, wobble=(40.0, 1.7), with_gyro=False
):
    """Attitudes of strips with errors of NOISE: a rotation about any axis 50 to 85 degrees from the line
    of sight, about which a head is eight times worse, and a slow oscillation `wobble` (arcsec, s) on top.
    `late_s` (K,) is by how much later than stated each attitude was taken.
    """
    rng = np.random.default_rng(seed)
    t_s = np.concatenate([40.0 * n + step_s * np.arange(rows) for n in range(strips)])
    oblique = Rotation.from_euler("zy", rng.uniform([0.0, 0.9], [6.2, 1.5]))
    axis = NOISE.R_sn.apply(oblique.apply([0.0, 0.0, 1.0]))
    phase, size = rng.uniform(0.0, 6.0), wobble[0] * ARCSEC * rng.normal(size=3)

    def true(at):
        slow = np.outer(np.sin(at / wobble[1] + phase), size)
        steady = Rotation.from_rotvec(np.outer(at, np.radians(rate) * axis))
        return Rotation.from_rotvec(slow) * steady * MOUNTING

    R_si = true(t_s + np.broadcast_to(late_s, t_s.shape))
    full = NOISE.coloured_covariance_s(t_s)
    full[np.arange(len(t_s)), :, np.arange(len(t_s)), :] += scatter**2 * NOISE.white_covariance_s
    drawn = rng.multivariate_normal(np.zeros(3 * len(t_s)), full.reshape(3 * len(t_s), -1)).reshape(-1, 3)
    stars = tuple(exposure_without_stars(f"STR7-{k:06d}", t) for k, t in enumerate(t_s.tolist()))
    subject = Subject(Kind.HEAD, head="STR7")
    gyro = gyro_of(true, t_s, rng) if with_gyro else None
    own = {"source": ROWS, "noise": NOISE, "subject": subject, "gyro": gyro, "times_in": (ROWS.file, "utc")}
    head = SimpleNamespace(**{**vars(HEAD), **own})
    white = np.tile(NOISE.white_covariance_s, (len(t_s), 1, 1))
    solved = solved_attitudes(Rotation.from_rotvec(drawn) * R_si, white)
    return HeadSightings(head=head, stars=stars, attitudes=solved, omissions=())


@pytest.mark.parametrize("rate", RATES_DEG_S.values(), ids=RATES_DEG_S)
@pytest.mark.parametrize("seed", range(20))
def test_every_second_row_that_is_dated_early_is_named_with_its_size(seed, rate):
    (told,) = against_own_motion([record_of(seed, rate, late_s=0.05 * (np.arange(42) % 2))])
    assert (told.cause, told.item, told.file) == ("times of attitudes", "head STR7", "STR7.csv")
    assert told.refutes and told.text.startswith("every second one is dated")
    assert told.value == pytest.approx(50.0, abs=4.0 * told.sigma) and told.sigma < 3.0


def test_sound_attitudes_of_a_moving_satellite_have_no_finding():
    """Of 120; one of 500 would be 0.2 %."""
    told = [
        against_own_motion([record_of(seed, rate, rows=rows, step_s=step_s)])
        for seed in range(30)
        for rate, rows, step_s in ((0.061, 14, 0.2), (0.38, 12, 0.4), (0.061, 40, 0.1), (0.0, 6, 0.5))
    ]
    assert told == [[]] * 120


@pytest.mark.parametrize("seed", range(10))
def test_rows_that_scatter_more_than_stated_are_told_as_noise_or_as_both(seed):
    (told,) = against_own_motion([record_of(seed, 0.061, scatter=3.0, rows=20)])
    assert "errors of attitudes" in (told.cause, *(one.partition(",")[0] for one in told.rivals))
    assert told.refutes


@pytest.mark.parametrize("seed", range(10))
def test_instants_cut_to_a_coarse_unit_are_times(seed):
    t_s = np.concatenate([40.0 * n + 0.2 * np.arange(20) for n in range(3)])
    (told,) = against_own_motion([record_of(seed, 0.061, rows=20, late_s=t_s - np.floor(8.0 * t_s) / 8.0)])
    assert told.cause == "times of attitudes" and told.refutes


@pytest.mark.parametrize("seed", range(5))
def test_what_is_told_does_not_depend_on_axes_or_on_the_origin_of_time(seed):
    record = record_of(seed, 0.061, late_s=0.03 * (np.arange(42) % 3 == 0))
    turned = Rotation.random(random_state=seed)
    own, later = record.attitudes, restated(record, np.array([one.t_s + 1234.5 for one in record.stars]))
    moved = replace(later, attitudes=replace(own, R_si=own.R_si @ turned.as_matrix()))
    (told,), (again,) = against_own_motion([record]), against_own_motion([moved])
    assert (told.cause, told.text) == (again.cause, again.text)
    assert told.value == pytest.approx(again.value, rel=1e-6)  # of instants that are rounded to 1e-13 s


def restated(record, t_s):
    stars = tuple(exposure_without_stars(one.exposure_id, t) for one, t in zip(record.stars, t_s.tolist()))
    return replace(record, stars=stars)


@pytest.mark.parametrize("rate", [0.061, 0.38, 0.82])
@pytest.mark.parametrize("step_s", [0.15, 0.4])
def test_even_instants_that_are_cut_or_early_are_named_in_a_single_strip(step_s, rate):
    """Twelve rows, which a free motion follows: with evenly spaced instants there is none."""
    t_s = step_s * np.arange(12)
    cut, early = np.floor(8.0 * t_s) / 8.0 + 0.05, t_s - 0.05 * (np.arange(12) % 3 == 0)
    for stated in (cut, early):
        (told,) = against_own_motion([restated(record_of(1, rate, strips=1, rows=12, step_s=step_s), stated)])
        assert told.cause == "times of attitudes" and told.refutes
        assert ("multiples of 0.125 s" in told.text) == (stated is cut)
    # Half to twice the scatter of instants that are cut by chance, a step over the root of twelve.
    for ratio, step in ((0.48, 0.0), (0.52, 0.125), (1.9, 0.125), (2.1, 0.0)):
        assert _common_step(cut, 0.125 / np.sqrt(12.0) / ratio) == pytest.approx(step, abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_a_single_row_dated_early_is_named_singly(seed):
    t_s = 0.2 * np.arange(20)
    record = restated(record_of(seed, 0.38, strips=1, rows=20), t_s - 0.05 * (np.arange(20) == 7))
    (told,) = against_own_motion([record])
    assert told.item == "exposure STR7-000007"
    some = record_of(1, 0.061, strips=1, rows=20, late_s=0.1 * np.isin(np.arange(20), range(3, 14, 2)))
    assert against_own_motion([some])[0].text.startswith("6 of 20 are dated")  # not every second one
    turn = np.array([0.0, 0.1, 0.3, 0.4])  # of a steady motion, of which the last row is 0.3 rad late
    steady = SimpleNamespace(
        t_s=np.array([0.0, 1.0, 3.0, 7.0]), R_si=Rotation.from_rotvec(np.outer(turn, [0, 1, 0]))
    )
    assert [_off(steady, n, np.arange(4)) for n in (0, 1, 2)] == pytest.approx([0.0, 0.0, 0.1])


@pytest.mark.parametrize("rate", RATES_DEG_S.values(), ids=RATES_DEG_S)
@pytest.mark.parametrize("rows", [1, -1, 2])
def test_attitudes_that_stand_rows_from_their_times_are_named_with_the_rows(rate, rows):
    """Those of later rows stand early; what has no attitude then is cut off."""
    sound = record_of(1, rate)
    of = np.arange(42 - abs(rows)) + max(rows, 0)
    stars = tuple(exposure_without_stars(f"STR7-{k:06d}", sound.stars[k - rows].t_s) for k in of.tolist())
    R_si, covariance_s = sound.attitudes.R_si[of], sound.attitudes.covariance_s[of]
    shifted = solved_attitudes(Rotation.from_matrix(R_si), covariance_s)
    (told,) = against_own_motion([replace(sound, stars=stars, attitudes=shifted)])
    assert (told.cause, told.item, told.value) == ("times of attitudes", "head STR7", -rows)
    words = f"{abs(rows)} row{'s' * (abs(rows) > 1)} {'early' if rows > 0 else 'late'}"
    assert told.refutes and words in told.text


def test_exposures_that_were_uneven_have_no_finding():
    for seed in range(20):
        late = np.random.default_rng(seed).uniform(0.0, 0.05, 12)
        record = record_of(seed, 0.38, strips=1, rows=12, late_s=late)
        assert against_own_motion([restated(record, 0.2 * np.arange(12) + late)]) == []


# --- With a gyro

FAST = {"wobble": (90.0, 0.3), "rows": 20, "with_gyro": True}  # period of 1.9 s


@pytest.mark.parametrize("late_s", [-0.05, 0.05])
@pytest.mark.parametrize("seed", range(5))
def test_attitudes_that_lag_behind_the_gyro_are_named_with_their_lag(seed, late_s):
    (told,) = against_own_motion([record_of(seed, 0.061, late_s=late_s, **FAST)])
    assert (told.cause, told.item, told.file) == ("times of attitudes", "head STR7", "STR7.csv")
    assert told.value == pytest.approx(-1e3 * late_s, abs=5.0) and told.refutes


@pytest.mark.parametrize("late_s", [-0.05, 0.08])
def test_a_gyro_from_which_two_heads_differ_alike_is_dated_late_or_early_by_as_much(late_s):
    one = record_of(1, 0.061, **FAST)
    gyro = replace(one.head.gyro, t_s=one.head.gyro.t_s + late_s)
    own = vars(one.head) | {"gyro": gyro}
    heads = [replace(one, head=SimpleNamespace(**own | {"name": name})) for name in ("STR7", "STR8")]
    (told,) = against_own_motion(heads)
    assert (told.cause, told.field, told.unit) == ("times of a gyro", "gyro.file", "ms")
    assert told.value == pytest.approx(1e3 * late_s, abs=3.0)  # ms: 6 sigma of 60 rows of 1.2″ at 200″/s
    assert f" ms {'late' if late_s > 0.0 else 'early'} against all heads" in told.text


def test_sound_attitudes_beside_a_gyro_have_no_finding():
    found = [against_own_motion([record_of(seed, 0.061, **FAST | {"rows": 8})]) for seed in range(30)]
    assert found == [[]] * 30


@pytest.mark.parametrize("seed", range(5))
def test_a_gyro_about_other_axes_is_named(seed):
    sound = record_of(seed, 0.061, **FAST)
    gyro = sound.head.gyro.in_axes(Rotation.from_euler("x", 90.0, degrees=True))
    wrong = replace(sound, head=SimpleNamespace(**{**vars(sound.head), "gyro": gyro}))
    (told,) = against_own_motion([wrong])
    assert (told.cause, told.field) == ("a gyro", "gyro.quaternion_sg")


@pytest.mark.parametrize("seed", range(5))
def test_beside_a_gyro_rows_that_scatter_are_told_of_the_head(seed):
    (told,) = against_own_motion([record_of(seed, 0.061, scatter=3.0, **FAST | {"rows": 7})])
    assert told.item == "head STR7" and told.refutes
