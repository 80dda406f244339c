"""The line-scanner model of the USGS, written here anew from its documentation and source as it reads an ISD:
nothing of ours but the numbers in the file goes in.
"""

import json

import numpy as np
from scipy.spatial.transform import Rotation


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
        return p, Rotation.from_quat(q).apply(look / np.linalg.norm(look))

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
