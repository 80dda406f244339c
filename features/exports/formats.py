"""Export formats by name, and the files that each writes of a finished result."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from boresight.features.exports.ccsds_aem import AemHeader, attitude_message, comprehensive_message
from boresight.features.exports.csm_isd import IsdNames, line_scanner_isds, parameter_covariance
from boresight.features.exports.dimap_product import corrected_dimap
from boresight.features.exports.gipp_product import corrected_gipp
from boresight.features.exports.ground_control_points import (
    GroundPoints,
    points_asp,
    points_envi,
    points_geojson,
    points_qgis,
)
from boresight.features.exports.ground_error import ground_error
from boresight.features.exports.kml import kml_text
from boresight.features.exports.notes import Notes, notes_of
from boresight.features.exports.operator_parameters import fit_correction, operator_parameters
from boresight.features.exports.quaternions import instants_to_interpolate
from boresight.features.exports.rpc import fit_rpc, rpc_heights, rpc_metadata, rpc_text
from boresight.features.exports.spice_export import (
    SpiceFrames,
    attitude_kernel,
    clock_kernel,
    frame_kernel,
    instrument_kernel,
    on_ticks,
)
from boresight.features.exports.star_fits import centroids_fits
from boresight.features.exports.vrt import vrt_with_gcps, vrt_with_rpc
from boresight.geometry.epoch import Epoch
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.geoid import egm96
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import outline_deg
from boresight.geometry.sightings import StarSightings
from boresight.pipeline import __version__
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.dimap_metadata import operator_model
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.strip_table import Strip
from boresight.pipeline.files.table_files import column, list_values
from boresight.pipeline.files.terrain_files import mean_level, surface_of
from boresight.pipeline.files.whole_file import write_whole
from boresight.pipeline.results.calibration_file import calibration_text
from boresight.pipeline.results.reading import read_for_dump, read_saved_result
from boresight.pipeline.results.sightings_tables import read_sightings
from boresight.pipeline.results.strip_model import (
    Calibrated,
    StripModel,
    open_calibrated,
    strip_model,
    whole_strip_model,
)
from boresight.records.record import Floats, record, scalar

__all__ = ["FORMATS", "OF_STRIPS", "ExportRequest", "Remark", "export", "strips_left_out"]

# Error between exported attitudes when they are interpolated, px: a third of what is asked of an export.
ATTITUDE_LIMIT_PX = 0.003
RPC_LIMIT_PX = 0.1  # an RPC that misses the rigorous model by more is reported


@record
class Remark:
    """What a format does not write, and why."""

    text: str = scalar("one sentence")


Made = Iterator[tuple[str, str | bytes] | Remark]  # file name and content


@record(kw_only=True)
class ExportRequest:
    """What to export."""

    result: Path = scalar("folder that `calibrate` wrote")
    dump: Path | None = scalar("its dump; None: where it was")
    camera: str = scalar("which of several cameras; empty: the only one", default="")
    strips: tuple[str, ...] = scalar("ids of strips; empty: all that star exposures cover")
    frames: SpiceFrames = scalar("names and ids for SPICE")
    creation_utc: str = scalar("date written into the files, ISO 8601")
    product: Path | None = scalar("the operator's DIMAP file, for the format dimap", default=None)
    valid_utc: tuple[str, str] = scalar("first and last date of use; empty: no limit", default=("", ""))
    object_id: str = scalar("OBJECT_ID of CCSDS messages; empty: the mission's name", default="")
    allow_stale_eop: bool = scalar("accept dates after the Earth-orientation table", default=False)


def export(name: str, request: ExportRequest, folder: Path) -> Iterator[Path | Remark]:
    """Files of one of `FORMATS`, each once it is written into a folder, and remarks on what is left out.

    Raises `RawDataError` for a damaged or missing file, `DataNotSufficientError` without star exposures.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for one in FORMATS[name](request):
        if isinstance(one, Remark):
            yield one
            continue
        file, content = one
        raw = content.encode("utf-8") if isinstance(content, str) else content
        write_whole(folder / file, lambda path, raw=raw: path.write_bytes(raw))
        yield folder / file


def strips_left_out(request: ExportRequest) -> Iterator[Remark]:
    """Why strips of the dump are in no file of their own, where no strips were requested."""
    calibrated = _opened(request)
    if not request.strips:
        yield from (one for one in _every_model(calibrated) if isinstance(one, Remark))


def _spice(request: ExportRequest) -> Made:
    of = request.result, request.dump, request.camera
    result = read_for_dump(*of)[1] if request.camera else read_saved_result(request.result)
    sigma = ", ".join(f"{value:.3e}" for value in np.sqrt(np.diag(result.cov_theta)))
    comment = (
        f"Installation matrix between star camera and remote-sensing camera, boresight {__version__}.\n"
        f"1-sigma of a small rotation about the axes of {request.frames.remote_camera_name}: {sigma} rad."
    )
    comment = "\n".join([comment, *_notes(request).lines()])
    yield "installation.tf", frame_kernel(result.R_cs, comment, request.frames)


def _spice_attitude(request: ExportRequest) -> Made:
    """Attitudes of the star camera with its clock, and fields of view; the frames are those of `_spice`."""
    calibrated, frames = _opened(request), request.frames
    dump, lines = calibrated.dump, _notes(request).lines()
    yield "clock.tsc", clock_kernel(dump.epoch, frames, "\n".join(["Clock of the attitudes", *lines]))
    yield "camera.ti", instrument_kernel(dump.line_camera, frames, "\n".join(["Fields of view", *lines]))
    for model in _models(calibrated, request.strips):
        ticks, t_s = on_ticks(dump.epoch, _instants(calibrated, model, *model.track.span_s))
        name = model.strip.strip_id
        about = [f"Strip {name}: attitude of the star camera, axes of GCRS", *_line_times(model, dump.epoch)]
        comment = "\n".join([*about, *lines])
        yield f"{name}.bc", attitude_kernel(ticks, model.track.R_si(t_s), frames, f"strip {name}", comment)


def _message(request: ExportRequest, ending: str, text_of: Callable[..., str]) -> Made:
    """Attitudes of the camera and their variances over each strip."""
    calibrated, notes = _opened(request), _notes(request)
    dump, R_cs = calibrated.dump, calibrated.result.R_cs
    C = R_cs.as_matrix()
    for model in _models(calibrated, request.strips):
        first, last = model.pushbroom.instants(np.array([-0.5, model.strip.lines - 0.5]))
        t_s = _instants(calibrated, model, *np.clip([first, last], *model.track.span_s).tolist())
        own = np.nan_to_num(model.track.covariance_s(t_s))
        variance_c = np.einsum("ij,njk,ik->ni", C, own, C) + np.diag(calibrated.result.cov_theta)
        name = model.strip.strip_id
        header = AemHeader(
            creation_utc=request.creation_utc, object_name=dump.mission, object_id=request.object_id
        )
        comments = [f"Strip {name}: calibrated attitude of the remote-sensing camera, GCRS axes"]
        comments += [*_line_times(model, dump.epoch), *notes.lines()]
        utc = dump.epoch.utc_from_seconds(t_s)
        text = text_of(header, comments, utc, R_cs * model.track.R_si(t_s), variance_c)
        yield f"{name}.{ending}", text


def _instants(calibrated: Calibrated, model: StripModel, first_s: float, last_s: float) -> Floats:
    """Instants of a strip's exported attitudes."""
    limit_rad = ATTITUDE_LIMIT_PX * calibrated.dump.line_camera.pixel_rad
    return instants_to_interpolate(model.track, first_s, last_s, limit_rad)


def _csm_isd(request: ExportRequest) -> Made:
    calibrated = _opened(request)
    dump, about = calibrated.dump, {"notes": _notes(request).items()}
    about |= {"parameter_covariance": parameter_covariance(calibrated.result.cov_theta)}
    height_m = mean_level(dump.terrain).height
    for model in _models(calibrated, request.strips):
        for ccd, lines in sorted(model.strip.ccd_lines.items()):
            image = _image_name(model.strip, ccd)
            names = IsdNames(image, dump.mission, f"remote-sensing camera, CCD {ccd}")
            for piece in line_scanner_isds(model.pushbroom, dump.epoch, ccd, lines, height_m, names):
                yield f"{model.strip.strip_id}.{piece.suffix}.json", piece.text(about)


def _rpc(request: ExportRequest) -> Made:
    calibrated, notes = _opened(request), _notes(request)
    heights = rpc_heights(surface_of(calibrated.dump.terrain))
    for model in _models(calibrated, request.strips):
        strip = model.strip
        for ccd, lines in sorted(strip.ccd_lines.items()):
            rpc, error = fit_rpc(model.pushbroom, ccd, lines, heights)
            if error.largest_px > RPC_LIMIT_PX:
                yield Remark(
                    f"{strip.strip_id}.ccd{ccd} misses the rigorous model by up to {error.largest_px:.2f} px "
                    f"(rms {error.rms_px:.2f}): no cubic follows its attitude; csm-isd does, "
                    "and the image of `virtual-ccd` has an RPC of a smooth attitude"
                )
            height_m = sum(heights) / 2.0
            on_ground = ground_error(calibrated, model, ccd, lines, height_m, error.rms_px)
            yield f"{strip.strip_id}.ccd{ccd}_RPC.TXT", rpc_text(rpc, on_ground)
            if ccd in strip.images.ccds:
                vrt = vrt_with_rpc(*_image(calibrated, strip, ccd), rpc_metadata(rpc, on_ground), notes)
                yield f"{strip.strip_id}.ccd{ccd}.rpc.vrt", vrt
        yield from _without_vrt(strip, sorted(strip.ccd_lines), "an RPC without a VRT, name it as the image")


def _vrt(request: ExportRequest) -> Made:
    calibrated, notes = _opened(request), _notes(request)
    strips = {strip.strip_id: strip for strip in calibrated.dump.strips}
    measured: dict[str, list[int]] = {}
    for points in _ground_points(request):
        strip = strips[points.strip_id]
        measured.setdefault(strip.strip_id, []).append(points.ccd)
        if points.ccd in strip.images.ccds:
            image = _image(calibrated, strip, points.ccd)
            yield f"{points.strip_id}.ccd{points.ccd}.gcp.vrt", vrt_with_gcps(*image, points, notes)
    for name, ccds in measured.items():
        yield from _without_vrt(strips[name], ccds, "no VRT; asp, envi and qgis need no image")


def _kml(request: ExportRequest) -> Made:
    calibrated = _opened(request)
    height = mean_level(calibrated.dump.terrain)
    outlines = {
        model.strip.strip_id: outline_deg(model.pushbroom, model.strip.ccd_lines, height)
        for model in _models(calibrated, request.strips)
    }
    yield "boresight.kml", kml_text(outlines, _ground_points(request), _notes(request))


def _each_image(request: ExportRequest, ending: str, text_of: Callable[[GroundPoints, Notes], str]) -> Made:
    """The ground control points of each image as a text of its own."""
    notes = _notes(request)
    for points in _ground_points(request):
        yield f"{points.strip_id}.ccd{points.ccd}.{ending}", text_of(points, notes)


def _fits(request: ExportRequest) -> Made:
    calibrated = _opened(request)
    read_sightings(calibrated.folder, "stars", "exposure_id t_s hip xy_px u_s u_i cov_s")  # names damage
    file = pq.ParquetFile(calibrated.folder / "sightings" / "stars.parquet")
    exposures = [_exposure(file, group) for group in range(file.num_row_groups)]
    found = [exposure for exposure in exposures if exposure is not None]
    yield "centroids.fits", centroids_fits(found, calibrated.dump.epoch, _notes(request))


def _operator(request: ExportRequest) -> Made:
    """The correction of each strip in operators' parameters; with rate and scale where points allow them."""
    calibrated, notes = _opened(request), _notes(request).items()
    dump = calibrated.dump
    table = read_sightings(calibrated.folder, "targets", "strip_id t_s kept u_c u_i")
    strips = np.array(table.column("strip_id").to_pylist(), dtype=str)
    kept, t_s = column(table, "kept").astype(bool), column(table, "t_s")
    u_c, u_i = list_values(table, "u_c", 3), list_values(table, "u_i", 3)
    for model in _models(calibrated, request.strips):
        name = model.strip.strip_id
        rows = np.flatnonzero(kept & (strips == name))
        v_s = model.track.R_si(t_s[rows]).apply(u_i[rows])
        t0 = float(np.round(model.pushbroom.instants(np.array([0.5 * (model.strip.lines - 1.0)]))[0], 6))
        found = None
        for degree, with_scale in ((1, True), (0, False)):
            try:
                found = fit_correction(
                    v_s, u_c[rows], t_s[rows], dump.R_cs0, t0, degree=degree, with_scale=with_scale
                )
                break
            except ValueError:  # too few points, or too close together
                continue
        if found is None:
            yield Remark(f"strip {name}: {len(rows)} used targets do not determine a rotation, no file")
        else:
            yield f"{name}.operator.json", operator_parameters(found, dump.R_cs0, dump.epoch, notes)


def _dimap(request: ExportRequest) -> Made:
    """The operator's product with the attitude corrected."""
    dump, correction, product = _corrected(request, "the format dimap needs", "the operator's DIMAP file")
    found = operator_model(product)
    orbit = found.pushbroom.orbit
    assert isinstance(orbit, Orbit)
    first_utc = orbit.epoch.utc_from_seconds([found.pushbroom.rows.t_first_row_s])
    apart_s = dump.epoch.seconds_from_utc(first_utc)[0] - dump.strips[0].t_first_row_s
    if len(dump.strips) > 1 or dump.strips[0].lines != found.height_px or abs(apart_s) > 1e-6:
        text = f"{found.height_px} lines from {first_utc[0]}"
        raise RawDataError(str(product), "strip", text, "the product that the dump was imported from")
    yield product.name, corrected_dimap(product, correction, _notes(request).items())


def _gipp(request: ExportRequest) -> Made:
    """The operator's own GIPP file with the matrix of the result."""
    dump, correction, product = _corrected(request, "the format gipp needs", "a SPAMOD or VIEDIR file")
    head = dump.heads[0].name
    yield product.name, corrected_gipp(product, correction, dump.R_cs0, head, request.valid_utc)


def _corrected(request: ExportRequest, who: str, what: str) -> tuple[Dump, Rotation, Path]:
    """The dump, the rotation of frame c from its matrix to the result's, and the operator's file."""
    if request.product is None:
        raise DataNotSufficientError(f"{who} the option --product, {what}")
    calibrated = _opened(request)
    return calibrated.dump, calibrated.result.R_cs * calibrated.dump.R_cs0.inv(), request.product


def _calibration(request: ExportRequest) -> Made:
    result, notes = read_saved_result(request.result), _notes(request).items()
    of = {"mission": notes["mission"], "satellite": notes.get("satellite", "")}
    of |= {"camera": "", "star_camera": (result.installation.get("heads") or [{"name": ""}])[0]["name"]}
    first, last = (date or None for date in request.valid_utc)
    yield (
        "calibration.json",
        calibration_text(result.R_cs, result.cov_theta, of, (first, last), {"notes": notes}),
    )


OF_STRIPS = "spice-ck aem acm operator csm-isd rpc kml".split()  # formats that write strips one by one
# What writes a format, by the name after --format.
FORMATS: dict[str, Callable[[ExportRequest], Made]] = {
    "spice": _spice,
    "spice-ck": _spice_attitude,
    "aem": partial(_message, ending="aem", text_of=lambda *of: attitude_message(*of[:4])),
    "acm": partial(_message, ending="acm", text_of=comprehensive_message),
    "operator": _operator,
    "dimap": _dimap,
    "gipp": _gipp,
    "calibration": _calibration,
    "csm-isd": _csm_isd,
    "rpc": _rpc,
    "vrt": _vrt,
    "kml": _kml,
    "asp": partial(_each_image, ending="gcp", text_of=points_asp),
    "geojson": lambda of: iter([("targets.geojson", points_geojson(_ground_points(of), _notes(of)))]),
    "envi": lambda request: _each_image(request, "pts", partial(points_envi, geoid=egm96())),
    "qgis": partial(_each_image, ending="points", text_of=points_qgis),
    "fits": _fits,
}


def _notes(request: ExportRequest) -> Notes:
    return notes_of(request.result, request.dump, request.creation_utc, request.valid_utc)


def _image(calibrated: Calibrated, strip: Strip, ccd: int) -> tuple[Path, tuple[int, int], str]:
    """Path, size (samples, lines) and GDAL type of a raw image."""
    lines, samples = strip.images.shapes[ccd]
    kind = "Byte" if calibrated.dump.remote_bit_depth == 8 else "UInt16"
    return strip.images.paths[ccd].resolve(), (samples, lines), kind


def _opened(request: ExportRequest) -> Calibrated:
    return open_calibrated(
        request.result, request.dump, camera=request.camera, allow_stale_eop=request.allow_stale_eop
    )


def _image_name(strip: Strip, ccd: int) -> str:
    """File name of a raw image; one made of strip and CCD where the dump has no image."""
    return strip.images.names.get(ccd, f"{strip.strip_id}.ccd{ccd}")


def _without_vrt(strip: Strip, ccds: Sequence[int], so: str) -> Iterator[Remark]:
    if bare := [str(ccd) for ccd in ccds if ccd not in strip.images.ccds]:
        yield Remark(f"strip {strip.strip_id}: the dump has no image of CCD {', '.join(bare)}: {so}")


def _line_times(model: StripModel, epoch: Epoch) -> list[str]:
    """When line 0 of each CCD was exposed, one line a CCD."""
    lines, push = [], model.pushbroom
    for ccd in sorted(model.strip.ccd_lines):
        (utc,) = epoch.utc_from_seconds(push.instants_of_lines(ccd, np.zeros(1)))
        lines.append(f"CCD {ccd}: middle of line 0 at {utc} UTC, {push.rows.row_period_s!r} s a line")
    return lines


def _models(calibrated: Calibrated, wanted: tuple[str, ...]) -> Iterator[StripModel]:
    """Models of the strips requested, or of all strips that star exposures cover."""
    if wanted:
        yield from (whole_strip_model(calibrated, name) for name in wanted)
        return
    models = (one for one in _every_model(calibrated) if isinstance(one, StripModel))
    if (first := next(models, None)) is None:
        raise DataNotSufficientError("no strip has star exposures around it")
    yield first
    yield from models


def _every_model(calibrated: Calibrated) -> Iterator[StripModel | Remark]:
    """The model of each strip, or why there is none."""
    for strip in calibrated.dump.strips:
        try:
            yield whole_strip_model(calibrated, strip.strip_id)
        except DataNotSufficientError as error:
            yield Remark(f"not exported: {error}")


def _exposure(file: pq.ParquetFile, group: int) -> StarSightings | None:
    table = file.read_row_group(group)
    if not len(table):
        return None
    has_snr = "snr" in table.column_names and table.column("snr").null_count < len(table)
    return StarSightings(
        exposure_id=str(table.column("exposure_id")[0]),
        t_s=float(table.column("t_s")[0].as_py()),
        hip=column(table, "hip"),
        xy_px=list_values(table, "xy_px", 2),
        u_s=list_values(table, "u_s", 3),
        u_i=list_values(table, "u_i", 3),
        cov_s=list_values(table, "cov_s", 3, 3),
        snr=column(table, "snr") if has_snr else None,
    )


def _ground_points(request: ExportRequest) -> list[GroundPoints]:
    """Matched targets, one record per CCD of each strip."""
    calibrated = _opened(request)
    table = read_sightings(calibrated.folder, "targets", "strip_id target_id ccd kept xy_px cov_px")
    strips = np.array(table.column("strip_id").to_pylist(), dtype=str)
    names = np.array(table.column("target_id").to_pylist(), dtype=str)
    ccd, kept = column(table, "ccd"), column(table, "kept").astype(bool)
    xy, covariance = list_values(table, "xy_px", 2), list_values(table, "cov_px", 2, 2)
    targets = calibrated.dump.ground_targets
    if unknown := sorted(set(names.tolist()) - set(targets)):
        raise RawDataError("targets.csv", "id", "missing", f"target {unknown[0]} of the result")
    of_id = {strip.strip_id: strip for strip in calibrated.dump.strips}
    chosen = [
        (strip, one)
        for strip, one in sorted(set(zip(strips.tolist(), ccd.tolist())))
        if not request.strips or strip in request.strips
    ]
    points = []
    for strip, one in chosen:
        rows = np.flatnonzero((strips == strip) & (ccd == one))
        p_e = np.array([targets[name].p_e for name in names[rows]])
        lat, lon, height = geodetic_from_ecef(p_e)
        residual_px = xy[rows] - _computed(calibrated, strip, one, p_e)
        points.append(
            GroundPoints(
                strip_id=strip,
                ccd=one,
                image=_image_name(of_id[strip], one),
                target_id=tuple(names[rows].tolist()),
                lat_deg=np.degrees(lat),
                lon_deg=np.degrees(lon),
                height_m=height,
                xy_px=xy[rows],
                sigma_px=np.sqrt(np.einsum("naa->na", covariance[rows])),
                residual_px=residual_px,
                sigma_m=np.array([targets[name].sigma_m for name in names[rows]]),
                used=kept[rows],
            )
        )
    return points


def _computed(calibrated: Calibrated, strip_id: str, ccd: int, p_e: Floats) -> Floats:
    """Image points (N, 2) of ground points (N, 3), ITRS, by the result; NaN without star exposures."""
    try:
        model = strip_model(calibrated, strip_id)
    except DataNotSufficientError:
        return np.full((len(p_e), 2), np.nan)
    return np.column_stack(model.pushbroom.pixels_from_ground(ccd, p_e))
