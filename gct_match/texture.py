"""How well a picture's texture can fix a place: the standard error that its gradients and its noise allow."""

from __future__ import annotations

import cv2
import numpy as np

from boresight.gct_match.records import Image
from boresight.geometry.record import Bools

__all__ = ["expected_sigma_px", "noise_of", "sigma_from_gradients", "smooth_gradients"]


_NOISE_SHARE = (
    0.04  # of white noise's variance that its smoothed derivative keeps (of both columns and rows each)
)


def expected_sigma_px(image: Image, valid: Bools) -> float:
    """Standard error of the place of a whole picture (h, w) against another as noisy: Cramér-Rao, the
    worse direction.
    """
    weight = valid.astype(np.float32)
    gx, gy = smooth_gradients(image)
    sums = (float(np.vdot(weight * a, b)) for a, b in ((gx, gx), (gx, gy), (gy, gy)))
    xx, xy, yy = (np.array([value], dtype=np.float32) for value in sums)
    return float(sigma_from_gradients(xx, xy, yy, noise_of(image), float(weight.sum()))[0])


def smooth_gradients(image: Image) -> tuple[Image, Image]:
    """Derivatives by column and row after a Gaussian of 0.8 px, grey values per pixel."""
    smooth = cv2.GaussianBlur(image, (0, 0), 0.8)
    return (
        cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125),
        cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125),
    )


def sigma_from_gradients(xx: Image, xy: Image, yy: Image, noise: float, pixels: float) -> Image:
    """The worse standard error, px, from sums of products of `smooth_gradients` over so many pixels."""
    own = np.float32(_NOISE_SHARE * pixels * noise**2)
    least = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2) - 1.5 * own
    sigma: Image = np.sqrt(np.float32(2.0 * noise**2) / np.maximum(least, 1e-9))
    return sigma


def noise_of(image: Image) -> float:
    """Standard deviation of a picture's noise, from its quietest tenth (Immerkær's difference of Laplacians).

    Not less than 0.3, which rounding to whole values gives.
    """
    mask = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]], dtype=np.float32)
    power: Image = cv2.blur(np.asarray(cv2.filter2D(image, -1, mask) ** 2 / 36.0, dtype=np.float32), (15, 15))
    step = max(1, min(power.shape) // 100)
    return max(float(np.sqrt(np.percentile(power[::step, ::step], 10.0))), 0.3)
