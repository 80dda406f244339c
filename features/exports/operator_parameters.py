"""The correction of one strip in parameters that operators' software takes: angles with a rate, and a scale.

JSON, with the same correction in three forms (`calib.refining` has the model):

* `angles`: polynomials about x, y, z of frame s, as Sentinel-2's Refined_Corrections hold them;
* `piloting_to_instrument_mrad`: the angles of the corrected installation matrix at t0, intrinsic rotations
  about y, x, z, as Sentinel-2's PILOTING_TO_MSI_FRAME and similar files hold them;
* `rugged`: transforms of a line of sight in their order, for `addTransform` of Rugged's LOSBuilder;
* `quaternion`: Q at t0, scalar first: an attitude polynomial that takes frame s to other axes (DIMAP's Q0 ...
  Q3) is corrected by its product with the conjugate, `q (x) Q*`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.features.exports.refining import LineOfSightCorrection
from boresight.geometry.epoch import Epoch

__all__ = ["operator_parameters"]

# The model of the parameters, as the file states it.
MODEL = "v_s = Q(t)^-1 diag(1, 1, 1 + h) R_sc0 v_c,  Q = R_y(b) R_x(a) R_z(c);  a, b, c in rad of t - t0 in s"


def operator_parameters(
    found: LineOfSightCorrection, R_cs0: Rotation, epoch: Epoch, notes: Mapping[str, str]
) -> str:
    """Text of the file."""
    degree = len(found.angles_rad) - 1
    sigma = found.sigma[: 3 * (degree + 1)].reshape(degree + 1, 3)
    (t0_utc,) = epoch.utc_from_seconds([found.t0_s])
    Q = found.rotations(np.array([found.t0_s]))[0]
    y, x, z = (R_cs0 * Q).as_euler("YXZ")
    x0, y0, z0, w0 = Q.as_quat()
    content: dict[str, Any] = {
        "boresight": dict(notes),
        "model": MODEL,
        "t0_utc": t0_utc,
        "points": len(found.residuals_rad),
        "residual_rms_rad": float(np.sqrt((found.residuals_rad**2).sum(axis=1).mean())),
        "angles": {
            axis: {"coefficients": found.angles_rad[:, n].tolist(), "sigma": sigma[:, n].tolist()}
            for n, axis in enumerate("xyz")
        },
        "homothety_z": {"h": found.scale, "sigma": float(found.sigma[-1]) if _has_scale(found) else None},
        "piloting_to_instrument_mrad": {"R1_X": 1e3 * x, "R2_Y": 1e3 * y, "R3_Z": 1e3 * z},
        "rugged": [
            {"transform": "FixedZHomothety", "factor": 1.0 + found.scale},
            *(
                {
                    "transform": "PolynomialRotation",
                    "axis": axis,
                    "referenceDate": t0_utc,
                    "coefficients": (-found.angles_rad[:, n]).tolist(),
                }
                for n, axis in ((1, "y"), (0, "x"), (2, "z"))
            ),
        ],
        "quaternion": [float(w0), float(x0), float(y0), float(z0)],
    }
    return json.dumps(content, indent=2) + "\n"


def _has_scale(found: LineOfSightCorrection) -> bool:
    return len(found.covariance) > found.angles_rad.size
