"""The installation matrix as CSV with the columns `name` and `value`, for spreadsheets."""

from __future__ import annotations

from typing import Any

from boresight.features.exports.notes import Notes
from boresight.pipeline.files.text_tables import csv_line

__all__ = ["matrix_csv"]

_AXES = "xyz"  # of rows and columns of R_cs


def matrix_csv(installation: dict[str, Any], notes: Notes) -> str:
    """CSV text of installation.json: rows `R_cs_xx` ... `R_cs_zz` (row, column), `q_x` ... `q_w`,
    `theta_*_rad`, `euler_*_deg`, `cov_**_rad2`; then the notes by their names.
    """
    rows = [
        (f"R_cs_{_AXES[i]}{_AXES[j]}", v) for i, r in enumerate(installation["R_cs"]) for j, v in enumerate(r)
    ]
    rows += [(f"q_{name}", value) for name, value in zip("xyzw", installation["quaternion"])]
    rows += [(f"theta_{axis}_rad", value) for axis, value in zip(_AXES, installation["theta_rad"])]
    rows += [(f"euler_{axis}_deg", value) for axis, value in zip(_AXES, installation["euler_zxy_deg"])]
    covariance = installation["covariance_rad2"]
    rows += [(f"cov_{_AXES[i]}{_AXES[j]}_rad2", covariance[i][j]) for i in range(3) for j in range(3)]
    lines = [("name", "value"), *((name, float(value)) for name, value in rows), *notes.items().items()]
    return "".join(csv_line(line) + "\n" for line in lines)
