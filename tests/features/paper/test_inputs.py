"""Tables 1 to 3 as inputs, beside the paper's printed values."""

import numpy as np
import pandas as pd
import pytest
from recorded_numbers import assert_recorded

from boresight.features.paper.comparison import compare_inputs
from boresight.features.paper.inputs import inputs
from boresight.features.paper.plots import plot_inputs
from boresight.features.paper.vector_experiments import ExperimentSettings


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    return inputs(ExperimentSettings().cameras, seed=1, strips=400)


def test_each_error_of_table_1_has_its_size_on_the_ground(table: pd.DataFrame):
    rows = table[table["source"] == "Table 1"]
    # GPS, clock and distortion are drawn once a strip, 400 strips: 3.5 %, four sigma
    np.testing.assert_allclose(rows["ours"], rows["expected"], rtol=0.14)
    printed = rows.set_index("item")["paper"]
    assert (printed["GPS, along"], printed["vibration, across"], printed["clock, along"]) == (2.0, 0.25, 0.75)


def test_tables_2_and_3_are_those_of_the_scenario(table: pd.DataFrame):
    each = {" ".join(key): part["ours"] for key, part in table.groupby(["source", "item"])}
    assert_recorded("inputs", each, relative=2e-5)  # half a pixel of a field of view
    rows = table[table["source"].isin(["Table 2", "Table 3"]) & table["at"].isna()]
    settings = rows[~rows["item"].str.startswith("field")]
    np.testing.assert_allclose(settings["ours"], settings["paper"], rtol=1e-15)  # one rounding of a unit
    curves = table[table["at"].notna() & table["paper"].notna()]
    # (5) written out against the camera model, px; Table 3 through its spline, um: a thousandth of a pixel
    for unit, tolerance in (("px", 1e-9), ("um", 0.01)):
        curve = curves[curves["unit"] == unit]
        np.testing.assert_allclose(curve["ours"], curve["paper"], rtol=0, atol=tolerance)


def test_values_of_the_text_follow_from_printed_inputs_alone(table: pd.DataFrame):
    ours = table[table["source"] == "text"]["ours"]
    sigma = 3.0 * 0.05 * np.degrees(6.4e-5) * 3600.0 / np.sqrt(30.0)  # 30 stars, pixels of 6.4 um at 100 mm
    np.testing.assert_allclose(ours, [0.53, 0.2 * 1250.0 / 530.0, sigma], rtol=0.005)  # a field of 18 degrees


def test_text_and_picture_hold_the_printed_values(table: pd.DataFrame):
    text = "\n".join(compare_inputs(table))
    assert all(value in text for value in ("2.29e-05", "-4.25e-09", "1077.2", "6144"))
    assert len(plot_inputs(table).axes) == 3
