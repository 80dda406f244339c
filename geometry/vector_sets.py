"""Star and target vectors of many attitudes, one instant each, as in the paper's simulations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["VectorSets"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class VectorSets:
    """Vectors of K frames, one after another. Frame k has stars star_start[k]:star_start[k+1], and likewise
    targets.
    """

    star_start: Index  # (K + 1,)
    u_s: Array  # (N, 3) measured star vectors, star-camera frame
    v_stars: Array  # (N, 3) their known directions, GCRS
    sigma_s: Array  # (N,) rad per axis (QUEST model)
    target_start: Index  # (K + 1,)
    w_c: Array  # (J, 3) measured target vectors, remote-sensing-camera frame
    v_targets: Array  # (J, 3) their known directions, GCRS
    sigma_c: Array  # (J,) rad per axis

    def __post_init__(self) -> None:
        N, J = int(self.star_start[-1]), int(self.target_start[-1])
        if len(self.star_start) != len(self.target_start):
            raise ValueError(
                f"{len(self.star_start) - 1} frames of stars, {len(self.target_start) - 1} of targets"
            )
        for name, n, width in (
            ("u_s", N, (3,)),
            ("v_stars", N, (3,)),
            ("sigma_s", N, ()),
            ("w_c", J, (3,)),
            ("v_targets", J, (3,)),
            ("sigma_c", J, ()),
        ):
            if (got := getattr(self, name).shape) != (n, *width):
                raise ValueError(f"{name} must have shape {(n, *width)}, got {got}")

    def __len__(self) -> int:
        return len(self.star_start) - 1

    def frame(self, k: int) -> tuple[Array, Array, Array, Array, Array, Array]:
        """The six arrays of frame k, as the literal form takes them."""
        s = slice(self.star_start[k], self.star_start[k + 1])
        c = slice(self.target_start[k], self.target_start[k + 1])
        return self.u_s[s], self.v_stars[s], self.sigma_s[s], self.w_c[c], self.v_targets[c], self.sigma_c[c]
