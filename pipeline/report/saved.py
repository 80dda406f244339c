"""Saved files of a result that a report is made from."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, get_type_hints

import pyarrow as pa

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.record_tables import plain
from boresight.pipeline.files.table_files import fixed, read_parquet
from boresight.pipeline.files.text_files import json_if_there, read_json
from boresight.pipeline.report.ground_map import SCHEMA as GROUND
from boresight.pipeline.report.page_template import UTC_FROM, Number, number_from
from boresight.pipeline.results.folder import INTERIOR
from boresight.pipeline.results.identity import identity_of_result, saved_about
from boresight.pipeline.results.reading import read_installation
from boresight.pipeline.results.sightings_tables import COLUMNS, read_sightings
from boresight.pipeline.stages.match_pictures import MatchPictures
from boresight.records.record import record, scalar

__all__ = ["EVIDENCE", "Saved", "read_saved"]

# Types of columns, and the columns of pictures of targets.
_TEXT, _WHOLE, _NUMBER = pa.string(), pa.int64(), pa.float64()
_PICTURES = {"strip_id": _TEXT, "target_id": _TEXT, "ccd": _WHOLE} | {
    name: pa.binary() if kind is bytes else _NUMBER for name, kind in get_type_hints(MatchPictures).items()
}
# Tables of evidence/, which docs/result-format.md describes.
EVIDENCE: dict[str, dict[str, pa.DataType]] = {
    "inputs": {"file": _TEXT, "bytes": _WHOLE, "sha256": _TEXT},
    "convergence": {"strip_id": _TEXT, "frames": _WHOLE, "targets": _WHOLE}
    | {"theta_rad": fixed(3), "sigma_rad": fixed(3)},
    "angles": dict.fromkeys(("strip_id", "target_id", "exposure_id"), _TEXT)
    | {"hip": _WHOLE, "z": _NUMBER, "sigma": _NUMBER},
    "matches": _PICTURES,
    "unmatched": _PICTURES,
    "ground": dict(zip(GROUND.names, GROUND.types)),
    "map": {"scene": _WHOLE, "strip_id": _TEXT, "box_m": fixed(4), "jpeg": pa.binary()},
    "allan": {"averaged_s": _NUMBER, "deviation_rad": fixed(3)},
    "attitude_noise": {"t_s": _NUMBER, "turn_rad": fixed(3)},
    "exposure": {"xy_px": fixed(2), "snr": _NUMBER, "state": _TEXT, "hip": _WHOLE},
}


@record(kw_only=True)
class Saved:
    """Files of a finished result (formats: docs/result-format.md)."""

    installation: dict[str, Any] = scalar("installation.json")
    context: dict[str, Any] = scalar("evidence/context.json")
    run: dict[str, Any] = scalar("run.json; empty where there is none")
    stars: pa.Table = scalar("sightings/stars.parquet, plotted columns")
    exposures: pa.Table = scalar("sightings/exposures.parquet, plotted columns")
    targets: pa.Table = scalar("sightings/targets.parquet")
    ledger: pa.Table = scalar("sightings/ledger.parquet")
    inputs: pa.Table = scalar("evidence/inputs.parquet")
    convergence: pa.Table = scalar("evidence/convergence.parquet")
    angles: pa.Table = scalar("evidence/angles.parquet")
    matches: pa.Table = scalar("evidence/matches.parquet")
    detections: pa.Table = scalar("evidence/exposure.parquet")
    ground: pa.Table = scalar("evidence/ground.parquet")
    unmatched: pa.Table = scalar("evidence/unmatched.parquet")
    map: pa.Table = scalar("evidence/map.parquet")
    allan: pa.Table = scalar("evidence/allan.parquet")
    attitude_noise: pa.Table = scalar("evidence/attitude_noise.parquet")
    requirement: dict[str, Any] = scalar("requirement.json; empty where there is none")
    identity: dict[str, str] = scalar("which result this is, by name")
    about: dict[str, str] = scalar("what its operator says of it; empty where nothing")
    validation: dict[str, Any] = scalar("validation.json; empty where there is none")
    interior: dict[str, Any] = scalar("interior/interior.json; empty where there is none")
    interior_png: bytes = scalar("interior/interior.png; empty where there is none")

    def number(self, key: str, form: str, *, scale: float = 1.0, root: bool = False) -> Number:
        """The number of installation.json under `key`, a path such as `covariance_rad2.0.1`."""
        return number_from(self.installation, "installation.json", key, form, scale=scale, root=root)

    def context_number(self, key: str, form: str, *, scale: float = 1.0) -> Number:
        """The number of evidence/context.json under `key`."""
        return number_from(self.context, "evidence/context.json", key, form, scale=scale)

    def cell(
        self, table: str, column: str, row: int, form: str, scale: float = 1.0, root: bool = False
    ) -> Number:
        """One cell of a table; `table` is its path without `.parquet`; of a list one element, "xy_px.0". Form
        "UTC": seconds as a time.
        """
        form = f"{UTC_FROM}{self.context['epoch_utc']}" if form == "UTC" else form
        name, _, element = column.partition(".")
        value, key = getattr(self, table.rpartition("/")[2]).column(name)[row].as_py(), f"{name}.{row}"
        value, key = (value[int(element)], f"{key}.{element}") if element else (value, key)
        exact = math.sqrt(value) if root else float(value)
        return Number(exact=exact, source=f"{table}.parquet", key=key, form=form, scale=scale, root=root)


def read_saved(result: Path) -> Saved:
    """The saved files of a finished result. `RawDataError` names a file that is missing or damaged."""
    installation = read_installation(result)
    needed = ("context.json", *(f"{name}.parquet" for name in EVIDENCE))
    if not all((result / "evidence" / name).is_file() for name in needed):
        again = "what `calibrate` writes unless --no-report is given; run it again, finished work is kept"
        raise RawDataError(str(result / "evidence"), "folder", "missing or incomplete", again)
    tables = {name: read_sightings(result, name, names) for name, names in _SIGHTINGS.items()}
    for name, columns in EVIDENCE.items():
        tables[name] = read_parquet(result / "evidence" / f"{name}.parquet", columns)
    tables["detections"] = tables.pop("exposure")
    own = {name: result / f"{name}.json" for name in ("run", "requirement", "validation")}
    own["interior"] = result / INTERIOR
    picture = own["interior"].with_suffix(".png")
    return Saved(
        installation=installation,
        context=read_json(result / "evidence" / "context.json"),
        identity=plain(identity_of_result(result)),
        about=saved_about(result),
        **{name: json_if_there(path) for name, path in own.items()},
        interior_png=picture.read_bytes() if own["interior"].is_file() and picture.is_file() else b"",
        **tables,
    )


_SIGHTINGS = {  # only the plotted columns of long tables
    "stars": "xy_px residual_s normalised kept",
    "exposures": "exposure_id t_s stars usable chi2 dof",
    "targets": " ".join(COLUMNS["targets"]),
    "ledger": " ".join(COLUMNS["ledger"]),
}
