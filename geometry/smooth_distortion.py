"""Smooth distortion of an image: sums of Legendre polynomials of its coordinates, as SIP polynomials, but
nearly orthogonal.

A point is displaced along columns and rows by  sum c_ij P_i(x) P_j(y),  2 <= i + j <= degree, where x and y
run from -1 to 1 over the longer side of the image, its middle at 0. Constant and linear terms are a camera's
own.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial.legendre import legval

from boresight.geometry.record import Floats, array, record, scalar

__all__ = ["SmoothDistortion", "legendre_terms", "term_orders"]

_BEYOND = 1.2  # times half the longer side: farther out the displacement stays what it is there
_EXACT_PX = 1e-11  # step, px, at which the inverse has converged: the rounding of doubles at 1e5 px


@record
class SmoothDistortion:
    """Displacement of the points of an image of `width_px` x `height_px`."""

    degree: int = scalar("largest i + j of a term")
    coefficients_px: Floats = array("2, T", "of columns and rows, px, in the order of `term_orders`")
    width_px: int = scalar("columns of the image")
    height_px: int = scalar("rows of the image")

    def __post_init__(self) -> None:
        if self.coefficients_px.shape[1] != (terms := len(term_orders(self.degree))):
            found = self.coefficients_px.shape[1]
            raise ValueError(f"a distortion of degree {self.degree} has {terms} coefficients, got {found}")

    def shift_px(self, xy_px: Floats) -> Floats:
        """Displacements (N, 2), px, of points (N, 2), px."""
        terms = legendre_terms(xy_px, self.width_px, self.height_px, self.degree)
        return np.asarray(terms @ self.coefficients_px.T)

    def applied(self, xy_px: Floats) -> Floats:
        """The displaced points (N, 2) of points (N, 2), px."""
        return xy_px + self.shift_px(xy_px)

    def removed(self, xy_px: Floats) -> Floats:
        """The points (N, 2), px, that are displaced to points (N, 2); NaN where the distortion is too steep
        to be inverted by repetition."""
        before = xy_px
        for _ in range(30):
            found = xy_px - self.shift_px(before)
            step, before = np.abs(found - before), found
            if not (step >= _EXACT_PX).any():
                return found
        return np.where((step < 1e-6).all(axis=1, keepdims=True), found, np.nan)


def term_orders(degree: int) -> tuple[tuple[int, int], ...]:
    """Orders (i, j) of the terms, by their sum."""
    return tuple((i, n - i) for n in range(2, degree + 1) for i in range(n + 1))


def legendre_terms(xy_px: Floats, width_px: int, height_px: int, degree: int) -> Floats:
    """(N, T) terms at points (N, 2), px."""
    half = 0.5 * max(width_px, height_px)
    middle = 0.5 * np.array([width_px - 1, height_px - 1])
    x, y = np.clip((xy_px - middle) / half, -_BEYOND, _BEYOND).T
    along_x, along_y = (legval(t, np.eye(degree + 1)) for t in (x, y))
    return np.stack([along_x[i] * along_y[j] for i, j in term_orders(degree)], axis=1)
