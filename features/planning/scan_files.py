"""What `boresight sky-strip-plan` writes and prints."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import erfa
import numpy as np
import pandas as pd

from boresight.features.planning.scan_plan import PlannedScan, ScanChoice
from boresight.geometry.constants import ARCSEC
from boresight.geometry.epoch import Epoch
from boresight.pipeline.files.text_tables import table_csv
from boresight.pipeline.files.whole_file import write_figure, write_text
from boresight.pipeline.report.panels import INK, OURS, SERIES, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["scan_lines", "scan_table", "write_scans"]


def scan_table(choice: ScanChoice, epoch: Epoch) -> pd.DataFrame:
    """One row a scan: when, where, how fast, what it sees, and the 1-sigma with it and those before."""
    rows = []
    for number, (scan, sigma) in enumerate(zip(choice.scans, choice.sigma_rad / ARCSEC), start=1):
        ra, dec, roll = _pointing(scan)
        quaternion = dict(zip(("qx_ci", "qy_ci", "qz_ci", "qw_ci"), scan.R_ci.as_quat(canonical=True)))
        rows.append(
            {
                "scan": number,
                "utc": epoch.utc_from_seconds(np.array([scan.t_s]))[0],
                "ra_deg": ra,
                "dec_deg": dec,
                "scan_angle_deg": roll,
                "rate_mrad_s": 1e3 * scan.rate_rad_s,
                "stars": scan.stars,
                "star_camera_stars": scan.head_stars,
                **dict(zip(("sun_deg", "moon_deg", "limb_deg"), scan.away_deg)),
                **{f"sigma_{axis}_arcsec": value for axis, value in zip("xyz", sigma)},
                **quaternion,
            }
        )
    return pd.DataFrame(rows)


def scan_lines(choice: ScanChoice, epoch: Epoch) -> list[str]:
    """The scans as text."""
    lines = [f"{choice.candidates} candidates hold stars and are clear of Sun, Moon and Earth"]
    lines.append("scan  UTC                   RA deg  Dec deg   angle  mrad/s  stars")
    rows = scan_table(choice, epoch).to_dict("records")
    lines += [
        f"{row['scan']:4d}  {row['utc']!s:.19}  {row['ra_deg']:7.2f} {row['dec_deg']:+8.2f}  "
        f"{row['scan_angle_deg']:6.1f}  {row['rate_mrad_s']:+6.2f}  {row['stars']:5d}"
        for row in rows
    ]
    lines.append("scan  from Sun  Moon  limb, deg   1 sigma with it: X       Y        Z, arcsec")
    for row in rows:
        sun, moon, limb = (row[f"{body}_deg"] for body in ("sun", "moon", "limb"))
        sigma = "".join(f"{row[f'sigma_{axis}_arcsec']:9.4f}" for axis in "xyz")
        lines.append(f"{row['scan']:4d}  {sun:8.0f}  {moon:4.0f}  {limb:4.0f}           {sigma}")
    x, y, z = choice.random_sigma_rad / ARCSEC
    lines.append(f"as many at random (median): X {x:.4f}  Y {y:.4f}  Z {z:.3f} arcsec")
    return lines


def write_scans(choice: ScanChoice, epoch: Epoch, out: Path) -> tuple[Path, ...]:
    """`scans.csv` and `scans.png` in the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    table, figure = scan_table(choice, epoch), _figure(choice, epoch)
    files = (out / "scans.csv", out / "scans.png")
    write_text(files[0], table_csv(table))
    write_figure(files[1], figure)
    return files


def _pointing(scan: PlannedScan) -> tuple[float, float, float]:
    """Right ascension and declination of the optical axis at the beginning, and the angle of the camera's
    x axis from north towards east, degrees.
    """
    x, _, z = scan.R_ci.inv().as_matrix().T
    ra, dec = np.arctan2(z[1], z[0]), np.arcsin(z[2])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    angle = np.arctan2(x @ east, x @ np.cross(z, east))
    return float(np.degrees(ra) % 360.0), float(np.degrees(dec)), float(np.degrees(angle) % 360.0)


def _figure(choice: ScanChoice, epoch: Epoch) -> Figure:
    """The scans on the sky with Sun and Moon, numbered, and the 1-sigma with each."""
    figure, ((sky, steps),) = panels(1, 2, 3.2, width_ratios=(1.6, 1.0))
    for number, scan in enumerate(choice.scans, start=1):
        ra, dec, _ = _pointing(scan)
        sky.plot(ra, dec, "o", ms=6, color=OURS)
        sky.annotate(str(number), (ra, dec), textcoords="offset points", xytext=(6, 4), fontsize=9)
    jd = epoch.tt_jd(np.array([choice.scans[0].t_s]))
    bodies = (("Sun", -erfa.epv00(*jd)[0]["p"][0], "*"), ("Moon", erfa.moon98(*jd)["p"][0], "D"))
    for name, v, marker in bodies:
        ra, dec = np.degrees(np.arctan2(v[1], v[0])) % 360.0, np.degrees(np.arcsin(v[2] / np.linalg.norm(v)))
        sky.plot(ra, dec, marker, ms=11, color=INK, mfc="none", label=f"{name}, at scan 1")
    sky.set(
        xlim=(360.0, 0.0),
        ylim=(-90.0, 90.0),
        xlabel="right ascension, degrees",
        ylabel="declination, degrees",
    )
    sky.set_title("scans of the sky, in order", fontsize=10)
    sky.legend(loc="lower left", fontsize=8)
    n = np.arange(1, len(choice.scans) + 1)
    for axis, (colour, dash, marker) in enumerate(SERIES):
        sigma = choice.sigma_rad[:, axis] / ARCSEC
        steps.plot(n, sigma, dash, marker=marker, color=colour, label=f"about {'XYZ'[axis]}")
    steps.set(yscale="log", xlabel="scans", ylabel="1 sigma, arcsec", xticks=n)
    steps.set_title("installation matrix", fontsize=10)
    steps.legend(fontsize=8)
    return figure
