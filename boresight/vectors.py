"""The installation matrix from star and target vectors."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from functools import partial
from typing import TypeAlias

import pandas as pd
from numpy.typing import ArrayLike

from boresight.accepted import Progress, RotationLike, Table, no_progress, progress_of, rotation_of
from boresight.calib.estimate import NotObservable
from boresight.features.vectors import given_vectors, vector_result
from boresight.features.vectors.target_places import orbit_of_states
from boresight.features.vectors.vector_estimate import calibrate_vector_sets
from boresight.missions import UNUSED, Calibration
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.results.folder import ScratchFolder
from boresight.records.record import Floats

__all__ = ["Sigmas", "Vectors", "calibrate_vectors"]

OneFrame: TypeAlias = Floats | pd.DataFrame | Sequence[Sequence[float]]
Vectors: TypeAlias = OneFrame | Iterable[OneFrame]  # of one frame, or one table a frame
Sigmas: TypeAlias = float | Floats | Sequence[float] | Sequence[Floats]


def calibrate_vectors(
    u_s: Vectors,
    v_stars: Vectors,
    sigma_s: Sigmas,
    w_c: Vectors,
    v_targets: Vectors | Table | Iterable[Table],
    sigma_c: Sigmas,
    R_cs0: RotationLike,
    *,
    sigma_R_cs0_rad: ArrayLike | None = None,
    instants: Sequence[Hashable] | None = None,
    orbit: Table | None = None,
    orbit_frame: str = "ITRF",
    progress: Progress = no_progress,
) -> Calibration:
    """The installation matrix from star and target vectors of one frame or many; attitudes are not needed.

    A frame is one attitude; frames of one instant, or with the same stars, are parts of one. Errors are
    independent from vector to vector; for strips with errors of orbit, clock, vibration and distortion use
    `calibrate`. Rejection of wrong stars and targets, residuals, chi2, the verdict and what the vectors
    cannot show are by the same code as in `calibrate`: a frame needs three stars that agree. The first six
    arguments are tables for one frame, or lists with one table a frame. A Quantity of astropy is converted.

    Parameters
    ----------
    u_s : (N, 3) array, nested list or DataFrame, or list of them
        Measured unit vectors of stars, star-camera frame s. A vector whose length is off 1 by more than 1e-6
        and by more than five of its sigmas is an error.
    v_stars : (N, 3) array, nested list or DataFrame, or list of them
        Their apparent directions, GCRS: with the aberration by the satellite's velocity about the Sun, 20
        arcsec by the Earth's and 5 by its own; of length 1 to 1e-6.
    sigma_s : float, (N,) or (N, 3, 3) array, or list of them
        Their 1-sigma errors per axis, rad, from 1e-10 to 0.1; or their covariances, frame s, rad².
    w_c : (J, 3) array, nested list or DataFrame, or list of them
        Measured unit vectors of targets, remote-sensing-camera frame c. A frame may have none.
    v_targets : (J, 3) array, nested list or DataFrame, or list of them; or table, or list of tables
        Apparent directions from the camera to the targets, GCRS, at the instant of the frame's stars: with
        light time and the aberration by the satellite's geocentric velocity, 5 arcsec. With `orbit`: rows of
        lat_deg, lon_deg, height_m, time and, unless they are exact, sigma_east_m, sigma_north_m, sigma_up_m,
        from which the directions are computed; height_kind "egm96" for heights above the geoid. A place that
        several frames list has one error. A GeoDataFrame of points needs no columns of the place.
    sigma_c : float, (J,) or (J, 3, 3) array, or list of them
        Their 1-sigma errors per axis, rad, or covariances, frame c.
    R_cs0 : Rotation, or (3, 3) matrix
        Approximate installation matrix, s to c, good to 20 deg about each axis.
    sigma_R_cs0_rad : float, (3,) or (3, 3) array, optional
        1-sigma of its error about the axes of c, rad, or the covariance, as prior knowledge. An axis of 0 is
        held; one that is infinite, and all by default, are free.
    instants : sequence, optional
        A label for each frame, its time, say: frames of equal labels have one attitude.
    orbit : table, optional
        At least 8 states of the satellite: time, x_m, y_m, z_m, vx_m_s, vy_m_s, vz_m_s.
    orbit_frame : str
        "ITRF" (velocities relative to the rotating Earth), "GCRF" or "EME2000".
    progress : callable, optional
        Called with the stage, the tasks done and all tasks; default: a bar in a notebook, else nothing.

    Returns
    -------
    Calibration
        `R_cs` and `cov_theta` (3, 3), rad², axes of c; `verdict`, `residuals()`, `checks`, `blind_spots`.
        Stars and targets are numbered from 0 within their frame. The verdict `refuted` means: do not use.

    Raises
    ------
    ValueError
        If an argument is not as described; the message says which, what was found and what is expected.
    DataNotSufficientError
        If the vectors do not determine all three angles, or no three stars of any frame agree.

    Examples
    --------
    >>> import boresight as bs, numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> R_cs = Rotation.from_euler("xyz", [150, 10, 30], degrees=True)
    >>> stars = np.array([[0.1, 0.1, 1], [-0.1, 0.1, 1], [0.0, -0.1, 1], [0.1, -0.1, 1]])
    >>> stars /= np.linalg.norm(stars, axis=1, keepdims=True)
    >>> ground = np.array([[0.01, 0, 1], [-0.01, 0.01, 1], [0.0, -0.01, 1], [-0.01, -0.01, 1]])
    >>> ground /= np.linalg.norm(ground, axis=1, keepdims=True)
    >>> est = bs.calibrate_vectors(stars, stars, 1e-6, ground, R_cs.inv().apply(ground), 1e-6, R_cs)
    >>> est.verdict, bool(est.sigma_arcsec[2] > est.sigma_arcsec[0])
    ('consistent', True)
    """
    told = progress_of(progress)
    start, prior = rotation_of(R_cs0, "R_cs0"), given_vectors.information_of_start(sigma_R_cs0_rad)
    states = None
    if orbit is not None:
        from boresight.array_dump import orbit_text  # loads rasterio

        states = orbit_of_states(orbit_text("vectors", orbit_frame, orbit))
    stars, targets = (u_s, v_stars, sigma_s), (w_c, v_targets, sigma_c)
    vectors = given_vectors.vector_sets(stars, targets, instants, states)
    told("vectors", 0, 1)
    found = calibrate_vector_sets(vectors, start, prior)
    told("vectors", 1, 1)
    if isinstance(found, NotObservable):
        raise DataNotSufficientError(vector_result.why_not(found, vectors))
    given_vectors.check_directions(vectors, start, found)
    facts, tables = vector_result.vector_facts(vectors, found), vector_result.vector_tables(vectors, found)
    estimate = found.estimate
    return Calibration(
        R_cs=estimate.R_cs,
        theta=estimate.theta,
        cov_theta=estimate.cov_theta,
        chi2=estimate.chi2,
        dof=estimate.dof,
        counts=facts["counts"],
        targets=tables["targets"],
        stars=tables["stars"],
        not_used=tables["ledger"][UNUSED],
        facts=facts,
        _scratch=ScratchFolder(
            partial(vector_result.write_vector_result, found=found, facts=facts, tables=tables)
        ),
    )
