"""Columns of the tables in a result's folder `sightings`: written and read by this one declaration."""

from __future__ import annotations

import json
from pathlib import Path
from types import MappingProxyType

import pyarrow as pa

from boresight.calib.information import InformationPairs
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.table_files import arrow_array, fixed, fixed_list, read_parquet

__all__ = ["COLUMNS", "pairs_table", "read_sightings", "sightings_schema"]

# Types of columns.
_TEXT, _WHOLE, _NUMBER, _FLAG = pa.string(), pa.int64(), pa.float64(), pa.bool_()
COLUMNS = MappingProxyType(
    {
        "stars": {"exposure_id": _TEXT, "t_s": _NUMBER, "hip": _WHOLE, "xy_px": fixed(2), "u_s": fixed(3)}
        | {"u_i": fixed(3), "cov_s": fixed(9), "snr": _NUMBER, "residual_s": fixed(3)}
        | {"normalised": _NUMBER, "kept": _FLAG},
        "exposures": {"exposure_id": _TEXT, "t_s": _NUMBER, "stars": _WHOLE, "R_si": fixed(9)}
        | {"covariance_s": fixed(9), "usable": _FLAG, "chi2": _NUMBER, "dof": _WHOLE},
        "targets": {"strip_id": _TEXT, "target_id": _TEXT, "ccd": _WHOLE, "t_s": _NUMBER, "xy_px": fixed(2)}
        | {"cov_px": fixed(4), "predicted_px": fixed(2), "correlation": _NUMBER, "probability_wrong": _NUMBER}
        | {"u_c": fixed(3), "u_i": fixed(3), "cov_c": fixed(9), "range_m": _NUMBER, "v_rel_i": fixed(3)}
        | {"cov_target_i": fixed(9), "residual_c": fixed(2), "normalised": _NUMBER, "kept": _FLAG}
        | {"weight": _NUMBER, "detectable_rad": _NUMBER, "detectable_m": _NUMBER},
        "passes": {"strip_id": _TEXT, "utc_middle": _TEXT, "argument_of_latitude_rad": _NUMBER}
        | {"camera": _TEXT, "beta_rad": _NUMBER, "begin_deg": fixed(2), "end_deg": fixed(2)},
        "ledger": dict.fromkeys(("kind", "name", "file", "reason", "cause", "state", "strip"), _TEXT)
        | {"ccd": _WHOLE, "id": _TEXT, "exposure": _TEXT, "head": _TEXT, "camera": _TEXT, "dump": _TEXT}
        | {"statistic": _NUMBER, "limit": _NUMBER},
    }
)  # docs/result-format.md says what each means; `passes` has lists "taken_up" beside, of 21 a head


def sightings_schema(table: str) -> pa.Schema:
    """Names and types of the columns of `table`."""
    return pa.schema(list(COLUMNS[table].items()))


def pairs_table(pairs: InformationPairs) -> pa.Table:
    """One row a pass: its name, and all numbers of its pair in one list; the unknowns' names, in whose order
    they stand, are in the metadata. A column for each number takes ten times as long to read.
    """
    unknowns, numbers = pairs.numbers()
    table = pa.table({"name": arrow_array(pairs.names), "values": fixed_list(numbers)})
    return table.replace_schema_metadata({"unknowns": json.dumps(unknowns)})


def read_sightings(result: Path, table: str, names: str) -> pa.Table:
    """Columns of a table of a result, names separated by spaces; `RawDataError` where it is damaged."""
    path = result / "sightings" / f"{table}.parquet"
    if table == "ledger" and not path.is_file() and path.with_name("omissions.parquet").is_file():
        again = "a result of format 2: `calibrate` into this folder writes it, finished work is kept"
        raise RawDataError(str(path), "file", "a result of format 1 (sightings/omissions.parquet)", again)
    return read_parquet(path, {name: COLUMNS[table][name] for name in names.split()})
