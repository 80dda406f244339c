"""States of an OEM equal those of the library `oem`, an independent reader."""

import datetime
import gzip
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import erfa
import numpy as np
import pytest
from astropy.coordinates import GCRS, TEME, CartesianRepresentation
from astropy.time import Time
from handmade import OEM_HEAD
from oem import OrbitEphemerisMessage

from boresight.geometry.orbit import OrbitGapError
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files import ccsds_messages
from boresight.pipeline.files.dates import n_covered
from boresight.pipeline.files.orbit_and_earth import bundled_table, orbit_of
from boresight.pipeline.files.orbit_file import Ephemeris, joined_segments, read_oem, read_segments

FIXTURE = Path(__file__).parents[3] / "fixtures" / "mini" / "orbit.oem"
RADIUS_KM, RATE = 6908.0, 7.5963 / 6908.0


PLAIN = "{t} {x:.9f} {y:.9f} 0.0 {vx:.12f} {vy:.12f} -1e-3"


def text_of(count: int, line: str = PLAIN, begin: str = "2016-12-31T23:59:30", step_s: float = 1.0) -> str:
    """A message of states on a circle."""
    first, lines = datetime.datetime.fromisoformat(begin), []
    for after_s in step_s * np.arange(count):
        c, s = RADIUS_KM * np.cos(RATE * after_s), RADIUS_KM * np.sin(RATE * after_s)
        stamp = (first + datetime.timedelta(seconds=float(after_s))).isoformat(timespec="milliseconds")
        lines.append(line.format(t=stamp, x=c, y=s, vx=-RATE * s, vy=RATE * c))
    return OEM_HEAD.format(day=begin[:10]) + "\n".join(lines) + "\n"


def written(folder: Path, text: str) -> Path:
    (folder / "orbit.oem").write_text(text, encoding="utf-8")
    return folder / "orbit.oem"


def read(folder: Path, text: str) -> Ephemeris:
    return read_oem(written(folder, text), "orbit.oem")


def assert_as_library(path: Path) -> None:
    states = list(OrbitEphemerisMessage.open(path).segments[0].states)
    found = read_oem(path, "orbit.oem")
    tai = Time([state.epoch for state in states]).tai
    expected = ((tai.jd1 - tai.jd1[0]) + (tai.jd2 - tai.jd2[0])) * 86_400.0
    # 2e-10 s: a Julian date's second part, below a day, has 1e-16 days of rounding for each operation.
    assert np.allclose(found.t_s - found.t_s[0], expected, rtol=0, atol=2e-10)
    first_s = (tai[0] - Time("2000-01-01T12:00:00", scale="tai")).to_value("s")
    assert found.epoch.tai_s + found.t_s[0] == pytest.approx(first_s, abs=1e-6)
    assert np.array_equal(found.positions_m, 1e3 * np.array([state.position for state in states]))
    assert np.array_equal(found.velocities_m_s, 1e3 * np.array([state.velocity for state in states]))


@pytest.mark.parametrize("line", [PLAIN, "{t}\t{x:e}  {y} .5 1. {vx} +2E0 "])
def test_plain_states_are_those_of_the_library_across_a_leap_second(line: str, tmp_path: Path) -> None:
    assert_as_library(written(tmp_path, text_of(60, line)))


def test_fixture_is_read_as_the_library_reads_it() -> None:
    assert_as_library(FIXTURE)


@pytest.mark.parametrize(
    "changed",
    [
        lambda text: text.replace("\n\n", "\nCOMMENT numbers 1_000\n\n"),
        lambda text: text.replace(" 0.0 ", "\t0.0 ", 1).replace("-1e-3\n", "-1e-3 0 0 0\n"),
        lambda text: text + "COVARIANCE_START\nEPOCH = 2016-12-31T23:59:40\n1\n0 1\n0 0 1\n"
        "0 0 0 1\n0 0 0 0 1\n0 0 0 0 0 1\nCOVARIANCE_STOP\n",
        lambda text: text.replace("TIME_SYSTEM = UTC", "TIME_SYSTEM = TAI"),
        lambda text: text.replace("TIME_SYSTEM = UTC", "TIME_SYSTEM = TT"),
        lambda text: text.replace("TIME_SYSTEM = UTC", "TIME_SYSTEM = TDB"),
        lambda text: text.replace("2016-12-31T23:59", "2016-366T23:59"),
        lambda text: text.replace(".000 ", ".250Z "),
    ],
    ids=["comment", "accelerations", "covariance", "TAI", "TT", "TDB", "day of the year", "Z"],
)  # fmt: skip
def test_message_of_another_form_is_that_of_the_library(changed, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    assert_as_library(written(tmp_path, changed(text_of(20))))


VERSION = "CCSDS_OEM_VERS = 2.0\n"
SAME: dict[str, Callable[[str], str]] = {
    "byte order mark": lambda text: "\ufeff" + text,
    "byte order mark, other letters": lambda text: "\ufeff" + text.replace("\n\n", "\nCOMMENT é\n\n"),
    "accelerations of some states": lambda text: text.replace("-1e-3\n", "-1e-3 9 8 7\n", 7),
    "empty lines": lambda text: "\n \n" + text,
    "version 3": lambda text: text.replace(
        VERSION, "CCSDS_OEM_VERS = 3.0\nCLASSIFICATION = public, no limits\nMESSAGE_ID = OEM 201113719185\n"
    ),
}


@pytest.mark.parametrize("form", SAME)
def test_what_says_the_same_is_read_the_same(form: str, tmp_path: Path) -> None:
    text = text_of(20)
    other = SAME[form](text)
    plain, found = read(tmp_path, text), read(tmp_path, other)
    assert other != text and found.epoch == plain.epoch and np.array_equal(found.t_s, plain.t_s)
    assert np.array_equal(found.positions_m, plain.positions_m)
    assert np.array_equal(found.velocities_m_s, plain.velocities_m_s)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        *(
            ("6908.000000000", number, r"orbit.oem: line 15, X: found .*ASCII digits")
            for number in ("6_908.0", "６９０８.0", "٦٩٠٨.0")
        ),
        (" 0.0 ", " 1.0O5 ", "line 15, Z: found 1.0O5"),
        (" 0.0 ", " ", "line 15: found 6 words: 2016-12-31T23:59:30.000"),
        (" 0.0 ", " 0.0 1 2 ", "line 15: found 9 words"),
        ("2016-12-31T23:59:31.000 ", "2016-12-31 ", "line 16, time: found 2016-12-31,"),
        (VERSION, "\n \nCCSDS_OEM_VERS = 3.5\n", "line 3, CCSDS_OEM_VERS: found 3.5"),
        ("2016-12-31T23:59:31.000 ", "2016-13-31T23:59:31.000 ", "times that exist"),
        ("2016-12-31T23:59:31.000 ", "2016-12-31T23:59:30.000 ", "strictly increasing"),
        ("REF_FRAME = GCRF\n", "", "META_START of line 5, REF_FRAME: found nothing"),
        ("REF_FRAME = GCRF\n", "REF_FRAME = GCRF\nREF_FRAME = ICRF\n",
            "line 10, REF_FRAME: found a second time"),
        ("REF_FRAME = GCRF\n", "REF_FRAME = GCRF\nCOLOUR = red\n",
            "line 10, COLOUR: found an unknown keyword"),
        ("REF_FRAME = GCRF\n", "REF_FRAME = GCRF\nCOLOUR\n", "found COLOUR, expected KEYWORD = value"),
        ("CCSDS_OEM_VERS = 2.0", "CCSDS_OEM_VERS = 3.5", "expected 1.0, 2.0, 3.0"),
        ("META_START", "META_START\nMETA_STOP\nMETA_START",
            "META_START of line 5, OBJECT_NAME: found nothing"),
        ("META_STOP\n", "", "end of the file: found META_START of line 5, not closed"),
        ("META_START\n", "", "line 12: found META_STOP, expected META_START before it"),
        ("EARTH", "MARS", "line 8, CENTER_NAME: found MARS, expected EARTH"),
        ("CCSDS_OEM_VERS = 2.0", "CCSDS_OPM_VERS = 2.0",
            "line 1: found CCSDS_OPM_VERS = 2.0, expected CCSDS_OEM"),
        ("2016-12-31T23:59:31.000 ", "2016-367T23:59:31.000 ", "a day of that year"),
        (" 0.0 ", " 0.0 1.0 ", "line 15: found 8 words.*six numbers"),
        ("TIME_SYSTEM = UTC", "TIME_SYSTEM = UT1",
            "line 10, TIME_SYSTEM: found UT1, expected UTC, TAI, TT, TDB or GPS"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(old: str, new: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(RawDataError, match=says):
        read(tmp_path, text_of(20).replace(old, new, 1))


@pytest.mark.timed
def test_two_hours_at_one_hertz_take_less_than_a_third_of_the_librarys_time(tmp_path: Path) -> None:
    # In turn, as clocks of machines differ by three: on a fast one a day took 0.35 s of CPU time, the library
    # alone 4 s. Alone on a machine 0.17 to 0.25.
    path = written(tmp_path, text_of(7_200))
    alone_s, here_s = [np.inf], [np.inf]
    while len(here_s) <= 10 and not min(here_s) < min(alone_s) / 3:  # other programs take caches and clock
        alone_s.append(cpu_s(lambda: list(OrbitEphemerisMessage.open(path).segments[0].states)))
        here_s.append(cpu_s(lambda: read_oem(path, "orbit.oem")))
    assert min(here_s) < min(alone_s) / 3
    assert len(read_oem(path, "orbit.oem").t_s) == 7_200


def cpu_s(work: Callable[[], object]) -> float:
    begin = time.process_time()
    work()
    return time.process_time() - begin


@pytest.mark.parametrize("name", ["EME2000", "J2000"])
def test_states_in_eme2000_are_rotated_by_the_frame_bias(name: str, tmp_path: Path) -> None:
    # The precession of IAU 2006 at J2000 is the frame bias alone, 23 mas or 0.8 m; 0.2 µas from that of 2000.
    text = text_of(10)
    here = read(tmp_path, text)
    there = read(tmp_path, text.replace("= GCRF", f"= {name}"))
    bias = erfa.pmat06(2451545.0, 0.0)
    assert there.frame == "GCRF"
    assert np.abs(there.positions_m @ bias.T - here.positions_m).max() < 1e-5  # m
    assert np.abs(there.velocities_m_s @ bias.T - here.velocities_m_s).max() < 1e-8  # m/s
    assert 0.3 < np.linalg.norm(there.positions_m - here.positions_m, axis=1).max() < 1.0


def test_xml_is_read_as_the_keyword_form_is(tmp_path: Path) -> None:
    # The XML form is written by the library from the keyword form.
    path = written(tmp_path, text_of(10))
    as_xml = tmp_path / "orbit.xml"
    OrbitEphemerisMessage.open(path).save_as(as_xml, file_format="xml")
    kvn, xml = read_oem(path, "orbit.oem"), read_oem(as_xml, "orbit.xml")
    assert xml.epoch == kvn.epoch and xml.frame == kvn.frame and xml.method == kvn.method
    assert np.abs(xml.t_s - kvn.t_s).max() < 1e-9
    assert np.array_equal(xml.positions_m, kvn.positions_m)
    assert np.array_equal(xml.velocities_m_s, kvn.velocities_m_s)
    for old, new, field in (
        ("</oem>", "", "XML"),
        ("<X>", "<X>_", "state 1, X"),
        ("<Y>", "<Y>1.0</Y><Y>", "state 1, Y"),
        ("<Y_DOT>", '<Y_DOT units="m/s">', "state 1, Y_DOT"),
        ("<oem", "<!DOCTYPE a [<!ENTITY b 'c'>]><oem", "XML"),
        ("oem", "opm", "root element"),
    ):
        damaged = tmp_path / "damaged.xml"
        damaged.write_text(as_xml.read_text().replace(old, new))
        with pytest.raises(RawDataError) as error:
            read_oem(damaged, "damaged.xml")
        assert error.value.field == field


def test_third_version_with_its_own_keywords_is_read_in_xml(tmp_path: Path) -> None:
    plain = read(tmp_path, text_of(10))
    OrbitEphemerisMessage.open(tmp_path / "orbit.oem").save_as(tmp_path / "orbit.xml", file_format="xml")
    xml = (tmp_path / "orbit.xml").read_text().replace('version="2.0"', 'version="3.0"', 1)
    assert 'version="3.0"' in xml
    (tmp_path / "third.xml").write_text(xml.replace("<header>", "<header><MESSAGE_ID>7</MESSAGE_ID>", 1))
    assert np.array_equal(read_oem(tmp_path / "third.xml", "third.xml").positions_m, plain.positions_m)


def two_segments(text: str, later: str = "2017-01-01T00:00:31.000") -> str:
    """A message of one segment as one of two, of which the second begins anew at `later`."""
    head, meta = text.index("META_START"), text.index("META_STOP\n") + len("META_STOP\n")
    states = text[meta:].split("\n")
    first = next(n for n, line in enumerate(states) if line.startswith(later))
    of_second = text[head:meta].replace("2016-12-31T", "2017-01-01T")  # no time in two segments
    return "\n".join([text[:meta], *states[:first], "", of_second, *states[first:]])


def test_segments_are_those_of_the_library_with_one_epoch(tmp_path: Path) -> None:
    path = written(tmp_path, two_segments(text_of(120)))
    assert [len(list(one.states)) for one in OrbitEphemerisMessage.open(path).segments] == [61, 59]
    whole = read(tmp_path, text_of(120))
    path = written(tmp_path, two_segments(text_of(120)))
    OrbitEphemerisMessage.open(path).save_as(tmp_path / "orbit.xml", file_format="xml")
    for name in ("orbit.oem", "orbit.xml"):
        one, other = read_segments(tmp_path / name, name)
        assert one.epoch == other.epoch == whole.epoch
        # Dates of a segment are seconds since its own whole second first: rounding of 1e-10 s.
        assert np.allclose(np.concatenate([one.t_s, other.t_s]), whole.t_s, rtol=0, atol=1e-9)
        assert np.array_equal(np.concatenate([one.positions_m, other.positions_m]), whole.positions_m)
        with pytest.raises(RawDataError, match="segments: found 2, expected one segment"):
            read_oem(tmp_path / name, name)


def test_a_message_has_so_many_lines_and_segments_at_most(tmp_path: Path, monkeypatch) -> None:
    path = written(tmp_path, two_segments(text_of(120)).replace("\n", "\r\n"))
    lines = path.read_bytes().count(b"\r\n")
    for name, most, found in (("MAX_LINES", lines, f"{lines} lines"), ("MAX_SEGMENTS", 2, "2 blocks")):
        monkeypatch.setattr(ccsds_messages, name, most)
        assert len(read_segments(path, "orbit.oem")) == 2
        monkeypatch.setattr(ccsds_messages, name, most - 1)
        with pytest.raises(RawDataError, match=f"found {found}, expected at most {most - 1}"):
            read_segments(path, "orbit.oem")
        monkeypatch.undo()


def test_spans_are_counted_in_the_segment_that_covers_them(tmp_path: Path) -> None:
    segments = read_segments(written(tmp_path, two_segments(text_of(120))), "orbit.oem")
    at = [float(one.t_s[0]) for one in segments]
    of_second = [(at[1] + 1.0, at[1] + 2.0), (at[1] + 3.0, at[1] + 4.0)]
    assert [n_covered(one.t_s, []) for one in segments] == [0, 0]
    assert [n_covered(one.t_s, [(at[0] + 1.0, at[0] + 2.0)]) for one in segments] == [1, 0]
    assert [n_covered(one.t_s, [(at[0], at[0] + 1.0), *of_second]) for one in segments] == [1, len(of_second)]
    assert [n_covered(one.t_s, [(at[1] - 0.5, at[1] + 0.5)]) for one in segments] == [0, 0]  # in neither


def test_what_is_wrong_in_a_segment_is_named_by_its_number(tmp_path: Path) -> None:
    text = two_segments(text_of(66))
    few = r"orbit.oem \(segment 2 of 2\): states: found 5, expected at least 8"
    with pytest.raises(RawDataError, match=few):
        read_segments(written(tmp_path, text), "orbit.oem")
    head, mark, second = two_segments(text_of(120)).rpartition("OBJECT_ID = ")
    text = head + mark + second.replace("2024-000A", "2024-000B")
    other = r"line \d+, OBJECT_ID: found 2024-000B, expected 2024-000A, as in the first"
    with pytest.raises(RawDataError, match=other):
        read_segments(written(tmp_path, text), "orbit.oem")


def test_as_many_states_are_enough_as_the_interpolation_needs(tmp_path: Path) -> None:
    for method, degree, enough in (("LAGRANGE", 5, 6), ("HERMITE", 5, 3), ("LAGRANGE", 1, 2)):
        asked = f"INTERPOLATION = {method}\nINTERPOLATION_DEGREE = {degree}\nMETA_STOP"
        few, less = (text_of(n).replace("META_STOP", asked) for n in (enough, enough - 1))
        assert len(read(tmp_path, few).t_s) == enough
        with pytest.raises(RawDataError, match=f"states: found {enough - 1}, expected at least {enough}"):
            read(tmp_path, less)


def test_the_one_orbit_in_a_combined_message_is_read(tmp_path: Path) -> None:
    OrbitEphemerisMessage.open(written(tmp_path, text_of(10))).save_as(tmp_path / "a.xml", file_format="xml")
    declaration, _, message = (tmp_path / "a.xml").read_text().partition("<oem")
    path = tmp_path / "ndm.xml"
    path.write_text(f"\n{declaration}<ndm><COMMENT>two</COMMENT><omm/><oem{message}</ndm>")
    plain = read_oem(tmp_path / "a.xml", "a.xml")
    assert np.array_equal(read_oem(path, "ndm.xml").positions_m, plain.positions_m)
    path.write_text(f"{declaration}<ndm><omm/><opm/></ndm>")
    with pytest.raises(RawDataError, match="element: found ndm of omm, opm, expected oem, or ndm with one"):
        read_oem(path, "ndm.xml")


def test_states_may_be_minutes_apart_but_not_an_eighth_of_a_revolution(tmp_path: Path) -> None:
    # One revolution is 5714 s. The orbit of the ISS is distributed in steps of 240 s.
    says = "time of the states: found steps of 714 s, expected at most 571 s, 0.1 of a revolution"
    for step_s in (60.0, 240.0, 560.0, 714.0):
        found = read(tmp_path, text_of(12, PLAIN, "2017-04-11T00:00:00", step_s))
        with pytest.raises(RawDataError, match=says) if step_s > 600.0 else nullcontext():
            orbit_of(found, "orbit.oem", bundled_table(), allow_stale_eop=False)


def test_compressed_message_is_the_plain_one_and_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    text = text_of(30)
    plain, packed = read(tmp_path, text), tmp_path / "orbit.oem.gz"
    whole = gzip.compress(text.encode())
    packed.write_bytes(whole)
    assert np.array_equal(read_oem(packed, "orbit.oem.gz").positions_m, plain.positions_m)
    packed.write_bytes(whole[:-20])
    with pytest.raises(RawDataError, match=r"gzip: found .*, expected a whole gzip file"):
        read_oem(packed, "orbit.oem.gz")
    packed.write_bytes(whole[:30] + bytes([whole[30] ^ 0x55]) + whole[31:])
    with pytest.raises(RawDataError, match="gzip: found"):
        read_oem(packed, "orbit.oem.gz")


@pytest.mark.filterwarnings("ignore::astropy.utils.exceptions.AstropyWarning")
def test_states_of_teme_and_true_of_date_are_those_of_astropy_and_erfa(tmp_path: Path) -> None:
    text = text_of(12).replace("2016-12-31T23:59", "2023-09-14T11:42")
    plain = read(tmp_path, text).positions_m
    text = text.replace("REF_FRAME = GCRF", "REF_FRAME = {}")
    assert "REF_FRAME = {}" in text
    teme, tod = (read(tmp_path, text.replace("{}", frame)) for frame in ("TEME", "TOD"))
    at = [float(erfa.DJM0), Time("2023-09-14T11:42:30").tt.mjd + np.arange(12) / 86_400.0]
    when = Time(*at, format="jd", scale="tt")
    places = TEME(CartesianRepresentation(plain.T, unit="m"), obstime=when)
    gcrs = places.transform_to(GCRS(obstime=when)).cartesian.xyz.to_value("m").T
    # 1 mm: astropy's polar motion, which cancels but for s', and UT1; TEME is 24 km from GCRS
    assert np.abs(teme.positions_m - gcrs).max() < 1e-3 and np.abs(plain - gcrs).max() > 1e4
    R = erfa.pnm06a(*at)
    assert np.abs(tod.positions_m - np.einsum("nji,nj->ni", R, plain)).max() < 1e-6
    fixed = text.replace("{}", "TEME\nREF_FRAME_EPOCH = 2023-09-14T11:42:30.000")
    of_epoch = read(tmp_path, fixed)
    assert np.array_equal(of_epoch.positions_m[0], teme.positions_m[0])
    # in 11 s the axes turn by precession and nutation, 1e-11 rad
    assert 0.0 < np.abs(of_epoch.positions_m - teme.positions_m).max() < 1e-3


def test_strips_in_any_of_several_segments_have_an_orbit(tmp_path: Path) -> None:
    def of_2018(text: str) -> str:  # no leap second, by which its times would jump against its positions
        return text.replace("2017-01-01", "2018-01-02").replace("2016-12-31", "2018-01-01")

    whole = orbit_of(read(tmp_path, of_2018(text_of(120))), "a", bundled_table(), allow_stale_eop=True)
    segments = read_segments(written(tmp_path, of_2018(two_segments(text_of(120)))), "orbit.oem")
    joined = joined_segments(segments)
    assert joined is not None and joined.begins == (61,)
    orbit = orbit_of(joined, "orbit.oem", bundled_table(), allow_stale_eop=True)
    begin = float(segments[1].t_s[0])
    for t_s in ([3.4, 20.2, begin - 1.5], [begin + 0.3, begin + 33.3]):
        # 1e-5 m: seven neighbours of 1 s, at the ends of segments one-sided
        assert np.abs(orbit.positions_i(t_s) - whole.positions_i(t_s)).max() < 1e-5
        part = orbit.around(t_s[0], t_s[-1])
        assert np.array_equal(part.positions_i(t_s), orbit.positions_i(t_s))
    with pytest.raises(OrbitGapError, match="in a gap of the ephemeris"):  # between the segments
        orbit.positions_i([begin - 0.5])
    # A segment that begins with the last state of the one before it leaves no gap; overlapping ones are not
    # joined, and the one over most strips is used.
    names = ("positions_m", "velocities_m_s")
    states = {n: np.vstack([getattr(segments[0], n), getattr(segments[1], n)[:1]]) for n in names}
    last = replace(segments[0], t_s=np.append(segments[0].t_s, begin), **states)
    touching = joined_segments([last, segments[1]])
    assert touching is not None
    orbit = orbit_of(touching, "orbit.oem", bundled_table(), allow_stale_eop=True)
    around = np.linspace(begin - 2.0, begin + 2.0, 41)
    assert np.abs(orbit.positions_i(around) - whole.positions_i(around)).max() < 1e-5
    assert joined_segments([last, replace(segments[1], t_s=segments[1].t_s - 0.5)]) is None
    assert joined_segments([last, replace(segments[1], frame="ITRF")]) is None
