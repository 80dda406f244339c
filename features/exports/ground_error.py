"""The 1-sigma error on the ground of an image whose camera and attitude are a result's, each horizontal axis.

Of the covariance C (N, N) of the errors of N pixels over the image, along and across the track, the bias is
the error of their mean, which all pixels share, and the rest is random:

    bias² = 1ᵀ C 1 / N²,    random² = trace C / N - bias²,    each the mean over both directions
"""

from __future__ import annotations

import numpy as np

from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.results.place_errors import PassErrors, covariance_of_places
from boresight.pipeline.results.strip_model import Calibrated, StripModel
from boresight.records.record import record, scalar

__all__ = ["GroundError", "ground_error"]

GRID = (7, 5)  # lines and samples of the pixels


@record
class GroundError:
    """Errors of an image on the ground, 1 sigma for each horizontal axis."""

    bias_m: float = scalar("that all pixels share")
    random_m: float = scalar("of each pixel beside it")


def ground_error(
    calibrated: Calibrated, model: StripModel, ccd: int, lines: int, height_m: float, misfit_px: float = 0.0
) -> GroundError:
    """The error of the image of a CCD at an ellipsoidal height, by the result's covariance and by the errors
    that the dump states; `misfit_px`: rms by which the image's model misses the rigorous one.
    """
    dump, result, push = calibrated.dump, calibrated.result, model.pushbroom
    axes = [np.linspace(0.0, n - 1.0, count) for n, count in zip((lines, push.camera.n_px(ccd)), GRID)]
    line, sample = (grid.ravel() for grid in np.meshgrid(*axes, indexing="ij"))
    t_s = push.instants_of_lines(ccd, line)
    p_e = push.ground_points(ccd, sample, line, ConstantHeight(height_m))
    seen = np.isfinite(p_e).all(axis=1) & (t_s >= model.track.span_s[0]) & (t_s <= model.track.span_s[1])
    t_s, p_e = t_s[seen], p_e[seen]
    errors = PassErrors.of(result, dump, model.strip, model.track, calibrated.sigma_terrain_m).at(t_s, p_e)
    covariance = covariance_of_places([errors], result, dump)
    bias2 = float(covariance.mean())
    total2 = float(np.einsum("dnn->dn", covariance).mean())
    range_m = float(np.linalg.norm(p_e - dump.orbit.positions_e(t_s), axis=1).mean())
    misfit_m = misfit_px * range_m * dump.line_camera.pixel_rad / np.sqrt(2.0)
    return GroundError(bias2**0.5, float(np.sqrt(max(total2 - bias2, 0.0) + misfit_m**2)))
