"""Forms of one argument are one value, or refused by name."""

import datetime

import astropy.units as u
import numpy as np
import pandas as pd
import pytest
from astropy.time import Time

from boresight.accepted import floats_of, number_of, utc_of

EXACT = "2026-03-01T12:00:00.123456789"
TZ = datetime.timezone(datetime.timedelta(hours=2))


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (pd.Timestamp(EXACT), EXACT),
        (pd.Timestamp(EXACT, tz="UTC").tz_convert("Asia/Tokyo"), EXACT),
        (np.datetime64(EXACT), EXACT),
        (np.array(EXACT, dtype="datetime64[ns]"), EXACT),
        (Time(EXACT, scale="utc"), EXACT),
        (Time("2024-11-20T12:00:37.25", scale="tai"), "2024-11-20T12:00:00.250000000"),
        ("2024-11-20T12:00:00.25", "2024-11-20T12:00:00.25"),
        (datetime.datetime(2026, 3, 1, 14, tzinfo=TZ), "2026-03-01T12:00:00"),
        (np.datetime64("2026-03-01"), "2026-03-01T00:00:00"),
        (np.datetime64("2609-01-01"), "2609-01-01T00:00:00"),  # beyond what 64 bits of nanoseconds hold
    ],
)
def test_an_instant_is_the_same_to_the_nanosecond_in_every_form(given: object, text: str) -> None:
    assert utc_of(given, "time") == text


@pytest.mark.parametrize("given", [pd.NaT, np.datetime64("NaT"), np.datetime64("1930-01-01")])
def test_what_is_no_instant_since_1972_is_refused(given: object) -> None:
    with pytest.raises(ValueError, match=r"^time: found .*expected UTC since 1972"):
        utc_of(given, "time")


@pytest.mark.parametrize("columns", [["y_px", "x_px"], ["Y", "X"], ["z", "y", "x"], ["x", "z", "y"]])
def test_named_columns_are_taken_in_their_order_alone(columns: list[str]) -> None:
    table = pd.DataFrame(np.arange(2.0 * len(columns)).reshape(2, -1), columns=columns)
    with pytest.raises(ValueError, match=f"^xy: found the columns {', '.join(columns)}, expected x before y"):
        floats_of(table, "xy", "(N, 2)")
    for kept in (table[sorted(columns)], table.set_axis(range(len(columns)), axis=1)):
        assert np.array_equal(floats_of(kept, "xy", "(N, 2)"), kept.to_numpy())


@pytest.mark.parametrize(
    ("name", "given", "value"),
    [
        ("height_km", 500.0 * u.m, 0.5),
        ("orbit, row 3, vx_m_s", -7.1 * u.km / u.s, -7100.0),
        ("rate_mrad_s", 1.0 * u.deg / u.s, 1e3 * np.pi / 180.0),
        ("acceleration_deg_s2", 60.0 * u.arcmin / u.s**2, 1.0),
        ("clock_s", 3.0 * u.ms, 0.003),
        ("vx_m_s", 3.0 * u.s, None),
        ("height_km", 3.0 * u.s, None),
        ("exposures", 3.0 * u.s, None),
    ],
)
def test_a_number_with_a_unit_has_that_of_its_name(name: str, given: object, value: float | None) -> None:
    if value is None:
        with pytest.raises(ValueError, match=f"^{name}: found values in .*expected numbers"):
            number_of(given, name)
    else:
        assert number_of(given, name) == pytest.approx(value, rel=1e-12)
