"""Several star cameras (heads) on one satellite: what ties them together, and which of them contradicts.

The attitudes of the reference head carry a strip (`strips`). Every other head measures the same attitude with
errors of its own and in its own frame h; its alignment R_sh to the reference head is known but for a small
right-handed rotation alpha about the axes of s, three unknowns that all strips share. So are the
coefficients of errors that come back with a period, of every head (`AttitudeNoise`). A smoother takes the
rows of all heads together (`pass_attitude`): the attitude at a target changes with these unknowns, and the
rows tell of them by themselves, without any target.

Where the reference head has no attitude around a strip (blinded by the Sun, say), another head carries the
strip: its attitudes, turned to frame s by the assumed alignment, have the error alpha.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import linear_weights
from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.sightings import (
    HeadAttitudes,
    StripSightings,
    exposure_without_stars,
    solved_attitudes,
)
from boresight.records.record import Floats, array, record, scalar

__all__ = [
    "HeadAgreement",
    "HeadTie",
    "PeriodicError",
    "WithoutHead",
    "aligned",
    "alignment_names",
    "carried",
    "largest_turn",
    "lasting_of_head",
    "measured_alignment",
    "of_heads",
    "periodic_errors",
    "unknown_heads",
    "unknowns_of_head",
    "without_head",
]


@record(kw_only=True)
class WithoutHead:
    """What is left of the contradictions if one head is not used."""

    head: str = scalar("name of the head; empty for the reference head")
    chi2: float = scalar(
        "of targets and remaining heads, with the limit of the test for each target rejected"
    )
    dof: int = scalar("degrees of freedom of `chi2`")


@record(kw_only=True)
class HeadAgreement:
    """Differences between the attitudes of several heads, one alignment a head estimated."""

    chi2: float = scalar("squared differences over their variances")
    dof: int = scalar("degrees of freedom of `chi2`; 0 for a single head")
    gain: float = scalar("decrease of `chi2` if each strip had alignments of its own")
    dof_gain: int = scalar("degrees of freedom of `gain`")
    without: tuple[WithoutHead, ...] = scalar("each head left out; only if they differ too much", default=())


@record(kw_only=True)
class HeadTie:
    """What the rows of all heads tell of their A unknowns in one pass: M whitened rows
    r = by_phi q + by_alpha alpha + noise of unit variance.
    """

    unknowns: tuple[str, ...] = scalar("names of the A unknowns")
    r: Floats = array("M", "residuals")
    by_phi: Floats = array("M, P", "change by the strip's attitude unknowns, units of their prior sigma")
    by_alpha: Floats = array("M, A", "change by these, 1/rad; of periodic errors, units of their prior sigma")
    dof: int = scalar("degrees of freedom of the last row: root of the squares that any alignments leave")


@record(kw_only=True)
class PeriodicError:
    """An error of one head that comes back with a period: H terms of a Fourier series about its axes, rad."""

    head: str = scalar("name of the head; empty: the reference head")
    period_s: float = scalar("the period")
    stated_rad: Floats = array("3", "1-sigma stated for it about each axis")
    cosine_rad: Floats = array("H, 3", "coefficients of cos(2 pi h t / P), t since the epoch")
    sine_rad: Floats = array("H, 3", "coefficients of sin(2 pi h t / P)")
    sigma_cosine_rad: Floats = array("H, 3", "1-sigma of these")
    sigma_sine_rad: Floats = array("H, 3", "1-sigma of these")


def alignment_names(head: str) -> tuple[str, ...]:
    """Names of the three unknowns of a head's alignment."""
    return tuple(f"head/{head}/{axis}" for axis in "xyz")


def unknowns_of_head(head: str, noise: AttitudeNoise) -> tuple[str, ...]:
    """Names of all unknowns of a head: its alignment unless it is the reference head (""), and the
    coefficients of its periodic error.
    """
    terms = range(1, noise.harmonics + 1) if noise.periodic_rad.any() else ()
    waves = (f"periodic/{head}/{wave}{h}/{axis}" for h in terms for wave in ("cos", "sin") for axis in "xyz")
    return (*(alignment_names(head) if head else ()), *waves)


def lasting_of_head(head: str, noise: AttitudeNoise, t_s: Floats) -> Floats:
    """Error (J, 3, A) of a head about the axes of s, at instants (J,), by its `unknowns_of_head`."""
    alignment = np.tile(-np.eye(3), (len(t_s), 1, 1))[:, :, : 3 if head else 0]
    return np.concatenate([alignment, noise.waves_s(t_s)], axis=2)


def periodic_errors(
    strips: Sequence[StripSightings],
    names: Sequence[str],
    values_of: Callable[[Sequence[str]], tuple[Floats, Floats]],
) -> tuple[PeriodicError, ...]:
    """The periodic errors of the heads of strips, as far as they are among the unknowns `names`; `values_of`
    gives values (n,) and covariance (n, n) of some of these.
    """
    noise = {one.head: one.noise for strip in strips for one in strip.others}
    noise |= {strip.carrier: strip.noise for strip in strips if strip.exposures}
    found = []
    for head, of_head in sorted(noise.items()):
        own = [name for name in unknowns_of_head(head, of_head) if name.startswith("periodic/")]
        if not own or not set(own) <= set(names):
            continue
        values, covariance = values_of(own)
        unit = of_head.periodic_rad / np.sqrt(of_head.harmonics)
        (cosine, sine), (sigma_cosine, sigma_sine) = (
            np.moveaxis(part.reshape(of_head.harmonics, 2, 3) * unit, 1, 0)
            for part in (values, np.sqrt(np.diag(covariance)))
        )
        one = PeriodicError(
            head=head,
            period_s=of_head.period_s,
            stated_rad=of_head.periodic_rad,
            cosine_rad=cosine,
            sine_rad=sine,
            sigma_cosine_rad=sigma_cosine,
            sigma_sine_rad=sigma_sine,
        )
        found.append(one)
    return tuple(found)


def unknown_heads(strips: Sequence[StripSightings]) -> tuple[str, ...]:
    """Names of all heads but the reference head, in order."""
    return tuple(sorted({other.head for strip in strips for other in strip.others}))


def measured_alignment(strips: Sequence[StripSightings], head: str) -> Rotation:
    """R_sh of a head by the median difference from the reference head's attitudes at the same instants; as
    stated before where there are none.
    """
    own = [(strip, other) for strip in strips for other in strip.others if other.head == head]
    R_sh = own[0][1].R_sh
    for _ in range(2):
        rho = np.concatenate([np.zeros((0, 3)), *(_differences(*both, R_sh) for both in own)])
        if not len(rho):
            return R_sh
        R_sh = Rotation.from_rotvec(-np.median(rho, axis=0)) * R_sh
    return R_sh


def _differences(strip: StripSightings, other: HeadAttitudes, R_sh: Rotation) -> Floats:
    """Rotations (L, 3) from the reference head's attitudes to those of another head between them."""
    times, R_si, R_oi, _ = strip.usable()
    if len(times) < 2 or not ((rows := (other.t_s >= times[0]) & (other.t_s <= times[-1])).any()):
        return np.zeros((0, 3))
    D = R_si * R_oi.inv()
    middle = D[len(D) // 2]
    turns = linear_weights(times, other.t_s[rows]) @ (D * middle.inv()).as_rotvec()
    here = Rotation.from_rotvec(turns) * middle * other.R_oi[rows]
    return np.asarray((R_sh * other.R_hi[rows] * here.inv()).as_rotvec())


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


def of_heads(own: Sequence[str], columns: Floats, names: Sequence[str]) -> Floats:
    """Columns (..., A) by some unknowns of heads as columns (..., N) by all of these names."""
    every = np.zeros((*columns.shape[:-1], len(names)))
    every[..., [names.index(name) for name in own]] = columns
    return every


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
