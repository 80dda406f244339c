"""A finished result read back: matrix, attitudes, information of the strips."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from boresight.calib.distortion import MODES
from boresight.calib.error_table import BIASES, by_kind, coordinate_covariance, coordinate_names, prior_of
from boresight.calib.information import InformationPairs
from boresight.calib.predicted_earth import predictions_of
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.table_files import arrow_rows, column, list_values, read_parquet
from boresight.pipeline.files.text_files import json_if_there, read_json
from boresight.pipeline.results.folder import dumps_in
from boresight.pipeline.results.ownership import check_dump_of, dump_identity, origin_of
from boresight.pipeline.results.sightings_tables import read_sightings, sightings_schema
from boresight.records.record import Bools, Floats, array, record, scalar

__all__ = [
    "SavedResult",
    "pairs_in",
    "read_findings",
    "read_for_dump",
    "read_installation",
    "read_matrices",
    "read_mounting",
    "read_pairs",
    "read_saved_result",
]

ALIGNMENT = re.compile(r"head/[A-Za-z0-9_.-]{1,64}/[xyz]")  # names of unknowns: mounting of a further head
OTHERS = ("earth/", "reference/", "periodic/", "camera/")  # beginnings of others that are eliminated
# Names of unknowns: distortion along x or y, of a CCD, at a node or of a mode.
DISTORTION = re.compile(rf"distortion/[xy]/\d{{1,6}}/(-?\d{{1,6}}|{'|'.join(MODES)})")

UNIT_LENGTH = 1e-6  # by which a quaternion may be longer or shorter
# Keys of the verdict in installation.json, and of each of its checks.
VERDICT_KEYS = set("outcome sentence checks findings probability_false_alarm".split())
VERDICT_KEYS |= {"weakest_axis_c", "weakest_sigma_rad"}
CHECK_KEYS = set(
    "kind statistic expected n p_value p_plain limit holds fails is_caution look_at names".split()
)


@record(kw_only=True)
class SavedEarth:
    """Errors of predicted Earth orientation in a result, each rotation in units of its 1-sigma."""

    predictions: tuple[str, ...] = array("E", "as `EarthRotation.prediction`, three rotations each")
    covariance: Floats = array("F, F", "of the F = 3 E rotations")
    with_theta_rad: Floats = array("3, F", "of theta with them, rad")


# Of a result whose Earth orientation was measured.
NO_EARTH = SavedEarth(predictions=(), covariance=np.zeros((0, 0)), with_theta_rad=np.zeros((3, 0)))


@record(kw_only=True)
class SavedResult:
    """A finished result, read back."""

    R_cs: Rotation = scalar("installation matrix, star camera to remote-sensing camera")
    theta: Floats = array("3", "deviation from the pre-launch matrix, rad")
    cov_theta: Floats = array("3, 3", "its covariance, rad², a small rotation about the axes of c")
    installation: dict[str, Any] = scalar("content of installation.json")
    exposure_id: list[str] = array("K", "ids of the identified exposures")
    t_exposures_s: Floats = array("K", "their times, TAI seconds since the dump's epoch")
    R_si: Rotation = array("K", "their attitudes, GCRS to star camera")
    covariance_s: Floats = array("K, 3, 3", "covariance of their errors, frame s, rad²")
    usable: Bools = array("K", "whether enough stars were kept to determine the attitude")
    earth: SavedEarth = scalar(
        "errors of predicted Earth orientation, if it was not measured", default=NO_EARTH
    )
    taken_up: dict[str, Floats] = scalar(
        "of the errors of each strip's pass by the matrices of its camera, (3 H, 7): "
        "`InstallationEstimate.taken_up`",
        default_factory=dict,
    )

    @property
    def head_names(self) -> tuple[str, ...]:
        """Names of the H heads, the reference head first; a single one may have none."""
        return tuple(str(one["name"]) for one in self.installation.get("heads") or [{"name": ""}])

    @property
    def cov_heads(self) -> Floats:
        """Covariance (3 H, 3 H), rad², of the matrices of all heads, axes of c."""
        n = 3 * len(self.head_names)
        if n == 3:
            return self.cov_theta
        of_all = _numbers(self.installation, "heads_covariance_rad2", (n, n), "installation.json")
        # Alignments are the same for all cameras, and for one dump and for several.
        return of_all + np.tile(self.cov_theta - of_all[:3, :3], (n // 3, n // 3))


def read_findings(result: Path) -> list[dict[str, Any]]:
    """The findings of a result (`cause`, `item`, `text`, ...): those of its verdict, and with a report those
    that need images.

    `RawDataError` for findings that are not as the program writes them.
    """
    context, installation = result / "evidence" / "context.json", result / "installation.json"
    path = context if context.is_file() else installation
    content = json_if_there(path)
    found = (content if path == context else content.get("verdict") or {}).get("findings", [])
    if not all(isinstance(one, dict) and {"cause", "item", "text"} <= one.keys() for one in found):
        raise RawDataError(str(path), "findings", found, "objects with cause, item and text")
    return list(found)


def read_installation(result: Path) -> dict[str, Any]:
    """Content of installation.json; `RawDataError` if it is missing, or its verdict not as written here."""
    name = str(result / "installation.json")
    content = read_json(result / "installation.json", name)
    verdict = content.get("verdict")
    checks = verdict.get("checks") if isinstance(verdict, dict) else None
    parts = [(verdict, VERDICT_KEYS), *((one, CHECK_KEYS) for one in checks or ())]
    if not all(isinstance(one, dict) and keys <= one.keys() for one, keys in parts):
        expected = "what `calibrate` writes; calibrate again"
        raise RawDataError(name, "verdict", "missing or incomplete", expected)
    return content


def read_saved_result(result: Path, camera: str = "") -> SavedResult:
    """The result in a folder; of several dumps, the joint matrix without any exposures; of several cameras
    the matrix of `camera`.

    `RawDataError` when it is not there or damaged, or where it is of other cameras.
    """
    name = str(result / "installation.json")
    content = read_json(result / "installation.json", name)
    R_cs, theta, covariance = matrix_in(content, camera, result)
    path = result / "sightings" / "exposures.parquet"
    if dumps_in(result):
        table = arrow_rows([], sightings_schema("exposures"))
    else:
        table = read_sightings(result, "exposures", "exposure_id t_s R_si covariance_s usable")
    with refusing(str(path), "column R_si", "rotations"):
        R_si = Rotation.from_matrix(list_values(table, "R_si", 3, 3)) if len(table) else Rotation.identity(0)
    return SavedResult(
        R_cs=R_cs,
        theta=theta,
        cov_theta=covariance,
        installation=content,
        exposure_id=[str(name) for name in table.column("exposure_id").to_pylist()],
        t_exposures_s=column(table, "t_s"),
        R_si=R_si,
        covariance_s=list_values(table, "covariance_s", 3, 3),
        usable=column(table, "usable").astype(bool),
        earth=_earth(content, name),
        taken_up=_taken_up(result),
    )


def _taken_up(result: Path) -> dict[str, Floats]:
    """What the matrices have taken up of each strip's errors; none of results that did not say."""
    path = result / "sightings" / "passes.parquet"
    table = read_parquet(path) if path.is_file() else None
    if table is None or "taken_up" not in table.column_names:
        return {}
    names = table.column("strip_id").to_pylist()
    by_strip = list_values(table, "taken_up", -1) if names else np.zeros((0, 7))
    return dict(zip(names, by_strip.reshape(len(names), -1, 7)))


def _with_joint(folder: Path, joint: SavedResult, fields: str) -> SavedResult:
    """The result of one dump with some fields of the joint one, and what joint matrices have taken up of the
    errors of its strips.
    """
    own, of_joint = f"{folder.name}/", {name: getattr(joint, name) for name in fields.split()}
    taken_up = {name.removeprefix(own): G for name, G in joint.taken_up.items() if name.startswith(own)}
    return dataclasses.replace(read_saved_result(folder), taken_up=taken_up, **of_joint)


def of_camera(content: dict[str, Any], camera: str, result: Path) -> dict[str, Any]:
    """What installation.json says of one of several cameras, or the only one; `RawDataError` for another."""
    matrices = {str(one.get("name")): one for one in content.get("cameras") or ()}
    if not camera and not matrices:
        return content
    if camera not in matrices:
        expected = f"one of {', '.join(matrices)}" if matrices else "none: it is of one camera"
        raise RawDataError(str(result), "--camera", camera or "nothing", expected)
    return matrices[camera]


def matrix_in(content: dict[str, Any], camera: str, result: Path) -> tuple[Rotation, Floats, Floats]:
    """R_cs, theta (3,), rad, covariance (3, 3), rad², of an installation.json, or of one `camera` in it."""
    file, matrix = str(result / "installation.json"), of_camera(content, camera, result)
    return *_matrix(matrix, file), _numbers(matrix, "covariance_rad2", (3, 3), file)


def read_matrices(result: Path) -> tuple[tuple[str, ...], Rotation, Floats, Floats]:
    """Names of C cameras ("": the only one), matrices, theta (3 C,), rad, covariance (3 C, 3 C), rad²."""
    file = str(result / "installation.json")
    content = read_json(result / "installation.json", file)
    if not (cameras := content.get("cameras")):
        return ("",), *_matrix(content, file), _numbers(content, "covariance_rad2", (3, 3), file)
    names = tuple(str(one["name"]) for one in cameras)
    each = [_matrix(one, f"{file}: camera {name}") for name, one in zip(names, cameras)]
    covariance = _numbers(content, "cameras_covariance_rad2", (3 * len(names), 3 * len(names)), file)
    R_cs, theta = zip(*each)
    return names, Rotation.concatenate(R_cs), np.concatenate(theta), covariance


def _matrix(content: dict[str, Any], file: str) -> tuple[Rotation, Floats]:
    """A matrix with its theta."""
    quaternion = _numbers(content, "quaternion", (4,), file)
    if abs(np.linalg.norm(quaternion) - 1.0) > UNIT_LENGTH:
        raise RawDataError(file, "quaternion", quaternion.tolist(), "length 1")
    return Rotation.from_quat(quaternion), _numbers(content, "theta_rad", (3,), file)


def _earth(content: dict[str, Any], file: str) -> SavedEarth:
    """What `installation.json` says about predicted Earth orientation."""
    if (saved := content.get("predicted_earth")) is None:
        return NO_EARTH
    names: Any = saved.get("unknowns") if isinstance(saved, dict) else saved
    try:
        predictions = predictions_of(names)
    except (TypeError, ValueError, AttributeError) as error:
        expected = f"names of rotations ({error})"
        raise RawDataError(file, "predicted_earth.unknowns", names, expected) from error
    n = 3 * len(predictions)
    return SavedEarth(
        predictions=predictions,
        covariance=_numbers(saved, "covariance", (n, n), file),
        with_theta_rad=_numbers(saved, "covariance_with_theta_rad", (3, n), file),
    )


def read_for_dump(result: Path, dump: Path | None, camera: str = "") -> tuple[Path, SavedResult]:
    """The folder with the sightings of `dump`, and its result; where `result` is of several dumps, or of
    several cameras, with the joint matrix, that of `camera`, instead of its own.

    `RawDataError` where the result is not made from `dump`, or is of several dumps or cameras and none is
    given.
    """
    if camera or (dumps_in(result) and "cameras" in read_json(result / "installation.json")):
        joint = read_saved_result(result, camera)
        folders = [name for name in dumps_in(result) if name in (camera, f"{dump and dump.name}-{camera}")]
        if not folders:
            raise RawDataError(str(result), "--dump", str(dump or "nothing"), "one of its dumps")
        folder = result / folders[0]
        if dump is not None:
            check_dump_of(folder, dump)
        return folder, _with_joint(folder, joint, "R_cs theta cov_theta")
    if not (names := dumps_in(result)):
        if dump is not None:
            check_dump_of(result, dump)
        return result, read_saved_result(result)
    identity = None if dump is None else dump_identity(dump)
    for name in names:
        origin = origin_of(result / name)
        if origin is not None and origin.dump == identity:
            of_joint = "R_cs theta cov_theta installation earth"
            return result / name, _with_joint(result / name, read_saved_result(result), of_joint)
    expected = f"one of the {len(names)} dumps of that result: {', '.join(names)}"
    raise RawDataError(str(result), "--dump", str(dump or "nothing"), expected)


def _numbers(content: dict[str, Any], key: str, shape: tuple[int, ...], file: str) -> Floats:
    """An array of finite numbers under a key of installation.json."""
    expected = f"{' x '.join(map(str, shape))} finite numbers"
    with refusing(file, key, expected, (ValueError, TypeError, OverflowError)):
        values = np.array(content.get(key), dtype=float)
    if values.shape != shape or not np.isfinite(values).all():
        raise RawDataError(file, key, content.get(key), expected)
    return values


def read_pairs(result: Path) -> InformationPairs:
    """Normal equations (F, F theta) of each strip of a finished result; `RawDataError` if not readable."""
    return pairs_in(result / "sightings" / "strips.parquet")


def pairs_in(path: Path) -> InformationPairs:
    """The pairs of a file that `pairs_table` was written to; `RawDataError` if not readable."""
    wrong = (ValueError, KeyError, IndexError, TypeError)
    with refusing(str(path), "columns", "the table that `calibrate` wrote", wrong):
        table = read_parquet(path)
        unknowns = json.loads(table.schema.metadata[b"unknowns"])
        return InformationPairs.from_numbers(
            column(table, "name"), unknowns, list_values(table, "values", -1)
        )


def read_mounting(
    result: Path, name: str, scale: Mapping[str, float] | None = None, camera: str = ""
) -> InformationPairs:
    """Normal equations of a finished result as one: its strips added, coordinates of targets that several of
    them see, biases of orbit and clock, rotations of the Earth, alignments and periodic errors of heads, and
    matrices of other cameras than `camera` eliminated.
    The camera's distortion stays, since other results share it. `scale`: of each strip's information by the
    strip's name, instead of 1; 0 leaves it out. `RawDataError` if not readable.
    """
    pairs = read_pairs(result)
    if camera not in pairs.cameras:
        raise RawDataError(str(result), "--camera", camera or "nothing", f"one of {', '.join(pairs.cameras)}")
    pairs = pairs.of_camera(camera)
    if scale is not None:
        of_strip = np.array([scale.get(one, 1.0) for one in pairs.names.tolist()])
        F, right = of_strip[:, None, None] * pairs.F, of_strip[:, None] * pairs.F_theta
        pairs = dataclasses.replace(pairs, F=F, F_theta=right)
    path = result / "sightings" / "strips.parquet"
    own = [unknown for unknown in pairs.shared if not DISTORTION.fullmatch(unknown)]
    known = {*BIASES, *(one for one in own if ALIGNMENT.fullmatch(one) or one.startswith(OTHERS))}
    coordinates = [unknown for unknown in own if unknown not in known]
    targets = tuple(dict.fromkeys(unknown.removeprefix("target/")[:-2] for unknown in coordinates))
    if tuple(coordinates) != coordinate_names(targets):
        raise RawDataError(str(path), "columns", coordinates[0], "unknowns of camera, targets and heads")
    eliminated = by_kind(own)
    with refusing(str(path), "F", "information pairs of strips", (np.linalg.LinAlgError, ValueError)):
        return pairs.as_one(name, eliminated, prior_of(eliminated, _prior_of_targets(result, targets)))


def _prior_of_targets(result: Path, targets: Sequence[str]) -> Floats:
    """Information (3 t, 3 t) on the coordinates of targets before any strip, 1/m²."""
    if not targets:
        return np.zeros((0, 0))
    path = result / "sightings" / "targets.parquet"
    table = read_sightings(result, "targets", "target_id t_s u_i range_m cov_target_i")
    names = table.column("target_id").to_pylist()
    if unknown := sorted(set(targets) - set(names)):
        raise RawDataError(str(path), "target_id", "not there", f"target {unknown[0]} of strips.parquet")
    rows = [names.index(target) for target in targets]
    t_s, range_m = column(table, "t_s")[rows], column(table, "range_m")[rows]
    own, u_i = list_values(table, "cov_target_i", 3, 3)[rows], list_values(table, "u_i", 3)[rows]
    covariance = coordinate_covariance(own, t_s, u_i, np.isinf(range_m))
    return np.asarray(block_diag(*np.linalg.inv(covariance)))
