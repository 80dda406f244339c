"""Least-squares matching: a template placed in a picture to a few thousandths of a pixel, with its covariance.

The picture, warped by a translation or by a small affine map, is a radiometric map of the template plus noise:

    I(c + d + A (x - c))  =  o + o_x x + o_y y + (g + g_x x + g_y y) T + q T² + b lap(T) + noise

(x in template pixels, c the reference point; q serves another gamma, b another blur). Both sides pass the weighting
filter of `weighting`, first a fixed band-pass, then the one that the aligned pair itself asks for. Gauss-Newton in
the inverse-compositional form (Baker & Matthews 2004): derivatives of the template, which are known once. Pixels
whose neighbourhood fits worse than the rest lose weight, so that what hides part of the template (a cloud, another
crop) does not move it. The covariance is a sandwich: the scatter of the score summed over blocks, so that a residual
with a correlation of its own is honoured.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from gct_match.resample import gradient, sample
from gct_match.weighting import band_pass, coherence_filter, derivatives, inverse_spectrum, spectrum

__all__ = ["Placement", "place"]

Array = NDArray[np.float64]
Image = NDArray[np.float32]

_PAD = 8  # pixels around the template that interpolation and warp may reach into
_TAPS = 5  # half length of the interpolating kernel
_FARTHEST = _PAD - _TAPS - 0.51  # px from the start
_RIM = 3  # the filters reach this far over the template's edge
_NUISANCES = 8
_AFFINE_CHI2 = 18.5  # four parameters more have to earn this: chi² of 4 at 0.1 %
_LARGEST_AFFINE = 0.05  # beyond, the template was predicted with another model than the strip's
_LOW_PX, _HIGH_PX = 0.7, 4.0  # first band-pass, before the pair itself has told which frequencies to use
_CONVERGED_PX = 2e-4


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
    residual: Image  # (h, w) grey values of the picture


def place(
    template: Image,
    template_valid: NDArray[np.bool_],
    picture: Image,
    valid: NDArray[np.bool_],
    start_px: tuple[int, int],
    reference_px: Array,
) -> Placement:
    """Place `template` (h, w) in `picture` (H, W), started with its first pixel at `start_px` (x, y).

    `template_valid` (h, w) and `valid` (H, W) are false where template and picture must not be used. `reference_px` (x, y) is the point of the template
    whose place is wanted. The place may be up to 2 px from the start; farther is reported as not converged.
    """
    patch, usable = _patch(picture, valid, start_px, template.shape)
    solver = _Solver(template, template_valid, patch, usable, reference_px)
    solver.filter_by(band_pass(patch.shape, _LOW_PX, _HIGH_PX))
    solver.approach()
    solver.weigh()
    solver.extend_to_affine()
    solver.filter_by_coherence()
    solver.weigh()
    solver.refine(4)
    if not solver.affine:
        solver.extend_to_affine()
    return solver.placement(np.asarray(start_px, dtype=float))


def _patch(
    picture: Image, valid: NDArray[np.bool_], start_px: tuple[int, int], shape: tuple[int, ...]
) -> tuple[Image, NDArray[np.float32]]:
    """The template's place with _PAD pixels around it; mirrored beyond the picture's edge, where nothing is usable."""
    x, y = start_px
    h, w = shape
    rows, columns = picture.shape
    top, left = max(0, _PAD - y), max(0, _PAD - x)
    bottom, right = max(0, y + h + _PAD - rows), max(0, x + w + _PAD - columns)
    inner = np.s_[max(0, y - _PAD) : y + h + _PAD, max(0, x - _PAD) : x + w + _PAD]
    edges = (top, bottom, left, right)
    patch = cv2.copyMakeBorder(picture[inner], *edges, borderType=cv2.BORDER_REFLECT)
    usable = cv2.copyMakeBorder(
        valid[inner].astype(np.float32), *edges, borderType=cv2.BORDER_CONSTANT, value=0.0
    )
    return patch, usable


class _Solver:
    """One template against one patch: the design matrix and the state that the iterations move."""

    def __init__(
        self,
        template: Image,
        template_valid: NDArray[np.bool_],
        patch: Image,
        usable: Image,
        reference_px: Array,
    ) -> None:
        self.shape = template.shape
        self.template = template - np.float32(template.mean())
        self.contrast = np.float32(1.0 / (self.template.std() + 1e-12))
        self.mapped = self.template  # with the radiometry found so far
        self.patch = patch
        self.patch_spectrum = spectrum(patch - np.float32(patch.mean()))
        column, row, self.taper, inside = _grid(*self.shape)
        self.reference_px = reference_px
        self.x = (column - np.float32(reference_px[0])).ravel()
        self.y = (row - np.float32(reference_px[1])).ravel()
        middle = np.s_[_PAD : _PAD + self.shape[0], _PAD : _PAD + self.shape[1]]
        if not usable.all():
            inside = inside * cv2.erode(usable, np.ones((7, 7)))[middle]
        if not template_valid.all():
            inside = inside * cv2.erode(template_valid.astype(np.float32), np.ones((7, 7)))
        self.mask = inside.ravel()
        self.weight = self.mask
        self.affine = False
        self.warp = np.eye(3)  # template point - reference -> patch point - reference - _PAD
        self.step_px = np.inf

    # The filtered pair

    def filter_by(self, amplitude: Image) -> None:
        """Filter template and patch by `amplitude` (half spectrum); form the columns of the design matrix."""
        shape = self.patch.shape
        half = spectrum(_mirrored(self.mapped)) * amplitude
        square = spectrum(_mirrored(self.mapped**2)) * (amplitude * self.contrast)
        d_dx, d_dy, laplacian = derivatives(shape)
        t = self._core(half)
        extent = np.float32(2.0 / max(self.shape))
        self.filtered_patch = inverse_spectrum(self.patch_spectrum * amplitude, shape)
        self.columns: Image = np.empty((6 + _NUISANCES, t.size), dtype=np.float32)
        tx, ty = self._core(half * d_dx), self._core(half * d_dy)
        u, v = self.x * extent, self.y * extent
        for n, column in enumerate(
            (tx * self.x, tx * self.y, ty * self.x, ty * self.y, tx, ty)
            + (t, 1.0, u, v, u * t, v * t, self._core(square), self._core(half * laplacian))
        ):
            self.columns[n] = column

    def filter_by_coherence(self) -> None:
        """Carry the radiometry over to the template; measure the weighting filter from the aligned pair."""
        raw = self._warped(self.patch)
        self.mapped = self._mapped_template()
        taper = self.taper * np.sqrt(self.weight).reshape(self.shape)
        a = (self.mapped - _mean(self.mapped, taper)) * taper
        b = (raw - _mean(raw, taper)) * taper
        self.filter_by(coherence_filter(a, b, self.patch.shape))

    def _core(self, half: NDArray) -> Image:
        full = inverse_spectrum(half, self.patch.shape)
        return full[_PAD : _PAD + self.shape[0], _PAD : _PAD + self.shape[1]].ravel()

    def _mapped_template(self) -> Image:
        """The template with gain, its ramps, square and Laplacian as found, not filtered."""
        T = self.mapped
        extent = np.float32(2.0 / max(self.shape))
        g, _, _, gx, gy, q, b = (np.float32(value) for value in np.delete(self.radiometry, 1))
        gain = (g + gx * extent * self.x + gy * extent * self.y).reshape(self.shape)
        laplacian = cv2.Laplacian(T, cv2.CV_32F, borderType=cv2.BORDER_REFLECT)
        mapped = gain * T + (q * self.contrast) * T**2 + b * laplacian
        return mapped - np.float32(mapped.mean())

    # Warp

    def _warped(self, picture: Image) -> Image:
        return (self._affine_warped if self.affine else self._shifted)(picture)

    def _shifted(self, picture: Image) -> Image:
        h, w = self.shape
        d = self.warp[:2, 2]
        whole = np.round(d).astype(int)
        fx, fy = d - whole
        x, y = _PAD + whole
        inner = picture[y - _TAPS : y + h + _TAPS, x - _TAPS : x + w + _TAPS]
        out = cv2.sepFilter2D(inner, -1, _kernel(fx), _kernel(fy), borderType=cv2.BORDER_REFLECT)
        return out[_TAPS:-_TAPS, _TAPS:-_TAPS]

    def _affine_warped(self, picture: Image) -> Image:
        m = self.warp.astype(np.float32)
        origin = self.reference_px + _PAD
        px = (m[0, 0] * self.x + m[0, 1] * self.y + np.float32(m[0, 2] + origin[0])).reshape(self.shape)
        py = (m[1, 0] * self.x + m[1, 1] * self.y + np.float32(m[1, 2] + origin[1])).reshape(self.shape)
        return sample(picture, px, py)

    # Gauss-Newton

    def approach(self) -> None:
        """A first step from every fifth pixel, before anything is known about weights."""
        i = self._warped(self.filtered_patch).ravel()
        self._form_normal(stride=5)
        self._read_solution(i)
        self._compose()

    def weigh(self) -> None:
        """Robust weights from the residual, normal equations with them, step."""
        i = self._warped(self.filtered_patch).ravel()
        self._form_normal(stride=5)
        self._read_solution(i)
        self.weight = self._robust_weights()
        self._form_normal()
        self._read_solution(i)
        self._compose()

    def refine(self, most: int) -> None:
        """Steps with the weights as they are, until they are small."""
        for _ in range(most):
            if self.step_px < _CONVERGED_PX:
                break
            self._read_solution(self._warped(self.filtered_patch).ravel())
            self._compose()

    def _form_normal(self, stride: int = 1) -> None:
        """Normal matrix of all columns over every `stride`-th pixel; a translation uses its lower right part."""
        self.stride = stride
        columns = self.columns[:, ::stride]
        self.weighted = columns * self.weight[::stride]
        self.normal = (self.weighted @ columns.T).astype(np.float64)

    def _read_solution(self, i: Image) -> None:
        first = 0 if self.affine else 4
        normal = self.normal[first:, first:]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-30))
        scaled = normal * scale[:, None] * scale
        scaled[np.diag_indices_from(scaled)] += 1e-7  # columns that are nearly alike (a flat template)
        right = scale * (self.weighted[first:] @ i[:: self.stride]).astype(np.float64)
        solution = scale * np.linalg.solve(scaled, right)
        self.radiometry = solution[-_NUISANCES:]
        self.i = i
        self.residual = i - solution.astype(np.float32) @ self.columns[first:]
        gain = self.radiometry[0]
        warp = solution[:-_NUISANCES]
        self.delta = warp / gain if gain > 1e-6 else np.zeros_like(warp)

    def _robust_weights(self) -> Image:
        """One over the local variance, where a neighbourhood of 5 px fits worse than the rest."""
        square = (self.residual * self.residual * self.mask).reshape(self.shape)
        local = cv2.blur(square, (5, 5)).ravel()
        some = local[::7]
        some = some[some > 0.0]
        usual = np.float32(np.median(some) if some.size else 1.0)
        ratio = local * np.float32(1.0 / (3.0 * usual))
        return self.mask / (1.0 + ratio * ratio)

    def _compose(self) -> None:
        """Warp <- warp o increment^-1; the increment maps the template's own points."""
        increment = np.eye(3)
        increment[:2, 2] = self.delta[-2:]
        if self.affine:
            increment[:2, :2] += self.delta[:4].reshape(2, 2)
        self.warp = self.warp @ np.linalg.inv(increment)
        np.clip(self.warp[:2, 2], -_FARTHEST, _FARTHEST, out=self.warp[:2, 2])
        self.step_px = float(np.abs(self.delta[-2:]).max())

    def extend_to_affine(self) -> None:
        """Take up the four affine parameters if the data pay for them."""
        self.affine = True
        self._read_solution(self.i)
        extra = self.delta[:4]
        cov = self._covariance()[:4, :4]
        pays = float(extra @ np.linalg.solve(cov, extra)) > _AFFINE_CHI2
        if pays and np.abs(extra).max() < _LARGEST_AFFINE:
            self._compose()
            self.weigh()
            self.refine(2)
        else:
            self.affine = False
            self._read_solution(self.i)

    # What came out

    def _covariance(self) -> Array:
        """Covariance of the warp's parameters: score's scatter over blocks between two inverse Hessians."""
        first = 0 if self.affine else 4
        normal = self.normal[first:, first:]
        n_warp = len(normal) - _NUISANCES
        mix = np.linalg.solve(normal[n_warp:, n_warp:], normal[n_warp:, :n_warp])
        columns = self.columns[first:]
        j = columns[:n_warp] - mix.T.astype(np.float32) @ columns[n_warp:]
        score = (j * (self.weight * self.residual)).reshape(n_warp, *self.shape)
        sums = _block_sums(score, max(8, min(self.shape) // 8))
        n = sums.shape[1]
        hessian = (normal[:n_warp, :n_warp] - normal[:n_warp, n_warp:] @ mix) * self.radiometry[0]
        inverse = np.linalg.inv(hessian * self._shared_gradient())
        return inverse @ (sums @ sums.T * (n / (n - len(normal)))) @ inverse.T

    def _shared_gradient(self) -> float:
        """Share of the template's gradient that is the scene's: its noise adds to the Hessian, not to what is known."""
        t = self.columns[6].reshape(self.shape)
        weight = self.weight.reshape(self.shape)
        cross, own = 0.0, 1e-30
        for of_t, of_i in zip(gradient(t), gradient(self.i.reshape(self.shape))):
            cross += float(np.vdot(weight * of_t, of_i))
            own += float(np.vdot(weight * of_t, of_t))
        return float(np.clip(cross / own / max(self.radiometry[0], 1e-6), 0.05, 1.0))

    def placement(self, start_px: Array) -> Placement:
        cov = self._covariance()[-2:, -2:]
        raw = self._warped(self.patch)
        residual = raw - self.mapped
        residual -= _mean(residual, self.weight.reshape(self.shape))
        return Placement(
            xy_px=start_px + self.warp[:2, 2] + self.reference_px,
            cov_px=cov,
            affine=self.warp[:2, :2] - np.eye(2),
            correlation=_correlation(self.i, self.i - self.residual, self.weight),
            kept=float(self.weight.sum() / max(self.mask.sum(), 1.0)),
            converged=bool(self.step_px < 0.02 and np.abs(self.warp[:2, 2]).max() < _FARTHEST),
            found=raw,
            residual=residual,
        )


def _correlation(i: Image, t: Image, weight: Image) -> float:
    total = float(weight.sum()) + 1e-30
    i = i - np.float32(np.vdot(weight, i) / total)
    t = t - np.float32(np.vdot(weight, t) / total)
    power = float(np.vdot(weight * i, i)) * float(np.vdot(weight * t, t))
    return float(np.vdot(weight * i, t)) / np.sqrt(power) if power > 0.0 else 0.0


def _block_sums(score: NDArray, block: int) -> Array:
    p, h, w = score.shape
    rows = np.add.reduceat(score, np.arange(0, h, block), axis=1)
    return np.add.reduceat(rows, np.arange(0, w, block), axis=2).reshape(p, -1).astype(np.float64)


def _mirrored(image: Image) -> Image:
    return cv2.copyMakeBorder(image, _PAD, _PAD, _PAD, _PAD, borderType=cv2.BORDER_REFLECT)


def _mean(image: Image, weight: Image) -> np.float32:
    return np.float32(np.vdot(image, weight) / (weight.sum() + 1e-12))


@lru_cache(maxsize=16)
def _grid(h: int, w: int) -> tuple[Image, Image, Image, Image]:
    """Column and row of each pixel, a taper for spectra, and one inside the rim."""
    row, column = np.mgrid[0:h, 0:w].astype(np.float32)
    taper = np.outer(np.hanning(h + 2)[1:-1], np.hanning(w + 2)[1:-1]).astype(np.float32)
    inside = np.zeros((h, w), dtype=np.float32)
    inside[_RIM:-_RIM, _RIM:-_RIM] = 1.0
    return column, row, taper, inside


def _kernel(fraction: float) -> NDArray[np.float32]:
    """Windowed sinc that reads a picture at `fraction` (-0.5..0.5) of a pixel from its grid."""
    t = np.arange(-_TAPS, _TAPS + 1) - fraction
    taps = np.sinc(t) * np.sinc(t / (_TAPS + 0.5))
    return (taps / taps.sum()).astype(np.float32)
