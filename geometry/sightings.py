"""Records that the stages exchange: measured directions, the known directions of the same points, attitudes.

A covariance of a direction is (3, 3), rad², in the axes of the camera that measured it, and has no component
along the direction itself (paper, A3): `covariance @ u = 0`. The QUEST model of the paper's (A14) is
`isotropic_covariance(u, sigma)`. `VectorSets` holds star and target vectors of many frames, each with one
attitude, as in the paper's simulations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import Interpolation
from boresight.geometry.attitude_noise import NO_NOISE, AttitudeNoise
from boresight.geometry.gyro import GyroRows
from boresight.records.record import (
    Bools,
    Floats,
    Ints,
    RowRecord,
    Texts,
    array,
    inner,
    record,
    scalar,
    together,
)

__all__ = [
    "ExposureAttitudes",
    "GroundReferences",
    "GroundSightings",
    "HeadAttitudes",
    "StarSightings",
    "StripSightings",
    "VectorSets",
    "exposure_without_stars",
    "information_of_directions",
    "isotropic_covariance",
    "sigma_of",
    "solved_attitudes",
]


@record(kw_only=True)
class StarSightings:
    """Identified stars of one exposure. Row n of every array is the same star."""

    exposure_id: str = scalar("id of the exposure in the dump")
    t_s: float = scalar("middle of the exposure, TAI seconds since the dump's epoch")
    hip: Ints = array("N", "Hipparcos numbers")
    xy_px: Floats = array("N, 2", "centroids (column, row) as measured, distortion not removed")
    u_s: Floats = array("N, 3", "measured unit vectors, star-camera frame, distortion removed")
    u_i: Floats = array("N, 3", "apparent catalogue directions as seen from the moving satellite, GCRS")
    cov_s: Floats = array("N, 3, 3", "covariance of u_s, rad²")
    snr: Floats | None = array("N", "signal-to-noise ratio of the detections; None: not known", default=None)

    def told(self) -> list[str]:
        """Lines of the log."""
        return [f"{self.exposure_id}: {len(self.hip)} stars"]


@record(kw_only=True)
class ExposureAttitudes:
    """Attitudes of K exposures with N stars in all; `usable` is False where the kept stars do not fix one."""

    start: Ints = array("K + 1", "exposure k has the stars start[k]:start[k+1]")
    R_si: Floats = array("K, 3, 3", "GCRS to star camera")
    covariance_s: Floats = array("K, 3, 3", "rad², of psi, axes of s; zero where not usable")
    usable: Bools = array("K", "enough stars kept, and not all in one direction")
    kept: Bools = array("N", "stars that were not rejected")
    squared_mahalanobis: Floats = array("N", "squared residual over its variance, two degrees of freedom")
    chi2: Floats = array("K", "sum of `squared_mahalanobis` over kept stars")
    dof: Ints = array("K", "2 kept stars - 3")

    def stars(self, k: int) -> slice:
        """Rows of the stars of exposure k."""
        return slice(int(self.start[k]), int(self.start[k + 1]))

    def take(self, exposures: Ints) -> ExposureAttitudes:
        """The attitudes of the exposures with indices (M,), in that order."""
        counts = np.diff(self.start)[exposures]
        rows = np.concatenate([np.arange(0), *(np.arange(*self.start[k : k + 2]) for k in exposures)])
        return replace(
            self,
            start=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            kept=self.kept[rows],
            squared_mahalanobis=self.squared_mahalanobis[rows],
            **{n: getattr(self, n)[exposures] for n in ("R_si", "covariance_s", "usable", "chi2", "dof")},
        )

    @classmethod
    def together(cls, parts: Sequence[ExposureAttitudes]) -> ExposureAttitudes:
        """The exposures of several, part after part."""
        counts = np.concatenate([np.diff(part.start) for part in parts])
        names = ("R_si", "covariance_s", "usable", "kept", "squared_mahalanobis", "chi2", "dof")
        return replace(
            parts[0],
            start=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names},
        )


@record
class GroundReferences(RowRecord):
    """The references (a mosaic, a survey) of targets, whose offset is an error that their targets share."""

    name: Texts = array("N", "id of the reference of each target; empty: none")
    axes_i: Floats = array("N, 3, 3", "east, north and up at the target (columns), GCRS axes")
    sigma_m: Floats = array("N, 3", "1-sigma of the offset along them, m")
    place: Floats = array("N, 3", "of the target on the Earth, in correlation lengths; zero: one offset")


@record(kw_only=True)
class GroundSightings(RowRecord):
    """Calibration targets measured in one strip. Row n of every array is the same measurement.

    `cov_c` holds what is independent from row to row: the error of the image measurement. Errors that are
    common to a strip (position, clock) or belong to the target are described by the last fields. A star
    in a strip that scans the sky is a target too, at an infinite distance: no position of the satellite
    moves it.
    """

    target_id: Texts = array("N", "ids of the targets in the dump; of stars HIP and number")
    ccd: Ints = array("N", "CCD of the camera, from 0")
    xy_px: Floats = array("N, 2", "(sample, line) as measured in that CCD's raw image")
    t_s: Floats = array("N", "instant of the row, TAI seconds since the dump's epoch")
    u_c: Floats = array("N, 3", "measured look vectors, remote-sensing-camera frame")
    u_i: Floats = array("N, 3", "apparent directions of the targets from the moving satellite, GCRS")
    cov_c: Floats = array("N, 3, 3", "covariance of u_c, rad²")
    range_m: Floats = array("N", "distance from satellite to target; inf for a star")
    v_rel_i: Floats = array(
        "N, 3", "satellite velocity relative to the ground at the target, GCRS axes, m/s; 0 for a star"
    )
    cov_target_i: Floats = array(
        "N, 3, 3", "covariance of the target's own coordinates, GCRS axes, m²; of a star's direction, rad²"
    )
    earth_i: Floats = array(
        "N, 3, 3",
        "change of u_i (columns) by rotations of the Earth about the axes of e, each of the 1-sigma of "
        "predicted Earth orientation, rad; zero for measured values and for a star",
    )
    light_i: Floats = array(
        "N, 3, 4", "change of u_i (columns) by effects on light and by heights (`groundlight.moves_by_light`)"
    )
    references: GroundReferences | None = scalar("references of the targets; None: none", default=None)
    is_star = inner[Bools]("range_m", "(N,) whether the target is a star", of=np.isinf)

    def referenced(self) -> GroundReferences:
        """The references of all targets, without a name where they have none."""
        n = len(self.target_id)
        none = np.zeros(n, dtype=str), np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3))
        return self.references or GroundReferences(*none)

    @classmethod
    def of_stars(cls, t_s: Floats, **columns: Any) -> GroundSightings:
        """Stars in place of targets at instants (N,): no position of the satellite, Earth or effect on light
        moves them.
        """
        n = len(t_s)
        columns |= {"earth_i": np.zeros((n, 3, 3)), "light_i": np.zeros((n, 3, 4))}
        return cls(t_s=t_s, range_m=np.full(n, np.inf), v_rel_i=np.zeros((n, 3)), **columns)

    @classmethod
    def together(cls, parts: Sequence[GroundSightings]) -> GroundSightings:
        """The measurements of several, part after part."""
        if any(part.references for part in parts):
            parts = [replace(part, references=part.referenced()) for part in parts]
        return together(parts)


@record(kw_only=True)
class HeadAttitudes(RowRecord):
    """Attitudes of one more star camera (head) around a strip, in its own frame h."""

    head: str = scalar("name of the head")
    t_s: Floats = array("K", "instants, TAI seconds since the dump's epoch")
    R_hi: Rotation = array("K", "GCRS to frame h")
    covariance_h: Floats = array("K, 3, 3", "of each attitude by itself, axes of h, rad²")
    noise: AttitudeNoise = scalar("errors that the attitudes have in common, axes of h")
    R_oi: Rotation = array("K", "GCRS to the orbital frame at the same instants")
    R_sh: Rotation = scalar("alignment: frame h to that of the reference head, as far as it is known")

    @property
    def noise_s(self) -> AttitudeNoise:
        """The errors about the axes of frame s."""
        return replace(self.noise, R_sn=self.R_sh * self.noise.R_sn)


@record(kw_only=True)
class StripSightings:
    """One strip: its targets, the star exposures around it, and the nominal motion between their instants.

    `R_oi` is the rotation from GCRS to the satellite's orbital frame (or any other smooth nominal attitude).
    The measured attitude relative to it varies slowly, and only that is interpolated. `ValueError` unless the
    exposures are in strictly increasing order of time.
    """

    strip_id: str = scalar("id of the strip in the dump")
    exposures: tuple[StarSightings, ...] = array("K", "star exposures around the strip, in order of time")
    ground: GroundSightings = scalar("J measured targets")
    R_oi_exposures: Rotation = array("K", "GCRS to the orbital frame at the exposures")
    R_oi_targets: Rotation = scalar("(J,) GCRS to the orbital frame at the targets' rows")
    attitudes: ExposureAttitudes | None = scalar(
        "attitudes of the exposures; None: fitted by the estimate", default=None
    )
    noise: AttitudeNoise = scalar("errors of the attitudes beside their covariances", default=NO_NOISE)
    others: tuple[HeadAttitudes, ...] = scalar("attitudes of the other heads", default=())
    gyro: GyroRows | None = scalar("what a gyro tells around the strip", default=None)
    interpolation: Interpolation = scalar("between the attitudes", default="lagrange")
    carrier: str = scalar(
        "head that measured the exposures' attitudes, turned to frame s; empty: the reference head",
        default="",
    )
    earth: str = scalar(
        "prediction of Earth orientation (`EarthRotation.prediction`) of `ground.earth_i`; empty: measured",
        default="",
    )
    camera: str = scalar("remote-sensing camera that took it, of several; empty: the only one", default="")
    joined: tuple[tuple[str, str, int], ...] = scalar(
        "of strips joined to one (`calib.simultaneous_strips`): their ids, each with its camera and the "
        "number of its rows in `ground`, in order; none: the strip itself",
        default=(),
    )

    @property
    def parts(self) -> tuple[tuple[str, str, int], ...]:
        """The strips that are joined, or this one: id, camera, number of rows."""
        return self.joined or ((self.strip_id, self.camera, len(self.ground.target_id)),)

    @property
    def strip_of_target(self) -> Texts:
        """Strip (J,) of each target."""
        names, _, counts = zip(*self.parts)
        return np.repeat(np.array(names, dtype=str), counts)

    @property
    def camera_of_target(self) -> Texts:
        """Camera (J,) of each target."""
        _, cameras, counts = zip(*self.parts)
        return np.repeat(np.array(cameras, dtype=str), counts)

    @property
    def times_s(self) -> Floats:
        """Instants (K,) of the exposures, TAI seconds since the dump's epoch."""
        return np.array([exposure.t_s for exposure in self.exposures], dtype=np.float64)

    @property
    def fitted(self) -> ExposureAttitudes:
        """`attitudes`, which are there."""
        assert self.attitudes is not None
        return self.attitudes

    def usable(self) -> tuple[Floats, Rotation, Rotation, Floats]:
        """Instants (U,), R_si and R_oi (U,), and covariances (U, 3, 3), rad², of the usable exposures."""
        used = self.fitted.usable
        R_si = Rotation.from_matrix(self.fitted.R_si[used]) if used.any() else Rotation.identity(0)
        return self.times_s[used], R_si, self.R_oi_exposures[used], self.fitted.covariance_s[used]

    def later(self, seconds: float) -> StripSightings:
        """The strip with all its instants so much later."""
        return replace(
            self,
            exposures=tuple(replace(one, t_s=one.t_s + seconds) for one in self.exposures),
            ground=replace(self.ground, t_s=self.ground.t_s + seconds),
            others=tuple(replace(one, t_s=one.t_s + seconds) for one in self.others),
            gyro=self.gyro and replace(self.gyro, t_s=self.gyro.t_s + seconds),
        )

    def __post_init__(self) -> None:
        times = [exposure.t_s for exposure in self.exposures]
        if any(b <= a for a, b in pairwise(times)):
            raise ValueError(f"strip {self.strip_id}: exposures must be in strictly increasing order of time")
        if (got := len(self.R_oi_targets)) != (expected := len(self.ground.target_id)):
            raise ValueError(f"strip {self.strip_id}: R_oi_targets must hold {expected} rotations, got {got}")
        if self.attitudes is not None:
            counts = np.diff(self.attitudes.start).tolist()
            if counts != [len(exposure.hip) for exposure in self.exposures]:
                raise ValueError(f"strip {self.strip_id}: `attitudes` are not those of its exposures")


@record(kw_only=True)
class VectorSets:
    """Vectors of K frames, concatenated: N stars and J targets in all."""

    star_start: Ints = array("K + 1", "frame k has the stars star_start[k]:star_start[k+1]")
    u_s: Floats = array("N, 3", "measured star vectors, star-camera frame")
    v_stars: Floats = array("N, 3", "their known directions, GCRS")
    sigma_s: Floats = array("N", "1-sigma per axis of u_s, rad (QUEST model)")
    target_start: Ints = array("K + 1", "frame k has the targets target_start[k]:target_start[k+1]")
    w_c: Floats = array("J, 3", "measured target vectors, remote-sensing-camera frame")
    v_targets: Floats = array("J, 3", "their known directions, GCRS")
    sigma_c: Floats = array("J", "1-sigma per axis of w_c, rad")
    cov_s: Floats | None = array("N, 3, 3", "of u_s, rad²; None: by sigma_s", default=None)
    cov_c: Floats | None = array("J, 3, 3", "of w_c, rad²; None: by sigma_c", default=None)
    instant: Ints | None = array("K", "equal for frames of one attitude; None: of equal stars", default=None)
    target_id: Texts | None = array("J", "equal for one place on the ground; None: all differ", default=None)
    cov_targets: Floats | None = array("J, 3, 3", "of v_targets, GCRS, rad²; None: exact", default=None)

    def __post_init__(self) -> None:
        for start, values in ((self.star_start, self.u_s), (self.target_start, self.w_c)):
            if int(start[-1]) != len(values):
                raise ValueError(f"the frames hold {int(start[-1])} vectors, {len(values)} are given")

    def __len__(self) -> int:
        return len(self.star_start) - 1

    def frame(self, k: int) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
        """u_s (N, 3), v_stars, sigma_s (N,), w_c (J, 3), v_targets and sigma_c (J,) of frame k."""
        s = slice(self.star_start[k], self.star_start[k + 1])
        c = slice(self.target_start[k], self.target_start[k + 1])
        return self.u_s[s], self.v_stars[s], self.sigma_s[s], self.w_c[c], self.v_targets[c], self.sigma_c[c]

    @property
    def instants(self) -> list[int]:
        """The first frame (K,) that has the attitude of each frame."""
        first: dict[object, int] = {}
        own = range(len(self)) if self.instant is None else self.instant.tolist()
        if self.instant is None:
            keys = [tuple(part.tobytes() for part in self.frame(k)[:2]) for k in own]
            return [first.setdefault(key, k) for k, key in enumerate(keys)]
        return [first.setdefault(key, k) for k, key in enumerate(own)]

    def stars_of(self, frames: list[int]) -> Ints:
        """Rows (M,) of the stars of frames of one attitude, a star that several of them list once."""
        rows = np.concatenate([np.arange(*self.star_start[k : k + 2]) for k in frames])
        both = np.hstack([self.u_s[rows], self.v_stars[rows]])
        return rows[np.sort(np.unique(both, axis=0, return_index=True)[1])]

    @property
    def covariances(self) -> tuple[Floats, Floats]:
        """Of u_s (N, 3, 3) and w_c (J, 3, 3), rad²."""
        stars = isotropic_covariance(self.u_s, self.sigma_s) if self.cov_s is None else self.cov_s
        return stars, isotropic_covariance(self.w_c, self.sigma_c) if self.cov_c is None else self.cov_c


def exposure_without_stars(exposure_id: str, t_s: float) -> StarSightings:
    """An exposure whose attitude the star camera has solved itself."""
    none = np.zeros((0, 3))
    return StarSightings(
        exposure_id=exposure_id,
        t_s=t_s,
        hip=np.zeros(0, dtype=np.int64),
        xy_px=np.zeros((0, 2)),
        u_s=none,
        u_i=none,
        cov_s=np.zeros((0, 3, 3)),
        snr=np.zeros(0),
    )


def solved_attitudes(R_si: Rotation, covariance_s: Floats) -> ExposureAttitudes:
    """Attitudes (K,) that the star camera has solved itself, with covariances (K, 3, 3), rad², axes of s."""
    K = len(R_si)
    return ExposureAttitudes(
        start=np.zeros(K + 1, dtype=np.int64),
        R_si=R_si.as_matrix().reshape(K, 3, 3),
        covariance_s=covariance_s,
        usable=np.ones(K, dtype=bool),
        kept=np.zeros(0, dtype=bool),
        squared_mahalanobis=np.zeros(0),
        chi2=np.zeros(K),
        dof=np.zeros(K, dtype=np.int64),
    )


def sigma_of(covariance: Floats) -> Floats:
    """1-sigma (N,) of parameters by their covariance (N, N)."""
    return np.asarray(np.sqrt(np.diag(covariance)))


def isotropic_covariance(u: Floats, sigma_rad: Floats | float) -> Floats:
    """sigma² (I - u uᵀ), the QUEST model (paper, A14). `u` (N, 3), `sigma_rad` (N,) or a number."""
    variance = np.broadcast_to(np.asarray(sigma_rad, dtype=float) ** 2, (len(u),))
    return variance[:, None, None] * (np.eye(3) - u[:, :, None] * u[:, None, :])


def information_of_directions(u: Floats, covariance: Floats) -> Floats:
    """Pseudo-inverse of covariances that vanish along `u`: (N, 3, 3), rad⁻², also zero along `u`.

    The null direction u is regularised with the mean variance; its contribution is subtracted afterwards.
    """
    along = u[:, :, None] * u[:, None, :]
    size = 0.5 * np.trace(covariance, axis1=1, axis2=2)[:, None, None]
    return np.linalg.inv(covariance + size * along) - along / size
