"""A bias of the orbit, and of the row clock, that all strips of a calibration share.

Ground strips alone cannot tell such a bias from the installation matrix: their position errors are taken as
independent from strip to strip. Strips that scan the sky measure the matrix without any position, so beside
them the bias of the ground strips becomes observable. It is stated less true: along the velocity, to the
right of it, upwards, m; and of the instants of the rows, s.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from boresight.calib.settings import CalibrationSettings
from boresight.geometry.record import Floats, array, record

if TYPE_CHECKING:
    from boresight.calib.strips import PreparedStrip

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


def bias_columns(strip: PreparedStrip, settings: CalibrationSettings) -> Floats:
    """Change (J, 3, 4) of v_s by each of `BIASES` in units of the stated errors."""
    by_position = -settings.sigma_position_m * (strip.move_s * [1.0, 1.0, -1.0])
    return np.concatenate([by_position, -settings.sigma_clock_s * strip.late_s[:, :, None]], axis=2)


def bias_prior(names: Sequence[str]) -> Floats:
    """Prior information (n, n) of these biases, in units of the stated errors."""
    return np.diag([PRIOR_SIGMA[name] ** -2.0 for name in names])


def common_bias(values: Floats, covariance: Floats, settings: CalibrationSettings) -> CommonBias | None:
    """The biases that the data determine, from values (4,) and covariance (4, 4) of `BIASES` in units of the
    stated errors; None if there are none.
    """
    prior = np.array([PRIOR_SIGMA[name] for name in BIASES])
    rows = np.flatnonzero(np.sqrt(np.diag(covariance)) <= OBSERVABLE * prior)
    if not len(rows):
        return None
    stated = np.array([settings.sigma_position_m] * 3 + [settings.sigma_clock_s])[rows]
    return CommonBias(
        names=tuple(BIASES[n].removeprefix("bias/") for n in rows),
        value=stated * values[rows],
        covariance=covariance[np.ix_(rows, rows)] * np.outer(stated, stated),
        stated=stated,
    )
