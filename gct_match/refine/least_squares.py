"""Least-squares matching: a template placed in a picture to a few thousandths of a pixel, with its
covariance.

The picture, warped by a translation or by a small affine map, is a radiometric map of the template
(`radiometry`) plus noise. `approach` brings the two to a few hundredths of a pixel; then both pass the
filter that the aligned pair itself asks for (`weighting`), and Gauss-Newton in the inverse-compositional
form (Baker & Matthews 2004) does the rest: derivatives of the template, which are known once. Pixels whose
neighbourhood fits worse than the rest lose weight, so that what hides part of the template (a cloud,
another crop) does not move it. The covariance is that of the template's blocks (`blocks`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.gct_match.predict.resample import change, composed, gradient, largest_px, warped
from boresight.gct_match.refine.approach import approach, robust_weights
from boresight.gct_match.refine.blocks import blocks_of
from boresight.gct_match.refine.radiometry import TERMS, TONES, fill_columns
from boresight.gct_match.refine.spectra import filtered
from boresight.gct_match.refine.weighting import weighting
from boresight.gct_match.search.correlation import View

__all__ = ["Placement", "place"]

Array = NDArray[np.float64]
Image = NDArray[Any]  # single precision

_FARTHEST_PX = 2.5  # from the start
_RIM = 3  # the filters reach this far over the template's edge, and over a hole's
_COLUMNS = 2 + TERMS  # of the design matrix: the two derivatives and the radiometry
_STEPS = 5
_ROUNDS = 4
_NEAR_PX = 0.05  # the pair's coherence, as measured farther off, misleads
_SETTLED_PX = 0.02  # a step below this leaves a thirtieth of it as error: the derivatives are that good
_SETTLED_RIM_PX = 0.06  # the same at the template's rim, where an affine map is three times less well known
_PIECE = 2048  # pixels whose columns stay in the processor's cache
# A tone curve acts on the scene, of which the template shows no more than means over a pixel. The rest of
# what it does leans one way where light and shadow lie on the same side of trees and roofs, and a shift of
# all of them alike shows in no residual. It averages out over the scene as structures of this size would.
_LEANING_PX = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Where the reference point of a template lies in a picture."""

    xy_px: Array  # (2,) in the picture
    cov_px: Array  # (2, 2) px²
    affine: Array  # (2, 2) A - I, zero for a translation
    correlation: float  # of the filtered pair, weighted
    kept: float  # share of the weight that the robust weighting left
    converged: bool
    found: Image  # (h, w) picture warped onto the template
    residual: Image  # (h, w) what the fit left of it, filtered, in grey values of the picture


def place(template: View, picture: View, start_px: Array, reference_px: Array) -> Placement:
    """Place `template` (h, w) in `picture` (H, W), started with its first pixel at `start_px` (x, y).

    `reference_px` (x, y) is the point of the template whose place is wanted. The place may be up to 2 px
    from the start; farther is reported as not converged. Nearer than half a pixel is quicker.
    """
    fit = _Fit(template, picture, start_px, reference_px)
    for _ in range(_ROUNDS):
        if fit.measure():
            break
    if not fit.affine and fit.blocks.ask_for_affine(fit.response):
        fit.step(fit.blocks.displacement(affine=True) / fit.response)
        fit.measure()
    return fit.placement()


class _Fit:
    """One template against one picture: the warp, the weights, and the equations that move them."""

    def __init__(self, template: View, picture: View, start_px: Array, reference_px: Array) -> None:
        self.template = template.grey - np.float32(cv2.mean(template.grey)[0])
        h, w = template.grey.shape
        self.shape = (h, w)
        self.picture = picture.grey
        self.reference_px = reference_px
        self.from_corner = np.array(
            [[1.0, 0.0, -reference_px[0]], [0.0, 1.0, -reference_px[1]], [0.0, 0.0, 1.0]]
        )
        self.mask = _usable(template.valid, picture.valid, start_px)
        self.start = start_px + reference_px
        self.warp = np.eye(3)  # template point - reference -> picture
        self.warp[:2, 2] = self.start
        self.warp, weight = approach(
            template.normalised, picture.normalised, self.mask, self.warp, reference_px
        )
        self.affine = bool((self.warp[:2, :2] != np.eye(2)).any())
        self._keep_near()
        self.weight = self.mask * cv2.resize(weight, (w, h), interpolation=cv2.INTER_LINEAR)
        self.columns: Image = np.empty((_COLUMNS + 1, h * w), dtype=np.float32)  # and the picture

    def measure(self) -> bool:
        """Filter the pair as it asks for, weight its pixels, and step until the steps are small.

        Whether the pair was near enough from the beginning for filter, weights and a picture moved to first
        order to be right.
        """
        self.found = self._warped()
        before = self.warp[:2, 2].copy()
        pair = weighting(self.template, self.found, self.weight)
        image = self.columns.reshape(-1, *self.shape)
        fill_columns(image[:_COLUMNS], self.template, pair)
        image[_COLUMNS] = filtered(self.found, pair.amplitude)
        slopes = gradient(image[_COLUMNS])
        self._weigh(image, slopes)
        for _ in range(_STEPS):
            self._solve()
            P = self._displacement()
            self.step(P)
            near = bool(np.abs(self.warp[:2, 2] - before).max() < _NEAR_PX)
            if self.settled or not self.alike or not near:
                break
            image[_COLUMNS] -= change(slopes, P, self.reference_px, 1.0)
        if not self.affine:
            self._divide()
        return near

    def step(self, P: Array) -> None:
        """Warp <- warp o (identity + P)^-1; P is a displacement of the template's own points."""
        self.warp = composed(self.warp, P)
        self.affine = self.affine or bool(P[:, :2].any())
        self._keep_near()
        here = bool(np.abs(P[:, 2]).max() < _SETTLED_PX)
        self.settled = here and largest_px(P, self.shape) < _SETTLED_RIM_PX

    def placement(self) -> Placement:
        cov = self.blocks.covariance(affine=self.affine) / self.response**2
        cov += _LEANING_PX**2 / max(float(self.weight.sum()), 1.0) * self._tone_px2() * np.eye(2)
        far = np.abs(self.warp[:2, 2] - self.start).max()
        return Placement(
            xy_px=self.warp[:2, 2].copy(),
            cov_px=cov if self.alike else np.diag([np.inf, np.inf]),
            affine=self.warp[:2, :2] - np.eye(2),
            correlation=self._correlation(),
            kept=float(self.weight.sum() / max(self.mask.sum(), 1.0)),
            converged=bool(self.alike and self.settled and far < _FARTHEST_PX - 1e-6),
            found=self.found,
            residual=self.residual,
        )

    def _warped(self) -> Image:
        return warped(self.picture, self.warp @ self.from_corner, self.shape)

    def _keep_near(self) -> None:
        far = np.maximum(self.warp[:2, 2], self.start - _FARTHEST_PX)
        self.warp[:2, 2] = np.minimum(far, self.start + _FARTHEST_PX)

    def _weigh(self, image: Image, slopes: tuple[Image, Image]) -> None:
        """Robust weights from the residual of a quick fit to every fourth row; normal equations with them."""
        some = image[:, 1::4].reshape(len(image), -1)
        quick = (some @ (some * self.weight[1::4].ravel()).T).astype(float)
        solution = _solved(quick[:_COLUMNS, :_COLUMNS], quick[:_COLUMNS, _COLUMNS]).astype(np.float32)
        residual = image[_COLUMNS] - (solution @ self.columns[:_COLUMNS]).reshape(self.shape)
        self.weight = robust_weights(residual, self.mask, 5, 3.0)
        weight, columns = self.weight.ravel(), self.columns[:_COLUMNS]
        self.normal: Array = np.zeros((_COLUMNS, _COLUMNS))
        for k in range(0, columns.shape[1], _PIECE):
            piece = columns[:, k : k + _PIECE]
            self.normal = self.normal + (piece * weight[k : k + _PIECE]) @ piece.T
        explained = _solved(self.normal[2:, 2:], self.normal[2:, :2]).astype(np.float32)
        self.slopes = (columns[:2] - explained.T @ columns[2:]).reshape(2, *self.shape)
        self._measure_response(image, slopes)

    def _measure_response(self, image: Image, slopes: tuple[Image, Image]) -> None:
        """How the picture's gradients follow the template's: what a pixel of shift changes, per unit of the
        template's.

        It is the gain where nothing has changed and there is no noise. The template's noise adds to its
        gradients but not to what is known of the place; where part of the scene has changed, the gain of
        all of it says little of the rest.
        """
        cross = sum(float(np.vdot(self.weight * one, two)) for one, two in zip(image, slopes, strict=False))
        own = float(self.normal[0, 0] + self.normal[1, 1])
        self.alike = cross > 1e-3 * own  # else they have nothing in common, and no place can be told
        self.response = max(cross / (own + 1e-30), 1e-3)

    def _solve(self) -> None:
        columns, i = self.columns[:_COLUMNS], self.columns[_COLUMNS]
        self.solution = _solved(self.normal, (columns @ (self.weight.ravel() * i)).astype(float))
        self.residual = (i - self.solution.astype(np.float32) @ columns).reshape(self.shape)

    def _divide(self) -> None:
        """The template's blocks, their gradients free of all that the radiometry explains."""
        gx, gy = self.slopes
        self.blocks = blocks_of(gx, gy, self.residual, self.weight, self.reference_px, 1.0)

    def _displacement(self) -> Array:
        """The translation of the solution, and what the blocks still ask for if the warp is affine."""
        P: Array = np.zeros((2, 3))
        if self.affine:
            self._divide()
            P = self.blocks.displacement(affine=True)
        P[:, 2] += self.solution[:2]
        return P / self.response

    def _tone_px2(self) -> float:
        """What the tone curve changes in the picture, against its gradients, px²."""
        seen = self.solution[-TONES:]
        fixed = self.normal[2:-TONES, 2:-TONES], self.normal[2:-TONES, -TONES:]
        alone = self.normal[-TONES:, -TONES:] - fixed[1].T @ _solved(*fixed)
        slopes = 0.5 * self.response**2 * (self.normal[0, 0] + self.normal[1, 1])
        return float(seen @ alone @ seen / (slopes + 1e-30))

    def _correlation(self) -> float:
        """Square root of the share of the filtered picture's weighted variance that the fit explains."""
        i, total = self.columns[_COLUMNS].reshape(self.shape), float(self.weight.sum()) + 1e-30
        i = i - np.float32(np.vdot(self.weight, i) / total)
        left = float(np.vdot(self.weight * self.residual, self.residual))
        return float(np.sqrt(max(0.0, 1.0 - left / (float(np.vdot(self.weight * i, i)) + 1e-30))))


def _usable(template_valid: NDArray[np.bool_], valid: NDArray[np.bool_], start_px: Array) -> Image:
    """One for the pixels (h, w) of a template where no filter reaches over an edge or a hole, else zero."""
    x, y = np.round(start_px).astype(int)
    h, w = template_valid.shape
    rows, columns = valid.shape
    usable = np.zeros((h, w), dtype=np.uint8)
    inner = np.s_[max(0, -y) : rows - y, max(0, -x) : columns - x]
    usable[inner] = valid[max(0, y) : y + h, max(0, x) : x + w] & template_valid[inner]
    side = 2 * _RIM + 1
    kernel = np.ones((side, side), dtype=np.uint8)
    eroded = cv2.erode(usable, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=(0.0,))
    return eroded.astype(np.float32)


def _solved(normal: Array, right: Array) -> Array:
    """Solution of normal equations (P, P) for right sides (P,) or (P, K), even where columns are nearly alike
    (a flat template).
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(normal), 1e-30))
    firm = normal * scale[:, None] * scale
    firm.flat[:: len(firm) + 1] += 1e-7
    return (np.linalg.solve(firm, right.T * scale if right.ndim == 1 else right * scale[:, None]).T * scale).T
