"""Attitudes that the heads of a dump have solved: rows of one smoother, in frame s of the reference head."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import NominalMotion
from boresight.geometry.attitude_smoother import HeadRows
from boresight.geometry.record import Floats
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_side import SolvedAttitudes

__all__ = ["rows_of_heads"]

INSTANT_S = 1e-7  # instants that are one and the same


def rows_of_heads(
    dump: Dump,
    t_s: Floats,
    mountings: Mapping[str, Rotation],
    carrier: str = "",
    nominal: NominalMotion | None = None,
) -> list[HeadRows]:
    """Attitudes that the carrier, else the reference head, has solved from the first of instants (K,) to the
    last, and those of all other such heads, in frame s of the reference head by the matrices of all, relative
    to a nominal motion; None: the orbit's.
    """
    nominal = nominal or dump.orbit
    by_name = {head.name: head for head in dump.heads if head.is_smoothed}
    first, R_cs = by_name.pop(carrier or dump.heads[0].name), mountings[dump.heads[0].name]
    rows = []
    for head in (first, *by_name.values()):
        assert isinstance(head.source, SolvedAttitudes)
        of_head = head.source.rows
        at = np.flatnonzero((of_head.t_s >= t_s[0] - INSTANT_S) & (of_head.t_s <= t_s[-1] + INSTANT_S))
        if not len(at):
            continue
        R_sh, white = R_cs.inv() * mountings[head.name], head.noise.white_covariance_s
        own = np.tile(white, (len(at), 1, 1)) if of_head.covariance_s is None else of_head.covariance_s[at]
        A, R_hi = R_sh.as_matrix(), head.source.with_all_aberration(at, dump.epoch, dump.orbit)
        rows.append(
            HeadRows(
                t_s=of_head.t_s[at],
                R_so=R_sh * R_hi * nominal.R_oi(of_head.t_s[at]).inv(),
                covariance_s=A @ own @ A.T,
                noise=replace(head.noise, R_sn=R_sh * head.noise.R_sn),
            )
        )
    return rows
