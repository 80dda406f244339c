"""Radiometric model of a picture I that shows the scene of a template T:

    I  =  o + o_u u + o_v v + (g + g_u u + g_v v) T + b lap(T) + (q S² + r S³) * camera

with u and v from -1 to 1 along the longer side of the template, and S the scene before the camera's blur.
The terms are offset and gain with their ramps, a difference of blur, and a tone curve, which acts before the
blur. Both pictures are filtered with a kernel k first. Then k * (u T) differs from u (k * T): with s² the
second moment of the kernel, a ramp of the gain adds s² times its slope times the derivative of k * T, which
would appear as a shift of thousandths of a pixel.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from boresight.gct_match.imaging import spectra
from boresight.gct_match.imaging.resample import gradient
from boresight.gct_match.records import Image
from boresight.gct_match.refine.weighting import Weighting
from boresight.geometry.line_camera import gaussian_sigma_px

__all__ = ["TERMS", "TONE_TERMS", "fill_columns"]

# Number of terms of the equation above: T, 1, u, v, u T, v T, lap(T), S² and S³, in the order of the columns.
TERMS = 9
# How many of them, the last, are the tone curve: S² and S³.
TONE_TERMS = 2
# Added to the squared response of the camera before it is inverted: frequencies of which it passes less than
# a fourteenth, sqrt(0.005), are damped and not amplified (set by hand).
_REGULAR = 0.005


def fill_columns(out: Image, template: Image, weighting: Weighting, mtf_at_nyquist: float) -> None:
    """Write the columns of the design matrix to `out` (2 + TERMS, h, w): the derivatives of the filtered
    `template` (h, w) by column and row, then the terms of the equation above, T first.
    """
    shape = h, w = template.shape
    spectrum = spectra.padded_spectrum(template)
    u, v = _ramps(h, w)
    t = out[2]
    t[...] = spectra.picture_of(spectrum * weighting.amplitude, shape)
    out[0], out[1] = gradient(t)
    out[3], out[4], out[5] = 1.0, u, v
    slope = np.float32(weighting.spread_px2 * 2.0 / max(h, w))
    for column, ramp, derivative in ((out[6], u, out[0]), (out[7], v, out[1])):
        np.multiply(ramp, t, out=column)
        column += slope * derivative
    cv2.Laplacian(t, cv2.CV_32F, dst=out[8], borderType=cv2.BORDER_REFLECT)
    sigma_px = round(gaussian_sigma_px(mtf_at_nyquist), 2)  # an MTF is not known more accurately
    blur, sharpen = _camera(spectra.padded_shape(shape), sigma_px)
    scene = spectra.padded_picture(spectrum * sharpen)
    scene *= np.float32(1.0 / (np.sqrt(float(np.vdot(scene, scene)) / scene.size) + 1e-12))
    blur = blur * weighting.amplitude
    tone = scene * scene
    out[9] = spectra.picture_of(cv2.dft(tone) * blur, shape)
    out[10] = spectra.picture_of(cv2.dft(tone * scene) * blur, shape)


@lru_cache(maxsize=16)
def _ramps(h: int, w: int) -> tuple[Image, Image]:
    row, column = np.mgrid[0:h, 0:w]
    half = max(h, w) / 2.0
    u, v = (column - (w - 1) / 2.0) / half, (row - (h - 1) / 2.0) / half
    return u.astype(np.float32), v.astype(np.float32)


@lru_cache(maxsize=32)
def _camera(shape: tuple[int, int], sigma_px: float) -> tuple[Image, Image]:
    """Packed multipliers of a Gaussian camera of `sigma_px` and of its regularised inverse."""
    blur = np.exp(-2.0 * np.pi**2 * sigma_px**2 * spectra.frequency(shape) ** 2)
    return blur.astype(np.float32), (blur / (blur**2 + _REGULAR)).astype(np.float32)
