"""Least-squares matching: a template placed in a picture to a few thousandths of a pixel, with its
covariance.

The picture, warped by a translation or by a small affine map, is a radiometric map of the template plus
noise:

    I(c + d + A (x - c))  =  o + o_x x + o_y y + (g + g_x x + g_y y) T + q T² + b lap(T) + noise

(x in template pixels, c the reference point; q serves another gamma, b another blur). Both sides pass the
weighting filter of `weighting`, first a fixed band-pass, then the one that the aligned pair itself asks
for. Gauss-Newton in the inverse-compositional form (Baker & Matthews 2004): derivatives of the template,
which are known once. Pixels whose neighbourhood fits worse than the rest lose weight, so that what hides
part of the template (a cloud, another crop) does not move it. The covariance is a jackknife over blocks,
so that a residual with a correlation of its own is honoured.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gct_match.resample import gradient, sample
from gct_match.weighting import (
    band_pass,
    change_px2,
    coherence_filter,
    derivatives,
    inverse_spectrum,
    point_spread,
    spectrum,
)

__all__ = ["Placement", "place"]

Array = NDArray[np.float64]
Image = NDArray[Any]  # single precision

_PAD = 8  # pixels around the template that interpolation and warp may reach into
_TAPS = 5  # half length of the interpolating kernel
_FARTHEST = _PAD - _TAPS - 0.51  # px from the start
_RIM = 3  # the filters reach this far over the template's edge
_NUISANCES = 9
_BLOCKS = 8  # along each side of the template
_AFFINE_CHI2 = 18.5  # four parameters more have to earn this: chi² of 4 at 0.1 %
_LARGEST_AFFINE = 0.05  # beyond, the template was predicted with another model than the strip's
_LOW_PX, _HIGH_PX = 0.7, 4.0  # first band-pass, before the pair itself has told which frequencies to use
# Where the scene has changed, the change has a direction: light and shadow lie on the same side of every
# tree and
# roof, and a shift of all of them alike shows in no residual. On rendered dates it comes to this share of
# the change.
_LOPSIDED = 0.02
_BLUR_PX = 0.62  # of the camera, for tones that were changed before it: MTF 0.15 at the Nyquist frequency
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

    `template_valid` (h, w) and `valid` (H, W) are false where template and picture must not be used.
    `reference_px` (x, y) is the point of the template whose place is wanted. The place may be up to 2 px
    from the start; farther is reported as not converged.
    """
    patch, usable = _patch(picture, valid, start_px, template.shape)
    solver = _Solver(template, template_valid, patch, usable, reference_px)
    solver.filter_by(band_pass(patch.shape, _LOW_PX, _HIGH_PX), tones=False)
    solver.approach()
    solver.weigh(every=2)
    if not solver.lost:
        solver.extend_to_affine()
    if not solver.lost:
        solver.filter_by_coherence()
        solver.weigh()
        solver.refine(4)
    if not solver.affine and not solver.lost:
        solver.extend_to_affine()
    return solver.placement(np.asarray(start_px, dtype=float))


def _patch(
    picture: Image, valid: NDArray[np.bool_], start_px: tuple[int, int], shape: tuple[int, ...]
) -> tuple[Image, NDArray[np.float32]]:
    """The template's place with _PAD pixels around it; mirrored beyond the picture's edge, where nothing
    is usable.
    """
    x, y = start_px
    h, w = shape
    rows, columns = picture.shape
    top, left = max(0, _PAD - y), max(0, _PAD - x)
    bottom, right = max(0, y + h + _PAD - rows), max(0, x + w + _PAD - columns)
    inner = np.s_[max(0, y - _PAD) : y + h + _PAD, max(0, x - _PAD) : x + w + _PAD]
    patch = cv2.copyMakeBorder(picture[inner], top, bottom, left, right, borderType=cv2.BORDER_REFLECT)
    usable = np.pad(valid[inner].astype(np.float32), ((top, bottom), (left, right)))
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
        self.mask: Image = inside.ravel()
        self.weight: Image = self.mask
        self.affine = False
        self.warp = np.eye(3)  # template point - reference -> patch point - reference - _PAD
        self.step_px = np.inf
        self.columns: Image = np.empty((6 + _NUISANCES, template.size), dtype=np.float32)
        self.buffer = np.empty_like(self.columns)

    # The filtered pair

    def filter_by(self, amplitude: Image, *, tones: bool) -> None:
        """Filter template and patch by `amplitude` (half spectrum); form the columns of the design matrix.

        Without `tones` the tone curve is left for later: its two columns are zero.
        """
        shape = self.patch.shape
        full = spectrum(_mirrored(self.mapped))
        half = full * amplitude
        d_dx, d_dy, laplacian = derivatives(shape)
        extent = np.float32(2.0 / max(self.shape))
        u, v = self.x * extent, self.y * extent
        self.filtered_patch = inverse_spectrum(self.patch_spectrum * amplitude, shape)
        c = self.columns
        c[4], c[5], c[6] = self._core(half * d_dx), self._core(half * d_dy), self._core(half)
        for n, (slope, lever) in enumerate(((4, self.x), (4, self.y), (5, self.x), (5, self.y))):
            np.multiply(c[slope], lever, out=c[n])
        c[7], c[8], c[9] = 1.0, u, v
        np.multiply(u, c[6], out=c[10])
        np.multiply(v, c[6], out=c[11])
        c[12] = self._core(half * laplacian)
        if not tones:
            c[13:] = 0.0
            return
        blur, sharpen = point_spread(shape, _BLUR_PX)
        sharp = inverse_spectrum(full * sharpen, shape) * self.contrast
        blur = blur * amplitude
        square = sharp * sharp
        c[13] = self._core(spectrum(square) * blur)
        c[14] = self._core(spectrum(square * sharp) * blur)

    def filter_by_coherence(self) -> None:
        """Carry the radiometry over to the template; measure the weighting filter from the aligned pair."""
        raw = self._warped(self.patch)
        self.mapped = self._mapped_template()
        taper = self.taper * np.sqrt(self.weight).reshape(self.shape)
        a = (self.mapped - _mean(self.mapped, taper)) * taper
        b = (raw - _mean(raw, taper)) * taper
        self.filter_by(coherence_filter(a, b, self.patch.shape), tones=True)

    def _core(self, half: NDArray) -> Image:
        full = inverse_spectrum(half, self.patch.shape)
        return full[_PAD : _PAD + self.shape[0], _PAD : _PAD + self.shape[1]].ravel()

    def _mapped_template(self) -> Image:
        """The template with gain, its ramps and blur as found, not filtered."""
        T = self.mapped
        extent = np.float32(2.0 / max(self.shape))
        g, _, _, _, gx, gy, b, _, _ = (np.float32(value) for value in self.radiometry)
        gain = (g + gx * extent * self.x + gy * extent * self.y).reshape(self.shape)
        laplacian = cv2.Laplacian(T, cv2.CV_32F, borderType=cv2.BORDER_REFLECT)
        mapped = gain * T + b * laplacian
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

    @property
    def lost(self) -> bool:
        """Whether template and patch have nothing in common, so that no place can be told."""
        power = np.diag(self.normal)
        return not (self.alike and power[4] > 0.0 and power[5] > 0.0 and power[6] > 0.0)

    def approach(self) -> None:
        """A first step from every fourth row, weighted by how alike the two are around each pixel."""
        i = self._warped(self.filtered_patch).ravel()
        self.weight = self.mask * self._likeness(i)
        self._form_normal(every=4)
        self._measure_response(i)
        self._read_solution(i)
        self._compose()

    def weigh(self, every: int = 1) -> None:
        """Robust weights from the residual, normal equations with them, step."""
        i = self._warped(self.filtered_patch).ravel()
        self._form_normal(every=4)
        self._read_solution(i)
        self.weight = self._robust_weights()
        self._form_normal(every)
        self._measure_response(i)
        self._read_solution(i)
        self._compose()

    def refine(self, most: int) -> None:
        """Steps with the weights as they are, until they are small."""
        for _ in range(most):
            if self.step_px < _CONVERGED_PX:
                break
            self._read_solution(self._warped(self.filtered_patch).ravel())
            self._compose()

    def _measure_response(self, i: Image) -> None:
        """How the patch's gradients follow the template's: what a pixel of shift changes, per unit of the
        template's.

        It is the gain where nothing has changed and there is no noise. The template's noise adds to its
        gradients but not to what is known of the place; where part of the scene has changed, the gain of
        all of it says little of the rest.
        """
        t, weight = self.columns[6].reshape(self.shape), self.weight.reshape(self.shape)
        cross, own = 0.0, 1e-30
        for of_t, of_i in zip(gradient(t), gradient(i.reshape(self.shape))):
            weighted = weight * of_t
            cross += float(np.vdot(weighted, of_i))
            own += float(np.vdot(weighted, of_t))
        self.alike = cross > 1e-3 * own
        self.response = max(cross / own, 1e-3)

    def _form_normal(self, every: int = 1) -> None:
        """Normal matrix of all columns over every so many rows; a translation uses its lower right part."""
        self.every = every
        self.root = np.sqrt(self._rows(self.weight[None], every)[0])
        columns = self._rows(self.columns, every)
        self.scaled = np.multiply(columns, self.root, out=self.buffer[:, : columns.shape[1]])
        self.normal = (self.scaled @ self.scaled.T).astype(np.float64)

    def _rows(self, flat: Image, every: int) -> Image:
        if every == 1:
            return flat
        return flat.reshape(len(flat), *self.shape)[:, ::every].reshape(len(flat), -1)

    def _read_solution(self, i: Image) -> None:
        first = 0 if self.affine else 4
        normal = self.normal[first:, first:]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-30))
        scaled = normal * scale[:, None] * scale
        scaled.flat[:: len(scaled) + 1] += 1e-7  # columns that are nearly alike (a flat template)
        seen = self._rows(i[None], self.every)[0] * self.root
        right = scale * (self.scaled[first:] @ seen).astype(np.float64)
        solution = scale * np.linalg.solve(scaled, right)
        self.radiometry = solution[-_NUISANCES:]
        self.i = i
        self.residual = i - solution.astype(np.float32) @ self.columns[first:]
        self.delta = solution[:-_NUISANCES] / self.response

    def _robust_weights(self) -> Image:
        """One over the local variance, where a neighbourhood of 5 px fits worse than the rest."""
        square = (self.residual * self.residual * self.mask).reshape(self.shape)
        local = cv2.blur(square, (5, 5)).ravel()
        some = local[::7]
        some = some[some > 0.0]
        usual = np.float32(np.median(some) if some.size else 1.0)
        ratio = local * np.float32(1.0 / (3.0 * usual))
        return self.mask / (1.0 + ratio * ratio)

    def _likeness(self, i: Image) -> Image:
        """Square of the positive local correlation of template and patch, in neighbourhoods of 15 px."""
        t, i = self.columns[6].reshape(self.shape), i.reshape(self.shape)
        tt, ii, ti = (cv2.blur(product, (15, 15)) for product in (t * t, i * i, t * i))
        local = np.maximum(ti, 0.0) ** 2 / (tt * ii + np.float32(1e-20 + 1e-4 * tt.mean() * ii.mean()))
        return local.ravel()

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
        if self._pays(extra) and np.abs(extra).max() < _LARGEST_AFFINE:
            self._compose()
            self.weigh()
            self.refine(2)
        else:
            self.affine = False
            self._read_solution(self.i)

    def _pays(self, extra: Array) -> bool:
        """Whether four affine parameters are more than noise; the honest covariance is asked only if a
        quick one agrees.
        """
        inverse = np.linalg.inv(
            self.normal + 1e-9 * np.diag(np.diag(self.normal)) + 1e-30 * np.eye(len(self.normal))
        )
        noise = float(np.vdot(self.weight * self.residual, self.residual) / max(self.weight.sum(), 1.0))
        quick = inverse[:4, :4] * noise / self.response**2
        if float(extra @ np.linalg.solve(quick, extra)) < _AFFINE_CHI2:
            return False
        if self.every != 1:
            self._form_normal()
            self._read_solution(self.i)
        return float(extra @ np.linalg.solve(self._covariance()[:4, :4], extra)) > _AFFINE_CHI2

    # What came out

    def _covariance(self) -> Array:
        """Covariance of the warp's parameters: jackknife over blocks of pixels.

        Leaving out block b moves the solution by (N - N_b)^-1 g_b with g_b the block's score. The scatter
        of these moves honours a residual that is correlated within a block, and a few edges that carry
        most of the weight.
        """
        first = 0 if self.affine else 4
        columns = self._in_blocks(self.scaled[first:])
        residual = self._in_blocks((self.residual * self.root)[None])
        n_b = np.matmul(columns, columns.transpose(0, 2, 1)).astype(np.float64)
        g_b = np.matmul(columns, residual.transpose(0, 2, 1)).astype(np.float64)
        scale = 1.0 / np.sqrt(np.maximum(np.einsum("bcc->c", n_b), 1e-30))
        n_b *= scale[:, None] * scale
        without = n_b.sum(axis=0) + 1e-5 * np.eye(len(scale)) - n_b
        moved = np.linalg.solve(without, g_b * scale[:, None])[:, :-_NUISANCES, 0] * scale[:-_NUISANCES]
        moved -= moved.mean(axis=0)
        n = len(moved)
        # a covariance from n blocks is itself uncertain: n - 4 keeps the mean of the normalised error squared
        return (n - 1.0) / (n - 4.0) / self.response**2 * moved.T @ moved

    def _in_blocks(self, rows: Image) -> Image:
        """(P, pixels) as (blocks, P, pixels of a block); what does not fill a block at the far edges joins
        none.
        """
        h, w = self.shape
        side = max(8, min(h, w) // _BLOCKS)
        m, n = h // side, w // side
        image = rows.reshape(len(rows), h, w)[:, : m * side, : n * side]
        return image.reshape(-1, m, side, n, side).transpose(1, 3, 0, 2, 4).reshape(m * n, len(rows), -1)

    def placement(self, start_px: Array) -> Placement:
        cov = np.diag([np.inf, np.inf]) if self.lost else self._covariance()[-2:, -2:]
        raw = self._warped(self.patch)
        residual = raw - self.mapped
        weight = self.weight.reshape(self.shape)
        residual -= _mean(residual, weight)
        taper = self.taper * weight
        cov += _LOPSIDED**2 * change_px2(residual * taper, self.mapped * taper) * np.eye(2)
        return Placement(
            xy_px=start_px + self.warp[:2, 2] + self.reference_px,
            cov_px=cov,
            affine=self.warp[:2, :2] - np.eye(2),
            correlation=_correlation(self.i, self.i - self.residual, self.weight),
            kept=float(self.weight.sum() / max(self.mask.sum(), 1.0)),
            converged=bool(
                not self.lost and self.step_px < 0.02 and np.abs(self.warp[:2, 2]).max() < _FARTHEST
            ),
            found=raw,
            residual=residual,
        )


def _correlation(i: Image, t: Image, weight: Image) -> float:
    total = float(weight.sum()) + 1e-30
    i = i - np.float32(np.vdot(weight, i) / total)
    t = t - np.float32(np.vdot(weight, t) / total)
    power = float(np.vdot(weight * i, i)) * float(np.vdot(weight * t, t))
    return float(np.vdot(weight * i, t)) / np.sqrt(power) if power > 0.0 else 0.0


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
