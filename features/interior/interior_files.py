"""What `boresight remote-camera-calibrate` writes and prints."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from boresight.features.interior.interior_estimate import InteriorEstimate
from boresight.features.interior.interior_of_dumps import InteriorCalibration
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.files.remote_camera import remote_camera_table
from boresight.pipeline.files.text_tables import write_toml
from boresight.pipeline.files.whole_file import write_figure, write_json, write_whole
from boresight.pipeline.report.panels import GREY, OURS, THIRD, legend_below, panels
from boresight.records.record import Floats, Ints

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["interior_json", "interior_lines", "write_interior"]

MAP_SAMPLES = 60  # of each CCD
WIDTH = 80  # columns of a terminal that a table keeps to
KINDS = {  # unit of a parameter, and its size
    "shift_along": ("px", 1.0),
    "shift_across": ("px", 1.0),
    "rotation": ("µrad", 1e6),
    "scale": ("ppm", 1e6),
    "stagger": ("µs", 1e6),
}


def interior_lines(calibration: InteriorCalibration) -> list[str]:
    """Parameters with 1-sigma, error of the map, matrix and gauge."""
    found, camera = calibration.found, calibration.found.camera
    value, sigma = _by_name(found)
    old_m = calibration.found.model.camera.focal_m
    change = f"{value['focal'] * 1e6:+.1f} ± {sigma['focal'] * 1e6:.1f} ppm"
    lines = [f"{'focal length, m':26s}{old_m:.7f} -> {camera.focal_m:.7f} ({change})"]
    columns = [["", *(f"CCD {c}" for c in range(camera.n_ccds))]]
    for kind, (unit, scale) in KINDS.items():
        if f"{kind}/0" in value:
            names = [f"{kind}/{c}" for c in range(camera.n_ccds)]
            cells = [f"{scale * value[n]:+.2f} ± {scale * sigma[n]:.2f}" for n in names]
            columns.append([f"{kind}, {unit}", *cells])
    columns.append(["curve, px", *(f"{_curve_rms(found, c):.2f}" for c in range(camera.n_ccds))])
    lines += _table(columns)
    before, after = map_errors_px(found)
    lines.append(f"{'change of looks, rms px':26s}{before:.3f}; stated 1 sigma after it {after:.3f}")
    arcsec = "  ".join(f"{one / ARCSEC:.4f}" for one in found.installation.sigma_theta)
    lines.append(f"{'1 sigma of the matrix':26s}{arcsec} arcsec")
    lines += [f"zero by constraint: {gauge.name} (not told from {gauge.reason})" for gauge in found.gauges]
    stated = f"look_distortion_px = {after:.2g}"  # two digits: it is a 1-sigma
    return [*lines, f"state in dump.toml: {stated}; `calibrate` does not use the covariance of the camera"]


def map_errors_px(found: InteriorEstimate) -> tuple[float, float]:
    """rms over all samples of the change of the looks, and of its stated 1-sigma, px on each axis."""
    ccd, sample = _all_samples(found)
    change, sigma = found.map_change_px(ccd, sample), found.map_sigma_px(ccd, sample)
    return float(np.sqrt(np.mean(change**2))), float(np.sqrt(np.mean(sigma**2)))


def interior_json(calibration: InteriorCalibration) -> dict[str, Any]:
    """The interior orientation for programs."""
    found = calibration.found
    before, after = map_errors_px(found)
    value, sigma = _by_name(found)
    return {
        "parameters": [{"name": n, "value": value[n], "sigma": sigma[n]} for n in found.model.names],
        "gauge": [{"name": gauge.name, "not_told_from": gauge.reason} for gauge in found.gauges],
        "map_change_rms_px": before,
        "map_sigma_rms_px": after,
        "R_cs": found.installation.R_cs.as_matrix().tolist(),
        "covariance_rad2": found.installation.cov_theta.tolist(),
        "strips": len(calibration.strips),
        "targets": found.installation.n_targets,
        "chi2": found.installation.chi2,
        "dof": found.installation.dof,
    }


def write_interior(calibration: InteriorCalibration, out: Path) -> tuple[Path, ...]:
    """`remote_camera.toml`, `interior.json` and `interior.png` in the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    files = (out / "remote_camera.toml", out / "interior.json", out / "interior.png")
    found = calibration.found
    table = remote_camera_table(found.camera, calibration.dump.remote_bit_depth)
    table["interior"] = {
        "parameters": list(found.model.names),
        "values": found.values.tolist(),
        "covariance": [[float(f"{value:.12g}") for value in row] for row in found.covariance.tolist()],
        "gauge": [f"{gauge.name}: {gauge.reason}" for gauge in found.gauges],
    }
    write_whole(files[0], lambda path: write_toml(path, table))
    write_json(files[1], interior_json(calibration))
    write_figure(files[2], _figure(calibration))
    return files


def _by_name(found: InteriorEstimate) -> tuple[dict[str, float], dict[str, float]]:
    sigma = np.sqrt(np.maximum(np.diag(found.covariance), 0.0))
    names = found.model.names
    return dict(zip(names, found.values.tolist())), dict(zip(names, sigma.tolist()))


def _curve_rms(found: InteriorEstimate, c: int) -> float:
    rows = [n for n, name in enumerate(found.model.names) if name.startswith("curve_") and f"/{c}/" in name]
    return float(np.sqrt(np.mean(found.values[rows] ** 2)))


def _all_samples(found: InteriorEstimate) -> tuple[Ints, Floats]:
    sizes = [ccd.n_px - 1.0 for ccd in found.camera.ccds]
    sample = np.concatenate([np.linspace(0.0, size, MAP_SAMPLES) for size in sizes])
    return np.repeat(np.arange(len(sizes)), MAP_SAMPLES), sample


def _figure(calibration: InteriorCalibration) -> Figure:
    """Residuals along the field before and after, with the estimated change and its 1-sigma."""
    found, targets = calibration.found, calibration.found.installation.targets
    shown = targets.kept & np.isfinite(targets.residual_c).all(axis=1)
    ccd, sample = targets.ccd[shown], targets.sample[shown]
    after = targets.residual_c[shown] / found.camera.pixel_rad
    before = after - found.map_change_px(ccd, sample)
    starts = np.concatenate([[0], np.cumsum([one.n_px for one in found.camera.ccds])])
    grid_ccd, grid_sample = _all_samples(found)
    change, sigma = found.map_change_px(grid_ccd, grid_sample), found.map_sigma_px(grid_ccd, grid_sample)
    names = ("targets and stars", "assumed less estimated camera, 1 sigma")
    figure, axes = panels(2, 2, 2.3, sharex=True, sharey="col")
    for row, points, line in ((0, before, -change), (1, after, np.zeros_like(change))):
        for axis, name in enumerate(("along the flight (x)", "along the detectors (y)")):
            panel = axes[row, axis]
            panel.plot(starts[ccd] + sample, points[:, axis], ".", color=GREY, ms=3, label=names[0])
            for c in range(found.camera.n_ccds):
                own = grid_ccd == c
                at, middle = starts[c] + grid_sample[own], line[own, axis]
                panel.plot(at, middle, "-", color=OURS, label=names[1])
                low, high = middle - sigma[own, axis], middle + sigma[own, axis]
                panel.fill_between(at, low, high, color=THIRD, alpha=0.5, lw=0)
                panel.axvline(starts[c], color="0.8", lw=0.6)
            panel.set_title(f"{('before', 'after')[row]}: residuals {name}", fontsize=10)
    for panel in axes[1]:
        panel.set_xlabel("sample, CCD after CCD")
    for panel in axes[:, 0]:
        panel.set_ylabel("px")
    legend_below(figure, axes[0, 0])
    return figure


def _table(columns: list[list[str]]) -> list[str]:
    """Lines of a table of these columns, right-aligned; where it is wider than `WIDTH`, as several below one
    another, each with the first column.
    """
    names, *others = columns
    lines, part, used = list[str](), list[tuple[list[str], int]](), 0
    first = max(map(len, names))
    for column in [*others, None]:
        wide = 0 if column is None else max(map(len, column)) + 2
        if column is None or first + used + wide > WIDTH:
            for n, name in enumerate(names):
                lines.append(f"{name:{first}s}" + "".join(f"{one[n]:>{size}s}" for one, size in part))
            part, used = [], 0
        if column is not None:
            part, used = [*part, (column, wide)], used + wide
    return lines
