"""The installation matrix from star and target vectors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from boresight.accepted import RotationLike, floats_of, listed, rotation_of, shown, wrong
from boresight.calib.estimate import InstallationEstimate, NotObservable
from boresight.calib.from_vectors import VectorCalibration, calibrate_vector_sets
from boresight.geometry.constants import ARCSEC
from boresight.geometry.ledger import Entry, Kind, Subject
from boresight.geometry.record import Floats, Ints
from boresight.geometry.vector_sets import VectorSets
from boresight.missions import Calibration
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.results.writing import blind_spots_json, verdict_json

__all__ = ["Sigmas", "Vectors", "calibrate_vectors"]

OneFrame: TypeAlias = Floats | pd.DataFrame | Sequence[Sequence[float]]
Vectors: TypeAlias = OneFrame | Iterable[OneFrame]  # of one frame, or one table a frame
Sigmas: TypeAlias = float | Floats | Sequence[float] | Sequence[Floats]

UNIT_LENGTH = 1e-6  # that a vector's length may be off 1: values printed with seven digits
NOISE_SIGMAS = 5.0  # or so many of its sigmas: noise added to three components changes the length, too
FARTHEST_DEG = 20.0  # of half the targets from where stars and R_cs0 put them: a wrong frame, no misalignment
LARGEST_SIGMA_RAD = 0.1  # beyond, errors are no small rotations
NEARER = 0.2  # of that angle: the reading by which it falls so far is the likely one


def calibrate_vectors(
    u_s: Vectors,
    v_stars: Vectors,
    sigma_s: Sigmas,
    w_c: Vectors,
    v_targets: Vectors,
    sigma_c: Sigmas,
    R_cs0: RotationLike,
) -> Calibration:
    """The installation matrix from star and target vectors of one frame or many; attitudes are not needed.

    A frame is one attitude; frames with the same stars are parts of one. Errors are isotropic and
    independent from vector to vector; for strips with errors of orbit, clock, vibration and distortion use
    `calibrate`. Rejection of wrong stars and targets, residuals, chi2, the verdict and what the vectors
    cannot show are by the same code as in `calibrate`: a frame needs three stars that agree. The six
    arguments are tables for one frame, or lists with one table a frame.

    Parameters
    ----------
    u_s : (N, 3) array, nested list or DataFrame, or list of them
        Measured unit vectors of stars, star-camera frame s. A vector whose length is off 1 by more than 1e-6
        and by more than five of its sigmas is an error.
    v_stars : (N, 3) array, nested list or DataFrame, or list of them
        Their apparent directions, GCRS; of length 1 to 1e-6.
    sigma_s : float, (N,) array, or list of them
        Their 1-sigma errors per axis, rad, above 0 and at most 0.1.
    w_c : (J, 3) array, nested list or DataFrame, or list of them
        Measured unit vectors of targets, remote-sensing-camera frame c.
    v_targets : (J, 3) array, nested list or DataFrame, or list of them
        Directions from the camera to the targets, GCRS.
    sigma_c : float, (J,) array, or list of them
        Their 1-sigma errors per axis, rad.
    R_cs0 : Rotation, or (3, 3) matrix
        Approximate installation matrix, s to c, good to 20 deg.

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
    start = rotation_of(R_cs0, "R_cs0")
    stars = _frames(("u_s", "v_stars", "sigma_s"), u_s, v_stars, sigma_s)
    targets = _frames(("w_c", "v_targets", "sigma_c"), w_c, v_targets, sigma_c)
    if len(stars[0]) != len(targets[0]):
        raise wrong("w_c", f"{len(targets[0]) - 1} frames", f"{len(stars[0]) - 1}, as many as u_s has")
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
    found = calibrate_vector_sets(vectors, start)
    if isinstance(found, NotObservable):
        raise DataNotSufficientError(_why_not(found))
    _check_frames(vectors, start, found)
    return _calibration(vectors, found)


def _calibration(vectors: VectorSets, found: VectorCalibration) -> Calibration:
    estimate = found.estimate
    stars = {strip.exposures[0].t_s: len(strip.exposures[0].hip) for strip in found.strips}  # by instant
    counts = (
        f"{estimate.n_exposures} of {len(stars)} frames with {estimate.n_stars} of {sum(stars.values())} "
        f"star vectors and {estimate.n_targets} of {len(vectors.w_c)} target vectors"
    )
    unused = [entry.row for entry in map(_of_frame, estimate.rejected)]
    return Calibration(
        R_cs=estimate.R_cs,
        theta=estimate.theta,
        cov_theta=estimate.cov_theta,
        chi2=estimate.chi2,
        dof=estimate.dof,
        counts=counts,
        targets=_target_table(estimate, vectors),
        stars=_star_table(found),
        not_used=pd.DataFrame(unused, columns=["kind", "name", "reason", "cause"]),
        facts={"verdict": verdict_json(found.verdict), "blind_spots": blind_spots_json(found.verdict)},
    )


def _of_frame(entry: Entry) -> Entry:
    """The entry of a target vector, which the estimate takes for a star, under its own name."""
    subject = entry.subject
    if subject.kind is not Kind.STAR or subject.exposure:
        return entry
    return replace(entry, subject=Subject(Kind.TARGET, id=subject.id))


def _why_not(found: NotObservable) -> str:
    """What the vectors lack, with the frames whose stars do not agree."""
    lost = [entry for entry in found.rejected if entry.subject.kind is Kind.EXPOSURE]
    if not lost:
        return found.reason.replace("strips", "frames")
    first = lost[0]
    n_good, n_all = first.more
    return (
        f"{len(lost)} frames have no attitude: of the {n_all:.0f} stars of frame {first.subject.name} "
        f"{n_good:.0f} agree within sigma_s, 3 are needed; check the pairs of u_s and v_stars, and sigma_s"
    )


def _target_table(estimate: InstallationEstimate, vectors: VectorSets) -> pd.DataFrame:
    found = estimate.targets
    number = np.concatenate([np.arange(n) for n in np.diff(vectors.target_start)])
    return pd.DataFrame(
        {
            "frame": found.strip_id.astype(int),
            "target": number,
            "residual_x_arcsec": found.residual_c[:, 0] / ARCSEC,
            "residual_y_arcsec": found.residual_c[:, 1] / ARCSEC,
            "statistic": found.statistic,
            "p_value": chdtrc(2, found.statistic),
            "kept": found.kept,
            "weight": found.weight,
            "detectable_arcsec": found.detectable_rad / ARCSEC,
        }
    )


def _star_table(found: VectorCalibration) -> pd.DataFrame:
    parts = []
    for strip in found.strips:
        attitudes, stars = strip.attitudes, strip.exposures[0]
        assert attitudes is not None
        residual = (stars.u_s - stars.u_i @ attitudes.R_si[0].T) / ARCSEC
        usable = attitudes.usable[0]
        columns = {
            "frame": int(strip.strip_id),
            "star": stars.hip,
            "residual_x_arcsec": residual[:, 0],
            "residual_y_arcsec": residual[:, 1],
            "statistic": attitudes.squared_mahalanobis,
            "p_value": chdtrc(2, attitudes.squared_mahalanobis),
            "kept": attitudes.kept & usable,
        }
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def _check_frames(vectors: VectorSets, R_cs0: Rotation, found: VectorCalibration) -> None:
    """`ValueError` where half of the targets are far from where their frame's stars and `R_cs0` put them,
    with the reading of the arguments that would bring them there.
    """
    usable = [strip.attitudes is not None and bool(strip.attitudes.usable[0]) for strip in found.strips]
    R_si = np.stack([strip.attitudes.R_si[0] for strip in found.strips if strip.attitudes is not None])
    counts = np.diff(vectors.target_start)
    rows, known = np.repeat(R_si, counts, axis=0), np.repeat(usable, counts)
    w, v = vectors.w_c[known], vectors.v_targets[known]
    v_s = np.einsum("jab,jb->ja", rows[known], v)

    def apart_deg(R_cs: Rotation, directions: Floats) -> float:
        return float(
            np.degrees(np.median(np.arccos(np.clip(np.sum(w * R_cs.apply(directions), axis=1), -1, 1))))
        )

    now = apart_deg(R_cs0, v_s)
    if now <= FARTHEST_DEG:
        return
    readings = (
        ("R_cs0 takes c to s: give its inverse", apart_deg(R_cs0.inv(), v_s)),
        ("v_targets point from the targets to the camera: give -v_targets", apart_deg(R_cs0, -v_s)),
        ("w_c is in frame s: give it in frame c", apart_deg(Rotation.identity(), v_s)),
        ("v_targets are in frame s: give them in GCRS", apart_deg(R_cs0, v)),
        ("v_targets are in frame c: give them in GCRS", apart_deg(Rotation.identity(), v)),
    )
    text, angle = min(readings, key=lambda one: one[1])
    likely = f"; {text}, it seems ({angle:.1f} deg)" if angle < NEARER * now else ""
    raise wrong(
        "v_targets",
        f"half of them {now:.0f} deg and more from w_c by the stars' attitudes and R_cs0",
        f"at most {FARTHEST_DEG:g} deg{likely}",
    )


def _frames(
    names: tuple[str, str, str], vectors: Any, known: Any, sigma: Any
) -> tuple[Ints, Floats, Floats, Floats]:
    """Start of each frame (K + 1,), and its vectors, known directions and sigmas, one after another."""
    (name, of_known, of_sigma), one = names, _is_one_frame(vectors)
    parts, directions = (_tables(part, of, one) for part, of in ((vectors, name), (known, of_known)))
    if len(parts) != len(directions):
        raise wrong(of_known, f"{len(directions)} frames", f"{len(parts)}, as many as {name} has")
    for k, (a, b) in enumerate(zip(parts, directions)):
        if len(a) != len(b):
            at = "" if one else f" of frame {k}"
            raise wrong(f"{of_known}{at}", f"{len(b)} vectors", f"{len(a)}, one for each of {name}")
    sigmas = _sigmas(sigma, of_sigma, [len(part) for part in parts], one)
    start = np.cumsum([0, *(len(part) for part in parts)]).astype(np.int64)
    u, v, s = np.vstack(parts), np.vstack(directions), np.concatenate(sigmas)
    u, v = _unit(u, name, start, NOISE_SIGMAS * s), _unit(v, of_known, start, np.zeros(len(v)))
    _check_each_once(u, name, start)
    return start, u, v, s


def _is_one_frame(value: Any) -> bool:
    """Whether a table of vectors is given, and not a list of such tables."""
    if isinstance(value, pd.DataFrame):
        return True
    if isinstance(value, np.ndarray):
        return value.ndim == 2
    if not isinstance(value, Sequence) or not len(value):
        return False
    return not isinstance(value[0], pd.DataFrame) and np.ndim(_or_zero(value[0])) == 1


def _or_zero(value: Any) -> Any:
    """The value, or 0 for what is no regular array."""
    try:
        return 0.0 if np.iscomplexobj(value) else np.asarray(value, dtype=float)
    except Exception:  # of ragged lists, texts, foreign classes
        return 0.0


def _tables(value: Any, name: str, one: bool) -> list[Floats]:
    """One array (N, 3) a frame."""
    if isinstance(value, str | bytes | dict) or not (one or isinstance(value, Iterable)):
        raise wrong(name, value, "vectors of shape (N, 3), or a list with one such table a frame")
    parts = [value] if one else listed(value, name, "tables of vectors")
    if not parts:
        raise wrong(name, "no frames", "at least one")
    tables = []
    for k, part in enumerate(parts):
        at = name if one else f"{name} of frame {k}"
        table = floats_of(part, at, "(N, 3)")
        if table.ndim != 2 or table.shape[1] != 3:
            raise wrong(at, f"shape {table.shape}", "(N, 3), one unit vector a row")
        if not np.isfinite(table).all():
            row = int(np.flatnonzero(~np.isfinite(table).all(axis=1))[0])
            raise wrong(f"{at}, row {row}", table[row].tolist(), "finite numbers")
        tables.append(table)
    if not sum(map(len, tables)):
        raise wrong(name, "no vectors", "at least one")
    return tables


def _sigmas(value: Any, name: str, counts: Sequence[int], one: bool) -> list[Floats]:
    """1-sigma errors (N,) of each frame, from a number, one a frame, or one a vector."""
    whole = not isinstance(value, Iterable) or np.ndim(_or_zero(value)) == 0
    given = [value] * len(counts) if whole else [value] if one else listed(value, name, "standard errors")
    if len(given) != len(counts):
        raise wrong(name, f"{len(given)} frames", f"a number, or one entry for each of {len(counts)} frames")
    sigmas = []
    for k, (part, n) in enumerate(zip(given, counts)):
        at = name if one or whole else f"{name} of frame {k}"
        sigma = floats_of(part, at, f"(), or ({n},)")
        if sigma.shape not in ((), (n,)):
            raise wrong(at, f"shape {sigma.shape}", f"a number or shape ({n},)")
        bad = ~((sigma > 0.0) & (sigma <= LARGEST_SIGMA_RAD))
        if bad.any():
            found = float(np.atleast_1d(sigma)[np.atleast_1d(bad)][0])
            raise wrong(at, found, f"1-sigma errors above 0 and up to {LARGEST_SIGMA_RAD:g} rad")
        sigmas.append(np.broadcast_to(sigma, n))
    return sigmas


def _unit(v: Floats, name: str, start: Ints, noise: Floats) -> Floats:
    """The vectors (N, 3) at length 1; `ValueError` where a length is off by more than the tolerance."""
    length = np.linalg.norm(v, axis=1)
    off = np.abs(length - 1.0)
    bad = np.flatnonzero(off > np.maximum(UNIT_LENGTH, noise))
    if len(bad):
        row = int(bad[np.argmax(off[bad])])
        k = int(np.searchsorted(start, row, side="right")) - 1
        allowed = max(UNIT_LENGTH, float(noise[row]))
        raise wrong(
            f"{name}, row {row - start[k]}" + (f" of frame {k}" if len(start) > 2 else ""),
            f"a vector of length {length[row]:.8g}",
            f"unit vectors, to {allowed:.1e}",
        )
    return np.asarray(v / length[:, None])


def _check_each_once(u: Floats, name: str, start: Ints) -> None:
    """`ValueError` where a frame has one measurement twice: it would count as two."""
    frame = np.repeat(np.arange(len(start) - 1), np.diff(start))
    _, first, count = np.unique(np.column_stack([frame, u]), axis=0, return_index=True, return_counts=True)
    if (count > 1).any():
        row = int(first[count > 1].min())
        k = int(frame[row])
        other = next(n for n in chain(range(row + 1, int(start[k + 1]))) if np.array_equal(u[n], u[row]))
        rows = f"rows {row - start[k]} and {other - start[k]}"
        raise wrong(f"{name}, {rows} of frame {k}", f"equal vectors {shown(u[row].tolist())}", "each once")
