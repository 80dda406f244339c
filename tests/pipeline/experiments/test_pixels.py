"""A row of Table 4 from rendered images."""

import pytest

from boresight.pipeline.experiments.comparison import compare_table4_pixels
from boresight.pipeline.experiments.pixels import PixelSettings, table4_from_pixels


def test_missions_of_a_row_have_its_noise_and_errors_within_their_covariance():
    table = table4_from_pixels(PixelSettings(table4_runs=2), rows=[(0.08, 0.5)])
    assert list(table["axis"]) == ["X", "Y", "Z"]
    # the sky's stars differ from mission to mission, the survey's errors do not
    assert table["sigma_s_px"].iloc[0] == pytest.approx(0.08, rel=0.15)
    assert table["sigma_c_px"].iloc[0] == pytest.approx(0.5, rel=0.03)
    assert table["nees"].iloc[0] < 12.0  # twice that is chi-square of six degrees: exceeded once in 2000
    assert table["rms_arcsec"].min() > 0.0
    text = "\n".join(compare_table4_pixels(table))
    assert "0.0809, 0.0441, 0.1987" in text and "CPU" in text
