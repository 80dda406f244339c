"""`boresight noise` and `boresight heads`: numbers printed, written and drawn against the drawn errors, or
against the closed form of the noise that is printed.

A record of two trackers 0.1 s apart in step with noise unequal in all axes; the second is turned against what
is stated and its clock is late, which shows as the satellite slews.
"""

import json
import shutil
import tomllib
from collections.abc import Callable

import numpy as np
import pytest
from command_line import ran
from drawn_campaigns import squared
from drawn_pictures import kept_figures, numbers
from handmade_sentinel2 import POINT, write_sentinel2
from recorded_numbers import assert_recorded, flat, numbers_by_line
from scipy.linalg import toeplitz
from scipy.signal import freqz, lfilter, periodogram
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.features.heads import head_files
from boresight.features.operators.imported_mission import write_imported
from boresight.features.operators.sentinel2_import import sentinel2_mission
from boresight.features.operators.sentinel2_product import read_sentinel2
from boresight.pipeline.files.dump import open_dump

ARCSEC = np.pi / 648_000.0
STEP_S = 0.1
LATE_S = 0.004  # of the second tracker's clock
WHITE = np.array([[1.1, 1.6, 9.0], [1.4, 1.0, 12.0]])  # arcsec, per head and axis
CORRELATED = np.array([[0.9, 0.6, 7.0], [0.7, 1.2, 5.0]])
TIME_S = np.array([[0.6, 0.9, 1.3], [1.1, 0.5, 0.8]])
MOVED = Rotation.from_rotvec(np.array([35.0, -20.0, 50.0]) * ARCSEC)  # about the axes of the first
SLEW, SLEWING = np.array([1.2e-4, -1.0e-4, 1.24e-4]), np.array([7e-5, 9e-5, -5e-5])  # rad/s², rad/s³


def drawn_errors(head: int, rows: int, rng: np.random.Generator) -> np.ndarray:
    """White and AR(1) errors (rows, 3), rad, as SciPy's filter makes them."""
    r = np.exp(-STEP_S / TIME_S[head])
    shocks = rng.standard_normal((rows, 3)) * np.sqrt(1.0 - r**2) * CORRELATED[head]
    shocks[0] /= np.sqrt(1.0 - r**2)
    slow = np.column_stack([lfilter([1.0], [1.0, -r[n]], shocks[:, n]) for n in range(3)])
    return ARCSEC * (slow + WHITE[head] * rng.standard_normal((rows, 3)))


@pytest.fixture(scope="module")
def dump(tmp_path_factory):
    root = tmp_path_factory.mktemp("heads")
    datastrip = read_sentinel2(write_sentinel2(root), root, "B04")
    write_imported(root / "dump", sentinel2_mission([datastrip], "by hand"), POINT)
    one, two = open_dump(root / "dump").heads
    rng = np.random.default_rng(5)
    for n, (head, mount) in enumerate(zip((one, two), (None, MOVED * one.R_cs0.inv() * two.R_cs0))):
        path = root / "dump" / f"{head.name}.csv"
        names, *rows = path.read_text().splitlines()
        t = STEP_S * np.arange(len(rows)) - 15.0
        if mount is None:  # the satellite turns evenly, and slews beside that
            even = Rotation.from_quat([row.split(",")[1:] for row in rows]).inv()
            rate = (even[-1] * even[0].inv()).as_rotvec() / (t[-1] - t[0])
        shown = t - n * LATE_S
        slew = Rotation.from_rotvec(np.outer(shown**2 / 2, SLEW) + np.outer(shown**3 / 6, SLEWING))
        R_si = slew * Rotation.from_rotvec(np.outer(shown - t[0], rate)) * even[0]
        R_hi = R_si if mount is None else mount.inv() * R_si
        quaternions = (Rotation.from_rotvec(drawn_errors(n, len(rows), rng)) * R_hi).inv().as_quat()
        new = (",".join(repr(float(v)) for v in q) for q in quaternions)
        path.write_text("\n".join([names, *(f"{row.split(',')[0]},{q}" for row, q in zip(rows, new)), ""]))
    return root / "dump"


def called(*arguments: str) -> tuple[str, dict]:
    """What a command prints, and what it prints for programs."""
    plain, answer = ran(*arguments).output, json.loads(ran(*arguments, "--json").stdout)
    return plain, answer["result"] if "result" in answer else answer


@pytest.fixture(scope="module")
def noise(dump, tmp_path_factory):
    """The printed noise, that for programs, its folder, and the figure."""
    out = tmp_path_factory.mktemp("noise")
    with kept_figures(head_files) as figures:
        text, told = called("noise", str(dump), "--out", str(out))
    return text, told, out, figures[0]


def test_estimated_noise_is_the_drawn_one_within_its_error(noise):
    text, told, *_ = noise
    for n, head in enumerate(told["heads"]):
        assert head["name"] == f"STR{n + 1}"
        sigma = np.array(head["sigma_log"])
        for k, (key, drawn) in enumerate((("white_arcsec", WHITE), ("correlated_arcsec", CORRELATED))):
            off = (np.log(head[key]) - np.log(drawn[n])) / sigma[:, k]
            assert np.all(np.abs(off) < 3.5), (key, off)
            assert np.all(sigma[2, k] < 0.5)
        off = (np.log(head["correlation_time_s"]) - np.log(TIME_S[n])) / sigma[:, 2]
        assert np.all(np.abs(off) < 3.5)
    assert told["white_dof"] == 12 and told["white_statistic"] > chi2(12).isf(1e-6)
    assert_recorded("noise", flat("", told) | numbers_by_line(text), relative=5e-3)  # the search's own end


def test_every_printed_number_is_that_for_programs(noise):
    text, told, out, _ = noise
    rows = [numbers(line) for line in text.splitlines()[1:] if line.startswith("  ")]
    per_head = iter(rows)
    for head in told["heads"]:
        sigma = np.array(head["sigma_log"])
        for k, key in enumerate(("white_arcsec", "correlated_arcsec", "correlation_time_s")):
            values = np.array(head[key])
            printed = np.reshape(next(per_head)[-6:], (3, 2))
            assert np.allclose(printed, np.column_stack([values, values * sigma[:, k]]), atol=0.0051)
        assert np.allclose(next(per_head)[-3:], 100.0 * np.array(head["told_apart"]), atol=0.51)
        constant = next(per_head)
        assert np.allclose(constant[-3:], head["constant_arcsec"], atol=0.0051) and constant[0] == 11.0
        assert np.allclose(next(per_head), head["constant_time_s"], atol=0.51)
    for key in ("scatter_arcsec", "predicted_arcsec", "predicted_white_arcsec"):
        assert np.allclose(next(per_head), told[key], atol=0.00051)
    white = numbers(next(line for line in text.splitlines() if line.startswith("white noise alone: refuted")))
    assert np.allclose(white, [told["white_statistic"], chi2.sf(told["white_statistic"], 12)], rtol=0.05)
    tables = tomllib.loads(
        (out / "noise.toml").read_text().replace("[star", "[[star").replace("e]  #", "e]]  #")
    )
    for head, table in zip(told["heads"], tables["star_cameras"]["noise"], strict=True):
        constants = ("constant_arcsec", "constant_time_s")
        for key in ("white_arcsec", "correlated_arcsec", "correlation_time_s", *constants):
            assert np.allclose(table[key], head[key], rtol=1e-3)
        assert table["origin"] == "estimated"
    assert json.loads((out / "noise.json").read_text())["heads"] == told["heads"]


def both(dump) -> tuple[Rotation, Rotation, Rotation]:
    """Attitudes of both trackers, inertial to tracker, and the true rotation from the second to the first."""
    columns = {"delimiter": ",", "skiprows": 1, "usecols": (1, 2, 3, 4)}
    tables = (np.loadtxt(dump / f"STR{n}.csv", **columns) for n in (1, 2))
    one, two = (Rotation.from_quat(table).inv() for table in tables)
    first, second = open_dump(dump).heads
    return one, two, MOVED * first.R_cs0.inv() * second.R_cs0


@pytest.fixture(scope="module")
def record(dump) -> tuple[np.ndarray, Rotation]:
    """What the second tracker differs by from the first (N, 3), arcsec, about axes of the first, and the true
    rotation to these."""
    one, two, R_sh = both(dump)
    return (R_sh * two * one.inv()).as_rotvec() / ARCSEC, R_sh


def of_axes(told: dict, R_sh: Rotation, of: Callable[[float, float, float], np.ndarray]) -> np.ndarray:
    """Sum (..., 3), axes of the first tracker, of a variance of each tracker's axes by its noise."""
    total = 0.0
    for head, A in zip(told["heads"], (np.eye(3), R_sh.as_matrix())):
        keys = ("white_arcsec", "correlated_arcsec", "correlation_time_s")
        each = np.array([of(*noise) for noise in zip(*(head[key] for key in keys))])  # (3, ...)
        total = total + np.moveaxis(np.tensordot(A**2, each, axes=1), 0, -1)
    return total


def covariance(white: float, correlated: float, time_s: float, n: int) -> np.ndarray:
    """Of n rows, arcsec²."""
    return white**2 * np.eye(n) + correlated**2 * toeplitz(np.exp(-STEP_S * np.arange(n) / time_s))


def test_scatter_of_means_is_that_of_the_records_and_its_prediction_that_of_the_noise(record, noise):
    (_, told, _, figure), (values, R_sh) = noise, record
    means = values[:224].reshape(2, 112, 3).mean(axis=1)  # over the 11.2 s of both detectors' rows
    assert told["n_means"] == 2 and told["mean_s"] == pytest.approx(11.2)
    rtol = 1e-3  # the axes are those of the alignment found, some seconds of arc from the drawn one
    assert np.allclose(told["scatter_arcsec"], means.std(axis=0, ddof=1), rtol=rtol)
    of_mean = of_axes(told, R_sh, lambda *noise: covariance(*noise, 112).mean())
    assert np.allclose(told["predicted_arcsec"], np.sqrt(of_mean), rtol=rtol)
    levels = [line.get_ydata()[0] for line in figure.axes[0].lines[2::3]]  # arcsec² per Hz
    assert np.allclose(told["predicted_white_arcsec"], np.sqrt(np.array(levels) / 11.2), rtol=1e-9)


def test_the_figure_has_the_periodogram_and_the_density_of_the_noise(record, noise):
    (_, told, _, figure), (values, R_sh) = noise, record
    lines = figure.axes[0].lines
    frequency, power = periodogram(values, 1.0 / STEP_S, axis=0)  # one-sided
    used = (frequency > 0.0) & (frequency < 0.5 / STEP_S - 1e-9)
    bins = np.floor(frequency[used] / (0.5 / STEP_S) * 48 + 1e-9).astype(int)
    for n in range(3):
        f, measured = (np.asarray(part) for part in lines[3 * n].get_data())
        assert np.allclose(f, (np.arange(48) + 0.5) / 48 * 5.0)
        mean = np.array([power[used, n][bins == k].mean() / 2.0 for k in range(48)])
        # A frequency on the edge of two bins may fall in either.
        assert np.mean(np.isclose(measured, mean, rtol=1e-2)) > 0.9
        model = lines[3 * n + 1].get_ydata()
        assert np.allclose(model, of_axes(told, R_sh, density(f))[:, n], rtol=1e-3)


def density(frequency: np.ndarray) -> Callable[[float, float, float], np.ndarray]:
    """Two-sided spectral density, arcsec² per Hz, as SciPy gives it for the filter that makes the noise."""

    def of(white: float, correlated: float, time_s: float) -> np.ndarray:
        r = np.exp(-STEP_S / time_s)
        _, response = freqz([np.sqrt(1.0 - r**2)], [1.0, -r], worN=2.0 * np.pi * frequency * STEP_S)
        return STEP_S * (white**2 + correlated**2 * np.abs(response) ** 2)

    return of


def test_the_figure_has_the_allan_deviation_of_record_and_noise(record, noise):
    (_, told, _, figure), (values, R_sh) = noise, record
    lines, levels = figure.axes[1].lines, [line.get_ydata()[0] for line in figure.axes[0].lines[2::3]]
    for n in range(3):
        times, found = (np.asarray(part) for part in lines[3 * n].get_data())
        counts = np.round(times / STEP_S).astype(int)
        for k, m in enumerate(counts):
            means = np.lib.stride_tricks.sliding_window_view(values[:, n], m).mean(axis=1)
            assert np.isclose(found[k] ** 2, 0.5 * np.mean((means[m:] - means[:-m]) ** 2), rtol=2e-3)
            weights = np.repeat([-1.0 / m, 1.0 / m], m)
            model = of_axes(told, R_sh, lambda *one, m=m, w=weights: 0.5 * w @ covariance(*one, 2 * m) @ w)
            assert np.isclose(lines[3 * n + 2].get_ydata()[k] ** 2, model[n], rtol=1e-3)
        assert np.allclose(lines[3 * n + 1].get_ydata(), np.sqrt(levels[n] / times))


@pytest.fixture(scope="module")
def heads(dump, tmp_path_factory):
    """The printed alignment, that for programs, and the figure."""
    out = tmp_path_factory.mktemp("heads")
    with kept_figures(head_files) as figures:
        text, told = called("heads", str(dump), "--out", str(out))
    (one,) = told["dumps"]
    assert json.loads((out / "heads.json").read_text()).items() <= one.items()
    return text, one, figures[0]


def test_alignment_clock_and_angle_are_the_drawn_ones_within_their_errors(dump, heads):
    _, told, _ = heads
    *_, R_sh = both(dump)
    (found,) = told["alignments"]
    assert (told["reference"], found["head"], found["rows"]) == ("STR1", "STR2", 300)
    assert [head["name"] for head in told["noise"]["heads"]] == ["STR1", "STR2"]
    R_found, C = Rotation.from_quat(found["quaternion_sh"]), np.array(found["covariance_rad2"])
    off = (R_found * R_sh.inv()).as_rotvec()
    assert 0.05 < squared(off, C) < chi2(3).isf(1e-3)
    assert np.all(np.sqrt(np.diag(C)) < 4.0 * ARCSEC)
    assert_recorded("heads", flat("", told), relative=5e-3)
    assert abs(found["time_offset_s"] - LATE_S) < 3.5 * found["sigma_time_offset_s"] < 8.75e-3
    (term,) = found["terms"]  # the second tracker does not move against the first
    assert term["per"] == "hour" and np.all(np.abs(term["rad"]) < 3.5 * np.array(term["sigma_rad"]))

    def angle(R: Rotation) -> float:
        return float(np.arccos(R.apply([0.0, 0.0, 1.0])[2]))

    by_axis = [(angle(Rotation.from_rotvec(h) * R_found) - angle(R_found)) / 1e-6 for h in 1e-6 * np.eye(3)]
    assert np.isclose(found["angle_deg"], np.degrees(angle(R_found)), rtol=1e-12)
    assert np.isclose(found["sigma_angle_arcsec"], np.sqrt(by_axis @ C @ by_axis) / ARCSEC, rtol=1e-4)


def test_printed_alignment_is_compared_with_the_stated_one(dump, heads):
    text, told, _ = heads
    (found,) = told["alignments"]
    first, second = open_dump(dump).heads
    stated = first.R_cs0.inv() * second.R_cs0
    R_found, C = Rotation.from_quat(found["quaternion_sh"]), np.array(found["covariance_rad2"])
    assert np.allclose((Rotation.from_quat(found["stated_quaternion_sh"]) * stated.inv()).magnitude(), 0.0)
    lines = text.splitlines()
    assert lines[0] == "STR2 to STR1, 300 common instants"
    assert np.allclose(numbers(lines[1]), found["quaternion_sh"], atol=5.1e-10)
    assert np.allclose(numbers(lines[2])[1:], np.sqrt(np.diag(C)) / ARCSEC, atol=5.1e-4)
    turned = (R_found * stated.inv()).as_rotvec()
    against = turned @ np.linalg.solve(C, turned)
    assert np.allclose(numbers(lines[3])[:3], turned / ARCSEC, atol=5.1e-4)
    assert np.allclose(numbers(lines[4])[1:3], [against, 3.0], atol=0.051)
    z = [np.degrees(np.arccos(R.apply([0.0, 0.0, 1.0])[2])) for R in (R_found, stated)]
    off = 3600.0 * (z[0] - z[1])
    expected = [z[0], found["sigma_angle_arcsec"], z[1], off, abs(off) / found["sigma_angle_arcsec"]]
    assert np.allclose(numbers(lines[5]), expected, atol=[5.1e-6, 5.1e-3, 5.1e-6, 5.1e-3, 0.051])
    (term,) = found["terms"]
    per = np.concatenate([term["rad"], term["sigma_rad"]]) / ARCSEC
    assert np.allclose([*numbers(lines[6]), *numbers(lines[7])[1:]], per, atol=5.1e-4)
    clock = 1e3 * found["time_offset_s"], 1e3 * found["sigma_time_offset_s"]
    assert np.allclose(numbers(lines[8]), clock, atol=5.1e-3)


def test_of_two_dumps_each_has_its_alignment_and_folder(dump, heads, tmp_path):
    text, one, _ = heads
    other = shutil.copytree(dump, tmp_path / "other")
    shown, told = called("heads", str(dump), str(other), "--out", str(tmp_path / "out"))
    assert [here | {"dump": one["dump"]} for here in told["dumps"]] == [one, one]
    assert [here["dump"] for here in told["dumps"]] == [str(dump), str(other)]
    own = text.splitlines()[:9]
    lines = shown.splitlines()
    for name in ("dump", "other"):
        at = lines.index(f"dump {name}")
        assert lines[at + 1 : at + 10] == own
        assert (
            json.loads((tmp_path / "out" / name / "heads.json").read_text())["alignments"]
            == one["alignments"]
        )


def test_figure_of_the_alignment_has_means_of_blocks_with_their_errors(dump, heads):
    _, told, figure = heads
    one, two, _ = both(dump)
    (found,) = told["alignments"]
    off = (one * two.inv() * Rotation.from_quat(found["quaternion_sh"]).inv()).as_rotvec() / ARCSEC
    t = STEP_S * np.arange(len(off))
    blocks = np.minimum((t / (t[-1] + STEP_S) * 5.0 + 1e-9).astype(int), 4)
    R_sh = Rotation.from_quat(found["quaternion_sh"])
    n_rows = int(np.median(np.bincount(blocks)))
    variance = of_axes(told["noise"], R_sh, lambda *noise: covariance(*noise, n_rows).mean())
    constant = [np.array(head["constant_arcsec"]) ** 2 for head in told["noise"]["heads"]]
    variance = variance + constant[0] + R_sh.as_matrix() ** 2 @ constant[1]
    begin = open_dump(dump).heads[0].source.rows.t_s[0]
    for n, container in enumerate(figure.axes[0].containers):
        x, y = container.lines[0].get_data()
        assert np.allclose(y, [off[blocks == k, n].mean() for k in range(5)], atol=0.02)  # arcsec
        late = (n - 1) * 0.004 * (x[-1] - x[0])  # the three axes beside one another
        assert np.allclose(x - late, [begin + t[blocks == k].mean() for k in range(5)], atol=1e-3)
        heights = [np.ptp(segment[:, 1]) / 2.0 for segment in container.lines[2][0].get_segments()]
        # The error of a mean over many correlation times: 1 + 2 τ / T at most above the exact one.
        assert np.all(heights > 0.95 * np.sqrt(variance[n])) and np.all(heights < 1.2 * np.sqrt(variance[n]))
