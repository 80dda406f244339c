"""Dates of orbit, exposures and strips with nothing in common: file, found and expected are named."""

from pathlib import Path

import numpy as np
import pytest
from edits import replaced

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import open_dump


def test_an_orbit_of_the_next_day_is_told_with_both_dates(handmade: Path) -> None:
    replaced(handmade / "orbit.oem", "2024-11-20T03", "2024-11-21T03")
    with pytest.raises(RawDataError) as told:
        open_dump(handmade)
    assert (told.value.file, told.value.field) == ("orbit.oem", "time of the states")
    assert told.value.found == "2024-11-21T03:40:00 to 03:40:39 UTC"
    assert told.value.expected.startswith("states over the strips, 2024-11-20T03:40:19 to 03:40:20 UTC")


@pytest.mark.parametrize("scale", ["TT", "TAI"])
def test_a_wrong_time_system_is_named_where_it_explains_the_dates(handmade: Path, scale: str) -> None:
    replaced(handmade / "orbit.oem", "TIME_SYSTEM = UTC", f"TIME_SYSTEM = {scale}")
    with pytest.raises(RawDataError, match=f"with TIME_SYSTEM UTC, not {scale}, it would cover every strip"):
        open_dump(handmade)


def test_orbit_has_the_segment_over_the_strips(handmade: Path) -> None:
    whole = open_dump(handmade).orbit
    orbit = handmade / "orbit.oem"
    text = orbit.read_text()
    head, meta = text.index("META_START"), text.index("META_STOP\n") + len("META_STOP\n")
    # A segment of the day before, and one of the strips.
    orbit.write_text(text.replace("2024-11-20T03", "2024-11-19T03") + text[head:meta] + text[meta:])
    of_second = open_dump(handmade).orbit
    t_s = float(of_second.epoch.tai_s - whole.epoch.tai_s) + of_second.t_s
    here = np.flatnonzero(t_s > -3600.0)  # s, not of the day before
    assert np.abs(t_s[here] - whole.t_s).max() < 1e-9  # s
    assert np.array_equal(of_second.positions_m[here], whole.positions_m)
    replaced(orbit, "2024-11-20T03", "2024-11-21T03")
    says = r"orbit.oem \(segment 1 of 2\): time of the states: found 2024-11-19"
    with pytest.raises(RawDataError, match=says):
        open_dump(handmade)


def test_exposures_of_another_pass_are_told_with_both_dates(handmade: Path) -> None:
    replaced(handmade / "exposures.csv", "T03:40", "T05:14")
    with pytest.raises(RawDataError, match=r"exposures\.csv: time: found 2024-11-20T05:14:19 to 05:14:20"):
        open_dump(handmade)
