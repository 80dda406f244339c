"""Lists of centroids as other programs hand them over, arrays or tables, as lists of stars."""

from __future__ import annotations

import numbers
from collections.abc import Iterable
from typing import TypeGuard

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from boresight.accepted import floats_of, is_symmetric, wrong
from boresight.records.record import Floats
from boresight.star_id.centroids import Centroids
from boresight.star_id.finding.star_list import StarList

__all__ = ["are_centroids", "star_list_of"]

# Error of a centroid, px, 1 sigma an axis, where none is stated: of faint stars, and of programs that take
# the centre of light (set by hand).
UNSTATED_PX = 0.2
# Width of the PSF, px, where nothing is known of it: nearer neighbours displace a star.
USUAL_PSF_PX = 1.2


def are_centroids(given: object) -> TypeGuard[NDArray[np.generic] | pd.DataFrame]:
    """Whether an argument is a table, or an array or list (N, 2): no image is two pixels wide."""
    first = given[0] if isinstance(given, list) and given else None
    shape = (1, len(first)) if isinstance(first, list | tuple) else getattr(given, "shape", None)
    return isinstance(given, pd.DataFrame) or (shape is not None and len(shape) == 2 and shape[1] == 2)


def star_list_of(
    xy_px: ArrayLike | pd.DataFrame,
    size_px: tuple[int, int],
    *,
    sigma_px: ArrayLike | None = None,
    cov_px: ArrayLike | None = None,
    flux_dn: ArrayLike | None = None,
) -> StarList:
    """The stars, brightest first; arguments as of `Stars.of_centroids`."""
    sides = list(size_px) if isinstance(size_px, Iterable) else []
    if len(sides) != 2 or not all(isinstance(side, numbers.Integral) and side > 0 for side in sides):
        raise wrong("size_px", size_px, "(width, height) in whole pixels")
    snr = None
    if isinstance(xy_px, pd.DataFrame):
        table = xy_px
        if missing := {"x_px", "y_px", *(["sigma_y_px"] if "sigma_x_px" in table else [])} - set(table):
            columns = ", ".join(map(str, table))
            raise wrong("xy_px", f"a table with the columns {columns}", f"also {min(missing)}")
        xy_px, snr = table[["x_px", "y_px"]].to_numpy(), table.get("snr")
        sigma_px, flux_dn = table.get("sigma_px", sigma_px), table.get("flux_dn", flux_dn)
        cov_px = _covariances(table) if "sigma_x_px" in table else cov_px
    xy = _finite(xy_px, "xy_px", (-1, 2))
    n = len(xy)
    if cov_px is None:
        stated = _finite(UNSTATED_PX if sigma_px is None else sigma_px, "sigma_px", None)
        if stated.size not in (1, n):
            raise wrong("sigma_px", stated, f"a number or shape ({n},)")
        variance = stated * np.abs(stated)
        cov = np.broadcast_to(variance, (n,))[:, None, None] * np.eye(2)
        positive = ((variance > 0.0) & (variance < np.inf)).all()
    else:
        cov = _finite(cov_px, "cov_px", (n, 2, 2))
        positive = is_symmetric(cov) and (np.linalg.eigvalsh(cov) > 0.0).all()
    if n and not positive:
        found = "errors of 0 px or below, or a covariance that is none"
        raise wrong("sigma_px" if cov_px is None else "cov_px", found, "errors above 0 px")
    half = 0.5 * np.array(sides)
    if (beyond := float((np.abs(xy + 0.5 - half) - half).max(initial=0.0))) > 1.0:
        raise wrong("xy_px", f"a centroid {beyond:.4g} px outside of {size_px} px", "(column, row) inside")
    flux: Floats = np.array(np.arange(n, 0.0, -1.0)) if flux_dn is None else _finite(flux_dn, "flux_dn", (n,))
    stars = Centroids(
        xy_px=xy,
        cov_px=cov,
        blended=np.zeros(n, dtype=bool),
        snr=np.full(n, np.nan) if snr is None else _finite(snr, "snr", (n,)),
        psf_sigma_px=USUAL_PSF_PX,
    )
    listed = StarList.of_centroids(stars, flux, size_px)
    return listed if flux_dn is None else listed.take(np.argsort(-flux, kind="stable"))


def _covariances(table: pd.DataFrame) -> Floats:
    """(N, 2, 2) px² of the columns sigma_x_px, sigma_y_px and, if there, cov_xy_px2."""
    across = table.get("cov_xy_px2", 0.0 * table["sigma_x_px"])
    x, y = (table[name] * table[name].abs() for name in ("sigma_x_px", "sigma_y_px"))
    rows = [[x, across], [across, y]]
    return np.moveaxis(np.array(rows, dtype=np.float64), 2, 0)


def _finite(given: ArrayLike, name: str, shape: tuple[int, ...] | None) -> Floats:
    """Finite numbers of a shape, in which -1 is any length; None: any shape of one number or a row."""
    values = floats_of(given, name, "finite numbers")
    fits = values.ndim < 2 if shape is None else len(shape) == values.ndim
    if not fits or (shape is not None and any(a not in (-1, b) for a, b in zip(shape, values.shape))):
        expected = "a number or (N,)" if shape is None else f"shape {shape}".replace("-1", "N")
        raise wrong(name, values, expected)
    if not np.isfinite(values).all():
        raise wrong(name, "values that are not finite", "finite numbers")
    return values
