"""A bias of the orbit, and of the row clock, that all strips of a calibration share.

Ground strips alone cannot tell such a bias from the installation matrix: their position errors are taken as
independent from strip to strip. Strips that scan the sky measure the matrix without any position, so beside
them the bias of the ground strips becomes observable. It is stated less true: along the velocity, to the
right of it, upwards, m; and of the instants of the rows, s.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.information import Solution
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.record import Floats, array, record

__all__ = ["BIASES", "CommonBias", "bias_columns", "bias_prior", "common_bias"]

# Names of the biases common to all strips: of the orbit along the track, across it and radially (m), and of
# the row clock (s).
BIASES = ("bias/along", "bias/across", "bias/radial", "bias/clock")
# In units of the stated errors of one strip: wide for the orbit, which the sky has no part in. The scan of
# the sky itself depends on the clock: a wide prior would spoil a matrix that the sky alone determines.
PRIOR_SIGMA = {"bias/along": 10.0, "bias/across": 10.0, "bias/radial": 10.0, "bias/clock": 1.0}
OBSERVABLE = 0.25  # of its prior, the largest 1-sigma with which a bias counts as measured


@record(kw_only=True)
class CommonBias:
    """Biases that all strips share, stated less true, as far as the data determine them."""

    names: tuple[str, ...] = array(
        "N", "along, across (to the right), radial (upwards): m; clock (of the rows): s"
    )
    value: Floats = array("N", "stated less true")
    covariance: Floats = array("N, N", "of `value`")
    stated: Floats = array("N", "1-sigma stated for one strip")

    @property
    def sigma(self) -> Floats:
        """1-sigma (N,) of `value`."""
        return np.sqrt(np.diag(self.covariance))

    def texts(self) -> list[str]:
        """Each bias with its 1-sigma as text, the clock in milliseconds."""
        unit = [("ms", 1e3) if name == "clock" else ("m", 1.0) for name in self.names]
        rows = zip(self.names, self.value, self.sigma, unit)
        return [f"{name} {scale * b:+.3g} ± {scale * s:.2g} {of}" for name, b, s, (of, scale) in rows]


def bias_columns(move_s: Floats, R_oi: Rotation, clock: Floats, sigma_m: float) -> Floats:
    """Change (J, 3, 4) of targets' directions, frame s, by each of `BIASES` in units of the stated errors.

    `move_s` (J, 3, 3) is their change by the satellite's true position, GCRS axes, 1/m, `clock` (J, 3) that
    by the rows' true instant in units of its stated error, `R_oi` the orbital frame of each target.
    """
    along, right, down = np.moveaxis(R_oi.inv().as_matrix(), 2, 0)
    by_position = -sigma_m * (move_s @ np.stack([along, right, -down], axis=2))
    return np.concatenate([by_position, -clock[:, :, None]], axis=2)


def bias_prior(names: Sequence[str]) -> Floats:
    """Prior information (n, n) of these biases, in units of the stated errors."""
    return np.diag([PRIOR_SIGMA[name] ** -2.0 for name in names])


def common_bias(names: Sequence[str], solution: Solution, settings: CalibrationSettings) -> CommonBias | None:
    """The biases among the shared unknowns `names` that the data determine; None if there are none."""
    unit = np.array([settings.sigma_position_m] * 3 + [settings.sigma_clock_s])
    n_theta = len(solution.theta)
    sigma = np.sqrt(np.diag(solution.covariance_all))[n_theta:]
    rows = [
        n for n, name in enumerate(names) if name in BIASES and sigma[n] <= OBSERVABLE * PRIOR_SIGMA[name]
    ]
    if not rows:
        return None
    stated = unit[[BIASES.index(names[n]) for n in rows]]
    columns = n_theta + np.array(rows)
    return CommonBias(
        names=tuple(names[n].removeprefix("bias/") for n in rows),
        value=stated * solution.shared[rows],
        covariance=solution.covariance_all[np.ix_(columns, columns)] * np.outer(stated, stated),
        stated=stated,
    )
