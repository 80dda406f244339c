"""CE90 and LE90: of the residuals on the ground, and predicted for an image point of a new strip.

CE90 is the radius of the circle around zero that holds 90 % of the horizontal errors, LE90 the half width
that holds 90 % of the errors along one axis (here along and across the track; one strip measures no height).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

from boresight.pipeline.files.table_files import column
from boresight.records.record import Floats, Texts

__all__ = ["accuracy_by_strip", "accuracy_rows", "predicted_accuracy", "radius_90"]

# Share of errors within CE90 and LE90, the circular and linear errors of 90 %.
SHARE = 0.9
NODES = 720  # of the quadrature of a plane normal distribution: exact to 1e-5


def accuracy_by_strip(ground: pa.Table, used: str) -> list[dict[str, Any]]:
    """For all strips together (id empty) and for each: number of targets used, rms, CE90 and LE90 of their
    residuals along and across the track, m.
    """
    rows = np.array([state == used for state in ground.column("state").to_pylist()], dtype=bool)
    track_m = np.column_stack([column(ground, f"residual_{axis}_m") for axis in ("along", "across")])
    rows &= np.isfinite(track_m).all(axis=1)
    strips = column(ground, "strip_id")
    return accuracy_rows(strips[rows], track_m[rows])


def accuracy_rows(strip_id: Texts, track_m: Floats) -> list[dict[str, Any]]:
    """Number, rms, CE90 and LE90 of errors (N, 2) along and across the track, m: of all (id empty), and of
    each strip of `strip_id` (N,).
    """
    names = list(dict.fromkeys(strip_id.tolist()))
    return [_empirical("", track_m)] + [_empirical(n, track_m[strip_id == n]) for n in names]


def _empirical(strip_id: str, track_m: Floats) -> dict[str, Any]:
    n = len(track_m)
    track_m = track_m if n else np.full((1, 2), np.nan)
    return {
        "strip_id": strip_id,
        "n": n,
        "rms_m": np.sqrt(np.mean(track_m**2, axis=0)).tolist(),
        "ce90_m": float(np.quantile(np.linalg.norm(track_m, axis=1), SHARE)),
        "le90_m": np.quantile(np.abs(track_m), SHARE, axis=0).tolist(),
    }


def predicted_accuracy(
    covariance_rad2: Floats, range_m: float, tangents: Floats, sigma_position_m: float, sigma_along_m: float
) -> dict[str, Any]:
    """Predicted `sigma_m` and `le90_m` along and across the track, and `ce90_m`, of a pixel's place on flat
    ground in a strip that was not used for the calibration, at the worst of the camera's look directions
    x/z, y/z, `tangents` (N, 2).

    The covariance (3, 3) of the installation matrix is about the axes of c, `range_m` the distance to the
    ground along the camera's axis; stated are the orbit's error per axis, `sigma_position_m`, and the clock's
    times the speed over the ground, `sigma_along_m`.
    """
    worst, covariance = -1.0, np.zeros((2, 2))
    for x, y in np.asarray(tangents, dtype=float):
        J = range_m * np.array([[-x * y, 1.0 + x * x, -y], [-1.0 - y * y, x * y, x]])  # d place / d rotation
        own = np.diag([sigma_position_m**2 + sigma_along_m**2, sigma_position_m**2])
        here = J @ covariance_rad2 @ J.T + own
        if np.trace(here) > worst:
            worst, covariance = float(np.trace(here)), here
    sigma = np.sqrt(np.diag(covariance))
    le90 = ndtri(0.5 + 0.5 * SHARE) * sigma
    return {"sigma_m": sigma.tolist(), "le90_m": le90.tolist(), "ce90_m": radius_90(covariance)}


def radius_90(covariance: Floats) -> float:
    """Radius of the circle about the mean that holds 90 % of a plane normal distribution, whose covariance is
    (2, 2); in its unit.
    """
    b, a = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance), 0.0))
    if a == 0.0:
        return 0.0
    t = (np.arange(NODES) + 0.5) * (np.pi / NODES) - 0.5 * np.pi  # the longer axis runs over a sin t

    def missing(radius: float) -> float:
        in_chord = 2.0 * ndtr(radius * np.cos(t) / max(b, 1e-9 * a)) - 1.0
        normal = np.exp(-0.5 * (radius / a * np.sin(t)) ** 2) / np.sqrt(2.0 * np.pi)
        density = normal * radius / a * np.cos(t)
        return float(np.sum(in_chord * density) * np.pi / NODES) - SHARE

    return float(brentq(missing, 0.0, 10.0 * a))
