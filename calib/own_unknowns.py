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

import numpy as np
from scipy.linalg import qr

from boresight.records.record import Floats

__all__ = ["condensed"]

NO_EFFECT = 1e-12  # what is left of a column below this share of the largest is rounding


def condensed(X: Floats, ties: Floats, n_phi: int) -> tuple[Floats, Floats, Floats]:
    """As many unknowns of their own as the targets of S strips see: estimates from them are the same but for
    rounding.

    `X` (S, R, n) are the targets' rows by the n own unknowns, units of their prior sigma, `ties`
    (S, H, n_phi + A + 1) the rows of other heads by the first `n_phi` of these, by A unknowns of heads, and,
    last, their residual. Returned are the targets' rows by the m new unknowns (S, R, m), what the rows of
    other heads tell of these, by unknowns of heads and residual (S, m, A + 1), and what they tell of the
    unknowns of heads alone (S, H', A + 1).
    """
    S, _, n = X.shape
    by_ties, rows = np.zeros((S, n, ties.shape[2] - n_phi)), ties[:, :, n_phi:]
    R_inverse = np.broadcast_to(np.eye(n), (S, n, n)).copy()
    if ties.shape[1]:
        prior = np.broadcast_to(np.eye(n_phi, ties.shape[2]), (S, n_phi, ties.shape[2]))
        R: Floats = np.asarray(np.linalg.qr(np.concatenate([prior, ties], axis=1), mode="r"))
        by_ties[:, :n_phi], rows = R[:, :n_phi, n_phi:], R[:, n_phi:, n_phi:]
        R_inverse[:, :n_phi, :n_phi] = np.linalg.inv(R[:, :n_phi, :n_phi])
    # Columns of an orthogonal matrix, the first of which span what targets see
    seen = [qr(one.T, mode="economic", pivoting=True) for one in np.linalg.qr(X, mode="r") @ R_inverse]
    size = np.array([np.abs(np.diag(triangle)) for _, triangle, _ in seen])
    m = int(np.max(np.sum(size > NO_EFFECT * size[:, :1], axis=1), initial=0))
    V = np.array([Q[:, :m] for Q, *_ in seen])
    return X @ (R_inverse @ V), np.swapaxes(V, 1, 2) @ by_ties, rows
