"""Information about the installation matrix: pairs (F, F theta), their exact sum and what it says.

A pair determines the deviation theta (frame c, rad, the paper's sign: R_cs = exp[[theta]] R_cs_ref) from a
stated reference. Pairs of independent frames or strips about one reference add. The sum is exact and rounded
once, so it is the same, bit for bit, in whatever order it is made. Unknowns that several strips
share (a camera's distortion) stand after theta in the pair, each by its name; they get their prior, and are
eliminated, after the sum. Of C cameras theta is three components each, camera after camera, about C matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotri
from scipy.spatial.transform import Rotation

from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.records.record import array, record, scalar

__all__ = ["InformationPairs", "Iteration", "Solution", "corrected", "exact_sum", "solve_total", "theta_of"]

Array = NDArray[np.float64]


@record
class InformationPairs:
    """Pairs of K frames or strips about one reference; N = 3 C + unknowns shared between strips."""

    names: NDArray[np.str_] = array("K", "frame or strip ids")
    F: Array = array("K, N, N", "information; block of theta in rad⁻²")
    F_theta: Array = array("K, N", "F times the best (theta, shared unknowns)")
    R_cs_ref: Rotation = scalar("reference: theta is the deviation from it; (C,) of several cameras")
    shared: tuple[str, ...] = scalar("names of the unknowns after theta, in order", default=())
    cameras: tuple[str, ...] = scalar("of C matrices; a single one has no name", default=("",))

    def __post_init__(self) -> None:
        if self.F.shape[1] != (n := self.n_theta + len(self.shared)):
            raise ValueError(f"{len(self.shared)} shared unknowns need F of {n} rows, got {self.F.shape[1]}")

    @property
    def n_theta(self) -> int:
        """Components of theta."""
        return 3 * len(self.cameras)

    @property
    def unknowns(self) -> list[str]:
        """Names (N,) of all unknowns."""
        theta = [f"camera/{name}/{axis}" if name else axis for name in self.cameras for axis in "xyz"]
        return [*theta, *self.shared]

    def of_camera(self, name: str) -> InformationPairs:
        """The pairs about the matrix of one of several cameras; theta of the others, without a prior, are the
        first shared unknowns. `ValueError` for another name."""
        if self.cameras == (name,):
            return self
        first = 3 * self.cameras.index(name)
        unknowns, own = self.unknowns, slice(first, first + 3)
        every = np.arange(len(unknowns))
        order = np.concatenate([every[own], np.delete(every, own)])
        return InformationPairs(
            self.names,
            self.F[:, order[:, None], order],
            self.F_theta[:, order],
            self.R_cs_ref[first // 3],
            tuple(unknowns[n] for n in order[3:]),
        )

    def merged(self, other: InformationPairs) -> InformationPairs:
        """Both sets together, about this one's reference. `ValueError` for a name in both, other cameras."""
        if self.cameras != other.cameras:
            raise ValueError(f"pairs of the cameras {self.cameras} and of {other.cameras} do not add")
        if twice := sorted(set(self.names.tolist()) & set(other.names.tolist())):
            raise ValueError(f"{len(twice)} names are in both sets of pairs, first {twice[0]!r}")
        shared = tuple(sorted(set(self.shared) | set(other.shared)))
        return self.widened(shared).with_prior(other)

    def with_prior(self, prior: InformationPairs) -> InformationPairs:
        """The pairs and those of `prior`, which holds no other shared unknowns."""
        both = self, prior.about(self.R_cs_ref).widened(self.shared)
        columns = ("names", "F", "F_theta")
        return replace(self, **{n: np.concatenate([getattr(one, n) for one in both]) for n in columns})

    def about(self, R_cs_ref: Rotation) -> InformationPairs:
        """The information about another reference, to first order in its distance from this one."""
        # The last bit may be lost each time a quaternion is normalised.
        if np.allclose(self.R_cs_ref.as_quat(), R_cs_ref.as_quat(), rtol=0.0, atol=5e-16):
            return self
        shift = np.zeros(self.F.shape[-1])
        shift[: self.n_theta] = theta_of(self.R_cs_ref, R_cs_ref)
        return replace(self, F_theta=self.F_theta + self.F @ shift, R_cs_ref=R_cs_ref)

    def widened(self, shared: tuple[str, ...]) -> InformationPairs:
        """The pairs extended to the unknowns `shared`: zeros for those that they do not contain."""
        t = self.n_theta
        place = np.array([*range(t), *(t + shared.index(name) for name in self.shared)], dtype=np.int64)
        n = t + len(shared)
        F, F_theta = np.zeros((len(self.names), n, n)), np.zeros((len(self.names), n))
        F[:, place[:, None], place] = self.F
        F_theta[:, place] = self.F_theta
        return replace(self, F=F, F_theta=F_theta, shared=shared)

    def total(self) -> tuple[Array, Array]:
        """The exact sums (N, N) and (N,) of F and F_theta over all pairs."""
        return exact_sum(self.F, self.F_theta)

    def as_one(self, name: str, eliminated: tuple[str, ...], prior: Array) -> InformationPairs:
        """All pairs as a single one, added exactly. The shared unknowns `eliminated`, with the prior
        information `prior` (m, m), are marginalised; theta and the others stay.
        """
        F, right = self.total()
        out = self.n_theta + np.array([self.shared.index(unknown) for unknown in eliminated], dtype=np.int64)
        stay = np.setdiff1d(np.arange(len(F)), out)
        gain = np.linalg.solve(F[np.ix_(out, out)] + prior, F[np.ix_(out, stay)])
        left = F[np.ix_(stay, stay)] - F[np.ix_(stay, out)] @ gain
        shared = tuple(unknown for unknown in self.shared if unknown not in eliminated)
        return InformationPairs(
            np.array([name]),
            0.5 * (left + left.T)[None],
            (right[stay] - gain.T @ right[out])[None],
            self.R_cs_ref,
            shared,
            self.cameras,
        )

    def numbers(self) -> tuple[list[str], Array]:
        """Names (N,) of the unknowns, and numbers (K, M) of a table: upper triangle of F row by row, F_theta,
        references (scalar last). Components of theta are x, y, z, of one of several cameras camera/NAME/x.
        """
        rows, columns = np.triu_indices(len(self.unknowns))
        references = np.tile(self.R_cs_ref.as_quat().ravel(), (len(self.names), 1))
        return self.unknowns, np.hstack([self.F[:, rows, columns], self.F_theta, references])

    @classmethod
    def from_numbers(cls, pairs: NDArray[Any], unknowns: list[str], numbers: Array) -> InformationPairs:
        """Pairs of the names `pairs` (K,) from what `numbers` gives; `ValueError` if they have several
        references, or other numbers than those of the unknowns.
        """
        named = [name.split("/")[1] for name in unknowns if name.startswith("camera/")]
        cameras = tuple(dict.fromkeys(named)) or ("",)
        n = len(unknowns)
        rows, columns = np.triu_indices(n)
        of_F, F_theta, quaternions = np.split(numbers, [len(rows), len(rows) + n], axis=1)
        if np.any(quaternions != quaternions[0]):
            raise ValueError("the pairs of one table must share one reference")
        F = np.empty((len(numbers), n, n))
        F[:, rows, columns] = F[:, columns, rows] = of_F
        R_cs_ref = Rotation.from_quat(quaternions[0].reshape((len(cameras), 4) if len(cameras) > 1 else 4))
        return cls(pairs.astype(str), F, F_theta, R_cs_ref, tuple(unknowns[3 * len(cameras) :]), cameras)


def exact_sum(F: Array, F_theta: Array) -> tuple[Array, Array]:
    """The sums over the first axis of `F` (K, n, n), symmetric, and `F_theta` (K, n), exact before they are
    rounded: the same, bit for bit, in whatever order the pairs come. `ValueError` for a number not finite."""
    n = F_theta.shape[1]
    if not (np.isfinite(F).all() and np.isfinite(F_theta).all()):
        raise ValueError("information that is not a finite number cannot be added")
    rows, columns = np.triu_indices(n)
    sums, total = _rounded_once(np.concatenate([F[:, rows, columns], F_theta], axis=1)), np.empty((n, n))
    total[rows, columns] = total[columns, rows] = sums[:-n]
    return total, sums[-n:]


def _rounded_once(numbers: Array) -> Array:
    """Sums (M,) over the first axis of `numbers` (K, M), as `math.fsum` gives them; by it where the errors of
    the additions, added up in doubles themselves, do not tell which way a sum is rounded.
    """
    high, low, rest = np.zeros((3, numbers.shape[1]))
    with np.errstate(over="ignore", invalid="ignore"):
        for row in numbers:
            high, error = _two_sum(high, row)
            low, error = _two_sum(low, error)
            rest += np.abs(error)
        unsure = np.where(rest == 0.0, 0.0, 2.0 * rest + 4.0 * np.finfo(float).eps * np.abs(low))
        sums = high + (low - unsure)
        left = np.flatnonzero(~(sums == high + (low + unsure)))
    sums[left] = [math.fsum(column) for column in numbers[:, left].T.tolist()]
    return np.asarray(sums + 0.0)  # no negative zero


def _two_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """Sums (M,) and the errors of their rounding (Knuth)."""
    total = a + b
    back = total - a
    return total, (a - (total - back)) + (b - back)


@record
class Iteration:
    """One Gauss-Newton step."""

    theta_step: Array = array("T", "rad, frame c; of several cameras camera after camera, as all of theta")
    sigma: Array = array("T", "1-sigma predicted at this step, rad, frame c")
    chi2: float = scalar("weighted sum of squares after the step, priors included")
    targets: float = scalar("sum of the targets' weights")


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """The best theta of a total, and the directions that are not observable."""

    theta: Array  # (3 C,) about the reference, rad; zero along unobservable directions
    covariance: Array  # (3 C, 3 C) of theta, frame c, rad²; zero along unobservable directions
    information: Array  # (3 C, 3 C) shared unknowns eliminated, rad⁻²
    shared: Array  # (N,) best shared unknowns
    shared_information: Array  # (N, N) of these, theta given
    gain: Array  # (N, 3 C) change of the best shared unknowns by -theta
    unobservable: Array  # (M, 3 C) unit vectors, frame c: rotation about them is not observable

    @cached_property
    def covariance_all(self) -> Array:
        """Covariance (3 C + N, 3 C + N) of theta and the shared unknowns."""
        t = len(self.theta)
        lift = np.vstack([np.eye(t), -self.gain])
        covariance = lift @ self.covariance @ lift.T
        covariance[t:, t:] += _inverse(self.shared_information)
        return np.asarray(covariance)


def solve_total(
    F: Array, F_theta: Array, prior_shared: Array | None = None, *, sigma_observable_rad: float
) -> Solution:
    """Best theta (t,) of the summed pair (n, n), (n,); `prior_shared` (n - t, n - t) is the shared unknowns'
    information.

    A direction (eigenvector of the information on theta) whose 1-sigma would exceed `sigma_observable_rad`,
    or whose eigenvalue is below the rounding error of the largest, is reported as unobservable.
    """
    prior = np.zeros((0, 0)) if prior_shared is None else prior_shared
    t = len(F) - len(prior)
    shared_F = F[t:, t:] + prior
    solved = np.linalg.solve(shared_F, np.column_stack([F[t:, :t], F_theta[t:]]))
    gain, shared_0 = np.asarray(solved[:, :-1]), solved[:, -1]
    information = F[:t, :t] - F[:t, t:] @ gain
    information = 0.5 * (information + information.T)
    right = F_theta[:t] - gain.T @ F_theta[t:]
    values, vectors = np.linalg.eigh(information)
    seen = (values > sigma_observable_rad**-2.0) & (values > 1e-13 * values[-1])
    inverse = np.divide(1.0, values, out=np.zeros(t), where=seen)
    covariance = (vectors * inverse) @ vectors.T
    theta = vectors @ (inverse * (vectors.T @ right))
    return Solution(
        theta=theta,
        covariance=covariance,
        information=information,
        shared=shared_0 - gain @ theta,
        shared_information=shared_F,
        gain=gain,
        unobservable=vectors.T[~seen],
    )


def _inverse(information: Array) -> Array:
    """The inverse (N, N) of an information matrix: half the work of that of any matrix, which is computed
    where rounding leaves it not positive.
    """
    factor, not_positive = dpotrf(information, lower=1) if len(information) else (information, 1)
    if not_positive:
        return np.asarray(np.linalg.inv(information), dtype=np.float64)
    half = np.tril(dpotri(factor, lower=1)[0])
    return np.asarray(half + np.tril(half, -1).T)


def theta_of(R_cs: Rotation, R_cs0: Rotation) -> Array:
    """Deviation theta (3 C,) of the matrices of C cameras from others."""
    return theta_between(R_cs, R_cs0).ravel()


def corrected(R_cs: Rotation, theta: Array) -> Rotation:
    """The matrices of C cameras that deviate by theta (3 C,) from `R_cs`."""
    return deviation_from_theta(theta if R_cs.single else theta.reshape(-1, 3)) * R_cs
