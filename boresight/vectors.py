"""The installation matrix from star and target vectors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from boresight.calib.frames import calibrate_frames
from boresight.geometry.installation import theta_between
from boresight.geometry.record import Floats, Ints
from boresight.geometry.vector_sets import VectorSets
from boresight.missions import Calibration
from boresight.pipeline.errors import DataNotSufficientError

__all__ = ["calibrate_vectors"]

Vectors = Floats | Sequence[Floats]  # of one frame, or one array a frame
Sigmas = float | Floats | Sequence[float] | Sequence[Floats]


def calibrate_vectors(
    u_s: Vectors,
    v_stars: Vectors,
    sigma_s: Sigmas,
    w_c: Vectors,
    v_targets: Vectors,
    sigma_c: Sigmas,
    R_cs0: Rotation,
) -> Calibration:
    """The installation matrix from star and target vectors of one frame or many; attitudes are not needed.

    A frame is one attitude. Errors are isotropic and independent from vector to vector; for strips with
    errors of orbit, clock, vibration and distortion use `calibrate`. All six arguments are arrays for one
    frame, or lists with one array a frame.

    Parameters
    ----------
    u_s : (N, 3) array, or list of them
        Measured unit vectors of stars, star-camera frame s.
    v_stars : (N, 3) array, or list of them
        Their apparent directions, GCRS.
    sigma_s : float, (N,) array, or list of them
        Their 1-sigma errors per axis, rad.
    w_c : (J, 3) array, or list of them
        Measured unit vectors of targets, remote-sensing-camera frame c.
    v_targets : (J, 3) array, or list of them
        Directions from the camera to the targets, GCRS.
    sigma_c : float, (J,) array, or list of them
        Their 1-sigma errors per axis, rad.
    R_cs0 : Rotation
        Approximate installation matrix, s to c.

    Returns
    -------
    Calibration
        `R_cs` and `cov_theta` (3, 3), rad², axes of c.

    Raises
    ------
    ValueError
        If shapes do not agree or the iteration does not converge.
    DataNotSufficientError
        If the vectors do not determine all three angles.

    Examples
    --------
    >>> import boresight as bs, numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> R_cs = Rotation.from_euler("xyz", [150, 10, 30], degrees=True)
    >>> stars = np.array([[0.1, 0.1, 1], [-0.1, 0.1, 1], [0.0, -0.1, 1]]); stars /= np.linalg.norm(stars[0])
    >>> ground = np.array([[0.01, 0, 1], [-0.01, 0.01, 1]]); ground /= np.linalg.norm(ground, axis=1)[:, None]
    >>> stars /= np.linalg.norm(stars, axis=1)[:, None]
    >>> est = bs.calibrate_vectors(stars, stars, 1e-6, ground, R_cs.inv().apply(ground), 1e-6, R_cs)
    >>> bool(est.sigma_arcsec[2] > est.sigma_arcsec[0])
    True
    """
    stars, targets = _frames("u_s", u_s, v_stars, sigma_s), _frames("w_c", w_c, v_targets, sigma_c)
    vectors = VectorSets(
        star_start=stars[0],
        u_s=stars[1],
        v_stars=stars[2],
        sigma_s=stars[3],
        target_start=targets[0],
        w_c=targets[1],
        v_targets=targets[2],
        sigma_c=targets[3],
    )
    found = calibrate_frames(vectors, R_cs0)
    if len(found.solution.unobservable):
        raise DataNotSufficientError(
            f"rotations about {found.solution.unobservable} (frame c) are not observable"
        )
    frames, n_stars, n_targets = len(stars[0]) - 1, int(stars[0][-1]), int(targets[0][-1])
    return Calibration(
        R_cs=found.R_cs,
        theta=theta_between(found.R_cs, R_cs0),
        cov_theta=found.solution.covariance,
        counts=f"{frames} frames with {n_stars} star vectors and {n_targets} target vectors",
        targets=pd.DataFrame(),
    )


def _frames(
    name: str, vectors: Vectors, known: Vectors, sigma: Sigmas
) -> tuple[Ints, Floats, Floats, Floats]:
    """Start of each frame (K + 1,), and its vectors, known directions and sigmas, one after another."""
    one = isinstance(vectors, np.ndarray) and vectors.ndim == 2
    parts = [np.asarray(v, dtype=float) for v in ([vectors] if one else vectors)]
    directions = [np.asarray(v, dtype=float) for v in ([known] if one else known)]
    sigmas = [sigma] * len(parts) if one or isinstance(sigma, float | int) else list(sigma)
    shapes = [part.shape for part in parts]
    if shapes != [part.shape for part in directions] or any(shape[1:] != (3,) for shape in shapes):
        found = f"{shapes}, {[part.shape for part in directions]}"
        raise ValueError(f"{name} and its known directions must be (N, 3) in each frame, got {found}")
    if len(sigmas) != len(parts):
        raise ValueError(f"sigma of {name}: {len(sigmas)} given for {len(parts)} frames")
    start = np.cumsum([0, *(len(part) for part in parts)])
    errors = [np.broadcast_to(np.asarray(s, dtype=float), len(part)) for s, part in zip(sigmas, parts)]
    return start.astype(np.int64), np.vstack(parts), np.vstack(directions), np.concatenate(errors)
