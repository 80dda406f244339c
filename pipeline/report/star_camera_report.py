"""A star camera calibrated from image files: what is read, what is written, what is said."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from geometry.star_camera import StarCamera
from pipeline.errors import RawDataError
from pipeline.files.toml_writer import toml_text
from pipeline.identify import read_camera, read_sky_image, sky_index
from pipeline.work.unit_store import write_whole
from star_id.camera_calibration import (
    CameraCalibration,
    ResidualMap,
    SkyFrame,
    calibrate_camera,
    residual_map,
)
from star_id.camera_fit import PARAMETERS
from star_id.field import nominal_camera, solve_stars
from star_id.finding.star_list import find_stars
from star_id.naming.identify import NotIdentified
from star_id.settings import StarSettings

__all__ = ["calibrate_from_images"]


def calibrate_from_images(
    images: Sequence[Path],
    camera_file: Path | None,
    fov_deg: float | None,
    settings: StarSettings,
    *,
    out: Path,
    report: Path | None,
    plot: Path | None,
) -> tuple[list[str], bool]:
    """Lines to print, and whether a camera came out and was written to `out`."""
    camera = read_camera(camera_file)
    frames, bits, size = [], 8, None
    for path in images:
        image = read_sky_image(path, camera, camera_file)
        size = size or image.shape
        if image.shape != size:
            found, expected = (f"{s[1]} x {s[0]} px" for s in (image.shape, size))
            raise RawDataError(str(path), "image size", found, f"{expected}, as in {images[0]}")
        bits = 8 * image.dtype.itemsize if image.dtype.kind == "u" else 16
        frames.append(SkyFrame(path.name, find_stars(image, settings)))
    assert size is not None  # the command line asks for one image at least
    lines: list[str] = []
    index = sky_index(None, _fov_deg(camera) if camera is not None else fov_deg, settings)
    if camera is None:
        first = _first_camera(frames, (size[1], size[0]), fov_deg, settings, index)
        if isinstance(first, NotIdentified):
            return [f"no image was identified: {first.reason}"], False
        camera = first
    result = calibrate_camera(frames, camera, index, settings)
    if isinstance(result, NotIdentified):
        return [f"not calibrated: {result.reason}"], False
    write_whole(out, lambda target: target.write_text(toml_text(_camera_table(result.camera, bits)), "utf-8"))
    cells = residual_map(result)
    if report is not None:
        content = json.dumps(_report(result, cells), indent=1)
        write_whole(report, lambda target: target.write_text(content + "\n", "utf-8"))
    if plot is not None:
        _draw(result, cells, plot)
    lines += _lines(result)
    lines.append(f"-> {out}")
    return lines, True


def _first_camera(
    frames: Sequence[SkyFrame],
    size: tuple[int, int],
    fov_deg: float | None,
    settings: StarSettings,
    index: Any,
) -> StarCamera | NotIdentified:
    """A camera of the field of view that is given, or of the first image that can be named without it."""
    if fov_deg is not None:
        return nominal_camera(size, float(np.radians(fov_deg)))
    answer: NotIdentified = NotIdentified("there is no image", {})
    for frame in frames:
        found = solve_stars(frame.stars.xy_px, size, index, settings)
        if not isinstance(found, NotIdentified):
            return nominal_camera(size, found.fov_x_rad)
        answer = found
    return answer


def _fov_deg(camera: StarCamera) -> float:
    return float(np.degrees(2.0 * np.arctan(0.5 * camera.width_px * camera.pixel_m / camera.focal_m)))


def _camera_table(camera: StarCamera, bits: int) -> dict[str, Any]:
    return {
        "focal_length_mm": camera.focal_m * 1e3,
        "pixel_pitch_um": camera.pixel_m * 1e6,
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "principal_point_px": list(camera.principal_px),
        "bit_depth": bits,
        "distortion": {
            "p1_per_mm": camera.p1,
            "p2_per_mm": camera.p2,
            "q1_per_mm2": camera.q1,
            "q2_per_mm4": camera.q2,
        },
    }


def _lines(result: CameraCalibration) -> list[str]:
    camera, sigma = result.camera, np.sqrt(np.diag(result.covariance))
    corner = np.array([[0.0, 0.0], [0.5 * camera.width_px, 0.5 * camera.height_px]])
    model = result.model_sigma_px(corner)
    lines = [
        f"{len(result.frame)} stars in {len(result.frames_used)} images, {result.outliers} left out"
        f"   rms {result.rms_px:.4f} px   chi2/dof {result.chi2 / max(result.dof, 1):.2f}",
        f"focal length  {camera.focal_m * 1e3:.6f} mm  +- {sigma[0] * 1e3:.6f}"
        f"  (pixel pitch taken as {camera.pixel_m * 1e6:g} um)",
        f"principal point  ({camera.principal_px[0]:.3f}, {camera.principal_px[1]:.3f}) px"
        f"  +- ({sigma[1]:.3f}, {sigma[2]:.3f})",
        *(
            f"{name}  {getattr(camera, name):.4e}  +- {sigma[k + 3]:.1e}"
            for k, name in enumerate(("p1", "p2", "q1", "q2"))
        ),
        f"error of the model  {model[1]:.4f} px in the middle, {model[0]:.4f} px in a corner (1 sigma)",
    ]
    return lines + [f"{frame} not used: {reason}" for frame, reason in result.frames_refused]


def _report(result: CameraCalibration, cells: ResidualMap) -> dict[str, Any]:
    opencv = result.camera.opencv_parameters()
    return {
        "parameters": list(PARAMETERS),
        "values": [
            result.camera.focal_m,
            *result.camera.principal_px,
            *(getattr(result.camera, name) for name in PARAMETERS[3:]),
        ],
        "units": ["m", "px", "px", "1/mm", "1/mm", "1/mm^2", "1/mm^4"],
        "covariance": result.covariance.tolist(),
        "chi2": result.chi2,
        "dof": result.dof,
        "rms_px": result.rms_px,
        "stars": len(result.frame),
        "outliers": result.outliers,
        "frames_used": list(result.frames_used),
        "frames_refused": [{"file": frame, "reason": reason} for frame, reason in result.frames_refused],
        "opencv": {
            "camera_matrix": opencv.camera_matrix.tolist(),
            "distortion_k1_k2_p1_p2": opencv.distortion.tolist(),
        },
        "residual_map": {
            "mean_px": np.nan_to_num(cells.mean_px).tolist(),
            "error_px": np.nan_to_num(cells.error_px).tolist(),
            "count": cells.count.tolist(),
        },
    }


def _draw(result: CameraCalibration, cells: ResidualMap, path: Path) -> None:
    """Mean residual of each cell of the detector as an arrow, and the scale beside it."""
    from matplotlib.figure import Figure

    camera = result.camera
    rows, columns = cells.count.shape
    x, y = np.meshgrid(
        (np.arange(columns) + 0.5) * camera.width_px / columns,
        (np.arange(rows) + 0.5) * camera.height_px / rows,
    )
    figure = Figure(figsize=(6.0, 4.6), layout="constrained")
    axes = figure.subplots()
    arrows = axes.quiver(x, y, cells.mean_px[..., 0], cells.mean_px[..., 1], angles="xy")
    axes.quiverkey(arrows, 0.9, 1.03, 0.01, "0.01 px", labelpos="W")
    axes.set_xlim(0, camera.width_px)
    axes.set_ylim(camera.height_px, 0)
    axes.set_aspect("equal")
    axes.set_xlabel("column, px")
    axes.set_ylabel("row, px")
    axes.set_title(f"mean residuals, rms of all stars {result.rms_px:.4f} px", loc="left", fontsize=10)
    write_whole(path, lambda target: figure.savefig(target, format="png", dpi=120))
