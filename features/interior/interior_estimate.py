"""The interior orientation estimated together with the installation matrix, from the sky, the ground or both.

The parameters (`interior_parameters`) are shared unknowns of the calibration, eliminated and solved with the
others. They take the place of the curve that otherwise stands for the residual distortion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate, NotObservable
from boresight.calib.settings import CalibrationSettings
from boresight.calib.strips import prepare_strip
from boresight.features.interior.interior_parameters import Gauge, InteriorModel, InteriorPriors
from boresight.geometry.line_camera import LineCamera
from boresight.geometry.sightings import StripSightings
from boresight.records.record import Floats, Ints, array, inner, record, scalar

__all__ = ["InteriorEstimate", "calibrate_interior"]

# Difference of row rates, share of the largest: strips less different do not tell a delay from a shift (set
# by hand).
RATES_APART = 0.2


@record(kw_only=True)
class InteriorEstimate:
    """The interior orientation with covariance, beside the installation matrix it was estimated with."""

    installation: InstallationEstimate = scalar("with the parameters estimated")
    model: InteriorModel = scalar("parameters, priors and gauge")
    values: Floats = array("P", "of the parameters: change of the assumed camera")
    covariance: Floats = array("P, P", "of `values`")
    camera: LineCamera = scalar("assumed camera with the parameters applied")
    gauges = inner[tuple[Gauge, ...]]("model.gauges", "what is zero by constraint")

    def map_sigma_px(self, ccd: Ints, sample: Floats) -> Floats:
        """1-sigma (J, 2) of the look directions of samples (J,) along x and y of frame c, px."""
        change = self.model.look_change(ccd, sample)[:, :2] / self.camera.pixel_rad
        return np.asarray(
            np.sqrt(np.einsum("jap,pq,jaq->ja", change, self.covariance, change, optimize=True))
        )

    def map_change_px(self, ccd: Ints, sample: Floats) -> Floats:
        """Change (J, 2) of the look directions of samples (J,) along x and y of frame c, px."""
        change = self.model.look_change(ccd, sample)[:, :2] @ self.values
        return np.asarray(change / self.camera.pixel_rad)


def calibrate_interior(
    strips: Sequence[StripSightings],
    R_cs0: Rotation,
    camera: LineCamera,
    settings: CalibrationSettings,
    priors: InteriorPriors | None = None,
) -> InteriorEstimate | NotObservable:
    """Interior orientation and installation matrix from strips of the ground, of the sky or both, whose look
    directions `u_c` were made from their samples by `camera`; or why the matrix cannot be estimated.

    `R_cs0` is the matrix to start from; of `settings`, the priors of the residual distortion are not used.
    """
    model = InteriorModel.of(
        camera, priors or InteriorPriors(), stagger=_rates_differ(strips, R_cs0, settings)
    )
    plain = replace(settings, sigma_distortion_rad=0.0, ccd_px=(), of_cameras=())
    found = calibrate_strips(strips, R_cs0, plain, further=[model.row])
    if isinstance(found, NotObservable):
        return found
    columns = [n for n, name in enumerate(found.pairs.shared) if name.startswith("interior/")]
    z, covariance = found.shared_values[columns], found.shared_covariance[np.ix_(columns, columns)]
    values = model.basis @ z
    return InteriorEstimate(
        installation=found,
        model=model,
        values=values,
        covariance=model.basis @ covariance @ model.basis.T,
        camera=model.corrected(values),
    )


def _rates_differ(strips: Sequence[StripSightings], R_cs: Rotation, settings: CalibrationSettings) -> bool:
    """Whether the images of some strips move at another rate along x of frame c than those of others."""
    rates = [
        float(np.mean(prepare_strip(strip, settings).late_s @ R_cs.as_matrix()[0]))
        for strip in strips
        if len(strip.ground.t_s)
    ]
    return bool(rates and max(rates) - min(rates) > RATES_APART * max(map(abs, rates)))
