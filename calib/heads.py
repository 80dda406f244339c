"""Several star cameras (heads) on one satellite: what ties them together, and which of them contradicts.

The attitudes of the reference head carry a strip (`strips`). Every other head measures the same attitude with
errors of its own and in its own frame h; its alignment R_sh to the reference head is known but for a small
right-handed rotation alpha about the axes of s, three unknowns that all strips share. Where the reference
head's attitude is interpolated to the instant of row l of the other head, the logarithm of the rotation from
one to the other is

    rho_l = sum_k w_lk phi_k - alpha - phi_l,

with the errors phi_k of the reference head, which are unknowns of the strip, and the row's own error phi_l,
whose covariance (white, correlated, constant) whitens these rows. They need no target.

Where the reference head has no attitude around a strip (blinded by the Sun, say), another head carries the
strip: its attitudes, turned to frame s by the assumed alignment, have the errors phi_k + alpha. The targets
of such a strip, and the rows of further heads in it, see the alignment of the head that carries it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import lagrange_weights
from boresight.geometry.record import Floats, Ints, array, record, scalar
from boresight.geometry.sightings import (
    HeadAttitudes,
    StripSightings,
    exposure_without_stars,
    solved_attitudes,
)

__all__ = [
    "HeadTie",
    "aligned",
    "alignment_columns",
    "carried",
    "head_names",
    "interpolated",
    "largest_turn",
    "measured_alignment",
    "tie_of_head",
    "unknown_heads",
    "without_head",
]


@record(kw_only=True)
class HeadTie:
    """Whitened rows of one head in one strip: r = by_phi q + by_alpha alpha + noise of unit variance."""

    head: str = scalar("name of the head")
    r: Floats = array("M", "three rows an attitude")
    by_phi: Floats = array("M, P", "change by the strip's attitude unknowns, units of their prior sigma")
    by_alpha: Floats = array("M, 3", "change by the error of the alignment, 1/rad")


def head_names(heads: Sequence[str]) -> tuple[str, ...]:
    """Names of the unknown alignments of heads, three each."""
    return tuple(f"head/{head}/{axis}" for head in heads for axis in "xyz")


def unknown_heads(strips: Sequence[StripSightings]) -> tuple[str, ...]:
    """Names of all heads but the reference head, in order."""
    return tuple(sorted({other.head for strip in strips for other in strip.others}))


def interpolated(R_si: Rotation, R_oi: Rotation, weights: Floats, R_oi_wanted: Rotation) -> Rotation:
    """Attitudes (J,) by weights (J, K) of those at K exposures, relative to the nominal motion R_oi (K,)."""
    D = R_si * R_oi.inv()
    middle = D[len(D) // 2]
    return Rotation.from_rotvec(weights @ (D * middle.inv()).as_rotvec()) * middle * R_oi_wanted


def tie_of_head(
    other: HeadAttitudes,
    times: Floats,
    R_si: Rotation,
    R_oi: Rotation,
    root: Floats,
    sigma_vibration_rad: float,
) -> HeadTie:
    """Rows of a head over a strip whose K exposures have times (K,), attitudes, and errors with the square
    root (K, 3, 3 K) of their covariance. Rows between exposures also see the vibration.
    """
    rho, weights, rows = _differences(other, times, R_si, R_oi)
    count, unknowns = len(rows), root.shape[2]
    if not count:
        none = np.zeros((0, unknowns + 4))
        return HeadTie(head=other.head, r=none[:, 0], by_phi=none[:, :unknowns], by_alpha=none[:, -3:])
    covariance = other.noise_s.coloured_covariance_s(other.t_s[rows])
    A = other.R_sh.as_matrix()
    between = 1.0 - weights.max(axis=1) > 1e-9
    each = np.arange(count)
    covariance[each, :, each, :] += A @ other.covariance_h[rows] @ A.T
    covariance[each, :, each, :] += (sigma_vibration_rad**2 * between)[:, None, None] * np.eye(3)
    L = np.linalg.cholesky(covariance.reshape(3 * count, 3 * count))
    by_phi = np.tensordot(weights, root, axes=1).reshape(3 * count, unknowns)
    by_alpha = np.tile(-np.eye(3), (count, 1))
    whitened = solve_triangular(L, np.column_stack([rho.ravel(), by_phi, by_alpha]), lower=True)
    return HeadTie(head=other.head, r=whitened[:, 0], by_phi=whitened[:, 1:-3], by_alpha=whitened[:, -3:])


def _differences(
    other: HeadAttitudes, times: Floats, R_si: Rotation, R_oi: Rotation
) -> tuple[Floats, Floats, Ints]:
    """rho (L, 3), interpolation weights (L, K), and the rows of the head that the exposures cover."""
    if len(times) < 2:
        return np.zeros((0, 3)), np.zeros((0, len(times))), np.zeros(0, dtype=np.int64)
    rows = np.flatnonzero((other.t_s >= times[0]) & (other.t_s <= times[-1]))
    weights = lagrange_weights(times, other.t_s[rows], points=min(4, len(times)))
    if not len(rows):
        return np.zeros((0, 3)), weights, rows
    here = interpolated(R_si, R_oi, weights, other.R_oi[rows])
    return (other.R_sh * other.R_hi[rows] * here.inv()).as_rotvec(), weights, rows


def measured_alignment(strips: Sequence[StripSightings], head: str) -> Rotation:
    """R_sh of a head by the median difference from the reference head's attitudes at the same instants; as
    stated before where there are none.
    """
    own = [(strip, other) for strip in strips for other in strip.others if other.head == head]
    R_sh = own[0][1].R_sh
    for _ in range(2):
        rho = []
        for strip, other in own:
            assert strip.attitudes is not None
            used = strip.attitudes.usable
            times = np.array([exposure.t_s for exposure in strip.exposures])[used]
            if len(times) < 2:
                continue
            R_si = Rotation.from_matrix(strip.attitudes.R_si[used])
            moved = replace(other, R_sh=R_sh)
            rho.append(_differences(moved, times, R_si, strip.R_oi_exposures[used])[0])
        every = np.concatenate([np.zeros((0, 3)), *rho])
        if not len(every):
            return R_sh
        R_sh = Rotation.from_rotvec(-np.median(every, axis=0)) * R_sh
    return R_sh


def without_head(strip: StripSightings, head: str) -> StripSightings:
    """The strip without the attitudes of one head. Of the reference head (""): the first other head carries
    the strip, its attitudes in frame s by the alignment R_sh.
    """
    others = tuple(sorted((one for one in strip.others if one.head != head), key=lambda one: one.head))
    if head or not others:
        return replace(strip, others=others)
    first, *rest = others
    K, A = len(first.t_s), first.R_sh.as_matrix()
    names = [f"{first.head}/{k:06d}" for k in range(K)]
    return replace(
        strip,
        exposures=tuple(exposure_without_stars(name, float(t)) for name, t in zip(names, first.t_s)),
        R_oi_exposures=first.R_oi,
        attitudes=solved_attitudes(first.R_sh * first.R_hi, A @ first.covariance_h @ A.T),
        noise=first.noise_s,
        others=tuple(rest),
    )


def carried(strip: StripSightings) -> StripSightings:
    """The strip itself or, without exposures of the reference head, carried by the head whose attitudes span
    most of its targets' instants; the first by name where several span as many.
    """
    if strip.exposures or not strip.others:
        return strip

    def spanned(other: HeadAttitudes) -> int:
        t_s, inside = strip.ground.t_s, len(other.t_s) > 1
        return int(np.sum((t_s >= other.t_s[0]) & (t_s <= other.t_s[-1]))) if inside else -1

    by_name = sorted(strip.others, key=lambda one: one.head)
    first = max(by_name, key=spanned)
    rest = tuple(one for one in by_name if one is not first)
    return replace(without_head(replace(strip, others=(first,)), ""), others=rest, carrier=first.head)


def alignment_columns(tie: HeadTie, heads: Sequence[str], carrier: str) -> Floats:
    """Change (M, 3 heads) of a head's rows by all alignments, in a strip that `carrier` carries."""
    columns = np.zeros((len(tie.r), 3 * len(heads)))
    for head, sign in ((tie.head, 1.0), (carrier, -1.0)):
        if head:
            first = 3 * heads.index(head)
            columns[:, first : first + 3] = sign * tie.by_alpha
    return columns


def aligned(strips: Sequence[StripSightings], alignment: dict[str, Rotation]) -> list[StripSightings]:
    """The strips with these alignments R_sh of their heads."""
    return [
        replace(
            strip, others=tuple(replace(one, R_sh=alignment.get(one.head, one.R_sh)) for one in strip.others)
        )
        for strip in strips
    ]


def largest_turn(strips: Sequence[StripSightings], alignment: dict[str, Rotation]) -> float:
    """The largest rotation, rad, by which `aligned` would change an alignment."""
    others = [one for strip in strips for one in strip.others]
    turns = [(alignment.get(one.head, one.R_sh) * one.R_sh.inv()).magnitude() for one in others]
    return float(max(turns, default=0.0))
