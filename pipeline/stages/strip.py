"""One strip's way: strip images + chips -> targets placed (`TargetMatch`) -> directions (`GroundSightings`).

    attitude from the star exposures around the strip, R_cs as known -> predicted templates -> places
    place -> look direction u_c (column) and instant (row); target - satellite -> apparent direction u_i

A task holds all that one strip needs; matching is the long part and its outcome is kept on disk, directions
are made from it in a moment. What the matcher refuses is counted with its reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.gct_match.match import match_strip
from boresight.gct_match.records import Chip, Refusal, StripMatches, Target
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef, local_axes_e
from boresight.geometry.groundlight import LightEffects, apparent_ground_directions
from boresight.geometry.line_camera import LineCamera
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import Pushbroom, RowClock
from boresight.geometry.sightings import GroundSightings
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.errors import Omission, RawDataError
from boresight.pipeline.files.dump import ChipFile, Dump, Strip, TargetHeights, TerrainFile, surface_of
from boresight.pipeline.files.image_files import read_grid
from boresight.pipeline.files.table_files import column, fixed_list, list_values
from boresight.pipeline.stages.match_pictures import (
    MatchPictures,
    match_pictures,
    pictures_columns,
    pictures_from_columns,
)
from boresight.pipeline.work.unit_store import read_meta

__all__ = [
    "Placings",
    "StripTask",
    "ground_sightings",
    "match_targets",
    "nothing_placed",
    "placings_from_table",
    "placings_table",
    "pushbroom_of",
    "strip_matches",
]

Array = NDArray[np.float64]
MAX_CHIP_PIXELS = 4096 * 4096


@dataclass(frozen=True, slots=True, eq=False)
class StripTask:
    """One strip and everything that the places of its targets depend on."""

    strip: Strip
    camera: LineCamera
    orbit: Orbit  # the part around the strip
    t_attitude_s: Array  # (K,) exposures around the strip
    R_si: Rotation  # (K,) their attitudes
    R_cs: Rotation  # the installation matrix to start from
    sigma_installation_rad: Array  # (3,) 1-sigma by which it may be wrong, axes of c
    effects: LightEffects
    targets: tuple[Target, ...]
    chips: tuple[ChipFile, ...]
    terrain: TerrainFile | TargetHeights
    settings: MatchSettings


@dataclass(frozen=True, slots=True, eq=False)
class Placings:
    """Targets placed in one strip. Row n of every array speaks of the same place."""

    strip_id: str
    target_id: NDArray[np.str_]  # (N,)
    ccd: NDArray[np.int64]  # (N,)
    xy_px: Array  # (N, 2) sample, line
    cov_px: Array  # (N, 2, 2) px²
    correlation: Array  # (N,)
    probability_wrong: Array  # (N,)
    predicted_px: Array  # (N, 2) where the model put it
    pictures: tuple[MatchPictures, ...]  # (N) what a person needs to believe it
    omissions: tuple[Omission, ...]  # chips that could not be read, targets that were refused


def pushbroom_of(task: StripTask) -> Pushbroom:
    """The rigorous model of the strip with the installation matrix of the task."""
    return Pushbroom(
        task.camera,
        RowClock(task.strip.t_first_row_s, task.strip.row_period_s),
        task.orbit,
        task.orbit.earth,
        AttitudeTrack(task.t_attitude_s, task.R_si, task.orbit),
        task.R_cs,
        task.effects,
    )


def match_targets(task: StripTask) -> Placings:
    """Place the targets of one strip. A damaged strip image leaves nothing of that strip, and says so."""
    result, omitted = strip_matches(task)
    return _placings(task.strip, result, omitted)


def strip_matches(task: StripTask) -> tuple[StripMatches | None, list[Omission]]:
    """What the matcher says of one strip, None if its images are damaged; and what could not be read."""
    chips, targets, omitted = [], [], []
    for target, file in zip(task.targets, task.chips):
        try:
            chips.append(_chip(file))
            targets.append(target)
        except RawDataError as error:
            omitted.append(Omission("chip", target.target_id, file.file, str(error)))
    try:
        result = match_strip(
            task.strip.images,
            pushbroom_of(task),
            targets,
            chips,
            surface_of(task.terrain),
            task.sigma_installation_rad,
            task.settings,
        )
    except RawDataError as error:
        omitted.append(Omission("strip", task.strip.strip_id, error.file, str(error)))
        return None, omitted
    return result, omitted


def _chip(file: ChipFile) -> Chip:
    grid = read_grid(file.path, file.file, max_pixels=MAX_CHIP_PIXELS)
    valid = np.isfinite(grid.values)
    return Chip(file.target_id, np.where(valid, grid.values, 0.0), grid.transform, grid.crs, valid)


def _placings(strip: Strip, result: StripMatches | None, omitted: Sequence[Omission]) -> Placings:
    matches = sorted(result.matches, key=lambda m: (m.target_id, m.ccd)) if result else []
    refused = [r for r in result.refused if not r.is_out_of_view] if result else []
    n = len(matches)
    return Placings(
        strip.strip_id,
        np.array([m.target_id for m in matches], dtype=str),
        np.array([m.ccd for m in matches], dtype=np.int64),
        np.array([m.xy_px for m in matches], dtype=float).reshape(n, 2),
        np.array([m.cov_px for m in matches], dtype=float).reshape(n, 2, 2),
        np.array([m.correlation for m in matches], dtype=float),
        np.array([m.probability_wrong for m in matches], dtype=float),
        np.array([m.predicted_px for m in matches], dtype=float).reshape(n, 2),
        tuple(match_pictures(m.evidence) for m in matches),
        (*omitted, *(_omission(strip, refusal) for refusal in refused)),
    )


def nothing_placed(strip: Strip, omission: Omission) -> Placings:
    """The outcome for a strip that could not be worked on."""
    return _placings(strip, None, [omission])


def _omission(strip: Strip, refusal: Refusal) -> Omission:
    if refusal.ccd >= 0:
        file, where = strip.images.names.get(refusal.ccd, ""), f", CCD {refusal.ccd}"
    else:
        file, where = "", ""
    return Omission("target", f"{strip.strip_id}/{refusal.target_id}{where}", file, refusal.sentence)


def ground_sightings(placings: Placings, task: StripTask) -> GroundSightings:
    """Directions of the placed targets: measured by the camera, and known from the ground and the orbit."""
    model = pushbroom_of(task)
    order = {target.target_id: n for n, target in enumerate(task.targets)}
    rows = [order[name] for name in placings.target_id.tolist()]
    p_e = np.array([task.targets[n].p_e for n in rows], dtype=float).reshape(-1, 3)
    sigma_m = np.array([task.targets[n].sigma_m for n in rows], dtype=float).reshape(-1, 3)
    sample, line = placings.xy_px.T
    t_s = np.asarray(model.instants(line), dtype=float)
    u_c, jacobian = np.zeros((len(rows), 3)), np.zeros((len(rows), 3, 2))
    for ccd in np.unique(placings.ccd).tolist():
        here = placings.ccd == ccd
        u_c[here] = task.camera.directions_from_pixels(ccd, sample[here])
        jacobian[here] = model.pixel_jacobian(ccd, sample[here], line[here])
    u_i, range_m = apparent_ground_directions(p_e, t_s, task.orbit, task.orbit.earth, task.effects)
    R_ie = task.orbit.earth.matrices_ie(t_s)
    lat, lon, _ = geodetic_from_ecef(p_e, WGS84)
    axes_i = R_ie @ local_axes_e(lat, lon)
    return GroundSightings(
        target_id=placings.target_id,
        ccd=placings.ccd,
        xy_px=placings.xy_px,
        t_s=t_s,
        u_c=u_c,
        u_i=u_i,
        cov_c=jacobian @ placings.cov_px @ np.swapaxes(jacobian, 1, 2),
        range_m=range_m,
        v_rel_i=np.einsum("nij,nj->ni", R_ie, task.orbit.velocities_e(t_s)),
        cov_target_i=(axes_i * sigma_m[:, None, :] ** 2) @ np.swapaxes(axes_i, 1, 2),
    )


def placings_table(placings: Placings) -> tuple[pa.Table, dict[str, Any]]:
    """A strip's outcome as a table, one row a place; the refusals stand in the remarks."""
    n = len(placings.target_id)
    table = pa.table(
        {
            "strip_id": pa.array([placings.strip_id] * n, pa.string()),
            "target_id": pa.array(placings.target_id.tolist(), pa.string()),
            "ccd": pa.array(placings.ccd),
            "xy_px": fixed_list(placings.xy_px),
            "cov_px": fixed_list(placings.cov_px),
            "correlation": pa.array(placings.correlation),
            "probability_wrong": pa.array(placings.probability_wrong),
            "predicted_px": fixed_list(placings.predicted_px),
            **pictures_columns(placings.pictures),
        }
    )
    omitted = [[o.kind, o.name, o.file, o.reason] for o in placings.omissions]
    return table, {"kind": "strip", "id": placings.strip_id, "targets": n, "omitted": omitted}


def placings_from_table(table: pa.Table) -> Placings:
    """The inverse of `placings_table`, bit for bit."""
    meta = read_meta(table)
    return Placings(
        meta["id"],
        np.array(column(table, "target_id").tolist(), dtype=str),
        column(table, "ccd"),
        list_values(table, "xy_px", 2),
        list_values(table, "cov_px", 2, 2),
        column(table, "correlation"),
        column(table, "probability_wrong"),
        list_values(table, "predicted_px", 2),
        pictures_from_columns(table),
        tuple(Omission(*parts) for parts in meta["omitted"]),
    )


def targets_near(
    task: StripTask, targets: Sequence[Target], chips: Sequence[ChipFile]
) -> tuple[tuple[Target, ...], tuple[ChipFile, ...]]:
    """Those that the strip might show, generously: all that its result depends on, however large the list."""
    model, lines = pushbroom_of(task), np.linspace(0.0, task.strip.lines - 1.0, 9)
    seen = []
    for ccd in range(task.camera.n_ccds):
        for sample in (0.0, task.camera.n_px(ccd) - 1.0):
            seen.append(model.ground_points(ccd, np.full(9, sample), lines, ConstantHeight(0.0)))
    ground_e = np.vstack(seen)
    ground_e = ground_e[np.isfinite(ground_e).all(axis=1)]
    if not len(ground_e):
        return (), ()
    middle = ground_e.mean(axis=0)
    reach = float(np.linalg.norm(ground_e - middle, axis=1).max())
    satellite = task.orbit.positions_e(model.instants(lines[4:5]))[0]
    distance = float(np.linalg.norm(satellite - middle))
    turn = 2.0 * task.settings.sigmas * float(task.sigma_installation_rad.max())
    reach = 1.2 * reach + distance * turn + 2e4
    near = [n for n, target in enumerate(targets) if np.linalg.norm(target.p_e - middle) <= reach]
    return tuple(targets[n] for n in near), tuple(chips[n] for n in near)


def orbit_around(orbit: Orbit, t_first_s: float, t_last_s: float) -> Orbit:
    """The nodes that interpolation between two instants can touch, and a few more: all that a strip depends
    on.
    """
    spare = orbit.nodes_needed + 2
    first = max(int(np.searchsorted(orbit.t_s, t_first_s)) - spare, 0)
    last = min(int(np.searchsorted(orbit.t_s, t_last_s)) + spare, len(orbit.t_s))
    velocities = None if orbit.velocities_m_s is None else orbit.velocities_m_s[first:last]
    usual_step = float(np.median(np.diff(orbit.t_s)))
    return Orbit(
        orbit.epoch,
        orbit.t_s[first:last],
        orbit.positions_m[first:last],
        velocities,
        orbit.frame,
        orbit.degree,
        orbit.earth,
        orbit.sigma_position_m,
        orbit.method,
        orbit.max_step_s if orbit.max_step_s is not None else 1.5 * usual_step,
    )


def covers(dump: Dump, strip: Strip) -> bool:
    """Whether the orbit has states for every row of a strip."""
    label = np.array([0.0, strip.lines - 1.0]) * strip.row_period_s + strip.t_first_row_s
    instants = label + dump.line_camera.delay_to_middle_s(strip.row_period_s)
    try:
        dump.orbit.positions_i(instants)
    except ValueError:
        return False
    return True
