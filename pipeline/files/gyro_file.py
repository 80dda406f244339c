"""Read a gyro's record: CSV of rates, or of the angles by which it turned since the row before."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC
from boresight.geometry.epoch import Epoch
from boresight.geometry.gyro import GyroNoise, GyroRecord, summed_up
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump_schema import GyroFile
from boresight.pipeline.files.orbit_file import tai_seconds
from boresight.pipeline.files.text_files import check_number, csv_rows

__all__ = ["read_gyro"]

GYRO_AXES = ("x", "y", "z")  # columns of rates or angles
UNITS = {"rad": 1.0, "deg": np.pi / 180.0, "arcsec": ARCSEC}
LARGEST_RATE = 1.0  # rad/s: no satellite takes images that turns faster
FREE_RAD_S = 1e-3  # 1-sigma of a bias that is not stated: 200 arc-seconds a second
FINE = 0.1  # of the angle random walk over a step: resolution of a gyro that states none
GAP = 3.0  # usual steps: over longer ones nothing is summed up


def read_gyro(path: Path, stated: GyroFile, epoch: Epoch) -> GyroRecord:
    """The record that the table [gyro] of dump.toml describes; `RawDataError` with line and column."""
    file, clock = stated.file, stated.time_scale.lower()
    times, values = list[str](), list[list[float]]()
    for line, row in csv_rows(path, (clock, *GYRO_AXES), (), file):
        times.append(row[clock].strip())
        values.append([check_number(row[name], file, f"{line}, {name}") for name in GYRO_AXES])
    if len(times) < 2:
        raise RawDataError(file, "rows", len(times), "two or more")
    since, t = tai_seconds(times, stated.time_scale, file, clock)
    t_s = t + float(since.tai_s - epoch.tai_s)
    step = np.diff(t_s, prepend=t_s[0])[:, None]
    if len(bad := np.flatnonzero(step[1:, 0] <= 0.0)):
        raise RawDataError(file, f"row {bad[0] + 2}, {clock}", times[bad[0] + 1], "strictly increasing times")
    turns = np.array(values) * UNITS[stated.unit]
    if stated.quantity == "rates":
        turns[1:] = 0.5 * (turns[1:] + turns[:-1])
        turns *= step
    turns[0] = 0.0
    usual = float(np.median(step[1:]))
    near = step[1:, 0] < GAP * usual  # over gaps nothing is summed up
    rate = np.abs(turns[1:] / step[1:])[near].max(initial=0.0)
    if rate > LARGEST_RATE:
        expected = f"turns of at most {LARGEST_RATE:g} rad/s"
        raise RawDataError(file, "rates", f"{rate:.3g} rad/s by {stated.quantity} in {stated.unit}", expected)
    walk = stated.random_walk_arcsec * ARCSEC
    return GyroRecord(
        t_s=t_s,
        R_sz=summed_up(Rotation.from_quat(stated.quaternion_sg).apply(turns)),
        noise=GyroNoise(
            random_walk_rad=walk,
            bias_walk_rad_s=stated.bias_walk_arcsec_s * ARCSEC,
            bias_rad_s=FREE_RAD_S if stated.bias_arcsec_s is None else stated.bias_arcsec_s * ARCSEC,
            white_rad=stated.white_arcsec * ARCSEC or FINE * walk * np.sqrt(usual),
        ),
    )
