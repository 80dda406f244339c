"""ISDs against the line-scanner model of the USGS, written here anew from its documentation and source as it
reads an ISD: nothing of ours but the numbers in the file goes in."""

import json

import numpy as np
import pytest
from orbiting_camera import EPOCH, LINES, strip

from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.exports.csm_isd import IsdNames, line_scanner_isds

NAMES = IsdNames("strip.tif", "TESTSAT", "TESTCAM")
HEIGHT_M = 400.0


class LineScanner:
    """`USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL`: CSM image coordinates, where (0.5, 0.5) is the first pixel's
    centre.
    """

    def __init__(self, text):
        self.isd = json.loads(text)
        centre = self.isd["center_ephemeris_time"]
        position, pointing = self.isd["instrument_position"], self.isd["instrument_pointing"]
        assert self.isd["body_rotation"]["quaternions"] == [[1.0, 0.0, 0.0, 0.0]] * 2
        self.t = np.array(position["ephemeris_times"]) - centre
        self.p = 1e3 * np.array(position["positions"])
        q = np.array(pointing["quaternions"])  # scalar first, inertial (here: Earth-fixed) to camera
        self.q = np.column_stack([-q[:, 1:], q[:, 0]])  # camera to Earth-fixed, scalar last
        assert pointing["ephemeris_times"] == position["ephemeris_times"]

    def ray(self, line, sample):
        (start_line, start_s, step_s), *_ = self.isd["line_scan_rate"]
        t = start_s + step_s * (line - start_line + 0.5)
        p, q = self.lagrange(self.p, t), self.lagrange(self.q, t)
        x, y = self.undistorted(*self.focal_plane(sample))
        look = np.array([-x, -y, -self.isd["focal_length_model"]["focal_length"]])
        return p, self.matrix(q / np.linalg.norm(q)) @ (look / np.linalg.norm(look))

    def focal_plane(self, sample):
        """Real image point, mm, of a sample; the line within the detector is 0."""
        centre = self.isd["detector_center"]
        s, el = np.array(self.isd["focal2pixel_samples"]), np.array(self.isd["focal2pixel_lines"])
        detector_sample = sample * self.isd["detector_sample_summing"] + self.isd["starting_detector_sample"]
        rhs = [
            self.isd["starting_detector_line"] - centre["line"] - el[0],
            detector_sample - centre["sample"] - s[0],
        ]
        return np.linalg.solve([el[1:], s[1:]], rhs)

    def undistorted(self, x_real, y_real):
        """Ideal image point whose cubic distortion is the real one, by Newton's method."""
        cx, cy = (np.array(self.isd["optical_distortion"]["transverse"][axis]) for axis in "xy")
        x, y = x_real, y_real
        for _ in range(20):
            f = np.array([1, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])
            fx = np.array([0, 1, 0, 2 * x, y, 0, 3 * x * x, 2 * x * y, y * y, 0])
            fy = np.array([0, 0, 1, 0, x, 2 * y, 0, x * x, 2 * x * y, 3 * y * y])
            jacobian = [[cx @ fx, cx @ fy], [cy @ fx, cy @ fy]]
            step = np.linalg.solve(jacobian, [x_real - cx @ f, y_real - cy @ f])
            x, y = x + step[0], y + step[1]
        return x, y

    def lagrange(self, values, t):
        """Eight points around t; equal steps."""
        step = (self.t[-1] - self.t[0]) / (len(self.t) - 1)
        first = int((t - self.t[0]) // step) - 3
        assert 0 <= first <= len(self.t) - 8, "the model would fall back to a lower order here"
        nodes = self.t[first : first + 8]
        weights = [np.prod([(t - m) / (n - m) for m in nodes if m != n]) for n in nodes]
        return np.array(weights) @ values[first : first + 8]

    @staticmethod
    def matrix(q):
        x, y, z, w = q
        return np.array(
            [
                [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
            ]
        )


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


def test_a_detector_with_strong_distortion_is_cut_and_one_without_is_not(pieces):
    assert (
        len(pieces[0]) > 1 and pieces[0][0].suffix == f"ccd0.samples-00000-{pieces[0][0].stop_sample - 1:05d}"
    )
    assert len(pieces[1]) == 1 and pieces[1][0].suffix == "ccd1"
    *cut, whole = pieces[0]
    assert whole.suffix == "ccd0.whole" and (whole.first_sample, whole.stop_sample) == (0, 2048)
    assert whole.isd["boresight"]["model_error_px"] > 0.01  # stated: one cubic does not follow the table
    covered = [n for p in cut for n in range(p.first_sample, p.stop_sample)]
    assert covered == list(range(2048))
    assert all(p.isd["boresight"]["model_error_px"] < 0.01 for p in cut)


def test_what_an_isd_reader_asks_for_is_there(pieces):
    # The keys that the ISD reader of the Abstraction Layer for Ephemerides takes without a default.
    isd = pieces[1][0].isd
    assert [isd[k] for k in ("image_identifier", "name_platform", "name_sensor")] == [
        "strip.tif",
        "TESTSAT",
        "TESTCAM",
    ]
    assert isd["name_model"] == "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"
    assert (isd["image_lines"], isd["image_samples"]) == (LINES, 2048)
    assert isd["radii"] == {"semimajor": 6378.137, "semiminor": pytest.approx(6356.752314), "unit": "km"}
    for key in ("body_rotation", "instrument_pointing"):
        assert {"ephemeris_times", "quaternions", "angular_velocities", "reference_frame"} <= set(isd[key])
    assert {"positions", "velocities", "ephemeris_times", "reference_frame"} <= set(isd["sun_position"])
    sun = np.array(isd["sun_position"]["positions"][0])
    # 20 March 2025, 02:31 UTC: equinox at 09:01, so the Sun stands over longitude 180 - 15 * 2.5 = 144
    # degrees (and
    # 2 degrees more for the equation of time), 0.1 degrees south of the equator, at 0.996 au.
    assert np.degrees(np.arctan2(sun[1], sun[0])) == pytest.approx(144.1, abs=0.5)
    assert np.linalg.norm(sun) == pytest.approx(0.9960 * 149_597_870.7, rel=1e-3)
