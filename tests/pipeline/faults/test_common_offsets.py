"""Points of a dump that share the offset of a mosaic: it is estimated, and does not move the matrix."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from edits import rows_of, write_rows

from boresight.calib.verdict import Outcome
from boresight.geometry.installation import theta_between

OFFSET_M = np.array([9.0, -14.0, 5.0])  # east, north, up
M_PER_DEG = np.radians(1.0) * 6.37e6
TABLE = """
[[ground_references]]
id = "mosaic"
sigma_east_m = 20.0
sigma_north_m = 30.0
sigma_up_m = 10.0
"""


def off_in_one_strip(stated: str, dump: Path) -> None:
    """Coordinates of the points of a strip off by one offset, of which a table of dump.toml may tell."""
    rows = rows_of(dump / "points.csv")
    for row in rows:
        row["reference"] = "mosaic" if stated and row["strip"] == "s02" else ""
        if row["strip"] == "s02":
            lat, lon, height = (float(row[name]) for name in ("lat_deg", "lon_deg", "height_m"))
            row["lat_deg"] = f"{lat + OFFSET_M[1] / M_PER_DEG:.10f}"
            row["lon_deg"] = f"{lon + OFFSET_M[0] / M_PER_DEG / np.cos(np.radians(lat)):.10f}"
            row["height_m"] = f"{height + OFFSET_M[2]:.4f}"
    write_rows(dump / "points.csv", rows)
    text = (dump / "dump.toml").read_text()
    (dump / "dump.toml").unlink()
    (dump / "dump.toml").write_text(text + stated)


@pytest.mark.parametrize("correlation", ["", "correlation_km = 5000.0\n"])  # a hundred strips long
def test_a_stated_offset_of_a_mosaic_is_estimated_and_leaves_the_matrix_where_it_was(with_fault, correlation):
    plain = with_fault("points", lambda dump: None).estimate
    found = with_fault("points", partial(off_in_one_strip, TABLE + correlation))
    assert found.verdict.outcome is Outcome.CONSISTENT and not found.verdict.findings
    (offset,) = found.estimate.references
    assert offset.name == "mosaic" and offset.stated_m.tolist() == [20.0, 30.0, 10.0]
    assert np.all(np.abs(offset.value_m - OFFSET_M) < 4.0 * offset.sigma_m)
    # two strips tell where the third should lie to some 2 m, of the survey and of their attitudes
    assert np.all((1.0 < offset.sigma_m[:2]) & (offset.sigma_m[:2] < 5.0))
    assert 8.0 < offset.sigma_m[2] < 10.0  # of 10: one look shows little of a height
    moved = theta_between(found.estimate.R_cs, plain.R_cs)
    # the variance of what is lost is the difference of the variances
    lost = np.diag(found.estimate.cov_theta - plain.cov_theta)
    assert np.all(lost > 0.0) and np.all(np.abs(moved) < 4.0 * np.sqrt(lost) + 1e-9)


def test_an_offset_that_is_not_stated_is_named_and_refutes(with_fault):
    found = with_fault("points", partial(off_in_one_strip, ""))
    assert found.verdict.outcome is Outcome.REFUTED
    (one,) = found.verdict.findings
    assert (one.cause, one.item) == ("datum of the targets, north", "strip s02")
    assert abs(one.value - OFFSET_M[1]) < 4.0 * one.sigma
