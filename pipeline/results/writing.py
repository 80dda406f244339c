"""A result written: `installation.json` for the reader, Parquet tables for reports and later calibrations.

Everything but run.json is identical, bit for bit, for the same inputs, settings and version.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from boresight.calib.estimate import InstallationEstimate, TargetResiduals
from boresight.calib.predicted_earth import is_earth
from boresight.calib.reliability import blind_spots
from boresight.calib.settings import CalibrationSettings
from boresight.calib.verdict import Verdict
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.installation import euler_zxy_from_theta
from boresight.geometry.line_camera import LineSensor, edge_tangent
from boresight.geometry.orbit import argument_of_latitude, beta_angle
from boresight.geometry.sightings import StripSightings
from boresight.pipeline import __version__
from boresight.pipeline.calibration.calibrate import DumpCalibration
from boresight.pipeline.calibration.joint import JointCalibration
from boresight.pipeline.diagnosis.unused_rows import Rows
from boresight.pipeline.files.record_tables import columns_of, plain
from boresight.pipeline.files.table_files import arrow_array, arrow_rows, fixed_list
from boresight.pipeline.files.whole_file import remove_abandoned, write_inside, write_json
from boresight.pipeline.results.sightings_tables import COLUMNS, pairs_table, sightings_schema
from boresight.pipeline.run.digests import rounded_digest
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.sky_strip import SkyTask
from boresight.pipeline.stages.strip import MatchedTargets, StripTask
from boresight.records.record import Floats

__all__ = [
    "blind_spots_json",
    "installation_facts",
    "joint_ground_m_per_rad",
    "rotation_json",
    "verdict_json",
    "write_installation",
    "write_joint_result",
    "write_result",
    "write_run",
    "write_sightings",
    "write_tables",
]

# Of the matrix of a single camera, in their order in installation.json (docs/result-format.md).
MATRIX = tuple("R_cs quaternion theta_rad euler_zxy_deg covariance_rad2 ground_m_per_rad".split())


def write_result(result: Path, calibration: DumpCalibration, settings: Settings) -> None:
    """Write everything but run.json; `installation.json` comes last, so that where it is, all is."""
    write_sightings(result, calibration)
    write_installation(result, calibration, settings)


def write_sightings(result: Path, calibration: DumpCalibration) -> None:
    """Write the tables in the folder `sightings`."""
    matched = {one.strip_id: one for one in calibration.observed}
    _write_tables(
        result,
        {
            "stars": _star_groups(calibration),
            "exposures": [_exposures_table(calibration)],
            "targets": _target_groups(calibration.estimate.targets, calibration.strips, matched),
            "passes": [_passes_table(calibration, calibration.estimate)],
        },
        calibration,
    )


def write_installation(result: Path, calibration: DumpCalibration, settings: Settings) -> None:
    """Write `installation.json`; where it is, all is."""
    content = installation_facts(
        calibration.estimate,
        calibration.verdict,
        calibration.rows,
        (calibration.settings, settings),
        [ground_m_per_rad(calibration.strips, calibration.camera)],
    )
    content["earth_orientation"] = plain(calibration.assessment.earth_table)
    write_json(result / "installation.json", content)


def write_joint_result(
    result: Path, joint: JointCalibration, of_dumps: Mapping[str, DumpCalibration], settings: Settings
) -> None:
    """Write the joint result of several dumps; their own stand in its folders. `installation.json` last."""
    matched = {f"{name}/{one.strip_id}": one for name, found in of_dumps.items() for one in found.observed}
    passes = [_passes_table(found, joint.estimate, f"{name}/") for name, found in of_dumps.items()]
    targets = _target_groups(joint.estimate.targets, joint.strips, matched)
    _write_tables(result, {"targets": targets, "passes": [pa.concat_tables(passes)]}, joint)
    content = installation_facts(
        joint.estimate,
        joint.verdict,
        joint.rows,
        (joint.settings, settings),
        joint_ground_m_per_rad(joint),
        joint.sigma_installation_rad,
    )
    write_json(result / "installation.json", content)


def write_tables(result: Path, tables: Mapping[str, pa.Table], facts: dict[str, Any]) -> None:
    """Write a result of whole tables; `installation.json` last."""
    for name, table in tables.items():
        _write_groups(result / "sightings" / f"{name}.parquet", [table])
    write_json(result / "installation.json", facts)


def _write_tables(
    result: Path, tables: dict[str, list[pa.Table]], found: DumpCalibration | JointCalibration
) -> None:
    """Write these tables and those that all results have, each of row groups."""
    of_all = {
        "strips": [pairs_table(found.estimate.pairs)],
        "ledger": [arrow_rows([entry.row for entry in found.omissions], sightings_schema("ledger"))],
        "reliability": [_tests_table(found.verdict)],
    }
    for name, groups in (tables | of_all).items():
        _write_groups(result / "sightings" / f"{name}.parquet", groups)


def write_run(result: Path, facts: dict[str, Any]) -> None:
    """Times, counts and machine of a run: what may differ between two runs with the same result."""
    write_json(result / "run.json", facts)
    remove_abandoned(result)  # of worker processes that were killed during the run


def verdict_json(verdict: Verdict, rows: Sequence[Rows] = ()) -> dict[str, Any]:
    """A verdict as installation.json has it: for each check also whether it holds or fails, and what to look
    at; for all of them, the sentence that console and report begin with, with the rows of tables of which not
    all are used.
    """
    partly = [str(one) for one in rows if one.used < one.listed]
    used = f"; used: {', '.join(partly)}" if partly else ""
    checks = [
        plain(check)
        | {"holds": check.holds, "fails": check.fails, "is_caution": check.is_caution}
        | {"look_at": [suspect.value for suspect in check.look_at]}
        for check in verdict.checks
    ]
    facts = {key: value for key, value in plain(verdict).items() if key != "tests"}
    return facts | {"checks": checks, "sentence": verdict.sentence + used}


def blind_spots_json(verdict: Verdict) -> list[dict[str, Any]]:
    """What the data cannot show, or show too late, as installation.json has it."""
    return [
        plain(one) | {"is_unseen": one.is_unseen, "hidden_sigma": one.hidden_sigma}
        for one in blind_spots(verdict.tests)
    ]


def ground_m_per_rad(strips: Sequence[StripSightings], camera: LineSensor) -> Floats:
    """How far (3,), m, a point on the ground moves with a rotation by 1 rad about X, Y and Z of the
    remote-sensing camera: X, Y at its axis, Z at the edge of the swath. NaN for strips that see no ground.
    """
    range_m = np.concatenate([strip.ground.range_m for strip in strips])
    known = range_m[np.isfinite(range_m)]
    mean_m = float(known.mean()) if len(known) else np.nan
    return mean_m * np.array([1.0, 1.0, edge_tangent(camera)])


def joint_ground_m_per_rad(joint: JointCalibration) -> list[Floats]:
    """`ground_m_per_rad` (3,) of each camera of a joint calibration."""
    several = len(joint.estimate.cameras) > 1
    return [
        ground_m_per_rad([one for one in joint.strips if not several or one.camera == name], camera)
        for name, camera in zip(joint.estimate.cameras, joint.cameras)
    ]


def installation_facts(
    estimate: InstallationEstimate,
    verdict: Verdict,
    rows: Sequence[Rows],
    given: tuple[CalibrationSettings, Settings],
    grounds: Sequence[Floats],
    sigma_installation_rad: Floats | None = None,
) -> dict[str, Any]:
    """What installation.json holds: `given` are the error model of the estimate and all settings, `grounds`
    the `ground_m_per_rad` (3,) of each camera, `sigma_installation_rad` (3 C,) the 1-sigma before launch.
    """
    error_model, settings = given
    used = dataclasses.asdict(settings) | {"calibration": dataclasses.asdict(error_model)}
    rows_of = {
        "ground_references": [plain(one) for one in estimate.references],
        "periodic_errors": [plain(one) for one in estimate.periodic],
        "doubtful_targets": [[f"{t.strip}/{t.id}" for t in group] for group in estimate.targets.doubtful],
    }
    return {
        "verdict": verdict_json(verdict, rows),
        "blind_spots": blind_spots_json(verdict),
        **_matrices(estimate, grounds, sigma_installation_rad),
        "frames": estimate.n_exposures,
        "stars": estimate.n_stars,
        "targets": estimate.n_targets,
        "rows": {one.name: {"used": one.used, "listed": one.listed} for one in rows},
        "chi2": estimate.chi2,
        "dof": estimate.dof,
        "settings": used,
        "version": __version__,
        **(_heads(estimate) if len(estimate.heads) > 1 else {}),
        **({} if estimate.bias is None else {"common_bias": plain(estimate.bias)}),
        **_predicted_earth(estimate),
        **{name: found for name, found in rows_of.items() if found},
    }


def _matrices(
    estimate: InstallationEstimate, grounds: Sequence[Floats], sigma_rad: Floats | None
) -> dict[str, Any]:
    """The matrix; of several cameras that of each, their covariance, and the rotations between them."""
    cameras = []
    for n, (name, ground) in enumerate(zip(estimate.cameras, grounds)):
        R_cs, covariance = estimate.of_camera(name)
        theta = estimate.theta[3 * n : 3 * n + 3]
        matrix = {"name": name} | rotation_json(R_cs, "R_cs", theta, covariance)
        euler_deg = np.degrees(euler_zxy_from_theta(theta)).tolist()
        cameras.append(matrix | {"euler_zxy_deg": euler_deg, "ground_m_per_rad": ground.tolist()})
    if len(cameras) == 1:
        return {field: cameras[0][field] for field in MATRIX}
    between = [
        {"cameras": list(one.cameras), **rotation_json(one.R_ab, "R_ab", one.theta, one.covariance)}
        | {"p_value": one.p_value, "as_before_launch": one.as_before_launch}
        for one in estimate.between(sigma_rad)
    ]
    full = estimate.cov_theta.tolist()
    return {"cameras": cameras, "between_cameras": between, "cameras_covariance_rad2": full}


def rotation_json(R: Rotation, name: str, theta: Floats, covariance: Floats) -> dict[str, Any]:
    """A rotation of the name, with its theta (3,), rad, and covariance (3, 3), rad^2, for JSON."""
    return {
        name: R.as_matrix().tolist(),
        "quaternion": R.as_quat(canonical=True).tolist(),
        "theta_rad": theta.tolist(),
        "covariance_rad2": covariance.tolist(),
    }


def _predicted_earth(estimate: InstallationEstimate) -> dict[str, Any]:
    """Errors of predicted Earth orientation and what they have in common with theta; empty where measured."""
    names = estimate.pairs.shared
    rows = [n for n, name in enumerate(names) if is_earth(name)]
    if not rows:
        return {}
    content = {
        "unknowns": [names[n] for n in rows],
        "covariance": estimate.shared_covariance[np.ix_(rows, rows)].tolist(),
        "covariance_with_theta_rad": estimate.theta_with_shared[:, rows].tolist(),
    }
    return {"predicted_earth": content}


def _heads(estimate: InstallationEstimate) -> dict[str, Any]:
    """The matrices of several heads, and the covariance of all of them together."""
    heads = [
        {
            "name": head.name,
            "R_cs": head.R_cs.as_matrix().tolist(),
            "quaternion": head.R_cs.as_quat(canonical=True).tolist(),
            "covariance_rad2": estimate.cov_heads[3 * n : 3 * n + 3, 3 * n : 3 * n + 3].tolist(),
        }
        for n, head in enumerate(estimate.heads)
    ]
    return {"heads": heads, "heads_covariance_rad2": estimate.cov_heads.tolist()}


def _star_groups(calibration: DumpCalibration) -> list[pa.Table]:
    """Stars of each exposure, one row group an exposure."""
    attitudes, groups = calibration.attitudes, []
    for k, exposure in enumerate(calibration.stars):
        rows = attitudes.stars(k)
        own = {
            "exposure_id": arrow_array([exposure.exposure_id] * len(exposure.hip), pa.string()),
            "t_s": arrow_array(np.full(len(exposure.hip), exposure.t_s)),
            "residual_s": fixed_list(exposure.u_s - exposure.u_i @ attitudes.R_si[k].T),
            "normalised": arrow_array(attitudes.squared_mahalanobis[rows]),
            "kept": arrow_array(attitudes.kept[rows]),
        }
        groups.append(pa.table(columns_of(exposure) | own).select(list(COLUMNS["stars"])))
    return groups


def _exposures_table(calibration: DumpCalibration) -> pa.Table:
    stars = calibration.stars
    own = {
        "exposure_id": arrow_array([s.exposure_id for s in stars], pa.string()),
        "t_s": arrow_array([s.t_s for s in stars], pa.float64()),
        "stars": arrow_array([len(s.hip) for s in stars], pa.int64()),
    }
    return pa.table(own | columns_of(calibration.attitudes, "K")).select(list(COLUMNS["exposures"]))


def _target_groups(
    found: TargetResiduals, strips: Sequence[StripSightings], matched: Mapping[str, MatchedTargets]
) -> list[pa.Table]:
    """Targets of each strip, one row group a strip. Residuals are found by strip, target and CCD."""
    keys = zip(found.strip_id.tolist(), found.target_id.tolist(), found.ccd.tolist())
    row_of = {key: n for n, key in enumerate(keys)}
    groups = []
    for strip in strips:
        ground = strip.ground
        rows = [row_of[strip.strip_id, t, c] for t, c in zip(ground.target_id.tolist(), ground.ccd.tolist())]
        own = {
            "strip_id": arrow_array([strip.strip_id] * len(rows), pa.string()),
            "residual_c": fixed_list(found.residual_c[rows]),
            "normalised": arrow_array(found.statistic[rows]),
            "kept": arrow_array(found.kept[rows]),
            "weight": arrow_array(found.weight[rows]),
            "detectable_rad": arrow_array(found.detectable_rad[rows]),
            "detectable_m": arrow_array(found.detectable_m[rows]),
        }
        columns = columns_of(matched[strip.strip_id]) | columns_of(ground) | own
        groups.append(pa.table(columns).select(list(COLUMNS["targets"])))
    return groups


def _passes_table(calibration: DumpCalibration, estimate: InstallationEstimate, prefix: str = "") -> pa.Table:
    """A row for each strip of the estimate: time, place in orbit, height of the Sun, track, camera, and what
    the matrices of an estimate have taken up of its errors.
    """
    used = {strip.strip_id for strip in calibration.strips}
    every: list[StripTask | SkyTask] = [*calibration.tasks, *calibration.sky.tasks]
    tasks = [task for task in every if task.strip.strip_id in used]
    rows: list[dict[str, object]] = []
    for task in tasks:
        lasts_s = task.strip.lines * task.strip.row_period_s
        t_s = task.strip.t_first_row_s + lasts_s * np.array([0.5, 0.0, 1.0])
        states = task.orbit.states_i(t_s[:1])
        lat, lon, _ = geodetic_from_ecef(task.orbit.positions_e(t_s))
        track_deg = np.degrees([lat, lon]).T
        rows.append(
            {
                "strip_id": prefix + task.strip.strip_id,
                "utc_middle": task.orbit.epoch.utc_from_seconds(t_s[:1])[0],
                "argument_of_latitude_rad": float(argument_of_latitude(*states)[0]),
                "camera": rounded_digest(plain(task.camera)),
                "beta_rad": float(beta_angle(*states, task.orbit.epoch, t_s[:1])[0]),
                "begin_deg": track_deg[1].tolist(),
                "end_deg": track_deg[2].tolist(),
            }
        )
    nothing = np.zeros((3 * len(estimate.heads), 7))
    taken_up = [nothing, *(estimate.taken_up.get(str(row["strip_id"]), nothing) for row in rows)]
    table = arrow_rows(rows, sightings_schema("passes"))
    return table.append_column("taken_up", fixed_list(np.array(taken_up)[1:]))


def _tests_table(verdict: Verdict) -> pa.Table:
    """One row for each error of an input that was tested."""
    tests = verdict.tests
    texts = {
        name: arrow_array([str(getattr(one, name)) for one in tests], pa.string())
        for name in ("cause", "item", "unit", "file", "field")
    }
    numbers = ("value", "sigma", "statistic", "p_value", "detectable", "redundancy", "effect_sigma")
    values = {name: arrow_array([getattr(one, name) for one in tests], pa.float64()) for name in numbers}
    effect = fixed_list(np.array([one.effect_rad for one in tests]).reshape(len(tests), -1 if tests else 3))
    return pa.table(texts | values | {"effect_rad": effect})


def _write_groups(path: Path, groups: Sequence[pa.Table]) -> None:
    """One Parquet file, one row group a table, without dictionaries: few values repeat."""

    def write(target: Path) -> None:
        how = {"compression": "zstd", "use_dictionary": False, "write_page_checksum": True}
        with pq.ParquetWriter(target, groups[0].schema, **how) as file:
            for group in groups:
                file.write_table(group, row_group_size=max(len(group), 1))

    if groups:
        write_inside(path, write)
