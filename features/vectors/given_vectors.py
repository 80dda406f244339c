"""Vectors of frames as a caller gives them, in any form of arrays, as `VectorSets`.

Refused is what would be wrong without a trace: measurements that are given twice, and directions tens of
degrees from where the other arguments place them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from boresight.accepted import floats_of, is_symmetric, listed, shown, wrong
from boresight.features.vectors.target_places import SeenPlaces, seen_places
from boresight.features.vectors.vector_estimate import VectorCalibration
from boresight.geometry.orbit import Orbit
from boresight.geometry.sightings import VectorSets
from boresight.records.record import Floats, Ints

__all__ = ["check_directions", "information_of_start", "vector_sets"]

Parts: TypeAlias = list[Floats]  # one array a frame

UNIT_LENGTH = 1e-6  # that a vector's length may be off 1: values printed with seven digits
NOISE_SIGMAS = 5.0  # or so many of its sigmas: noise added to three components changes the length, too
FARTHEST_DEG = 20.0  # R_cs0 about each axis, and of half the targets from where stars and R_cs0 put them
SIGMA_RAD = (1e-10, 0.1)  # beyond, errors are no small rotations; below, sums of squares round them away
NEARER = 0.2  # of that angle: the reading by which it falls so far is the likely one
SAME_SIGMAS, SAME_RAD = 0.01, 1e-8  # two measurements, and known directions, that are nearer are one
FIXED_RAD = 1e-9  # to which an axis of 1-sigma 0 is held: 0.0002 arcsec


def vector_sets(
    stars: tuple[Any, Any, Any], targets: tuple[Any, Any, Any], instants: Any, orbit: Orbit | None
) -> VectorSets:
    """Vectors, known directions and errors of stars and of targets, whose directions may be `places` that
    the satellite sees from its `orbit`.
    """
    start_s, u, v, sigma_s, cov_s = _frames(("u_s", "v_stars", "sigma_s"), *stars)
    places, parts = None, targets[1]
    if orbit is not None:
        parts = [targets[1]] if _is_table(targets[1]) else listed(targets[1], "v_targets", "tables")
        seen = [seen_places(part, f"v_targets of frame {k}", orbit) for k, part in enumerate(parts)]
        places, parts = SeenPlaces.together(seen), [one.u_i for one in seen]
        parts = parts[0] if _is_one_frame(targets[0]) and len(parts) == 1 else parts
    elif _is_table(parts) or (isinstance(parts, Sequence) and any(map(_is_table, parts))):
        raise wrong("orbit", None, "states of the satellite: v_targets are places on the ground")
    start_c, w, v_targets, sigma_c, cov_c = _frames(
        ("w_c", "v_targets", "sigma_c"), targets[0], parts, targets[2]
    )
    if len(start_s) != len(start_c):
        raise wrong("w_c", f"{len(start_c) - 1} frames", f"{len(start_s) - 1}, as many as u_s has")
    sets = VectorSets(
        star_start=start_s,
        u_s=u,
        v_stars=v,
        sigma_s=sigma_s,
        cov_s=cov_s,
        target_start=start_c,
        w_c=w,
        v_targets=v_targets,
        sigma_c=sigma_c,
        cov_c=cov_c,
        instant=None if instants is None else _numbered(instants, len(start_s) - 1),
        target_id=None if places is None else places.place,
        cov_targets=None if places is None else places.covariance,
    )
    _check_each_once("u_s", u, v, sigma_s, start_s, may_repeat=True)
    _check_each_once("w_c", w, v_targets, sigma_c, start_c, may_repeat=False)
    return sets


def information_of_start(sigma: Any) -> Floats | None:
    """Information (3, 3), rad⁻², of 1-sigma errors of R_cs0 about the axes of c, or of their covariance."""
    if sigma is None:
        return None
    name, expected = "sigma_R_cs0_rad", "1-sigma errors, 0 to pi or infinite, or a positive covariance (3, 3)"
    given = floats_of(sigma, name, "(), (3,) or (3, 3)")
    if given.shape == (3, 3):
        if not (is_symmetric(given) and np.linalg.eigvalsh(given)[0] > 0.0):
            raise wrong(name, sigma, expected)
        return np.asarray(np.linalg.inv(given))
    inside = ((given >= 0.0) & (given <= np.pi)) | np.isposinf(given)
    if given.shape not in ((), (3,)) or not inside.all():
        raise wrong(name, sigma, expected)
    return np.diag(np.maximum(np.broadcast_to(given, 3), FIXED_RAD) ** -2.0)


def check_directions(vectors: VectorSets, R_cs0: Rotation, found: VectorCalibration) -> None:
    """`ValueError` where half of the targets are far from where their frame's stars and `R_cs0` put them, or
    the estimate from `R_cs0`, with the reading of the arguments that explains it.
    """
    usable = [strip.attitudes is not None and bool(strip.attitudes.usable[0]) for strip in found.strips]
    R_si = np.stack([strip.attitudes.R_si[0] for strip in found.strips if strip.attitudes is not None])
    counts = np.diff(vectors.target_start)
    counts = counts[counts > 0]  # frames without targets are no strips
    rows, known = np.repeat(R_si, counts, axis=0), np.repeat(usable, counts)
    w, v = vectors.w_c[known], vectors.v_targets[known]
    v_s = np.einsum("jab,jb->ja", rows[known], v)

    def apart_deg(R_cs: Rotation, directions: Floats) -> float:
        cosine = np.sum(w * R_cs.apply(directions), axis=1)
        return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))

    if (now := apart_deg(R_cs0, v_s)) > FARTHEST_DEG:
        readings = (
            ("R_cs0 takes c to s: give its inverse", apart_deg(R_cs0.inv(), v_s)),
            ("v_targets point from the targets to the camera: give -v_targets", apart_deg(R_cs0, -v_s)),
            ("w_c is in frame s: give it in frame c", apart_deg(Rotation.identity(), v_s)),
            ("v_targets are in frame s: give them in GCRS", apart_deg(R_cs0, v)),
            ("v_targets are in frame c: give them in GCRS", apart_deg(Rotation.identity(), v)),
        )
        text, angle = min(readings, key=lambda one: one[1])
        likely = f"; {text}, it seems ({angle:.1f} deg)" if angle < NEARER * now else ""
        what = f"half of them {now:.0f} deg and more from w_c by the stars' attitudes and R_cs0"
        raise wrong("v_targets", what, f"at most {FARTHEST_DEG:g} deg{likely}")
    turn_deg = np.degrees(found.estimate.theta)
    axis = int(np.argmax(np.abs(turn_deg)))
    if abs(turn_deg[axis]) > FARTHEST_DEG:
        flipped = axis == 2 and abs(turn_deg[2]) > 180.0 - FARTHEST_DEG
        raise wrong(
            "R_cs0",
            f"a matrix {abs(turn_deg[axis]):.0f} deg about {'xyz'[axis]} of c from that of the vectors",
            f"at most {FARTHEST_DEG:g} deg; check signs and order of x and y of w_c"
            + (": both have the opposite sign, it seems" if flipped else ", and R_cs0"),
        )


def _is_table(value: Any) -> bool:
    """Whether places on the ground are given: a DataFrame with latitudes, or mappings."""
    if isinstance(value, pd.DataFrame):
        return "lat_deg" in value.columns or hasattr(value, "to_crs")
    return isinstance(value, Sequence) and len(value) > 0 and isinstance(value[0], Mapping)


def _numbered(instants: Any, n: int) -> Ints:
    """A whole number (K,) for each frame, equal where the labels of their instants are."""
    labels = listed(instants, "instants", "labels of the frames' instants")
    missing = (not isinstance(one, Hashable) or one is None or one is pd.NA or one != one for one in labels)
    if len(labels) != n or any(missing):
        raise wrong("instants", instants, f"{n} labels, one for each frame")
    number: dict[Hashable, int] = {}
    return np.array([number.setdefault(one, len(number)) for one in labels], dtype=np.int64)


def _frames(
    names: tuple[str, str, str], vectors: Any, known: Any, sigma: Any
) -> tuple[Ints, Floats, Floats, Floats, Floats | None]:
    """Start of each frame (K + 1,), and its vectors, known directions, sigmas and covariances."""
    (name, of_known, of_sigma), one = names, _is_one_frame(vectors)
    parts, directions = (_tables(part, of, one) for part, of in ((vectors, name), (known, of_known)))
    if len(parts) != len(directions):
        raise wrong(of_known, f"{len(directions)} frames", f"{len(parts)}, as many as {name} has")
    for k, (a, b) in enumerate(zip(parts, directions)):
        if len(a) != len(b):
            at = "" if one else f" of frame {k}"
            raise wrong(f"{of_known}{at}", f"{len(b)} vectors", f"{len(a)}, one for each of {name}")
    start = np.cumsum([0, *(len(part) for part in parts)]).astype(np.int64)
    u, v = np.vstack(parts), np.vstack(directions)
    s, covariance = _errors(sigma, of_sigma, [len(part) for part in parts], one)
    u, v = _unit(u, name, start, NOISE_SIGMAS * s), _unit(v, of_known, start, np.zeros(len(v)))
    if covariance is not None:  # what a direction has of it
        across = np.eye(3) - u[:, :, None] * u[:, None, :]
        covariance = across @ covariance @ across
    return start, u, v, s, covariance


def _is_one_frame(value: Any) -> bool:
    """Whether a table of vectors is given, and not a list of such tables."""
    if isinstance(dimensions := getattr(value, "ndim", None), int):  # also of xarray and dask
        return dimensions == 2
    if not isinstance(value, Sequence) or isinstance(value, str | bytes) or not len(value):
        return False
    return _dimensions(value[0]) == 1


def _dimensions(value: Any) -> int:
    """Dimensions of numbers; 0 of a number and of what is no regular array."""
    try:
        return 0 if isinstance(value, Iterator) else int(np.ndim(value))
    except Exception:  # of ragged lists and foreign classes
        return 0 if not isinstance(value, Iterable) else -1


def _tables(value: Any, name: str, one: bool) -> Parts:
    """One array (N, 3) a frame."""
    if isinstance(value, str | bytes | dict) or not (one or isinstance(value, Iterable)):
        raise wrong(name, value, "vectors of shape (N, 3), or a list with one such table a frame")
    parts = [value] if one else listed(value, name, "tables of vectors")
    if not parts:
        raise wrong(name, "no frames", "at least one")
    tables = []
    for k, part in enumerate(parts):
        at = name if one else f"{name} of frame {k}"
        table = floats_of(part, at, "(N, 3)", unit="")
        table = table.reshape(0, 3) if table.size == 0 and table.ndim < 3 else table
        if table.ndim != 2 or table.shape[1] != 3:
            raise wrong(at, f"shape {table.shape}", "(N, 3), one unit vector a row")
        if not np.isfinite(table).all():
            row = int(np.flatnonzero(~np.isfinite(table).all(axis=1))[0])
            raise wrong(f"{at}, row {row}", table[row].tolist(), "finite numbers")
        tables.append(table)
    if not sum(map(len, tables)):
        raise wrong(name, "no vectors", "at least one")
    return tables


def _errors(value: Any, name: str, counts: Sequence[int], one: bool) -> tuple[Floats, Floats | None]:
    """1-sigma errors (N,) of all vectors, and where any is given their covariances (N, 3, 3), from a number,
    one a frame, or one a vector.
    """
    whole = not isinstance(value, Iterator) and _dimensions(value) == 0
    given = [value] * len(counts) if whole else [value] if one else listed(value, name, "standard errors")
    if len(given) != len(counts):
        raise wrong(name, f"{len(given)} frames", f"a number, or one entry for each of {len(counts)} frames")
    sigmas, covariances = [], []
    for k, (part, n) in enumerate(zip(given, counts)):
        at = name if one or whole else f"{name} of frame {k}"
        errors = floats_of(part, at, f"(), ({n},) or covariances ({n}, 3, 3)", unit="rad")
        if errors.shape not in ((), (n,), (n, 3, 3)):
            raise wrong(at, f"shape {errors.shape}", f"a number or shape ({n},), or covariances ({n}, 3, 3)")
        if errors.ndim == 3 and not is_symmetric(errors):
            raise wrong(at, errors, "covariances, symmetric and finite, rad²")
        full = errors.ndim == 3
        axes = np.linalg.eigvalsh(errors)[:, 1:] if full else np.broadcast_to(errors, n)
        axes = np.copysign(np.sqrt(np.abs(axes)), axes) if full else axes  # below 0 of what is no covariance
        if (bad := ~((axes >= SIGMA_RAD[0]) & (axes <= SIGMA_RAD[1]))).any():
            expected = "1-sigma errors above 0, from {:g} to {:g} rad".format(*SIGMA_RAD)
            raise wrong(at, float(axes[bad][0]), expected + ", across the vectors" * full)
        sigmas.append(axes.max(axis=1) if full else axes)
        covariances.append((full, errors if full else axes[..., None, None] ** 2 * np.eye(3)))
    some = any(stated for stated, _ in covariances)
    return np.concatenate(sigmas), np.concatenate([one for _, one in covariances]) if some else None


def _unit(v: Floats, name: str, start: Ints, noise: Floats) -> Floats:
    """The vectors (N, 3) at length 1; `ValueError` where a length is off by more than the tolerance."""
    length = np.linalg.norm(v, axis=1)
    off = np.abs(length - 1.0)
    bad = np.flatnonzero(off > np.maximum(UNIT_LENGTH, noise))
    if len(bad):
        row = int(bad[np.argmax(off[bad])])
        allowed = max(UNIT_LENGTH, float(noise[row]))
        found = f"a vector of length {length[row]:.8g}"
        raise wrong(f"{name}, {_place(row, start)}", found, f"unit vectors, to {allowed:.1e}")
    return np.asarray(v / length[:, None])


def _place(row: int, start: Ints) -> str:
    k = int(np.searchsorted(start, row, side="right")) - 1
    return f"row {row - start[k]}" + (f" of frame {k}" if len(start) > 2 else "")


def _check_each_once(
    name: str, u: Floats, v: Floats, sigma: Floats, start: Ints, *, may_repeat: bool
) -> None:
    """`ValueError` where a measurement is given twice, or all of a frame: it would count as two. Frames of
    one attitude may list the very same ones, where they `may_repeat`.
    """
    near = KDTree(u).query_pairs(SAME_SIGMAS * float(np.median(sigma)), output_type="ndarray")
    frame = np.repeat(np.arange(len(start) - 1), np.diff(start))
    a, b = frame[near].T
    if (a == b).any():
        rows = min(near[a == b].tolist())
        k = int(frame[rows[0]])
        at = f"{name}, rows {rows[0] - start[k]} and {rows[1] - start[k]} of frame {k}"
        raise wrong(at, f"equal vectors {shown(u[rows[0]].tolist())}", "each once")
    first, second = near.T
    again = np.linalg.norm(v[first] - v[second], axis=1) < SAME_RAD
    if may_repeat:
        again &= np.any(u[first] != u[second], axis=1)
    for (k, other), n in sorted(Counter(zip(a[again].tolist(), b[again].tolist())).items()):
        if n == min(np.diff(start)[[k, other]]):
            raise wrong(name, f"frames {k} and {other} with equal vectors", "each frame once")
