"""Least-squares matching: position of a template in a picture, to thousandths of a pixel, with covariance.

The picture, warped by a translation or by a small affine map, equals a radiometric map of the template
(`radiometry`) plus noise.

    approach -> a few hundredths of a pixel
    repeat: filter both by the pair's own coherence (`weighting`) -> weights, normal equations -> Gauss-Newton
            steps, until the pair was near from the beginning of the round
    affine map, if the template's blocks show one (`blocks`) -> one more round -> position, covariance

The steps are inverse compositional (Baker & Matthews 2004): derivatives are those of the template, computed
once a round. Pixels whose neighbourhood fits worse than the rest lose weight, so that an occlusion (a cloud,
another crop) does not shift the result. The covariance is that of the template's blocks.
"""

from __future__ import annotations

import cv2
import numpy as np

from boresight.gct_match.imaging.resample import change, composed, gradient, largest_px, warped
from boresight.gct_match.imaging.spectra import filtered
from boresight.gct_match.imaging.views import View
from boresight.gct_match.records import Image
from boresight.gct_match.refine.approach import approach, robust_weights
from boresight.gct_match.refine.radiometry import TERMS, TONE_TERMS, fill_columns
from boresight.gct_match.refine.template_blocks import Blocks, blocks_of
from boresight.gct_match.refine.weighting import weighting
from boresight.records.record import Bools, Floats, array, record, scalar

__all__ = ["PositionFit", "fit_position", "usable_pixels"]

_FARTHEST_PX = 2.5  # from the start
_RIM = 3  # px: the filters reach this far over the template's edge, and over a hole's
_COLUMNS = 2 + TERMS  # of the design matrix: the two derivatives and the radiometry
_STEPS = 5  # Gauss-Newton steps with given weights, at most (set by hand)
_ROUNDS = 4  # of weighting anew and fitting, at most (set by hand)
_NEAR_PX = 0.05  # a coherence measured at a larger misalignment is biased
_SETTLED_PX = 0.02  # a step below this leaves a thirtieth of it as error, from errors of the derivatives
_SETTLED_RIM_PX = 0.06  # the same at the template's rim, where an affine map is three times less accurate
_PIECE = 2048  # pixels whose columns stay in the processor's cache
# A tone curve acts on the scene, of which the template shows only means over a pixel. The part of its
# effect that the fit cannot model shifts the position where light and shadow lie on the same side of trees
# and roofs; a common shift shows in no residual. It averages out over the scene as structures of this size.
_TONE_STRUCTURE_PX = 5.0


@record(kw_only=True)
class PositionFit:
    """Position of a template's reference point in a picture, as fitted."""

    xy_px: Floats = array("2", "(x, y) in the picture, px")
    cov_px: Floats = array("2, 2", "its covariance, px²; infinite where the pair has nothing in common")
    affine: Floats = array("2, 2", "A - I of the affine map template to picture; zero for a translation")
    correlation: float = scalar("weighted correlation of the filtered pair")
    converged: bool = scalar("whether the last step was small and the position near the start")
    found: Image = array("H, W", "picture warped onto the template")
    residual: Image = array("H, W", "residual of the fit, filtered, in grey values of the picture")

    @property
    def sigma_px(self) -> float:
        """Standard error of the less certain coordinate, px."""
        return float(np.sqrt(max(self.cov_px[0, 0], self.cov_px[1, 1])))


@record
class _Pair:
    """What does not change during a fit."""

    template: Image  # (h, w) grey values without their mean
    picture: Image  # (H, W)
    usable: Image  # (h, w) zero where template or picture must not be used
    start_px: Floats  # (2,) initial (x, y) of the reference point in the picture
    reference_px: Floats  # (2,) (x, y) of the reference point in the template
    mtf_at_nyquist: float  # of the camera that took the picture


@record
class _Warp:
    """Map from the template to the picture, and whether the step that led to it was small."""

    matrix: Floats  # (3, 3) template point minus reference point -> picture
    affine: bool
    settled: bool


@record
class _Equations:
    """The linearised problem at one warp."""

    columns: Image  # (_COLUMNS, h * w) design matrix, transposed
    weight: Image  # (h, w)
    normal: Floats  # (_COLUMNS, _COLUMNS)
    slopes: Image  # (2, h, w) derivatives of the template, orthogonal to the radiometric columns
    response: float  # change of the picture by a pixel of shift, per unit of the template's
    informative: bool  # whether template and picture have gradients in common


@record
class _Round:
    """A round of filtering, weighting and Gauss-Newton steps."""

    warp: _Warp  # after the last step
    found: Image  # (h, w) picture at the first warp
    equations: _Equations
    solution: Floats  # (_COLUMNS,) of the last step
    filtered: Image  # (h, w) filtered picture at the last step
    residual: Image  # (h, w) of the last step
    blocks: Blocks  # of the last step
    near: bool  # whether the first warp was near enough for filter, weights and linearisation


def fit_position(
    template: View, picture: View, start_px: Floats, reference_px: Floats, mtf_at_nyquist: float
) -> PositionFit:
    """Least-squares position in `picture` (H, W) of the point `reference_px` (x, y) of `template` (h, w).

    `start_px` (x, y) is the initial position of the template's first pixel in the picture; an error of up to
    2 px converges, below half a pixel faster. `mtf_at_nyquist` is that of the camera that took the picture.
    """
    pair, warp, weight = _approached(template, picture, start_px, reference_px, mtf_at_nyquist)
    for _ in range(_ROUNDS):
        last = _round(pair, warp, weight)
        warp, weight = last.warp, last.equations.weight
        if last.near:
            break
    response = last.equations.response
    if not warp.affine and last.blocks.show_affine(response):
        warp = _stepped(pair, warp, last.blocks.displacement(affine=True) / response)
        last = _round(pair, warp, weight)
    return _fit_of(pair, last)


def usable_pixels(template_valid: Bools, valid: Bools, start_px: Floats) -> Image:
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


def _approached(
    template: View, picture: View, start_px: Floats, reference_px: Floats, mtf_at_nyquist: float
) -> tuple[_Pair, _Warp, Image]:
    """The pair, the warp to a few hundredths of a pixel, and first weights (h, w)."""
    h, w = template.grey.shape
    usable = usable_pixels(template.valid, picture.valid, start_px)
    grey = template.grey - np.float32(cv2.mean(template.grey)[0])
    pair = _Pair(grey, picture.grey, usable, start_px + reference_px, reference_px, mtf_at_nyquist)
    first = np.eye(3)
    first[:2, 2] = pair.start_px
    matrix, weight = approach(template.normalised, picture.normalised, usable, first, reference_px)
    affine = bool((matrix[:2, :2] != np.eye(2)).any())
    weight = usable * cv2.resize(weight, (w, h), interpolation=cv2.INTER_LINEAR)
    return pair, _Warp(_near_start(pair, matrix), affine, False), weight


def _round(pair: _Pair, warp: _Warp, weight: Image) -> _Round:
    """Filter the pair by its coherence, weight its pixels, and step until the steps are small."""
    shape, first = pair.template.shape, warp
    from_corner = np.eye(3)
    from_corner[:2, 2] = -pair.reference_px
    found = warped(pair.picture, warp.matrix @ from_corner, shape)
    coherence = weighting(pair.template, found, weight)
    columns: Image = np.empty((_COLUMNS, *shape), dtype=np.float32)
    fill_columns(columns, pair.template, coherence, pair.mtf_at_nyquist)
    image = filtered(found, coherence.amplitude)
    slopes = gradient(image)
    equations = _equations(pair, columns, image, slopes, weight)
    for _ in range(_STEPS):
        solution, residual = _solution(equations, image)
        blocks = _blocks(pair, equations, residual) if warp.affine else None
        P = _displacement(equations, solution, blocks)
        warp = _stepped(pair, warp, P)
        near = bool(np.abs(warp.matrix[:2, 2] - first.matrix[:2, 2]).max() < _NEAR_PX)
        if warp.settled or not equations.informative or not near:
            break
        image = image - change(slopes, P, pair.reference_px, 1.0)
    blocks = blocks or _blocks(pair, equations, residual)
    return _Round(warp, found, equations, solution, image, residual, blocks, near)


def _equations(
    pair: _Pair, columns: Image, image: Image, slopes: tuple[Image, Image], weight: Image
) -> _Equations:
    """Robust weights from the residual of a quick fit to every fourth row; normal equations with them."""
    some = np.concatenate([columns[:, 1::4], image[None, 1::4]]).reshape(_COLUMNS + 1, -1)
    quick = (some @ (some * weight[1::4].ravel()).T).astype(float)
    solution = _solved(quick[:_COLUMNS, :_COLUMNS], quick[:_COLUMNS, _COLUMNS]).astype(np.float32)
    flat = columns.reshape(_COLUMNS, -1)
    weight = robust_weights(image - (solution @ flat).reshape(image.shape), pair.usable, 5, 3.0)
    normal: Floats = np.zeros((_COLUMNS, _COLUMNS))
    for k in range(0, flat.shape[1], _PIECE):
        piece = flat[:, k : k + _PIECE]
        normal = normal + (piece * weight.ravel()[k : k + _PIECE]) @ piece.T
    explained = _solved(normal[2:, 2:], normal[2:, :2]).astype(np.float32)
    free = (flat[:2] - explained.T @ flat[2:]).reshape(2, *image.shape)
    # The response is the gain where nothing has changed and there is no noise. Noise of the template adds to
    # its gradients but not to the information on the position; where part of the scene has changed, the gain
    # of the whole is not that of the rest.
    cross = sum(float(np.vdot(weight * one, two)) for one, two in zip(columns, slopes, strict=False))
    own = float(normal[0, 0] + normal[1, 1])
    return _Equations(flat, weight, normal, free, max(cross / (own + 1e-30), 1e-3), cross > 1e-3 * own)


def _solution(equations: _Equations, image: Image) -> tuple[Floats, Image]:
    """Coefficients (_COLUMNS,) that explain the filtered picture (h, w) best, and the residual (h, w)."""
    flat = image.ravel()
    right = (equations.columns @ (equations.weight.ravel() * flat)).astype(float)
    solution = _solved(equations.normal, right)
    return solution, (flat - solution.astype(np.float32) @ equations.columns).reshape(image.shape)


def _blocks(pair: _Pair, equations: _Equations, residual: Image) -> Blocks:
    gx, gy = equations.slopes
    return blocks_of(gx, gy, residual, equations.weight, pair.reference_px, 1.0)


def _displacement(equations: _Equations, solution: Floats, blocks: Blocks | None) -> Floats:
    """P (2, 3), px: translation of the solution, and the affine map that the blocks of its residual show. A
    template without slopes along an axis leaves the translation along it open.
    """
    P: Floats = np.zeros((2, 3)) if blocks is None else blocks.displacement(affine=True)
    P[:, 2] += np.clip(solution[:2], -_FARTHEST_PX, _FARTHEST_PX)
    return P / equations.response


def _stepped(pair: _Pair, warp: _Warp, P: Floats) -> _Warp:
    """warp o (identity + P)^-1, where P displaces the template's own points."""
    small = bool(np.abs(P[:, 2]).max() < _SETTLED_PX)
    settled = small and largest_px(P, pair.template.shape) < _SETTLED_RIM_PX
    matrix = _near_start(pair, composed(warp.matrix, P))
    return _Warp(matrix, warp.affine or bool(P[:, :2].any()), settled)


def _near_start(pair: _Pair, matrix: Floats) -> Floats:
    """The warp with its reference point at most `_FARTHEST_PX` from the start."""
    out = matrix.copy()
    far = np.maximum(matrix[:2, 2], pair.start_px - _FARTHEST_PX)
    out[:2, 2] = np.minimum(far, pair.start_px + _FARTHEST_PX)
    return out


def _fit_of(pair: _Pair, last: _Round) -> PositionFit:
    """The fit after its last round."""
    equations, warp = last.equations, last.warp
    total = float(equations.weight.sum())
    cov = last.blocks.covariance(affine=warp.affine) / equations.response**2
    cov += _TONE_STRUCTURE_PX**2 / max(total, 1.0) * _tone_px2(equations, last.solution) * np.eye(2)
    far = np.abs(warp.matrix[:2, 2] - pair.start_px).max()
    return PositionFit(
        xy_px=warp.matrix[:2, 2].copy(),
        cov_px=cov if equations.informative else np.diag([np.inf, np.inf]),
        affine=warp.matrix[:2, :2] - np.eye(2),
        correlation=_correlation(equations.weight, last.filtered, last.residual),
        converged=bool(equations.informative and warp.settled and far < _FARTHEST_PX - 1e-6),
        found=last.found,
        residual=last.residual,
    )


def _tone_px2(equations: _Equations, solution: Floats) -> float:
    """Power of the fitted tone curve relative to that of the gradients, px²."""
    tone, normal = solution[-TONE_TERMS:], equations.normal
    fixed = normal[2:-TONE_TERMS, 2:-TONE_TERMS], normal[2:-TONE_TERMS, -TONE_TERMS:]
    alone = normal[-TONE_TERMS:, -TONE_TERMS:] - fixed[1].T @ _solved(*fixed)
    slopes = 0.5 * equations.response**2 * (normal[0, 0] + normal[1, 1])
    return float(tone @ alone @ tone / (slopes + 1e-30))


def _correlation(weight: Image, image: Image, residual: Image) -> float:
    """Square root of the share of the filtered picture's weighted variance that the fit explains."""
    i = image - np.float32(np.vdot(weight, image) / (float(weight.sum()) + 1e-30))
    left = float(np.vdot(weight * residual, residual))
    return float(np.sqrt(max(0.0, 1.0 - left / (float(np.vdot(weight * i, i)) + 1e-30))))


def _solved(normal: Floats, right: Floats) -> Floats:
    """Solution of normal equations (P, P) for right sides (P,) or (P, K), regularised against columns that
    are nearly equal (a flat template).
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(normal), 1e-30))
    firm = normal * scale[:, None] * scale
    firm.flat[:: len(firm) + 1] += 1e-7
    return (np.linalg.solve(firm, right.T * scale if right.ndim == 1 else right * scale[:, None]).T * scale).T
