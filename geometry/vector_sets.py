"""Star and target vectors of many frames, each with one attitude, as in the paper's simulations."""

from __future__ import annotations

import numpy as np

from boresight.geometry.record import Floats, Ints, Texts, array, record
from boresight.geometry.sightings import isotropic_covariance

__all__ = ["VectorSets"]


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
