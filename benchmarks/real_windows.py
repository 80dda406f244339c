"""Windows of one telemetry record against each other: three strips within 95 s of Sentinel-2A's trackers.

The record is imported once, with the noise that `import` writes by default. For each window the strip's times
are moved and points are measured in it with the operator's own attitude and refining, exact to a millimetre;
the stated errors of position, clock, vibration and looks are those of exact points: none. `calibrate` then
gives the matrices of both trackers with their covariance; three windows must agree within it.

The data (`../shared/data/sentinel2`) are not part of the project: without them the script says so and stops.
Half a minute of CPU time.

    python benchmarks/real_windows.py [--folder DATA]
"""

from __future__ import annotations

import csv
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from real_sentinel2 import HEADER, real_folder
from record import exit_status, head, verdict
from scipy.stats import chi2

from boresight.features.operators.sentinel2_grid import operator_orbit, operator_pushbroom
from boresight.features.operators.sentinel2_product import Sentinel2, read_sentinel2
from boresight.geometry.constants import ARCSEC, WGS84
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.run.settings import Settings

BAND = "B04"
Array = np.ndarray
SHIFTS_S = (-30.0, 4.0, 37.0)  # within the ephemeris, without common rows
SAMPLES = (0.0, 1275.5, 2551.0)  # of each of the twelve CCDs, in nine rows: 324 points
ERRORS = ("position_m", "clock_s", "vibration_arcsec", "look_distortion_px")


def imported(real: Path, root: Path) -> str:
    """The dump that the command makes by default; what it says."""
    asked = ("import", "sentinel2", next(real.glob("*MTD_L1B_DS*.xml")), root, "--gipp", real, "--band", BAND)
    command = [sys.executable, "-m", "boresight", *map(str, asked)]
    ran = subprocess.run(command, capture_output=True, text=True)
    return ran.stdout + ran.stderr


def window(strip: Sentinel2, plain: Path, root: Path, shift_s: float) -> Path:
    """The dump with its strip moved by `shift_s`, and points measured in it by the operator's model."""
    shutil.copytree(plain, root)
    rows = list(csv.reader((root / "strips.csv").open()))
    epoch = open_dump(plain, sky_alone=True).epoch
    for row in rows[1:]:
        t_s = float(epoch.seconds_from_utc([row[3]])[0]) + shift_s
        row[3] = epoch.utc_from_seconds([t_s])[0]
    (root / "strips.csv").write_text("\n".join(map(",".join, rows)) + "\n")
    moved = replace(strip, t_first_row_s=strip.t_first_row_s + shift_s)
    orbit, points = operator_orbit(strip, strip.earth_orientation), [HEADER]
    for ccd in range(12):
        sample, line = (a.ravel() for a in np.meshgrid(SAMPLES, np.linspace(0.0, 13_823.0, 9)))
        place = operator_pushbroom(moved, ccd, orbit).ground_points(ccd, sample, line, ConstantHeight(50.0))
        lat, lon, height = geodetic_from_ecef(place, WGS84)
        for n, values in enumerate(zip(sample, line, np.degrees(lat), np.degrees(lon), height)):
            x, y, a, o, h = map(float, values)
            measured = f"{ccd},{x!r},{y!r},0.001,0.001,{a!r},{o!r},{h!r},ellipsoidal,0,0,0"
            points.append(f"p{ccd}.{n},{BAND},{measured}\n")
    (root / "points.csv").write_text("".join(points))
    text = (root / "dump.toml").read_text()
    for key in ERRORS:
        text = re.sub(rf"(?m)^{key} = .*$", f"{key} = 0.0", text)
    (root / "dump.toml").write_text(text)
    return root


def matrices(root: Path) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (6,) of both trackers' matrices from the operator's, axes of c, rad, and their covariance."""
    dump = open_dump(root)
    estimate = calibrate_dump(dump, Settings()).estimate
    turns = [one.R_cs * known.R_cs0.inv() for one, known in zip(estimate.heads, dump.heads)]
    return np.concatenate([turn.as_rotvec() for turn in turns]), estimate.cov_heads


def disagreement(found: list[tuple[np.ndarray, np.ndarray]]) -> tuple[float, int]:
    """Chi-squared of windows about their weighted mean, and its degrees of freedom."""
    weights = [np.linalg.inv(covariance) for _, covariance in found]
    mean = np.linalg.solve(sum(weights), sum(w @ theta for w, (theta, _) in zip(weights, found)))
    off = [theta - mean for theta, _ in found]
    return sum(float(one @ w @ one) for w, one in zip(weights, off)), 6 * (len(found) - 1)


def compared(noise: str, strip: Sentinel2, plain: Path, work: Path) -> tuple[str, float, Array]:
    """Calibrate all windows; the text of their disagreement, chi-squared and its 99 % band."""
    found = []
    for shift_s in SHIFTS_S:
        theta, covariance = matrices(window(strip, plain, work / f"{noise}{shift_s:+g}", shift_s))
        found.append((theta, covariance))
        turns, sigma = np.round(theta / ARCSEC, 2), np.round(np.sqrt(np.diag(covariance)) / ARCSEC, 2)
        print(f'{noise}, window {shift_s:+5.1f} s: STR1 and STR2 {turns}", 1 sigma {sigma}"', flush=True)
    statistic, dof = disagreement(found)
    return f"{noise}: chi2 {statistic:.1f} of {dof}", statistic, chi2(df=dof).ppf([0.005, 0.995])


def main() -> int:
    """Print all figures; 1 where a limit is missed."""
    real = real_folder(__doc__) / "sentinel2"
    head("Windows of one telemetry record against each other: Sentinel-2A")
    with tempfile.TemporaryDirectory() as scratch:
        work, plain = Path(scratch), Path(scratch) / "plain"
        print(imported(real, plain).replace(f"{work}/", ""))
        strip = read_sentinel2(next(real.glob("*MTD_L1B_DS*.xml")), real, BAND)
        text, statistic, (low, high) = compared("as import writes it", strip, plain, work)
        verdict(f"windows of one record, {text}", f"{low:.1f} to {high:.1f}", low <= statistic <= high, 3)
        rows = (plain / "dump.toml").read_text().splitlines()
        white = [row for row in rows if not re.match("c(orrelated|onstant|orrelation).*=", row)]
        (plain / "dump.toml").write_text("\n".join(white) + "\n")
        print(compared("white alone", strip, plain, work)[0])
    return exit_status()


if __name__ == "__main__":
    sys.exit(main())
