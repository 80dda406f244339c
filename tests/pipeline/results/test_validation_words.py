"""What `validate` prints, number by number."""

import numpy as np
import pytest

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.results.summary import validation_summary
from boresight.pipeline.results.validate import CheckPoints, TruthErrors


def points(along_m: list[float], across_m: list[float]) -> CheckPoints:
    n = len(along_m)
    other = {name: np.full(n, 99.0) for name in ("lat_deg", "lon_deg", "up_m", "east_m", "north_m")}
    ids = np.array([f"p{k}" for k in range(n)])
    return CheckPoints(
        strip_id=ids, point_id=ids, along_m=np.array(along_m), across_m=np.array(across_m), **other
    )


def test_errors_before_and_after_are_told_with_their_units_in_their_places() -> None:
    errors = TruthErrors(
        error_rad=np.array([0.5, -1.5, 6.0]) * ARCSEC,
        sigma_rad=np.array([0.25, 1.0, 4.0]) * ARCSEC,
        nees=4.25,
        before_rad=np.array([-600.0, 1200.0, 3000.0]) * ARCSEC,
        after=points([3.0, -4.0], [1.0, 7.0]),
        before=points([300.0, -400.0], [100.0, 700.0]),
        predicted=(),
        without=3,
    )
    lines = validation_summary(errors).splitlines()
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
