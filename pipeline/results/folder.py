"""The folder that `calibrate` leaves: `installation.json` for the reader, Parquet for reports and later
calibrations.

    installation.json            the matrix, its covariance and what it rests on
    sightings/stars.parquet      every identified star of every exposure, one row group an exposure
    sightings/exposures.parquet  attitude of every exposure from its stars
    sightings/targets.parquet    every placed target with look direction, known direction and residual
    sightings/passes.parquet     when each strip was taken, where in the orbit, by which camera
    sightings/strips.parquet     information pair (F, F theta) of every strip: all that a later merge needs
    sightings/omissions.parquet  what was left out, and why
    work/                        finished units, for a run that is started again
    run.json                     times and counts of the run that wrote the rest

The result of several dumps has `dumps.json` too, the full result of each dump in a folder of its own, and of
itself what is joint: no stars, exposures and work.

Everything but run.json is the same, bit for bit, for the same inputs, settings and version.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from boresight.calib.estimate import InstallationEstimate, TargetResiduals
from boresight.calib.information import InformationPairs
from boresight.calib.settings import CalibrationSettings
from boresight.calib.shared_unknowns import coordinate_names, turning_axes
from boresight.geometry.installation import euler_zxy_from_theta
from boresight.geometry.orbit import argument_of_latitude
from boresight.geometry.sightings import StarSightings, StripSightings
from boresight.pipeline import __version__
from boresight.pipeline.errors import Omission, RawDataError
from boresight.pipeline.files.table_files import column, fixed, fixed_list, list_values, read_parquet
from boresight.pipeline.files.text_files import read_json
from boresight.pipeline.files.whole_file import remove_abandoned, write_whole
from boresight.pipeline.settings import Settings
from boresight.pipeline.stages.calibrate import Calibration
from boresight.pipeline.stages.joint import JointCalibration
from boresight.pipeline.stages.strip import MatchedTargets
from boresight.pipeline.work.unit_store import UnitStore, digest

__all__ = [
    "SavedResult",
    "begin_result",
    "dumps_in",
    "read_for_dump",
    "read_mounting",
    "read_pairs",
    "read_result",
    "results_in",
    "store_of",
    "write_dumps",
    "write_joint_result",
    "write_result",
    "write_run",
]

Array = NDArray[np.float64]
DUMPS = "dumps.json"
FIELDS = (
    "R_cs",
    "quaternion",
    "theta_rad",
    "euler_zxy_deg",
    "covariance_rad2",
    "frames",
    "stars",
    "targets",
    "chi2",
    "dof",
    "settings",
    "version",
)
EXPOSURES = {
    "exposure_id": pa.string(),
    "t_s": pa.float64(),
    "R_si": fixed(9),
    "usable": pa.bool_(),
}
COORDINATES = {"target_id": pa.string(), "t_s": pa.float64(), "cov_target_i": fixed(9)}
DISTORTION = re.compile(r"distortion/[xy]/\d{1,6}/-?\d{1,6}")


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class SavedResult:
    """What `validate` and `report` read back of a result."""

    R_cs: Rotation
    theta: Array  # (3,) rad against the matrix measured on the ground
    cov_theta: Array  # (3, 3) rad², a small turn about the axes of c
    installation: dict[str, Any]  # installation.json as it stands
    exposure_id: list[str]
    t_exposures_s: Array  # (K,)
    R_si: Rotation  # (K,)
    usable: NDArray[np.bool_]  # (K,)


def store_of(result: Path) -> UnitStore:
    """Where finished units of a result lie."""
    return UnitStore(result / "work")


def begin_result(result: Path) -> None:
    """Make the folder; what says of an earlier run that it is finished goes, since it is true no more.

    What a killed run left half-written goes too: it has no name that anything is looked for under.
    """
    result.mkdir(parents=True, exist_ok=True)
    remove_abandoned(result)
    for name in ("installation.json", DUMPS, "drift.json"):
        (result / name).unlink(missing_ok=True)


def write_result(result: Path, calibration: Calibration, settings: Settings) -> None:
    """Write everything but run.json; `installation.json` comes last, so that where it is, all is."""
    tables = result / "sightings"
    tables.mkdir(parents=True, exist_ok=True)
    _write_groups(tables / "stars.parquet", _star_groups(calibration))
    _write_groups(tables / "exposures.parquet", [_exposures_table(calibration)])
    placed = {places.strip_id: places for places in calibration.matched}
    estimate = calibration.estimate
    _write_groups(tables / "targets.parquet", _target_groups(estimate.targets, calibration.strips, placed))
    _write_groups(tables / "strips.parquet", [_pairs_table(estimate)])
    _write_groups(tables / "passes.parquet", [_passes_table(calibration)])
    _write_groups(tables / "omissions.parquet", [_omissions_table(calibration.omissions)])
    _write_json(result / "installation.json", _installation(estimate, calibration.settings, settings))


def write_joint_result(
    result: Path, joint: JointCalibration, of_dumps: Mapping[str, Calibration], settings: Settings
) -> None:
    """Write the joint result of several dumps; their own stand in its folders. `installation.json` last."""
    tables = result / "sightings"
    tables.mkdir(parents=True, exist_ok=True)
    placed = {
        f"{name}/{places.strip_id}": places for name, found in of_dumps.items() for places in found.matched
    }
    estimate = joint.estimate
    _write_groups(tables / "targets.parquet", _target_groups(estimate.targets, joint.strips, placed))
    _write_groups(tables / "strips.parquet", [_pairs_table(estimate)])
    passes = [_passes_table(found, f"{name}/") for name, found in of_dumps.items()]
    _write_groups(tables / "passes.parquet", [pa.concat_tables(passes)])
    _write_groups(tables / "omissions.parquet", [_omissions_table(joint.omissions)])
    _write_json(result / "installation.json", _installation(estimate, joint.settings, settings))


def write_dumps(result: Path, names: Sequence[str]) -> None:
    """Note that the folder is of several dumps, whose own results lie in its folders `names`."""
    _write_json(result / DUMPS, {"dumps": list(names)})


def dumps_in(result: Path) -> tuple[str, ...]:
    """Names of the dumps whose results lie in this one's folders; none for the result of one dump."""
    if not (path := result / DUMPS).is_file():
        return ()
    names = read_json(path, str(path)).get("dumps")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise RawDataError(str(path), "dumps", names, "a list of names")
    return tuple(names)


def results_in(result: Path) -> list[Path]:
    """The result itself, or the finished ones of its dumps."""
    if not (names := dumps_in(result)):
        return [result]
    return [result / name for name in names if (result / name / "installation.json").is_file()]


def write_run(result: Path, facts: dict[str, Any]) -> None:
    """Times, counts and machine of a run: what may differ between two runs with the same result."""
    _write_json(result / "run.json", facts)
    remove_abandoned(result)  # of worker processes that were killed during the run


def read_result(result: Path) -> SavedResult:
    """Read back what a finished run left; of several dumps, the joint matrix without any exposures.

    `RawDataError` when it is not there or damaged.
    """
    name = str(result / "installation.json")
    content = read_json(result / "installation.json", name)
    quaternion = _numbers(content, "quaternion", (4,), name)
    if abs(np.linalg.norm(quaternion) - 1.0) > 1e-6:
        raise RawDataError(name, "quaternion", quaternion.tolist(), "length 1")
    path = result / "sightings" / "exposures.parquet"
    table = read_parquet(path, EXPOSURES) if not dumps_in(result) else _no_rows(EXPOSURES)
    try:
        R_si = Rotation.from_matrix(list_values(table, "R_si", 3, 3)) if len(table) else Rotation.identity(0)
    except ValueError as error:
        raise RawDataError(str(path), "column R_si", str(error), "rotations") from error
    return SavedResult(
        Rotation.from_quat(quaternion),
        _numbers(content, "theta_rad", (3,), name),
        _numbers(content, "covariance_rad2", (3, 3), name),
        content,
        [str(name) for name in table.column("exposure_id").to_pylist()],
        column(table, "t_s"),
        R_si,
        column(table, "usable").astype(bool),
    )


def read_for_dump(result: Path, dump: Path | None) -> tuple[Path, SavedResult]:
    """The folder with a dump's own sightings, and its result; where `result` is of several dumps, with the
    joint matrix instead of its own.

    `RawDataError` where `result` is of several dumps and `dump` is none of them.
    """
    if not dumps_in(result):
        return result, read_result(result)
    path = result / "run.json"
    roots = read_json(path, str(path)).get("dumps")
    if not isinstance(roots, dict):
        raise RawDataError(str(path), "dumps", type(roots).__name__, "folders of dumps by their names")
    for name, root in roots.items():
        if dump is not None and dump.resolve() == Path(str(root)):
            joint, own = read_result(result), read_result(result / name)
            matrix = {key: getattr(joint, key) for key in ("R_cs", "theta", "cov_theta", "installation")}
            return result / name, dataclasses.replace(own, **matrix)
    expected = f"one of {', '.join(map(str, roots.values()))}: the result is of {len(roots)} dumps"
    raise RawDataError(str(result), "--dump", "nothing" if dump is None else str(dump), expected)


def _no_rows(columns: Mapping[str, pa.DataType]) -> pa.Table:
    return pa.schema(list(columns.items())).empty_table()


def _numbers(content: dict[str, Any], key: str, shape: tuple[int, ...], file: str) -> Array:
    """An array of finite numbers under a key of installation.json."""
    expected = f"{' x '.join(map(str, shape))} finite numbers"
    try:
        values = np.array(content.get(key), dtype=float)
    except (ValueError, TypeError, OverflowError) as error:
        raise RawDataError(file, key, str(error), expected) from error
    if values.shape != shape or not np.isfinite(values).all():
        raise RawDataError(file, key, content.get(key), expected)
    return values


def _installation(
    estimate: InstallationEstimate, believed: CalibrationSettings, settings: Settings
) -> dict[str, Any]:
    used = dataclasses.asdict(dataclasses.replace(settings, calibration=())) | {
        "calibration": dataclasses.asdict(believed)
    }
    values = {
        "R_cs": estimate.R_cs.as_matrix().tolist(),
        "quaternion": estimate.R_cs.as_quat(canonical=True).tolist(),
        "theta_rad": estimate.theta.tolist(),
        "euler_zxy_deg": np.degrees(euler_zxy_from_theta(estimate.theta)).tolist(),
        "covariance_rad2": estimate.cov_theta.tolist(),
        "frames": estimate.n_exposures,
        "stars": estimate.n_stars,
        "targets": estimate.n_targets,
        "chi2": estimate.chi2,
        "dof": estimate.dof,
        "settings": used,
        "version": __version__,
    }
    return {field: values[field] for field in FIELDS}


def _star_groups(calibration: Calibration) -> list[pa.Table]:
    attitudes = calibration.attitudes
    groups = []
    for k, exposure in enumerate(calibration.stars):
        rows = attitudes.stars(k)
        residual = exposure.u_s - exposure.u_i @ attitudes.R_si[k].T
        squared, kept = attitudes.squared_mahalanobis[rows], attitudes.kept[rows]
        groups.append(_star_table(exposure, residual, squared, kept))
    return groups


def _star_table(exposure: StarSightings, residual: Array, normalised: Array, kept: NDArray) -> pa.Table:
    n = len(exposure.hip)
    return pa.table(
        {
            "exposure_id": pa.array([exposure.exposure_id] * n, pa.string()),
            "t_s": pa.array(np.full(n, exposure.t_s)),
            "hip": pa.array(exposure.hip),
            "xy_px": fixed_list(exposure.xy_px),
            "u_s": fixed_list(exposure.u_s),
            "u_i": fixed_list(exposure.u_i),
            "cov_s": fixed_list(exposure.cov_s),
            "residual_s": fixed_list(residual),
            "normalised": pa.array(np.asarray(normalised, dtype=float)),
            "kept": pa.array(np.asarray(kept, dtype=bool)),
        }
    )


def _exposures_table(calibration: Calibration) -> pa.Table:
    attitudes, stars = calibration.attitudes, calibration.stars
    return pa.table(
        {
            "exposure_id": pa.array([s.exposure_id for s in stars], pa.string()),
            "t_s": pa.array(np.array([s.t_s for s in stars], dtype=float)),
            "stars": pa.array(np.array([len(s.hip) for s in stars], dtype=np.int64)),
            "R_si": fixed_list(attitudes.R_si),
            "covariance_s": fixed_list(attitudes.covariance_s),
            "usable": pa.array(np.asarray(attitudes.usable, dtype=bool)),
            "chi2": pa.array(np.asarray(attitudes.chi2, dtype=float)),
            "dof": pa.array(np.asarray(attitudes.dof, dtype=np.int64)),
        }
    )


def _target_groups(
    found: TargetResiduals, strips: Sequence[StripSightings], placed: Mapping[str, MatchedTargets]
) -> list[pa.Table]:
    """One row group a strip. Residuals are matched by strip, target and CCD."""
    row_of = {
        key: n
        for n, key in enumerate(zip(found.strip_id.tolist(), found.target_id.tolist(), found.ccd.tolist()))
    }
    groups = []
    for strip in strips:
        ground, places = strip.ground, placed[strip.strip_id]
        rows = [row_of[strip.strip_id, t, c] for t, c in zip(ground.target_id.tolist(), ground.ccd.tolist())]
        groups.append(
            pa.table(
                {
                    "strip_id": pa.array([strip.strip_id] * len(rows), pa.string()),
                    "target_id": pa.array(ground.target_id.tolist(), pa.string()),
                    "ccd": pa.array(ground.ccd),
                    "t_s": pa.array(ground.t_s),
                    "xy_px": fixed_list(ground.xy_px),
                    "cov_px": fixed_list(places.cov_px),
                    "predicted_px": fixed_list(places.predicted_px),
                    "correlation": pa.array(places.correlation),
                    "probability_wrong": pa.array(places.probability_wrong),
                    "u_c": fixed_list(ground.u_c),
                    "u_i": fixed_list(ground.u_i),
                    "cov_c": fixed_list(ground.cov_c),
                    "range_m": pa.array(ground.range_m),
                    "v_rel_i": fixed_list(ground.v_rel_i),
                    "cov_target_i": fixed_list(ground.cov_target_i),
                    "residual_c": fixed_list(found.residual_c[rows]),
                    "normalised": pa.array(found.statistic[rows]),
                    "kept": pa.array(found.kept[rows]),
                }
            )
        )
    return groups


def read_pairs(result: Path) -> InformationPairs:
    """The strips' information pairs of a finished result."""
    path = result / "sightings" / "strips.parquet"
    try:
        return InformationPairs.from_table(read_parquet(path).to_pandas())
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise RawDataError(str(path), "columns", str(error), "the table that `calibrate` wrote") from error


def read_mounting(result: Path, name: str) -> InformationPairs:
    """What a finished result says of the mounting, as one pair: its strips added, coordinates of targets that
    several of them see eliminated. The camera's distortion stays, for other results know of the same.
    """
    pairs = read_pairs(result)
    path = result / "sightings" / "strips.parquet"
    coordinates = [unknown for unknown in pairs.shared if not DISTORTION.fullmatch(unknown)]
    targets = tuple(dict.fromkeys(unknown.removeprefix("target/")[:-2] for unknown in coordinates))
    if tuple(coordinates) != coordinate_names(targets):
        raise RawDataError(str(path), "columns", coordinates[0], "unknowns of the camera and of targets")
    try:
        return pairs.as_one(name, coordinate_names(targets), _prior_of_targets(result, targets))
    except np.linalg.LinAlgError as error:
        raise RawDataError(str(path), "F", str(error), "information pairs of strips") from error


def _prior_of_targets(result: Path, targets: Sequence[str]) -> Array:
    """Information (3 t, 3 t) on the coordinates of targets before any strip, 1/m²."""
    if not targets:
        return np.zeros((0, 0))
    path = result / "sightings" / "targets.parquet"
    table = read_parquet(path, COORDINATES)
    names = table.column("target_id").to_pylist()
    if unknown := sorted(set(targets) - set(names)):
        raise RawDataError(str(path), "target_id", "not there", f"target {unknown[0]} of strips.parquet")
    rows = [names.index(target) for target in targets]
    axes = turning_axes(column(table, "t_s")[rows])
    covariance = np.swapaxes(axes, 1, 2) @ list_values(table, "cov_target_i", 3, 3)[rows] @ axes
    return np.asarray(block_diag(*np.linalg.inv(covariance)))


def _pairs_table(estimate: InstallationEstimate) -> pa.Table:
    return pa.Table.from_pandas(estimate.pairs.table(), preserve_index=False)


def _passes_table(calibration: Calibration, prefix: str = "") -> pa.Table:
    """One row a strip of the estimate, at its middle: what a drift estimate wants to know of it."""
    used = {strip.strip_id for strip in calibration.strips}
    tasks = [task for task in calibration.tasks if task.strip.strip_id in used]
    rows: list[dict[str, object]] = []
    for task in tasks:
        t_s = np.array([task.strip.t_first_row_s + 0.5 * task.strip.lines * task.strip.row_period_s])
        rows.append(
            {
                "strip_id": prefix + task.strip.strip_id,
                "utc_middle": task.orbit.epoch.utc_from_seconds(t_s)[0],
                "argument_of_latitude_rad": float(argument_of_latitude(*task.orbit.states_i(t_s))[0]),
                "camera": digest(task.camera),
            }
        )
    types = (pa.string(), pa.string(), pa.float64(), pa.string())
    names = ("strip_id", "utc_middle", "argument_of_latitude_rad", "camera")
    return pa.Table.from_pylist(rows, schema=pa.schema(list(zip(names, types))))


def _omissions_table(omissions: Sequence[Omission]) -> pa.Table:
    rows = [dataclasses.asdict(omission) for omission in omissions]
    names = ("kind", "name", "file", "reason")
    return pa.table({name: pa.array([row[name] for row in rows], pa.string()) for name in names})


def _write_groups(path: Path, groups: Sequence[pa.Table]) -> None:
    """One Parquet file, one row group a table."""

    def write(target: Path) -> None:
        with pq.ParquetWriter(target, groups[0].schema, compression="zstd", write_page_checksum=True) as file:
            for group in groups:
                file.write_table(group, row_group_size=max(len(group), 1))

    if groups:
        write_whole(path, write)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    text = json.dumps(content, indent=2, allow_nan=True) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda target: target.write_text(text, encoding="utf-8"))
