"""Smallest standard error of a position that a picture's gradients and noise allow (Cramér-Rao)."""

from __future__ import annotations

import cv2
import numpy as np

from boresight.gct_match.records import Image
from boresight.records.record import Bools

__all__ = ["expected_sigma_px", "noise_of", "sigma_from_gradients", "smooth_gradients"]

# Variance of a smoothed derivative of white noise over that of the noise, for the smoothing and the Sobel
# filter used here.
_NOISE_SHARE = 0.04


def expected_sigma_px(image: Image, valid: Bools) -> float:
    """Cramér-Rao standard error, px, of the position of a picture (h, w) in another of equal noise, in the
    worse direction; `valid` (h, w) marks the pixels that count.
    """
    weight = valid.astype(np.float32)
    gx, gy = smooth_gradients(image)
    sums = (float(np.vdot(weight * a, b)) for a, b in ((gx, gx), (gx, gy), (gy, gy)))
    xx, xy, yy = (np.array([value], dtype=np.float32) for value in sums)
    return float(sigma_from_gradients(xx, xy, yy, noise_of(image), float(weight.sum()))[0])


def smooth_gradients(image: Image) -> tuple[Image, Image]:
    """Derivatives by column and row, (h, w) each, after a Gaussian of 0.8 px; grey values per px."""
    smooth = cv2.GaussianBlur(image, (0, 0), 0.8)
    return (
        cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125),
        cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125),
    )


def sigma_from_gradients(xx: Image, xy: Image, yy: Image, noise: float, pixels: float) -> Image:
    """Standard error, px, in the worse direction, elementwise; sums of gradient products over `pixels`."""
    own = np.float32(_NOISE_SHARE * pixels * noise**2)
    least = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2) - 1.5 * own
    sigma: Image = np.sqrt(np.float32(2.0 * noise**2) / np.maximum(least, 1e-9))
    return sigma


def noise_of(image: Image, valid: Bools | None = None) -> float:
    """Noise (1 sigma) of a picture (h, w), from its tenth of least variance (Immerkær's difference of
    Laplacians), at least 0.3, the noise of rounding to integers; `valid` (h, w): of these pixels only.
    """
    mask = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]], dtype=np.float32)
    power: Image = cv2.blur(np.asarray(cv2.filter2D(image, -1, mask) ** 2 / 36.0, dtype=np.float32), (15, 15))
    step = max(1, min(power.shape) // 100)
    sampled = power[::step, ::step]
    sampled = sampled if valid is None or not valid.any() else sampled[valid[::step, ::step]]
    return max(float(np.sqrt(np.percentile(sampled, 10.0))), 0.3) if sampled.size else 0.3
