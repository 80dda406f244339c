"""Instants and their names, against published examples and against ERFA and astropy."""

import erfa
import numpy as np
import pytest
from astropy.time import Time
from hypothesis import given, settings
from hypothesis import strategies as st

from boresight.geometry.epoch import Epoch, tai_minus_utc_s

# From 1972 to 2035, in nanoseconds since 1972-01-01T00:00:10 TAI
NANOSECONDS = st.integers(0, 63 * 365 * 86_400 * 10**9)
TAI_OF_1972 = -(28 * 365 + 7) * 86_400 - 43_200 + 10


def test_vallado_example_3_7_utc_to_tai_gps_and_tt():
    # Vallado, Fundamentals of Astrodynamics, 4th ed., example 3-7: 2004-05-14 16:43:00 UTC.
    epoch = Epoch.from_utc("2004-05-14T16:43:00")
    assert epoch.tai_s == (4 * 365 + 1 + 134) * 86_400 - 43_200 + 16 * 3600 + 43 * 60 + 32  # TAI 16:43:32
    assert epoch.seconds_from_gps_dates(["2004-05-14T16:43:13.0"]) == 0.0
    day, since = epoch.tt_jd(0.0)
    assert ((day - 2451545.0) + since) / 36525.0 == pytest.approx(0.043674121031, abs=1e-12)  # centuries, TT


def test_vallado_example_3_4_julian_date():
    # Vallado, 4th ed., example 3-4: 1996-10-26 14:20:00 is JD 2450383.09722222 (here on the scale of UTC).
    day, since = Epoch.from_utc("1996-10-26T14:20:00").tai_jd(0.0)
    assert day + since - 30.0 / 86_400 == pytest.approx(2450383.09722222, abs=1e-8)


def test_sofa_time_cookbook_example():
    # SOFA Time Scale and Calendar Tools: 2006-01-15 21:24:37.5 UTC = 21:25:10.5 TAI = 21:25:42.684 TT.
    epoch = Epoch.from_utc("2006-01-15T21:24:37.5")
    t_s = epoch.seconds_from_utc(["2006-01-15T21:24:37.5"])
    day, since = epoch.tt_jd(t_s)
    seconds = ((day[0] - 2453751.0) + since[0] + 0.5) * 86_400.0  # since 0h on 2006-01-15
    assert seconds == pytest.approx(21 * 3600 + 25 * 60 + 42.684, abs=1e-9)


def test_gps_week_2048_began_when_the_counter_rolled_over():
    # IS-GPS-200: the ten-bit week counter rolled over for the second time at 2019-04-06 23:59:42 UTC.
    epoch = Epoch.from_utc("2019-04-06T23:59:42")
    assert epoch.seconds_from_gps_dates(["2019-04-07T00:00:00.25"]) == 0.25


def test_every_leap_second_has_its_own_name_and_length():
    for row in erfa.leap_seconds.get():
        if row["year"] < 1973:
            continue
        year, month = int(row["year"]), int(row["month"])
        last_day = f"{year - (month == 1)}-{'12-31' if month == 1 else '06-30'}"
        names = [f"{last_day}T23:59:59.5", f"{last_day}T23:59:60.5", f"{year}-{month:02d}-01T00:00:00.5"]
        epoch = Epoch.from_utc(names[0])
        t_s = epoch.seconds_from_utc(names)
        np.testing.assert_array_equal(t_s, [0.5, 1.5, 2.5])
        assert epoch.utc_from_seconds(t_s) == [name + "00000000" for name in names]


@settings(deadline=None)  # the first call loads tables
@given(NANOSECONDS)
def test_utc_comes_back(nanoseconds):
    second, nano = divmod(nanoseconds, 10**9)
    epoch = Epoch(TAI_OF_1972 + second)
    (name,) = epoch.utc_from_seconds(nano * 1e-9)
    assert Epoch.from_utc(name) == epoch
    # 1e-15 s: the fraction is read as a decimal number.
    assert epoch.seconds_from_utc([name])[0] == pytest.approx(nano * 1e-9, abs=1e-15)


@pytest.mark.filterwarnings("ignore:.*dubious year")
@settings(deadline=None)  # the first call loads tables
@given(NANOSECONDS)
def test_utc_agrees_with_astropy(nanoseconds):
    second, nano = divmod(nanoseconds, 10**9)
    epoch = Epoch(TAI_OF_1972 + second)
    (name,) = epoch.utc_from_seconds(nano * 1e-9)
    day, since = epoch.tai_jd(nano * 1e-9)
    with np.errstate(all="ignore"):
        theirs = Time(float(day), float(since), format="jd", scale="tai")
    ours = Time(name, format="isot", scale="utc").tai
    assert abs((theirs - ours).to_value("s")) < 2e-9  # names are rounded to 1 ns


def test_a_day_of_microseconds_survives():
    # 1e-11 s: one unit in the last place of a day in float64.
    epoch, t_s = Epoch.from_utc("2024-02-29T23:59:59"), np.array([1e-6, 86_399.000001])
    (day, since), (day0, since0) = epoch.tai_jd(t_s), epoch.tai_jd(np.zeros(2))
    np.testing.assert_allclose(((day - day0) + (since - since0)) * 86_400.0, t_s, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("2024-06-30 12.00", "must look like"),
        ("2023-02-29T00:00:00", "day is out of range"),
        ("2016-12-31T23:59:61", "no such time of day"),
        ("2015-12-31T23:59:60", "no leap second"),
        ("2016-12-31T22:59:60", "no leap second"),
        ("2020-01-01T24:00:00", "no such time of day"),
        ("1971-12-31T00:00:00", "before 1972"),
    ],
)
def test_what_is_not_a_utc_date_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        Epoch.from_utc(text)


def test_tai_minus_utc_is_that_of_bulletin_c():
    np.testing.assert_array_equal(tai_minus_utc_s([41317, 57203, 57204, 57753, 57754]), [10, 35, 36, 36, 37])
    with pytest.raises(ValueError, match="before 1972"):
        tai_minus_utc_s(41316)


def test_gps_dates_are_18_seconds_ahead_of_utc_in_2020_and_agree_with_astropy():
    epoch = Epoch.from_utc("2020-08-16T12:02:00")
    dates = ["2020-08-16T12:02:18", "2020-08-16T12:02:45.812731", "2020-08-17T00:00:00.5"]
    found = epoch.seconds_from_gps_dates(dates)
    assert found[0] == 0.0
    expected = (Time(dates, scale="tai") - Time("2020-08-16T12:02:00", scale="utc").tai).to_value("s") + 19.0
    assert np.abs(found - expected).max() < 1e-9


@pytest.mark.parametrize("text", ["2020-08-16", "2020-02-30T00:00:00", "2020-08-16T12:02:60", "noon"])
def test_gps_dates_that_do_not_exist_are_refused(text):
    with pytest.raises(ValueError, match="GPS date"):
        Epoch.from_utc("2020-08-16T12:02:00").seconds_from_gps_dates([text])


@pytest.mark.parametrize(
    "text", ["２０２４-06-30T23:59:59Z", "2024-06-30T23:59:５9Z", "2024-06-30T23:59:59.٥Z"]
)
def test_digits_of_other_scripts_are_no_time(text):
    with pytest.raises(ValueError, match="UTC must look like"):
        Epoch.from_utc(text)
    with pytest.raises(ValueError, match="GPS date must look like"):
        Epoch(0).seconds_from_gps_dates([text.removesuffix("Z")])
