"""Nine of the paper's ten steps, literally: one frame of vectors to (F, F theta) through the SVD of B
(section 2.3, appendix B).

This is the reference that the fast forms are held to. Frames: star vectors `u_s` in s, targets `w_c` in c,
their known directions `v_stars`, `v_targets` in i; one attitude for the whole frame. Sign of H: the paper
prints -(W° x W) in (20), (21) and (A9); under its own (12), (13) and (19) the coefficient of theta is **+(W°
x W)**.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def frame_information_literally(
    u_s: Array, v_stars: Array, sigma_s: Array, w_c: Array, v_targets: Array, sigma_c: Array, R_cs0: Rotation
) -> tuple[Array, Array]:
    """Steps 1 to 9 for one frame: F (3, 3) rad⁻² and F theta (3,) of (A13), about `R_cs0`.

    `u_s`, `v_stars` (n_s, 3), `w_c`, `v_targets` (n_c, 3) unit vectors; `sigma_s` (n_s,), `sigma_c` (n_c,)
    rad per axis (QUEST model, A14). LAPACK's gesvd is asked for: the default gesdd has failed to converge on
    such matrices.
    """
    n_s, n_c = len(u_s), len(w_c)
    w_o = R_cs0.apply(u_s)  # step 1, (18)
    z = (w_o @ w_c.T - v_stars @ v_targets.T).ravel()  # steps 2 and 3, (21), (23)
    cross = np.cross(w_o[:, None, :], w_c[None, :, :])  # (n_s, n_c, 3)
    H = cross.reshape(-1, 3)  # step 4, (21) with the sign of its own (19)
    # Steps 5 and 6: G = sigma [[W]], so B's blocks are sigma (W° x W), (A9).
    B = np.zeros((n_s, n_c, n_s + n_c, 3))
    stars, targets = np.arange(n_s), np.arange(n_c)
    B[stars, :, stars] = sigma_s[:, None, None] * cross
    B[:, targets, n_s + targets] = -sigma_c[:, None] * cross
    U, S, _ = scipy.linalg.svd(
        B.reshape(n_s * n_c, -1),
        full_matrices=False,
        overwrite_a=True,
        check_finite=False,
        lapack_driver="gesvd",
    )
    l_max = min(int(np.count_nonzero(S > 1e-9 * S[0])), 2 * n_s + 2 * n_c - 3)  # appendix B.1
    zeta, C = U.T @ z, U.T @ H  # step 7, (A11)
    zeta, C, S = zeta[:l_max], C[:l_max], S[:l_max]  # step 8
    weighted = C / S[:, None] ** 2
    return weighted.T @ C, weighted.T @ zeta  # step 9, (A13)
