"""Sentinel-2's trackers and residuals, from ../shared/data: `python scripts/figures/real_mission.py`.

Without the data, which are not part of the project, the drawings stay as they are.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation
from style import Ink, draw

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from real_sentinel2 import BULLETIN, grid_of, looks
from record import SHARED

from boresight.features.exports.operator_parameters import fit_correction
from boresight.features.operators.sentinel2_grid import operator_orbit
from boresight.features.operators.sentinel2_product import AttitudeRecord, Sentinel2, read_sentinel2
from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.files.orbit_and_earth import read_earth_orientation

REAL = SHARED / "sentinel2"
RANGE_M = 786e3  # distance to the ground below
if not (REAL / "grid_B04.csv").exists():
    sys.exit(f"the data of Sentinel-2 are not there: {REAL}; the drawings stay as they are")


def opened() -> tuple[Sentinel2, object]:
    """The strip of band B04 and its orbit."""
    table = Path(sys.argv[0]).with_suffix(".bulletin.csv")
    table.write_text(BULLETIN)
    strip = read_sentinel2(next(REAL.glob("*MTD_L1B_DS*.xml")), REAL, "B04")
    orbit = operator_orbit(strip, read_earth_orientation(table, "bulletin"))
    table.unlink()
    return strip, orbit


STRIP, ORBIT = opened()
SEEN = looks(STRIP, grid_of(REAL, "B04"), ORBIT, "taylor")


def errors_of(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Instants, and rotations (K, 3), arc-seconds, axes of the tracker, from the corrected attitude to it."""
    t, tracker = _within(STRIP.trackers[name])
    corrected = _track(STRIP.corrected).R_si(t)
    off = (tracker * (STRIP.R_ps[name].inv() * corrected).inv()).as_rotvec() / ARCSEC
    return t, off


def _track(record: AttitudeRecord) -> AttitudeTrack:
    first, last = ORBIT.span_s
    inside = (record.t_s >= first) & (record.t_s <= last)
    return AttitudeTrack(record.t_s[inside], record.R_is[inside].inv(), ORBIT)


def _within(record: AttitudeRecord) -> tuple[np.ndarray, Rotation]:
    low, high = STRIP.corrected.t_s[1], ORBIT.span_s[1] - 0.1
    inside = (record.t_s >= low) & (record.t_s <= high)
    return record.t_s[inside], record.R_is[inside].inv()


def noise(ink: Ink) -> Figure:
    figure, axes = plt.subplots(1, 2, figsize=(8.6, 3.7), sharex=True)
    counts = np.unique(np.round(2.0 ** np.arange(0.0, 8.0, 0.5)).astype(int))
    for axis, title, panel in ((0, "across the line of sight (x)", axes[0]), (2, "about it (z)", axes[1])):
        for name, ink_of, mark in (("STR1", ink.star, "o"), ("STR2", ink.ground, "s")):
            _, off = errors_of(name)
            value = off[:, axis] - off[:, axis].mean()
            scatter = []
            for n in counts:
                means = value[: len(value) // n * n].reshape(-1, n).mean(axis=1)
                scatter.append(np.sqrt(0.5 * np.mean(np.diff(means) ** 2)))
            panel.loglog(counts * 0.1, scatter, mark, ls="-", color=ink_of, label=name, ms=5)
            panel.loglog(counts * 0.1, scatter[0] / np.sqrt(counts), ls=":", color=ink_of, lw=1.2)
        panel.set_title(title, color=ink.text, fontsize=11)
        panel.set_xlabel("averaging time, s")
        panel.grid(color=ink.faint, alpha=0.35, which="both", lw=0.5)
        panel.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("Allan deviation, arc-seconds")
    axes[0].legend(frameon=False, labelcolor=ink.text, loc="lower left")
    axes[1].text(0.09, 0.5, "dotted: white noise\nof the same size", color=ink.text, fontsize=9.5)
    figure.tight_layout()
    return figure


def alignment(ink: Ink) -> Figure:
    """Running means of STR2 against STR1, about the axes of the MSI, against the operator's file."""
    t, one = _within(STRIP.trackers["STR1"])
    two = _track(STRIP.trackers["STR2"]).R_si(t)
    in_msi = [STRIP.R_cp * STRIP.R_ps[name] for name in ("STR1", "STR2")]
    off = (in_msi[1] * two * (in_msi[0] * one).inv()).as_rotvec() / ARCSEC
    figure, panel = plt.subplots(figsize=(8.6, 3.4))
    for axis, name, colour, style in zip(
        range(3),
        ("x, along track", "y, across track", "z, nadir"),
        (ink.star, ink.text, ink.ground),
        ("-", ":", "--"),
    ):
        smooth = np.convolve(off[:, axis], np.ones(50) / 50, mode="valid")
        panel.plot(t[25 : 25 + len(smooth)], smooth, color=colour, ls=style, label=f"about {name}", lw=1.8)
    panel.axhline(0.0, color=ink.faint, lw=1.0)
    panel.text(64.0, 0.0, "operator's\nfile", color=ink.text, fontsize=9.5, va="center")
    panel.axvspan(0.0, 25.25, color=ink.fill, zorder=0)
    panel.text(0.4, panel.get_ylim()[1], "strip", color=ink.text, va="top")
    panel.set_xlabel("seconds from the begin of the strip")
    panel.set_ylabel("STR2 against STR1, arc-seconds")
    panel.legend(frameon=False, labelcolor=ink.text, ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.16))
    panel.spines[["top", "right"]].set_visible(False)
    return figure


def residuals(ink: Ink) -> Figure:
    """Residuals on the ground, along and across the track, before and after the constant rotation."""
    v_s, u_c, t_s = SEEN
    grid = grid_of(REAL, "B04")
    order = np.argsort(grid[:, 0], kind="stable")  # as `looks` has them
    place = grid[order][:, 3:5]
    t0 = STRIP.refining.t_middle_s
    found = fit_correction(v_s, u_c, t_s, STRIP.R_cp, t0, degree=0, with_scale=False)
    before = v_s - STRIP.R_cp.inv().apply(u_c)
    figure, panels = plt.subplots(1, 2, figsize=(8.6, 4.3), sharey=True)
    for panel, off, unit, title in (
        (panels[0], before, 4.0, "the operator's mounting"),
        (panels[1], found.residuals_rad, 0.4, "after calibration"),
    ):
        metres = off[:, :2] * RANGE_M
        some = slice(None, None, 7)
        # x of the piloting frame is along the track, which goes 13 degrees west of south; y is to its west
        arrow = np.column_stack(
            [
                -np.cos(0.224) * metres[:, 1] - np.sin(0.224) * metres[:, 0],
                np.sin(0.224) * metres[:, 1] - np.cos(0.224) * metres[:, 0],
            ]
        )
        panel.quiver(*place[some].T, *arrow[some].T, color=ink.star, scale=14.0 * unit, width=0.004)
        panel.quiver(-19.3, 31.95, unit, 0.0, color=ink.ground, scale=14.0 * unit, width=0.006)
        panel.text(-19.3, 32.02, f"{unit:g} m", color=ink.ground)
        rms = np.sqrt((metres**2).sum(axis=1).mean())
        panel.set_title(f"{title}: {rms:.2f} m rms", color=ink.text, fontsize=11)
        panel.set_xlabel("longitude, degrees east")
        panel.set_xticks([-19, -18, -17, -16])
        panel.set_aspect(1.0 / np.cos(np.radians(32.4)))
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("latitude, degrees north")
    figure.tight_layout()
    return figure


draw("real_noise", noise)
draw("real_alignment", alignment)
draw("real_residuals", residuals)
