"""A row of Table 4 and a cell of the grid from rendered images."""

import math
from collections.abc import Iterator
from functools import cache

import numpy as np
import pandas as pd
import pytest
from recorded_numbers import assert_recorded, numbers_by_line
from scipy.special import betainc

from boresight.features.paper import pixels as missions
from boresight.features.paper.comparison import compare_grid_pixels, compare_table4_pixels
from boresight.features.paper.pixels import PixelSettings, grid_from_pixels, table4_from_pixels
from boresight.features.paper.plots import PLOTS

CELL = (0.08, 0.5)  # px, of stars and targets: a row of Table 4 and a cell of the grid share a mission


@pytest.fixture(scope="module", autouse=True)
def rendered_once() -> Iterator[None]:
    """A mission that row and cell share is rendered and calibrated once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(missions, "_mission", cache(missions._mission))
        yield


def assert_bars_of_chance(name: str, table: pd.DataFrame, ratios: list[float], n: int) -> None:
    """The bars of a figure are the 1-sigma of an rms of n squares, which is known to 1 / sqrt(2 n)."""
    bars = [one for ax in PLOTS[name](table).axes for one in ax.collections]
    for bar, ratio in zip(bars, ratios, strict=True):
        (low, high) = bar.get_segments()[0][:, 1]
        assert [low, high] == pytest.approx(ratio * (1.0 + np.array([-1.0, 1.0]) / math.sqrt(2 * n)))


def test_missions_of_a_row_have_its_noise_and_errors_within_their_covariance():
    table = table4_from_pixels(PixelSettings(table4_runs=1), rows=[CELL])
    assert list(table["axis"]) == ["X", "Y", "Z"]
    # the sky's stars differ from mission to mission, the survey's errors do not
    assert table["sigma_s_px"].iloc[0] == pytest.approx(0.08, rel=0.15)
    assert table["sigma_c_px"].iloc[0] == pytest.approx(0.5, rel=0.03)
    assert table["nees"].iloc[0] < 17.7  # chi-square of three degrees: exceeded once in 2000
    assert table["rms_arcsec"].min() > 0.0
    text = "\n".join(compare_table4_pixels(table))
    assert "0.0809 (" in text and "0.1987 (" in text and "CPU" in text
    assert_bars_of_chance("table4-pixels", table, (table["rms_arcsec"] / table["bound_arcsec"]).tolist(), 1)


def test_redrawn_vectors_of_a_mission_have_its_geometry_and_their_own_bound():
    table = grid_from_pixels(PixelSettings(runs=1, redraws=40), cells=[CELL])
    pixels, vectors = (table[table["method"] == name] for name in ("pixels", "vectors"))
    # one and the same stars and targets, displaced by noise of arcseconds: the bound moves by 1e-3
    np.testing.assert_allclose(vectors["bound_arcsec"], pixels["bound_arcsec"].to_numpy(), rtol=0.01)
    # mean of 40 runs of 3 degrees: 3 +- 0.39; three sigma
    assert vectors["nees"].iloc[0] == pytest.approx(3.0, abs=1.2)
    assert pixels["nees"].iloc[0] < 21.1  # chi-square of three degrees: exceeded once in 10 000
    assert table["paper_arcsec"].tolist() == [0.0159, 0.0105, 0.0927] * 2
    text = "\n".join(compare_grid_pixels(table))
    assert "0.0927" in text and "F-test" in text
    assert len(PLOTS["grid-pixels"](table).axes) == 6


def test_p_values_of_the_grid_have_the_degrees_of_freedom_of_its_pixels_and_of_its_vectors():
    """Two cells of 5 missions and of 40 redrawn runs; tail of F by the incomplete beta function."""
    both = ("pixels", 5, 4.1), ("vectors", 40, 2.8)
    rows = [(name, axis, runs, square, square) for name, runs, square in both for axis in "XYZ"]
    rest = "row_s_px row_c_px rms_arcsec bound_arcsec cpu_s paper_arcsec paper_bound_arcsec".split()
    table = pd.DataFrame(2 * rows, columns=["method", "axis", "runs", "nees", "mean_square"])
    table = table.assign(**dict.fromkeys(rest, 1.0))
    assert_bars_of_chance("grid-pixels", table, [math.sqrt(4.1)] * 6, 2 * 5)
    lines = list(compare_grid_pixels(table))
    assert_recorded("grid_pixels", numbers_by_line("\n".join(lines)))
    for name, dof, word in (("X", 1, 7), ("Y", 1, 7), ("Z", 1, 7), ("NEES", 3, -1)):
        p = float(next(line for line in lines if line.startswith(f"{name}  ")).split()[word])
        n, m = dof * 2 * 5, dof * 2 * 40
        above = betainc(m / 2, n / 2, m / (m + n * 4.1 / 2.8))
        assert p == pytest.approx(2.0 * min(above, 1.0 - above), abs=5.1e-4)  # three digits are printed
