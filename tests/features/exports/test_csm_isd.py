"""ISDs against the line-scanner model of the USGS (`line_scanner.py`)."""

import numpy as np
import pytest
from astropy.time import Time
from line_scanner import LineScanner
from orbiting_camera import EPOCH, LINES, strip
from recorded_numbers import assert_recorded, flat

from boresight.features.exports import csm_isd
from boresight.features.exports.csm_isd import IsdNames, line_scanner_isds
from boresight.geometry.terrain import ConstantHeight

NAMES = IsdNames("strip.tif", "TESTSAT", "TESTCAM")
HEIGHT_M = 400.0


def nearest_px(p_e, origin, direction):
    """Distance of a ground point from a ray, in pixels of 1 µrad as seen from the satellite."""
    to_point = p_e - origin
    return np.linalg.norm(np.cross(to_point, direction)) / np.linalg.norm(to_point) / 1e-6


@pytest.fixture(scope="module")
def pieces():
    return [line_scanner_isds(strip(), EPOCH, ccd, LINES, HEIGHT_M, NAMES) for ccd in (0, 1)]


@pytest.mark.parametrize("ccd", [0, 1])
def test_ground_points_are_those_of_the_usgs_line_scanner(pieces, ccd):
    rng = np.random.default_rng(5)
    sample, line = rng.uniform(-0.49, 2047.49, 100), rng.uniform(-0.49, LINES - 0.51, 100)
    p_e = strip().ground_points(ccd, sample, line, ConstantHeight(HEIGHT_M))
    worst = 0.0
    for n in range(100):
        piece = next(p for p in pieces[ccd] if p.first_sample - 0.5 <= sample[n] < p.stop_sample - 0.5)
        model = LineScanner(piece.text())
        ray = model.ray(line[n] + 0.5, sample[n] - piece.first_sample + 0.5)
        worst = max(worst, nearest_px(p_e[n], *ray))
    assert worst < 0.01  # px, what users of the file are promised
    assert worst < 2.0 * max(p.isd["boresight"]["model_error_px"] for p in pieces[ccd]) + 1e-3


def test_ground_500_m_higher_moves_by_less_than_a_hundredth_of_a_pixel(pieces):
    # Light time and refraction are folded in at one height: 2e-13 d^2 and 1e-8 tan z d^2 metres, and the
    # light-time's own 0.9 mm per km of height.
    sample, line = np.array([50.0, 1000.0, 2000.0]), np.array([10.0, 1500.0, 2990.0])
    p_e = strip().ground_points(1, sample, line, ConstantHeight(HEIGHT_M + 500.0))
    model = LineScanner(pieces[1][0].text())
    for n in range(3):
        assert nearest_px(p_e[n], *model.ray(line[n] + 0.5, sample[n] + 0.5)) < 0.01


def test_a_detector_with_strong_distortion_is_cut_and_one_without_is_not(pieces, monkeypatch):
    assert len(pieces[0]) > 1
    assert pieces[0][0].suffix == f"ccd0.samples-00000-{pieces[0][0].stop_sample - 1:05d}"
    assert len(pieces[1]) == 1 and pieces[1][0].suffix == "ccd1"
    *cut, whole = pieces[0]
    assert whole.suffix == "ccd0.whole" and (whole.first_sample, whole.stop_sample) == (0, 2048)
    assert whole.isd["boresight"]["model_error_px"] > 0.01  # stated: one cubic does not follow the table
    covered = [n for p in cut for n in range(p.first_sample, p.stop_sample)]
    assert covered == list(range(2048))
    assert all(p.isd["boresight"]["model_error_px"] < 0.01 for p in cut)
    monkeypatch.setattr(csm_isd, "SMALLEST_PIECE_PX", cut[-1].stop_sample - cut[-1].first_sample + 1)
    fewer = line_scanner_isds(strip(), EPOCH, 0, LINES, HEIGHT_M, NAMES)
    assert [p.stop_sample for p in fewer[:-1]] == [*(p.stop_sample for p in cut[:-2]), 2048]


def test_what_an_isd_reader_asks_for_is_there(pieces):
    assert_recorded("isd", flat("", [piece.isd for of_ccd in pieces for piece in of_ccd]))
    # The keys that the ISD reader of the Abstraction Layer for Ephemerides takes without a default.
    isd = pieces[1][0].isd
    assert [isd[k] for k in ("image_identifier", "name_platform", "name_sensor")] == [
        "strip.tif",
        "TESTSAT",
        "TESTCAM",
    ]
    assert isd["name_model"] == "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"
    assert isd["radii"] == {"semimajor": 6378.137, "semiminor": pytest.approx(6356.752314), "unit": "km"}
    for key in ("body_rotation", "instrument_pointing"):
        assert {"ephemeris_times", "quaternions", "angular_velocities", "reference_frame"} <= set(isd[key])
    assert {"positions", "velocities", "ephemeris_times", "reference_frame"} <= set(isd["sun_position"])
    path = isd["instrument_position"]
    assert path["reference_frame"] == 1  # turns with the Earth
    times, p_km, v_km_s = (np.array(path[k]) for k in ("ephemeris_times", "positions", "velocities"))
    slope = (p_km[2:] - p_km[:-2]) / (times[2:] - times[:-2])[:, None]
    assert np.allclose(v_km_s[1:-1], slope, rtol=1e-5, atol=1e-4)  # km/s; nodes some seconds apart
    assert np.allclose(np.linalg.norm(p_km, axis=1), 6900.0, atol=60.0)
    sun = np.array(isd["sun_position"]["positions"][0])
    # 20 March 2025, 02:31 UTC: equinox at 09:01, so the Sun stands over longitude 180 - 15 * 2.5 = 144
    # degrees (and
    # 2 degrees more for the equation of time), 0.1 degrees south of the equator, at 0.996 au.
    assert np.degrees(np.arctan2(sun[1], sun[0])) == pytest.approx(144.1, abs=0.5)
    assert np.linalg.norm(sun) == pytest.approx(0.9960 * 149_597_870.7, rel=1e-3)


def test_times_of_an_isd_are_barycentric_seconds_by_astropy(pieces):
    isd, model = pieces[1][0].isd, strip()
    first, last = model.instants_of_lines(1, np.array([-0.5, LINES - 0.5]))
    middle = isd["center_ephemeris_time"]
    t = Time(EPOCH.utc_from_seconds(np.array([first, last])), scale="utc")
    et = (t.tdb - Time("2000-01-01T12:00:00", scale="tdb")).to_value("s")
    times = isd["starting_ephemeris_time"]
    # s: ERFA's geocentric terms, 2 us
    assert times == pytest.approx(et[0], abs=1e-5)
    assert et[0] < middle < et[1]
