"""Report page of several dumps: joint matrix, matrix of each dump, and drift of the mounting; of several
cameras: a matrix each, and the rotations between them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from boresight.pipeline.files.record_tables import plain
from boresight.pipeline.files.table_files import read_parquet
from boresight.pipeline.files.text_files import json_if_there, read_json
from boresight.pipeline.files.whole_file import write_text
from boresight.pipeline.report.budget_table import JOINT_BUDGET, budget_rows
from boresight.pipeline.report.first_screen import required, sigma_on_ground
from boresight.pipeline.report.map_view import MapView, map_view
from boresight.pipeline.report.marks import SHAPES
from boresight.pipeline.report.observations import data_uri, target_rows
from boresight.pipeline.report.page_template import number_from, template
from boresight.pipeline.report.saved import read_saved
from boresight.pipeline.report.sheet import SheetBasis, angles, basis_of, matrix_numbers
from boresight.pipeline.report.verdict_section import verdict_view
from boresight.pipeline.results.folder import dumps_in
from boresight.pipeline.results.identity import identity_of_result, saved_about
from boresight.pipeline.results.requirement import saved_requirement
from boresight.pipeline.results.sightings_tables import read_sightings
from boresight.records.record import record, scalar

__all__ = ["Bar", "SmallMap", "round_bar", "small_maps", "write_dumps_report"]

CONSTANT = ("chi2", "dof", "p_value")  # fields of drift.json: test that the matrix does not drift
MOST_MAPS = 12  # on one page: six rows of two on paper
LONGEST_BAR = 260.0  # of a bar, units of a sheet that is 1000 wide


def write_dumps_report(result: Path) -> Path:
    """Write `report.html` of a result of several dumps; its path. `RawDataError` names a missing file."""
    installation = read_json(result / "installation.json")
    omissions = read_sightings(result, "ledger", "kind name reason file").to_pylist()
    make = _cameras_page if "cameras" in installation else _joint_page
    path = result / "report.html"
    write_text(path, make(result, installation, omissions))
    return path


def _joint_page(result: Path, installation: dict[str, Any], omissions: list[dict[str, Any]]) -> str:
    """The page of several dumps of one camera."""
    joint = matrix_numbers(installation, "installation.json")
    sigma_m = sigma_on_ground(installation)
    dumps = _dumps(result, {row["name"]: row["reason"] for row in omissions if row["kind"] == "dump"})
    return template("dumps.html.j2").render(
        joint=joint,
        budget=budget_rows(json_if_there(result / JOINT_BUDGET), installation, JOINT_BUDGET),
        sigma_m=sigma_m,
        required=required(saved_requirement(result), joint["sigma"], sigma_m),
        **_common(result, installation, omissions),
        dumps=dumps,
        basis=_basis(result, [one["name"] for one in dumps if not one["reason"]]),
        maps=small_maps(result, dumps_in(result)),
        located=len(dumps_in(result)),
        shapes=SHAPES,
        drift=_drift(result),
        about=saved_about(result),
    )


def _cameras_page(result: Path, installation: dict[str, Any], omissions: list[dict[str, Any]]) -> str:
    """The page of several cameras."""
    source, pages = "installation.json", {name: f"{name}/report.html" for name in dumps_in(result)}
    cameras = [
        {
            "name": one["name"],
            "page": page if (result / (page := pages.get(one["name"], ""))).is_file() else "",
            "sigma_m": sigma_on_ground(installation, n),
            **matrix_numbers(installation, source, f"cameras.{n}."),
        }
        for n, one in enumerate(installation["cameras"])
    ]
    between = [
        {"name": " to ".join(reversed(one["cameras"]))}
        | angles(
            installation, source, f"between_cameras.{n}.theta_rad", f"between_cameras.{n}.covariance_rad2"
        )
        for n, one in enumerate(installation["between_cameras"])
    ]
    common = _common(result, installation, omissions)
    return template("cameras.html.j2").render(cameras=cameras, between=between, **common)


def _common(result: Path, installation: dict[str, Any], omissions: list[dict[str, Any]]) -> dict[str, Any]:
    """What the pages of several dumps and of several cameras share."""
    names = ("frames", "stars", "targets", "chi2", "dof")
    return {
        "verdict": verdict_view(installation),
        "counts": {name: number_from(installation, "installation.json", name, ".0f") for name in names},
        "omissions": omissions,
        "version": str(installation.get("version")),
        "identity": plain(identity_of_result(result)),
    }


def _dumps(result: Path, reasons: dict[str, str]) -> list[dict[str, Any]]:
    """One row per dump: name, date and matrix, or the reason why it has none."""
    passes = read_sightings(result, "passes", "strip_id utc_middle").to_pylist()
    rows: list[dict[str, Any]] = []
    for name in dumps_in(result):
        if name in reasons:
            rows.append({"name": name, "reason": reasons[name]})
            continue
        source = f"{name}/installation.json"
        utc = min((p["utc_middle"] for p in passes if p["strip_id"].startswith(f"{name}/")), default="")
        page = f"{name}/report.html"
        installation = read_json(result / source)
        matrix, verdict = matrix_numbers(installation, source), verdict_view(installation, source)
        rows.append(
            {"name": name, "reason": "", "utc": utc[:10], "matrix": matrix, "page": page, "verdict": verdict}
            | {"has_page": (result / page).is_file()}
        )
    return rows


def _basis(result: Path, names: list[str]) -> SheetBasis | None:
    """What the joint matrix belongs to; None where the dumps have no report."""
    paths = [result / name / "evidence" / "context.json" for name in names]
    known = [path for path in paths if path.is_file()]
    if not known:
        return None
    contexts = {path: read_json(path) for path in known}
    first = min(known, key=lambda path: list(contexts[path]["utc"]))
    last = max(str(one["utc"][1]) for one in contexts.values())
    source = first.relative_to(result).as_posix()
    return basis_of(contexts[first], source, read_parquet(first.parent / "inputs.parquet"), last)


def _drift(result: Path) -> dict[str, Any] | None:
    """Contents of the drift section; None where the result has no drift.json."""
    if not (content := json_if_there(result / "drift.json")):
        return None
    return {
        "moved": bool(content["moved"]),
        "constant": [number_from(content, "drift.json", f"constant.{k}", ".3g") for k in CONSTANT],
        "step": number_from(content, "drift.json", "step.p_value", ".3g"),
        "between": [str(utc)[:10] for utc in content["step"]["utc_interval"]],
        **angles(content, "drift.json", "step.theta_rad", "step.covariance_rad2"),
        "picture": data_uri("image/png", (result / "drift.png").read_bytes()),
    }


@record
class Bar:
    """A bar of scale."""

    length: float = scalar("units of the sheet")
    words: str = scalar("what it is on the ground")


@record(kw_only=True)
class SmallMap:
    """The map of one dump."""

    name: str = scalar("of the dump")
    page: str = scalar("place of its own page; empty if there is none")
    map: MapView = scalar("its map; residuals are those of its own matrix")
    ground: Bar = scalar("of the map")
    residual: Bar = scalar("of the arrows")


def small_maps(result: Path, names: Sequence[str]) -> tuple[SmallMap, ...]:
    """Maps of the first `MOST_MAPS` dumps that see the ground and whose evidence is kept."""
    found = list[SmallMap]()
    for name in names:
        folder = result / name
        if len(found) == MOST_MAPS or not (folder / "evidence" / "context.json").is_file():
            continue
        saved = read_saved(folder)
        drawn = map_view(saved, target_rows(saved, 0))
        if drawn is not None:
            page = f"{name}/report.html" if (folder / "report.html").is_file() else ""
            ground, residual = round_bar(drawn.metres), round_bar(drawn.residual_metres)
            found.append(SmallMap(name=name, page=page, map=drawn, ground=ground, residual=residual))
    return tuple(found)


def round_bar(metres: float) -> Bar:
    """The longest bar of 1, 2 or 5 times a power of ten metres that is within `LONGEST_BAR` units."""
    power = 10.0 ** math.floor(math.log10(LONGEST_BAR * metres))
    length_m = max(step * power for step in (1.0, 2.0, 5.0) if step * power <= LONGEST_BAR * metres)
    words = f"{length_m / 1000:g} km" if length_m >= 1000.0 else f"{length_m:g} m"
    return Bar(round(length_m / metres, 1), words)
