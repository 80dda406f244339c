"""The unknowns of a strip by itself, as few as its observations can tell apart.

A strip has three unknowns for each exposure, beside position, clock and slow motion. Its targets lie at a few
instants, between a few exposures each, so that they see only some combinations of these; the rows of other
heads see the attitudes alone, whatever the installation matrix and the weights of the targets. With

    ‖q‖² + ‖t - T s - K q‖² = ‖r₁ - R₁ s - R q‖² + ‖t' - T' s‖²        (QR of [[I, 0, 0], [K, T, t]])

for the attitude unknowns q (units of their prior sigma), the alignments s and the rows t of the other heads,
q' = R q - r₁ + R₁ s has unit variance again, and targets are all that sees it. Of X q, with X = U S Vᵀ, only
Vᵀ q matters, so that U S = X V takes the place of X. Both steps are exact.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import qr

from boresight.calib.strips import StripGroup, tangent_axes
from boresight.geometry.record import Floats

__all__ = ["condensed"]

NO_EFFECT = 1e-12  # what is left of a column below this share of the largest is rounding


def condensed(group: StripGroup) -> StripGroup:
    """The group with as many unknowns of its own as its targets see, and the rows of other heads, `n_phi` of
    them no longer, about the alignments alone. Estimates from it are the same but for rounding.
    """
    S, J = group.inside.shape
    tangent = tangent_axes(group.v_s)  # across the known directions, along which nothing changes
    X = (tangent @ group.shared_s).reshape(S, 2 * J, -1)
    n = X.shape[2]
    by_ties, rows = np.zeros((S, n, group.ties.shape[2] - group.n_phi)), group.ties[:, :, group.n_phi :]
    R_inverse = np.broadcast_to(np.eye(n), (S, n, n)).copy()
    if group.ties.shape[1]:
        R, by_ties[:, : group.n_phi], rows = _eliminated(group.ties, group.n_phi)
        R_inverse[:, : group.n_phi, : group.n_phi] = np.linalg.inv(R)
    # Columns of an orthogonal matrix, the first of which span what targets see
    seen = [qr(one.T, mode="economic", pivoting=True) for one in np.linalg.qr(X, mode="r") @ R_inverse]
    size = np.array([np.abs(np.diag(triangle)) for _, triangle, _ in seen])
    m = int(np.max(np.sum(size > NO_EFFECT * size[:, :1], axis=1), initial=0))
    V = np.array([Q[:, :m] for Q, *_ in seen])
    return replace(
        group,
        shared_s=np.swapaxes(tangent, 2, 3) @ (X @ (R_inverse @ V)).reshape(S, J, 2, m),
        by_ties=np.swapaxes(V, 1, 2) @ by_ties,
        ties=rows,
        n_phi=0,
    )


def _eliminated(ties: Floats, n_phi: int) -> tuple[Floats, Floats, Floats]:
    """R (S, n_phi, n_phi), R₁ with r₁ (S, n_phi, m), and T' with t' (S, m, m); all but R sum up the rows
    (S, H, n_phi + m) of the other heads.
    """
    S, _, n = ties.shape
    prior = np.broadcast_to(np.eye(n_phi, n), (S, n_phi, n))
    R: Floats = np.asarray(np.linalg.qr(np.concatenate([prior, ties], axis=1), mode="r"))
    return R[:, :n_phi, :n_phi], R[:, :n_phi, n_phi:], R[:, n_phi:, n_phi:]
