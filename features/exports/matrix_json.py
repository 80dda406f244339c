"""The installation matrix as JSON: matrix, quaternion (scalar last), deviation and covariance, units in the
names.
"""

from __future__ import annotations

import json
from typing import Any

from boresight.features.exports.notes import Notes

__all__ = ["KEYS", "matrix_json"]

KEYS = ("R_cs", "quaternion", "theta_rad", "euler_zxy_deg", "covariance_rad2")


def matrix_json(installation: dict[str, Any], notes: Notes) -> str:
    """JSON text with the keys `KEYS` of the content of installation.json and their conventions."""
    content: dict[str, Any] = {
        "rotation": "R_cs takes star-camera vectors to the remote-sensing camera: u_c = R_cs u_s",
        "quaternion_order": "x y z w",
        "covariance_of": "theta: R_cs = exp[[theta]] R_cs0, a right-handed rotation by -theta",
    }
    content |= {"boresight": notes.items()}
    return json.dumps(content | {key: installation[key] for key in KEYS}, indent=2, allow_nan=False) + "\n"
