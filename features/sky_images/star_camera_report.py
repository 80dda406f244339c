"""Star-camera calibration from image files: read the images, fit the camera, write TOML, report and plot."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from numpy.typing import NDArray

from boresight.accepted import counted
from boresight.features.sky_images import identify_images
from boresight.features.sky_images.frame_facts import SkyImage, open_sky_images
from boresight.features.sky_images.image_time import NOWHERE, Whereabouts
from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.console.arguments import option
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.star_side import star_camera_table
from boresight.pipeline.files.whole_file import write_figure, write_text
from boresight.pipeline.report.panels import GREY, panels
from boresight.records.record import record, scalar
from boresight.star_id import camera_calibration
from boresight.star_id.camera_calibration import CameraCalibration, ResidualMap, SkyFrame
from boresight.star_id.camera_fit import detector_grid
from boresight.star_id.field import nominal_camera, solve_stars
from boresight.star_id.finding.star_list import list_stars
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.lens_model import LARGEST_UNMODELLED_PX
from boresight.star_id.settings import StarSettings

__all__ = ["CameraRequest", "calibrate_from_images"]

# What the console says of a projection other than f tan t.
_OTHER_PROJECTIONS = {
    "equidistant": " (Kannala and Brandt): angles from the axis, not their tangents",
    "stereographic": ": tangents of half the angles from the axis, twice, not of the angles",
}


@record(kw_only=True)
class CameraRequest:
    """Inputs and output files of one star-camera calibration."""

    camera_file: Path | None = scalar("TOML file of an approximate camera", default=None)
    fov_deg: float | None = scalar("horizontal field of view, degrees", default=None)
    known: Whereabouts = scalar("times and sites of the images", default=NOWHERE)
    drift: bool = option("Fit a drift of the focal length with time as well.", False, "--drift")
    out: Path = option("The calibrated star_camera.toml.", Path("star_camera.toml"))
    report: Path | None = option("JSON file: covariance, OpenCV form, residual map, stars used.")
    plot: Path | None = option("PNG of the residual map.")


def calibrate_from_images(
    sources: Sequence[Path],
    request: CameraRequest,
    settings: StarSettings,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> tuple[list[str], bool]:
    """Lines to print, and whether a camera was calibrated and written to `request.out`.

    `sources` are image files and dumps (their exposures). An unreadable image is reported and not used;
    `RawDataError` for a drift of images without time.
    """
    identify_images.check_field(request.fov_deg)
    given = identify_images.read_camera(request.camera_file)
    sky = open_sky_images(sources, request.known)
    camera = given or (sky.camera if request.fov_deg is None else None)
    if request.drift and (timeless := [one.name for one in sky.images if one.observer is None]):
        raise RawDataError(
            timeless[0], "time", "none", "a time of each image: --times, or a dump's exposures"
        )
    frames, read, unread = [], None, list(sky.omitted)
    for one in counted(sky.images, "star images", progress):
        try:
            image = _image(one, given, request.camera_file, read)
        except RawDataError as error:
            unread.append((one.name, str(error)))
            continue
        read = read or (one.name, image)
        full = settings.saturation_dn or (None if one.bit_depth is None else 2.0**one.bit_depth - 1.0)
        stars = list_stars(image, replace(settings, saturation_dn=full))
        frames.append(SkyFrame(one.name, stars, one.observer))
    unused = [f"{name} not used: {reason}" for name, reason in unread]
    if read is None:
        return [*unused, "not calibrated: no image could be read"], False
    height, width = read[1].shape
    index = identify_images.sky_index(
        None, float(np.degrees(camera.fov_x_rad)) if camera is not None else request.fov_deg, settings
    )
    if camera is None:
        first = _first_camera(frames, (width, height), request.fov_deg, settings, index)
        if isinstance(first, NotIdentified):
            return [*unused, f"no image was identified: {first.reason}"], False
        camera = first
    result = camera_calibration.calibrate_camera(
        frames, camera, index, identify_images.with_unknown_time(settings), drift=request.drift
    )
    if isinstance(result, NotIdentified):
        return [*unused, f"not calibrated: {result.reason}"], False
    result = replace(result, frames_refused=(*unread, *result.frames_refused))
    stated = next((one.bit_depth for one in sky.images if one.bit_depth is not None), None)
    bits = stated or (8 * read[1].dtype.itemsize if read[1].dtype.kind == "u" else 16)
    _write(result, request, bits)
    times = [frame.observer.tai_s for frame in frames if frame.observer is not None]
    span_s = max(times) - min(times) if times else 0.0
    lines = _lines(result, span_s)
    if result.explained:
        return [*lines, f"-> {request.out}"], True
    refusal = (
        f"not calibrated: no lens model explains residuals of {result.unmodelled_px:.3f} px rms that stars of"
        f" different images have in common; {LARGEST_UNMODELLED_PX} px are accepted. --plot draws where"
    )
    return [*lines, refusal], False


def _write(result: CameraCalibration, request: CameraRequest, bit_depth: int) -> None:
    """The files that are asked for; the camera only if its lens model explains the residuals."""
    if result.explained:
        table = tomlkit.dumps(star_camera_table(result.camera, bit_depth))
        write_text(request.out, table)
    cells = camera_calibration.residual_map(result)
    if request.report is not None:
        content = json.dumps(_report(result, cells), indent=1, allow_nan=False)
        write_text(request.report, content + "\n")
    if request.plot is not None:
        _draw(result, cells, request.plot)


def _image(
    one: SkyImage, given: StarCamera | None, camera_file: Path | None, first: tuple[str, NDArray[Any]] | None
) -> NDArray[Any]:
    """The image; `RawDataError` when its size differs from that of the first."""
    image = identify_images.read_sky_image(one.path, given, camera_file)
    if first is not None and image.shape != first[1].shape:
        found, expected = (f"{s[1]} x {s[0]} px" for s in (image.shape, first[1].shape))
        raise RawDataError(one.name, "image size", found, f"{expected}, as in {first[0]}")
    return image


def _first_camera(
    frames: Sequence[SkyFrame],
    size: tuple[int, int],
    fov_deg: float | None,
    settings: StarSettings,
    index: Any,
) -> StarCamera | NotIdentified:
    """Nominal camera with the given field of view, or with that of the first image that is identified."""
    if fov_deg is not None:
        return nominal_camera(size, float(np.radians(fov_deg)))
    answer: NotIdentified = NotIdentified("there is no image")
    for frame in frames:
        found = solve_stars(frame.stars.xy_px, size, index, settings)
        if not isinstance(found, NotIdentified):
            return nominal_camera(size, found.fov_x_rad)
        answer = found
    return answer


def _lines(result: CameraCalibration, span_s: float) -> list[str]:
    """The result as text; `span_s` is the time from the first image to the last."""
    camera, sigma = result.camera, np.sqrt(np.diag(result.covariance))
    anywhere, sigmas = _map_error(result), result.band_factor()
    lines = [
        f"{len(result.frame)} stars in {len(result.frames_used)} images, {result.outliers} rejected"
        f"   rms {result.rms_px:.4f} px   chi2/dof {result.chi2 / max(result.dof, 1):.2f}",
        f"focal length  {camera.focal_m * 1e3:.6f} mm  +- {sigma[0] * 1e3:.6f}"
        f"  (pixel pitch taken as {camera.pixel_m * 1e6:g} um)",
        f"principal point  ({camera.principal_px[0]:.3f}, {camera.principal_px[1]:.3f}) px"
        f"  +- ({sigma[1]:.3f}, {sigma[2]:.3f})",
        *(
            f"{name}  {getattr(camera, name):.4e}  +- {sigma[k]:.1e}"
            for k, name in enumerate(result.parameters)
            if k > 2
        ),
        *_foreign(result),
        f"error of the map, everywhere with 95 %  {anywhere['middle']:.4f} px in the middle,"
        f" {anywhere['corner']:.4f} px in a corner, {anywhere['largest']:.4f} px at most",
        f"  1 sigma at a single place: {anywhere['middle'] / sigmas:.4f} px in the middle,"
        f" {anywhere['corner'] / sigmas:.4f} px in a corner; {sigmas:.1f} of these hold everywhere",
    ]
    if result.focal_drift_sigma_per_s > 0.0:
        drift, error = (
            1e6 * span_s * per_s for per_s in (result.focal_drift_per_s, result.focal_drift_sigma_per_s)
        )
        span = f"{span_s:.0f} s" if span_s < 86_400.0 else f"{span_s / 86_400.0:.1f} days"
        lines.append(f"drift of the focal length  {drift:+.2f} +- {error:.2f} ppm in {span}")
    return lines + [f"{frame} not used: {reason}" for frame, reason in result.frames_refused]


def _map_error(result: CameraCalibration) -> dict[str, float]:
    """What the error of the pixel map exceeds nowhere on the detector, with 95 %, px along one axis: in the
    middle, in a corner (of a fisheye the place nearest to one that has a direction), and the largest."""
    grid = detector_grid(result.camera)
    middle = 0.5 * np.array([result.camera.width_px - 1, result.camera.height_px - 1])
    corner = grid[((grid - middle) ** 2).sum(axis=1).argmax()]
    error = result.map_error_px(np.vstack([middle, corner, grid]))
    return {"middle": float(error[0]), "corner": float(error[1]), "largest": float(error.max())}


def _foreign(result: CameraCalibration) -> list[str]:
    """What the lens has beyond Brown's model to q2."""
    camera, lines = result.camera, []
    if camera.projection != "tangent":
        lines.append(f"projection  {camera.projection}{_OTHER_PROJECTIONS[camera.projection]}")
    if camera.smooth is not None:
        size, degree = result.smooth_size_px, camera.smooth.degree
        lines.append(f"smooth distortion  degree {degree}, 1-sigma size {size:.3f} px before the fit")
    if result.unmodelled_px > 0.0:
        lines.append(f"unmodelled  {result.unmodelled_px:.4f} px rms, part of the errors below")
    return lines


def _opencv(camera: StarCamera) -> dict[str, Any] | None:
    """OpenCV's form of a lens that it knows."""
    if camera.smooth is not None or camera.projection != "tangent":
        return None
    opencv = camera.opencv_parameters()
    return {
        "camera_matrix": opencv.camera_matrix.tolist(),
        "distortion_k1_k2_p1_p2": opencv.distortion[:4].tolist(),
        "k3": opencv.distortion[4:].sum(),
    }


def _report(result: CameraCalibration, cells: ResidualMap) -> dict[str, Any]:
    camera = result.camera
    units = {"focal_m": "m", "p1": "1/mm", "p2": "1/mm", "q1": "1/mm^2", "q2": "1/mm^4", "q3": "1/mm^6"}
    smooth = camera.smooth
    return {
        "parameters": list(result.parameters),
        "values": [
            camera.focal_m,
            *camera.principal_px,
            *(getattr(camera, name) for name in result.parameters[3:]),
        ],
        "units": [units.get(name, "px") for name in result.parameters],
        "covariance": result.covariance.tolist(),
        "projection": camera.projection,
        "smooth_px": None if smooth is None else smooth.coefficients_px.tolist(),
        "unmodelled_px": result.unmodelled_px,
        "sigmas_anywhere_95": result.band_factor(),
        "error_anywhere_95_px": _map_error(result),
        "focal_drift_per_s": result.focal_drift_per_s,
        "focal_drift_sigma_per_s": result.focal_drift_sigma_per_s,
        "chi2": result.chi2,
        "dof": result.dof,
        "rms_px": result.rms_px,
        "stars": len(result.frame),
        "outliers": result.outliers,
        "frames_used": list(result.frames_used),
        "frames_refused": [{"file": frame, "reason": reason} for frame, reason in result.frames_refused],
        "opencv": _opencv(camera),
        "residual_map": {
            "mean_px": np.nan_to_num(cells.mean_px).tolist(),
            "error_px": np.nan_to_num(cells.error_px, posinf=0.0).tolist(),
            "count": cells.count.tolist(),
        },
    }


def _draw(result: CameraCalibration, cells: ResidualMap, path: Path) -> None:
    """Mean residual of each cell of the detector as an arrow, its 1-sigma error as a circle at its foot."""
    from matplotlib.collections import EllipseCollection
    from matplotlib.patches import Rectangle

    camera = result.camera
    rows, columns = cells.count.shape
    width, height = camera.width_px / columns, camera.height_px / rows
    x, y = np.meshgrid((np.arange(columns) + 0.5) * width, (np.arange(rows) + 0.5) * height)
    longest = float(np.nanmax(np.hypot(*np.moveaxis(cells.mean_px, 2, 0))))
    scale = longest / (0.9 * min(width, height))  # px of residual a px of the picture
    figure, ((axes,),) = panels(1, 1, 5.0)
    axes.grid(False)
    seen = cells.count > 0
    size = 2.0 * cells.error_px[seen] / scale
    places = {"offsets": np.column_stack([x[seen], y[seen]]), "offset_transform": axes.transData}
    style = {"facecolors": "0.88", "edgecolors": GREY, "linewidths": 0.6}
    axes.add_collection(EllipseCollection(size, size, 0.0 * size, units="xy", **places, **style))
    u, v = np.moveaxis(cells.mean_px, 2, 0)
    arrows = axes.quiver(x, y, u, v, angles="xy", scale_units="xy", scale=scale, width=0.004)
    key = 10.0 ** np.floor(np.log10(longest))
    axes.quiverkey(arrows, 0.9, 1.03, key, f"{key:g} px", labelpos="W")
    axes.set_xlim(-0.5 * width, camera.width_px + 0.5 * width)
    axes.set_ylim(camera.height_px + 0.5 * height, -0.5 * height)
    axes.add_patch(
        Rectangle((0, 0), camera.width_px, camera.height_px, fill=False, edgecolor=GREY, linewidth=0.8)
    )
    axes.set(aspect="equal", xlabel="column, px", ylabel="row, px")
    title = f"mean residuals, 1 sigma grey; rms of all stars {result.rms_px:.4f} px"
    axes.set_title(title, loc="left", fontsize=10)
    write_figure(path, figure)
