"""A random walk of the mounting behind a series of calibrations: its density, and theta given all of them.

theta starts anywhere and then wanders by independent steps of variance q dt on each axis (q in rad²/s);
beside it may stand regressors with coefficients of their own. With L the information on all K theta together
(not block diagonal, since calibrations share unknowns) and W / q that of the steps, the axes V of

    W V = L V diag(mu),    Vᵀ L V = I

make both independent at once, for every q: the data z = Vᵀ L theta have unit variance and the walk's part
variance q / mu in them, or any size at all along the three axes of mu = 0, which are the mounting at rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.optimize import brentq, minimize_scalar
from scipy.special import chdtri

from boresight.geometry.record import array, record

__all__ = ["Course", "WalkProblem", "likely_density"]

Array = NDArray[np.float64]


@record
class Course:
    """theta at every calibration, given all of them, and what the regressors take."""

    theta: Array = array("K, 3", "without the regressors' part, rad")
    covariance: Array = array("K, 3, 3", "of each theta, rad²")
    coefficients: Array = array("M, 3", "of the regressors, rad")
    coefficients_covariance: Array = array("N, N", "N = 3 M, ordered regressor by regressor, rad²")


@record
class WalkProblem:
    """A series of K calibrations in the axes in which both they and the walk's steps are independent."""

    axes: Array = array("N, N", "V, N = 3 K")
    stiffness: Array = array("N", "mu, rad²/s; the first three are zero")
    z: Array = array("N", "data along the axes, unit variance")
    Z: Array = array("N, M", "change of z by the regressors' coefficients")

    @classmethod
    def of(cls, theta: Array, information: Array, t_s: Array, regressors: Array) -> WalkProblem:
        """theta (K, 3) rad with its information (3 K, 3 K) rad⁻² at increasing t_s (K,); regressors (K, m)
        work alike on each axis.
        """
        steps = np.diff(np.eye(len(t_s)), axis=0)
        W = np.kron(steps.T @ (steps / np.diff(t_s)[:, None]), np.eye(3))
        stiffness, axes = eigh(W, information)
        stiffness[:3] = 0.0  # to rounding they are
        lift = axes.T @ information
        return cls(axes, stiffness, lift @ theta.ravel(), lift @ np.kron(regressors, np.eye(3)))

    def loss(self, density: float) -> float:
        """-2 log likelihood of a density (rad²/s, 0 for none), levels and coefficients integrated out, but
        for a constant.
        """
        weight = self._weight(density)
        normal = self.Z.T @ (weight[:, None] * self.Z)
        best = np.linalg.solve(normal, self.Z.T @ (weight * self.z))
        residual = self.z - self.Z @ best
        size = float(weight @ residual**2 + np.log(density + self.stiffness[3:]).sum())
        return size + float(np.linalg.slogdet(normal)[1])

    def course(self, density: float) -> Course:
        """The posterior of theta and of the coefficients; neither start nor coefficients have a prior."""
        weight = self._weight(density)
        cov_best = np.linalg.inv(self.Z.T @ (weight[:, None] * self.Z))
        best = cov_best @ (self.Z.T @ (weight * self.z))
        gain = self.axes * (1.0 - weight)
        theta = gain @ (self.z - self.Z @ best)
        lift = gain @ self.Z
        K = len(theta) // 3
        own, axes, by_best = (part.reshape(K, 3, -1) for part in (gain, self.axes, lift))
        covariance = own @ np.swapaxes(axes, 1, 2) + by_best @ cov_best @ np.swapaxes(by_best, 1, 2)
        return Course(theta.reshape(K, 3), np.asarray(covariance), best.reshape(-1, 3), np.asarray(cov_best))

    def _weight(self, density: float) -> Array:
        """Share of each z that is not the walk's."""
        mu = self.stiffness
        return np.divide(mu, density + mu, out=np.zeros_like(mu), where=mu > 0.0)


def likely_density(problem: WalkProblem, confidence: float) -> tuple[float, tuple[float, float]]:
    """Most likely density (rad²/s), and the interval in which the likelihood falls by less than chi2 of one
    degree of freedom allows. 0 where no walk is as likely as any.
    """
    mu = problem.stiffness[3:]
    widest = mu[-1] * max(1.0, float(np.max(problem.z[3:] ** 2)))
    grid = np.linspace(np.log(1e-5 * mu[0]), np.log(1e2 * widest), 60)

    def loss(log_density: float) -> float:
        return problem.loss(float(np.exp(log_density)))

    losses = np.array([loss(x) for x in grid])
    at = int(np.argmin(losses))
    window = (grid[max(at - 1, 0)], grid[min(at + 1, len(grid) - 1)])
    found = minimize_scalar(loss, bounds=window, method="bounded", options={"xatol": 1e-4})
    at_rest = problem.loss(0.0)
    resting = at_rest <= found.fun + 1e-6
    limit = min(at_rest, float(found.fun)) + float(chdtri(1, 1.0 - confidence))
    centre = grid[0] if resting else float(found.x)
    below, above = grid[(grid < centre) & (losses > limit)], grid[(grid > centre) & (losses > limit)]
    low, high = 0.0, float("inf")
    if len(below) and not resting:
        low = float(np.exp(brentq(lambda x: loss(x) - limit, below[-1], centre)))
    if len(above):
        high = float(np.exp(brentq(lambda x: loss(x) - limit, centre, above[0])))
    return (0.0 if resting else float(np.exp(found.x))), (low, high)
