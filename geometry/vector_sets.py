"""Star and target vectors of many frames, each with one attitude, as in the paper's simulations."""

from __future__ import annotations

from boresight.geometry.record import Floats, Ints, array, record

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
