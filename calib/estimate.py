"""Results of a calibration: the installation matrix with its covariance, or the undetermined rotations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from boresight.calib.error_table import CommonBias
from boresight.calib.ground_references import ReferenceOffset
from boresight.calib.heads import HeadAgreement, PeriodicError
from boresight.calib.information import InformationPairs, Iteration
from boresight.calib.joint_solution import Posed
from boresight.geometry.installation import theta_between
from boresight.geometry.sightings import sigma_of
from boresight.records.ledger import Entry, Kind, Subject
from boresight.records.record import Bools, Floats, Ints, Texts, array, inner, record, scalar

__all__ = [
    "CameraRotation",
    "HeadInstallation",
    "InstallationEstimate",
    "NotObservable",
    "RejectionTest",
    "TargetResiduals",
]

PROBABILITY_MOVED = 1e-3  # that a rotation which is as stated is said not to be


@record(kw_only=True)
class TargetResiduals:
    """Residuals of all targets, all unknowns estimated. Row n of every array is the same sighting."""

    strip_id: Texts = array("J", "strip")
    camera: Ints = array("J", "number of the camera among those of the estimate")
    target_id: Texts = array("J", "target")
    ccd: Ints = array("J", "CCD of the camera, from 0")
    sample: Floats = array("J", "position along the CCD, px")
    is_star: Bools = array("J", "a star of a strip of the sky")
    residual_c: Floats = array("J, 2", "measured minus fitted direction along x and y of frame c, rad")
    statistic: Floats = array("J", "squared residual over its own covariance, chi-square of 2 dof")
    weight: Floats = array(
        "J",
        "1; 0 if the sighting takes no part; between, where one of several is wrong and the data do not tell "
        "which: the probability that this one is good, less if it is far off",
    )
    detectable_rad: Floats = array(
        "J",
        "minimal detectable bias: smallest error of the direction, along its least controlled axis, that the "
        "test finds with its power; inf where nothing controls it",
    )
    detectable_m: Floats = array("J", "`detectable_rad` times the distance to the target, m; NaN for stars")
    rivals: dict[int, Ints] = scalar(
        "rows of the rivals (`Entry.rivals`) of each row that the search for gross errors found"
    )

    @property
    def kept(self) -> Bools:
        """Whether each sighting (J,) takes part."""
        return self.weight > 0.0

    def subject(self, row: int) -> Subject:
        """The sighting of a row."""
        kind = Kind.STAR if self.is_star[row] else Kind.TARGET
        strip, target = str(self.strip_id[row]), str(self.target_id[row])
        return Subject(kind, strip=strip, ccd=int(self.ccd[row]), id=target)

    @property
    def doubtful(self) -> tuple[tuple[Subject, ...], ...]:
        """Groups of which one sighting is wrong, the likeliest first."""
        groups = [[j, *others] for j, others in self.rivals.items() if self.weight[j] > 0.0]
        return tuple(tuple(self.subject(int(row)) for row in group) for group in groups)


@record
class RejectionTest:
    """Test by which targets are rejected (data snooping, Baarda 1968), one per sighting."""

    limit: float = scalar("rejected above this statistic, chi-square of 2 degrees of freedom")
    noncentrality: float = scalar("of the chi-square of a bias that is found with the power of the test, 0.8")


@record(kw_only=True)
class HeadInstallation:
    """The installation matrix of one head."""

    name: str = scalar("name of the head; empty for the only one")
    R_cs: Rotation = scalar("its frame to the remote-sensing camera")


@record(kw_only=True)
class CameraRotation:
    """The rotation between two cameras of one satellite: errors that they share are not part of it."""

    cameras: tuple[str, str] = scalar("the cameras a and b")
    R_ab: Rotation = scalar("frame of b to frame of a")
    theta: Floats = array("3", "its deviation from that at the start, rad, frame of a")
    covariance: Floats = array("3, 3", "of a small rotation about the axes of a, rad²")
    p_value: float = scalar("of `theta`, by the stated errors of both matrices at the start")
    sigma = inner[Floats]("covariance", "1-sigma (3,) about the axes of a, rad", of=sigma_of)

    @property
    def as_before_launch(self) -> bool:
        """Whether the rotation is that at the start, but for its stated error."""
        return self.p_value >= PROBABILITY_MOVED


@record(kw_only=True)
class InstallationEstimate:
    """The installation matrix with covariance and fit statistics; of C cameras C matrices, T = 3 C."""

    R_cs: Rotation = scalar("installation matrix, star camera to remote-sensing camera; (C,) of several")
    R_cs0: Rotation = scalar("matrix at the start; (C,) of several")
    cameras: tuple[str, ...] = scalar("names of the cameras; a single one has none")
    theta: Floats = array("T", "whole deviation, R_cs = exp[[theta]] R_cs0, rad, frame c of each camera")
    cov_theta: Floats = array("T, T", "covariance of small rotations about the axes of c, rad²")
    chi2: float = scalar("of the targets' residuals, priors included")
    dof: int = scalar("degrees of freedom of `chi2`: two a good target, less three a camera")
    chi2_stars: float = scalar("of the stars' residuals about the attitudes of their exposures")
    dof_stars: int = scalar("degrees of freedom of `chi2_stars`")
    n_strips: int = scalar("strips that take part")
    n_exposures: int = scalar("exposures that take part")
    n_stars: int = scalar("stars that take part")
    n_targets: int = scalar("target sightings that take part, doubtful ones included")
    iterations: tuple[Iteration, ...] = scalar("all Gauss-Newton steps, in order")
    converged_matrix: bool = scalar("the last correction is within `tolerance_rad` of zero")
    converged_covariance: bool = scalar("... and within `tolerance_sigma` times the predicted 1-sigma")
    rejected: tuple[Entry, ...] = scalar("observations that take no part")
    pairs: InformationPairs = scalar("normal equations of each strip about the last iteration's matrix")
    prior_shared: Floats = array("G, G", "prior information of the pairs' shared unknowns")
    shared_values: Floats = array("G", "the shared unknowns as estimated")
    shared_covariance: Floats = array("G, G", "their covariance")
    theta_with_shared: Floats = array("T, G", "covariance of theta with them")
    targets: TargetResiduals = scalar("residuals of all targets")
    rejection: RejectionTest = scalar("how targets were tested")
    agreement: HeadAgreement = scalar("of the heads with one another")
    bias: CommonBias | None = scalar("of orbit and row clock; None: not observable (no strip of the sky)")
    references: tuple[ReferenceOffset, ...] = scalar("offsets of ground references whose error is stated")
    periodic: tuple[PeriodicError, ...] = scalar("errors of heads that come back", default=())
    taken_up: dict[str, Floats] = scalar(
        "of the errors of each strip's pass by the matrices, (3 H, 7)", default_factory=dict
    )
    heads: tuple[HeadInstallation, ...] = array("H", "of all heads, the reference head first")
    cov_heads: Floats = array("D, D", "rad², 3 H: small rotations about the axes of c, head after head")
    prior: InformationPairs | None = scalar("on theta, about `R_cs0`; None: none", default=None)
    posed: Posed | None = scalar("the problem that it solves; None: not kept", default=None)
    sigma_theta = inner[Floats]("cov_theta", "1-sigma (T,) about the axes of frame c, rad", of=sigma_of)

    def with_reference(self, name: str) -> InstallationEstimate:
        """The estimate with the reference head's name."""
        without = tuple(replace(one, head=one.head or name) for one in self.agreement.without)
        return replace(
            self,
            heads=(replace(self.heads[0], name=name), *self.heads[1:]),
            agreement=replace(self.agreement, without=without),
            periodic=tuple(replace(one, head=one.head or name) for one in self.periodic),
        )

    def of_camera(self, name: str) -> tuple[Rotation, Floats]:
        """The matrix of one camera, and the covariance (3, 3) of a small rotation about its axes, rad²."""
        n = self.cameras.index(name)
        own = slice(3 * n, 3 * n + 3)
        return (self.R_cs if self.R_cs.single else self.R_cs[n]), self.cov_theta[own, own]

    def between(self, sigma_rad: Floats | None = None) -> tuple[CameraRotation, ...]:
        """The rotation of each camera against each one before it, none of a single camera; `sigma_rad` (T,)
        is the 1-sigma of the matrices at the start.
        """
        every, sigma = range(len(self.cameras)), np.zeros(len(self.theta)) if sigma_rad is None else sigma_rad
        return tuple(self._rotation(a, b, sigma) for a in every for b in every[a + 1 :])

    def _rotation(self, a: int, b: int, sigma_rad: Floats) -> CameraRotation:
        R_ab, R_ab0 = self.R_cs[a] * self.R_cs[b].inv(), self.R_cs0[a] * self.R_cs0[b].inv()
        lift = np.zeros((3, len(self.theta)))
        lift[:, 3 * a : 3 * a + 3], lift[:, 3 * b : 3 * b + 3] = np.eye(3), -R_ab.as_matrix()
        theta, stated = theta_between(R_ab, R_ab0), np.diag(sigma_rad**2)
        apart = lift @ (self.cov_theta + stated) @ lift.T
        return CameraRotation(
            cameras=(self.cameras[a], self.cameras[b]),
            R_ab=R_ab,
            theta=theta,
            covariance=lift @ self.cov_theta @ lift.T,
            p_value=float(chdtrc(3, theta @ np.linalg.solve(apart, theta))),
        )


@record(kw_only=True)
class NotObservable:
    """Result where the data do not fix all three angles: no number is given."""

    reason: str = scalar("what is lacking, in words")
    directions_c: Floats = array("M, T", "unit vectors: rotations about them are not observable")
    rejected: tuple[Entry, ...] = scalar("observations that take no part")
