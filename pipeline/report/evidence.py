"""Files in `RESULT/evidence/`: what a report shows beyond the estimate and its tables (`saved.EVIDENCE`); of
several dumps jointly the budget alone.

The same inputs, settings and version give identical files.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, islice
from operator import call
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from boresight.calib.finding import Finding
from boresight.calib.information import solve_total
from boresight.calib.settings import CalibrationSettings
from boresight.calib.simultaneous_strips import passes_of
from boresight.geometry.attitude import NominalMotion
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.line_camera import LineCamera, edge_tangent, end_looks
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.calibration.calibrate import DumpCalibration
from boresight.pipeline.calibration.joint import JointCalibration
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.content import content_digest
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.dump_schema import DumpFile
from boresight.pipeline.files.record_tables import columns_of, plain
from boresight.pipeline.files.star_side import StarImages
from boresight.pipeline.files.table_files import arrow_array, arrow_rows, fixed_list
from boresight.pipeline.files.text_files import read_toml
from boresight.pipeline.files.whole_file import make_own_folder, write_inside, write_json
from boresight.pipeline.forecast.budget import uncertainty_budget
from boresight.pipeline.forecast.campaigns import improvements
from boresight.pipeline.head_noise.of_dump import attitude_signal
from boresight.pipeline.head_noise.spectrum import allan_deviation
from boresight.pipeline.report import ground_map
from boresight.pipeline.report.budget_table import CONTEXT, JOINT_BUDGET
from boresight.pipeline.report.findings import findings
from boresight.pipeline.report.ground_accuracy import accuracy_by_strip, predicted_accuracy
from boresight.pipeline.report.saved import EVIDENCE
from boresight.pipeline.report.star_preview import StarPreview, star_preview
from boresight.pipeline.report.unmatched import unmatched_pictures
from boresight.pipeline.results.angles import MeasuredStrip, cross_angles
from boresight.pipeline.run.executor import Executor, InOrder
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.exposure import exposure_image
from boresight.pipeline.stages.match_pictures import NO_PICTURES, MatchPictures, trace_pictures
from boresight.pipeline.stages.sky_strip import NamedStars, SkyTask, as_matched, strip_motion
from boresight.records.ledger import State
from boresight.records.record import Floats
from boresight.star_id.strip_stars.find import StripStars
from boresight.star_id.strip_stars.trace import Motion, trace_images, trace_radius

__all__ = ["star_pictures", "write_evidence", "write_joint_evidence"]

MOST_MEANS = 1500  # instants at which attitudes are plotted
# Pixels shown around the computed image of a star of a strip.
TRACE_MARGIN_PX = 2
LEVEL_ROWS = 64  # above and below, from which a column's level is taken


def write_evidence(
    result: Path,
    dump: Dump,
    calibration: DumpCalibration,
    settings: Settings,
    executor: Executor | None = None,
    beside: Sequence[Callable[[], Any]] = (),
) -> list[Finding]:
    """Write the folder `RESULT/evidence/`, of which a later calibration reads nothing; what stands out.

    `executor` makes all of it that no other part needs, and calls `beside`; default: this process.
    """
    folder, executor = result / "evidence", executor or InOrder()
    scenes = ground_map.scenes_of(dump, calibration)
    ground = ground_map.ground_table(scenes, dump, calibration)
    parts: dict[str, Callable[[], Any]] = {
        "accuracy": partial(_accuracy, dump, calibration, ground),  # the longest first
        "exposure": partial(_exposure, dump, calibration, settings),
        "findings": partial(findings, dump, calibration, scenes, ground),
        "unmatched": partial(unmatched_pictures, scenes, ground, dump),
        "inputs": partial(_inputs, dump),
        "convergence": partial(_convergence, calibration),
        "angles": partial(_angles, calibration),
        "matches": partial(_matches, calibration),
        "noise": partial(_attitude_noise, dump, settings),
    }
    quicklooks, shadings = ground_map.quicklooks_of(scenes), ground_map.shadings_of(scenes, dump)
    here = executor.share(1)  # what they need, the whole calibration, is not sent to other machines
    own = [*beside, *parts.values(), *shadings]
    lists = [(here, own + quicklooks)] if here == executor else [(here, own), (executor, quicklooks)]
    made = chain.from_iterable(one.map(call, items, lambda n, part: None) for one, items in lists)
    tables: dict[str, Any] = dict(zip(parts, islice(made, len(beside), None)))
    accuracy, found, noise = (tables.pop(name) for name in ("accuracy", "findings", "noise"))
    shaded = list(islice(made, len(shadings)))
    tables |= noise | {"ground": ground, "map": ground_map.scene_pictures(scenes, shaded, made)}
    for name, table in tables.items():
        write_inside(
            folder / f"{name}.parquet", lambda path, t=table: pq.write_table(t, path, compression="zstd")
        )
    context = _context(dump, calibration) | accuracy
    context |= {
        "findings": [plain(one) for one in found],
        "scenes": [ground_map.scene_json(scene) for scene in scenes],
    }
    write_json(result / CONTEXT, context)
    return found


def write_joint_evidence(result: Path, joint: JointCalibration) -> None:
    """Write `RESULT/evidence/budget.json` of several dumps jointly: the uncertainty budget alone."""
    make_own_folder(result / "evidence")
    estimate = joint.estimate
    matrices = {name: estimate.of_camera(name)[0] for name in estimate.cameras}
    R_cs = matrices if len(matrices) > 1 else estimate.R_cs
    budget = _budget(joint.strips, R_cs, joint.settings)
    write_json(result / JOINT_BUDGET, {"budget": budget})


def _context(dump: Dump, calibration: DumpCalibration) -> dict[str, Any]:
    estimate, camera, star = calibration.estimate, dump.line_camera, dump.star_camera
    head = _head(dump)
    stars = head.files if head.files.star_camera else head.star_cameras[0]
    return {
        "mission": dump.mission,
        "created_by": head.created_by,
        "is_simulated": ": simulate " in head.created_by,
        "star_camera_file": getattr(stars, "star_camera", None) or getattr(stars, "camera", None) or "",
        "altitude_m": float(_altitude_m(dump, calibration).mean()),
        "satellite": dump.satellite,
        "camera": dump.camera,
        "utc": dump.epoch.utc_from_seconds(_span_s(calibration)),
        "epoch_utc": dump.epoch.utc_from_seconds([0.0])[0],
        "quaternion_cs0": dump.R_cs0.as_quat().tolist(),
        "sigma_installation_rad": dump.sigma_installation_rad.tolist(),
        "sigma_theta_rad": estimate.sigma_theta.tolist(),
        "converged_matrix": bool(estimate.converged_matrix),
        "converged_covariance": bool(estimate.converged_covariance),
        "strips": int(estimate.n_strips),
        "chi2_stars": float(estimate.chi2_stars),
        "dof_stars": int(estimate.dof_stars),
        "iterations": [
            {"theta_step_rad": step.theta_step.tolist(), "sigma_rad": step.sigma.tolist()}
            | {"chi2": float(step.chi2), "targets": float(step.targets)}
            for step in estimate.iterations
        ],
        "star_camera": None
        if star is None
        else {
            "width_px": star.width_px,
            "height_px": star.height_px,
            "pixel_rad": star.pixel_m / star.focal_m,
            "focal_mm": 1e3 * star.focal_m,
        },
        "ground": {"range_m": _over_ground(dump, calibration)[0], "edge_tan": edge_tangent(camera)},
        "remote_camera": {
            "pixel_rad": camera.pixel_rad,
            "samples": [ccd.n_px for ccd in camera.ccds],
            "focal_m": camera.focal_m if isinstance(camera, LineCamera) else None,
        },
    }


def _span_s(calibration: DumpCalibration) -> list[float]:
    """Instants of the first and the last exposure."""
    return [calibration.stars[0].t_s, calibration.stars[-1].t_s]


def _accuracy(dump: Dump, calibration: DumpCalibration, ground: pa.Table) -> dict[str, Any]:
    """CE90 and LE90 of residuals and of a new strip, and what more data would change."""
    estimate, camera = calibration.estimate, dump.line_camera
    range_m, speed_m_s = _over_ground(dump, calibration)
    found = improvements(calibration.strips, estimate.R_cs, calibration.settings, camera)
    u_c = end_looks(camera)
    return {
        "accuracy": accuracy_by_strip(ground, State.USED),
        "new_strip": predicted_accuracy(
            estimate.cov_theta,
            range_m,
            u_c[:, :2] / u_c[:, 2:],
            calibration.settings.sigma_position_m,
            calibration.settings.sigma_clock_s * speed_m_s,
        ),
        "budget": _budget(calibration.strips, estimate.R_cs, calibration.settings),
        "improvements": [
            {"change": one.change, "sigma_rad": (estimate.sigma_theta * one.sigma_ratio).tolist()}
            for one in found
        ],
    }


def _budget(
    strips: Sequence[StripSightings], R_cs: Rotation | Mapping[str, Rotation], settings: CalibrationSettings
) -> list[dict[str, Any]]:
    return [
        {"source": one.source, "covariance_rad2": one.covariance.tolist()}
        for one in uncertainty_budget(strips, R_cs, settings)
    ]


def _over_ground(dump: Dump, calibration: DumpCalibration) -> tuple[float, float]:
    """Mean distance from the satellite to the targets on the ground, m, and its speed over it, m/s; where
    there are stars only, its height and its speed in ITRS.
    """
    ground = [strip.ground for strip in calibration.ground_strips]
    if ground:
        speed = np.concatenate([np.linalg.norm(one.v_rel_i, axis=1) for one in ground])
        return float(np.mean(np.concatenate([one.range_m for one in ground]))), float(speed.mean())
    speed = np.linalg.norm(dump.orbit.velocities_e(np.array(_span_s(calibration))), axis=1)
    return float(_altitude_m(dump, calibration).mean()), float(speed.mean())


def _altitude_m(dump: Dump, calibration: DumpCalibration) -> Floats:
    """Height of the satellite over the ellipsoid (2,), m, at the first and the last exposure."""
    positions_e = dump.orbit.positions_e(np.array(_span_s(calibration)))
    return np.asarray(geodetic_from_ecef(positions_e)[2])


def _inputs(dump: Dump) -> pa.Table:
    """Input files by name with size and SHA-256."""
    names = {"dump.toml", *_head(dump).paths.values()}
    names |= {exposure.file for exposure in dump.exposures} | {chip.file for chip in dump.chips}
    names |= {name for strip in dump.strips for name in strip.images.names.values()}
    rows = [_fingerprint(dump.root / name, name) for name in sorted(names)]
    return arrow_rows(rows, pa.schema(list(EVIDENCE["inputs"].items())))


def _head(dump: Dump) -> DumpFile:
    return read_toml(dump.root / "dump.toml", DumpFile, "dump.toml")


def _fingerprint(path: Path, name: str) -> dict[str, Any]:
    """Name, bytes and SHA-256; -1 and empty for a file that cannot be read."""
    try:
        return {"file": name, "bytes": path.stat().st_size, "sha256": content_digest(path)}
    except OSError:
        return {"file": name, "bytes": -1, "sha256": ""}


def _convergence(calibration: DumpCalibration) -> pa.Table:
    """theta (rad, relative to the final matrix) and 1-sigma after each further pass in time order; NaN and
    infinity while theta is not observable.
    """
    estimate = calibration.estimate
    pairs = estimate.pairs
    order = [strip.strip_id for strip in calibration.strips if strip.strip_id in set(pairs.names.tolist())]
    index = {name: n for n, name in enumerate(pairs.names.tolist())}
    passes = passes_of(calibration.strips, calibration.settings.attitudes)
    count = {one.strip_id: (len(one.exposures), len(one.ground.target_id)) for one in passes}
    F, F_theta = np.zeros(pairs.F.shape[1:]), np.zeros(pairs.F_theta.shape[1:])
    rows, frames, targets = list[dict[str, Any]](), 0, 0
    limit = calibration.settings.sigma_observable_rad
    for name in order:
        F, F_theta = F + pairs.F[index[name]], F_theta + pairs.F_theta[index[name]]
        so_far = solve_total(F, F_theta, estimate.prior_shared, sigma_observable_rad=limit)
        theta, sigma = so_far.theta, np.sqrt(np.diag(so_far.covariance))
        if len(so_far.unobservable):
            theta, sigma = np.full(3, np.nan), np.full(3, np.inf)
        frames, targets = frames + count[name][0], targets + count[name][1]
        row = {"strip_id": name, "frames": frames, "targets": targets}
        rows.append(row | {"theta_rad": theta.tolist(), "sigma_rad": sigma.tolist()})
    return arrow_rows(rows, pa.schema(list(EVIDENCE["convergence"].items())))


def _angles(calibration: DumpCalibration) -> pa.Table:
    angles = cross_angles(_motions(calibration), calibration.estimate.R_cs, calibration.settings)
    types = EVIDENCE["angles"].items()
    return pa.table({name: arrow_array(getattr(angles, name), kind) for name, kind in types})


def _motions(calibration: DumpCalibration) -> list[MeasuredStrip]:
    attitudes, found = calibration.attitudes, calibration.estimate.targets
    index = {exposure.t_s: k for k, exposure in enumerate(calibration.stars)}
    names = zip(found.strip_id.tolist(), found.target_id.tolist(), found.ccd.tolist())
    kept = dict(zip(names, found.kept.tolist()))
    orbits: dict[str, NominalMotion] = {task.strip.strip_id: task.orbit for task in calibration.tasks}
    orbits |= {task.strip.strip_id: task.nominal for task in calibration.sky.tasks}
    motions = []
    for strip in calibration.strips:
        rows = [index[exposure.t_s] for exposure in strip.exposures]
        ground = zip(strip.ground.target_id.tolist(), strip.ground.ccd.tolist())
        used = [kept.get((strip.strip_id, name, ccd), False) for name, ccd in ground]
        motions.append(
            MeasuredStrip(
                strip=strip,
                orbit=orbits[strip.strip_id],
                R_si=Rotation.from_matrix(attitudes.R_si[rows]),
                covariance_s=attitudes.covariance_s[rows],
                stars_kept=tuple(attitudes.kept[attitudes.stars(k)] for k in rows),
                targets_kept=np.array(used, dtype=bool),
            )
        )
    return motions


def _attitude_noise(dump: Dump, settings: Settings) -> dict[str, pa.Table]:
    """Allan deviation of the attitudes of the longest piece without a gap, and means of them over equal
    times, `MOST_MEANS` at most; no rows without attitudes.
    """
    found, names = attitude_signal(dump, settings), ""
    times: Floats = np.zeros(0)
    deviation: Floats = np.zeros((0, 3))
    t_s, turns = times, deviation
    if found is not None:
        heads, signal, t_s = found
        names = " and ".join(heads)
        longest = max(signal.pieces, key=lambda piece: piece.stop - piece.start)
        turns, t_s = signal.values[longest], t_s[longest]
        times, deviation = allan_deviation(turns, signal.step_s)
        each = -(-len(turns) // MOST_MEANS)
        t_s, turns = (
            a[: len(a) // each * each].reshape(-1, each, *a.shape[1:]).mean(1) for a in (t_s, turns)
        )
    tables = {
        "allan": {"averaged_s": arrow_array(times), "deviation_rad": fixed_list(deviation[:, :3])},
        "attitude_noise": {"t_s": arrow_array(t_s), "turn_rad": fixed_list(turns[:, :3])},
    }
    return {
        name: pa.table(columns).replace_schema_metadata({b"heads": names.encode()})
        for name, columns in tables.items()
    }


def _matches(calibration: DumpCalibration) -> pa.Table:
    """Pictures of targets matched in images, and of stars; the correlation surface runs from `surface_low` to
    `_high`.
    """
    stars = (
        replace(as_matched(named), pictures=star_pictures(task, named))
        for task, named in zip(calibration.sky.tasks, calibration.named)
    )
    names = ["strip_id", "target_id", "ccd", *get_type_hints(MatchPictures)]
    tables = [
        pa.table({"strip_id": arrow_array([one.strip_id] * len(one.ccd), pa.string())} | columns_of(one))
        for one in (*calibration.matched, *stars)
    ]
    every = pa.concat_tables(tables).select(names)
    pictured = [len(picture) > 0 for picture in every.column("template_png").to_pylist()]
    return every if all(pictured) else every.filter(arrow_array(pictured, pa.bool_()))


def star_pictures(task: SkyTask, named: NamedStars) -> tuple[MatchPictures, ...]:
    """Pictures of the stars with names; none where the strip cannot be read any more."""
    motion, stars = strip_motion(task), named.found.take(named.rows)
    pictures = []
    for k, ccd in enumerate(stars.ccd.tolist()):
        own = motion.of(ccd, stars.xy_px[k, 1:])
        try:
            pictures.append(_trace_pictures(task, stars, k, own))
        except RawDataError:
            pictures.append(NO_PICTURES)
    return tuple(pictures)


def _trace_pictures(task: SkyTask, stars: StripStars, k: int, motion: Motion) -> MatchPictures:
    ccd, (x, y), images = int(stars.ccd[k]), stars.xy_px[k], task.strip.images
    lines, samples = images.shape(ccd)
    radius = trace_radius(motion, stars.psf_sigma_px) + TRACE_MARGIN_PX
    side = 2 * radius + 1
    left = int(np.clip(round(float(x)) - radius, 0, max(samples - side, 0)))
    top = int(np.clip(round(float(y)) - radius, 0, max(lines - side, 0)))
    first, last = max(top - LEVEL_ROWS, 0), min(top + side + LEVEL_ROWS, lines)
    read: Floats = np.asarray(images.read(ccd, first, last, left, left + side), dtype=np.float64)
    seen = read[top - first : top - first + side]
    middle = np.array([[x - left - radius, y - top - radius]])
    unit = trace_images(middle, motion, stars.psf_sigma_px, radius).value.reshape(side, side)
    fitted = np.median(read, axis=0) + stars.flux_dn[k] * unit
    return trace_pictures(seen, fitted[: seen.shape[0], : seen.shape[1]])


def _preview(dump: Dump, calibration: DumpCalibration, settings: Settings) -> StarPreview | None:
    """The exposure with the most rejected stars; among equals the one nearest the middle of the mission."""
    attitudes = calibration.attitudes
    kept = [attitudes.kept[attitudes.stars(k)] for k in range(len(calibration.stars))]
    middle = len(kept) // 2
    order = sorted(range(len(kept)), key=lambda k: (-int((~kept[k]).sum()), abs(k - middle)))
    source = dump.heads[0].source
    if not isinstance(source, StarImages):
        return None
    files = {exposure.exposure_id: exposure for exposure in source.exposures}
    for k in order[:3]:
        sighted = calibration.stars[k]
        try:
            image = exposure_image(files[sighted.exposure_id], source.camera, source.bit_depth)
        except RawDataError:  # deleted since it was read: take another
            continue
        return star_preview(image, sighted, kept[k], settings.stars)
    return None


def _exposure(dump: Dump, calibration: DumpCalibration, settings: Settings) -> pa.Table:
    """One row per detection; the schema's metadata holds the picture (JPEG) and the facts of the exposure."""
    if (preview := _preview(dump, calibration, settings)) is None:
        return pa.schema(list(EVIDENCE["exposure"].items())).empty_table()
    about = {name: getattr(preview, name) for name in ("exposure_id", "shrunk", "hot_pixels", "misshapen")}
    table = pa.table(columns_of(preview)).select(list(EVIDENCE["exposure"]))
    return table.replace_schema_metadata(
        {b"about": json.dumps(about, sort_keys=True).encode(), b"jpeg": preview.jpeg}
    )
