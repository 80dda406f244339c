"""The correction of a camera in its operator's own parameters: angles with a rate, and a scale along z.

A line of sight v_c of frame c is corrected on the side of frame s, as the operators of Sentinel-2 do and the
library Rugged does:

    v_s = Q(t)^-1 diag(1, 1, 1 + h) R_sc0 v_c,    Q = R_y(b) R_x(a) R_z(c),

with a, b, c polynomials in t - t0 (rad, s). R_cs0 is the operator's matrix before the correction. For a
constant Q and no scale the corrected matrix is R_cs0 Q. The file is JSON, with one correction in three forms:

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

from boresight.geometry.attitude_estimate import cross_matrices
from boresight.geometry.epoch import Epoch
from boresight.geometry.sightings import sigma_of
from boresight.records.record import Floats, array, inner, record, scalar

__all__ = ["LineOfSightCorrection", "fit_correction", "operator_parameters"]


@record(kw_only=True)
class LineOfSightCorrection:
    """Angles, scale and their covariance. Parameters: a, b, c of each power of time in turn, then h."""

    t0_s: float = scalar("origin of the polynomials, TAI seconds since the epoch")
    angles_rad: Floats = array("D, 3", "coefficients of a, b, c about x, y, z of frame s; lowest power first")
    scale: float = scalar("h; 0 where it was not estimated")
    covariance: Floats = array("P, P", "of the parameters, in their units; scaled by the residuals")
    residuals_rad: Floats = array("J, 3", "known minus corrected directions, frame s")
    sigma = inner[Floats]("covariance", "1-sigma (P,) of the parameters", of=sigma_of)

    def rotations(self, t_s: Floats) -> Rotation:
        """Q (N,) at instants (N,)."""
        return _rotations(self.angles_rad, t_s - self.t0_s)


def fit_correction(
    v_s: Floats,
    u_c: Floats,
    t_s: Floats,
    R_cs0: Rotation,
    t0_s: float,
    *,
    degree: int = 1,
    with_scale: bool = True,
) -> LineOfSightCorrection:
    """Least-squares correction from J lines of sight with errors of equal size across the line.

    `v_s` (J, 3) are the known directions of the points, frame s, by the attitude of the star side; `u_c`
    (J, 3) the measured look directions, frame c; `t_s` (J,) their instants, TAI seconds since the epoch.
    `R_cs0` is the matrix before the correction, `t0_s` the origin of the polynomials, `degree` 0 means
    constant angles. The covariance has the variance of the residuals.

    Raises `ValueError` for fewer than P/2 + 1 points, or points that do not determine the parameters.
    """
    powers = (t_s - t0_s)[:, None] ** np.arange(degree + 1)
    n = 3 * (degree + 1) + int(with_scale)
    if 2 * len(v_s) < n + 2:
        raise ValueError(f"{n} parameters need {n // 2 + 1} points or more, got {len(v_s)}")
    w0 = R_cs0.inv().apply(u_c)
    angles, h = np.zeros((degree + 1, 3)), 0.0
    for _ in range(5):  # Gauss-Newton
        w = _corrected(w0, angles, h, t_s - t0_s)
        residuals = v_s - w
        tangent = np.eye(3) - w[:, :, None] * w[:, None, :]
        turn = cross_matrices(w)  # d w = -phi x w = w x phi
        columns = [turn * powers[:, k, None, None] for k in range(degree + 1)]
        if with_scale:
            columns.append((w[:, 2, None] * np.array([0.0, 0.0, 1.0]))[:, :, None])
        A = (tangent @ np.concatenate(columns, axis=2)).reshape(-1, n)
        size = np.linalg.norm(A, axis=0)
        if np.any(size == 0.0) or np.linalg.cond(A / size) > 1e8:
            raise ValueError("the points do not determine the parameters: take fewer, or more points")
        step, *_ = np.linalg.lstsq(A / size, residuals.ravel(), rcond=None)
        step /= size
        angles = angles + step[: 3 * (degree + 1)].reshape(-1, 3)
        h += float(step[-1]) if with_scale else 0.0
    residuals = v_s - _corrected(w0, angles, h, t_s - t0_s)
    variance = (residuals**2).sum() / (2 * len(v_s) - n)
    covariance = variance * np.linalg.inv((A / size).T @ (A / size)) / np.outer(size, size)
    return LineOfSightCorrection(
        t0_s=t0_s, angles_rad=angles, scale=h, covariance=covariance, residuals_rad=residuals
    )


def _corrected(w0: Floats, angles: Floats, h: float, t_s: Floats) -> Floats:
    scaled = w0 * np.array([1.0, 1.0, 1.0 + h])
    v = _rotations(angles, t_s).inv().apply(scaled)
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def _rotations(angles: Floats, t_s: Floats) -> Rotation:
    a, b, c = np.polynomial.polynomial.polyval(t_s, angles)
    return Rotation.from_euler("YXZ", np.column_stack([b, a, c]))


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
    has_scale = len(found.covariance) > found.angles_rad.size
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
        "homothety_z": {"h": found.scale, "sigma": float(found.sigma[-1]) if has_scale else None},
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
