"""Blur of a camera's optics, from the transfer function that its maker states."""

from __future__ import annotations

import numpy as np

__all__ = ["gaussian_sigma_px"]


def gaussian_sigma_px(mtf_at_nyquist: float) -> float:
    """Width, px, of the Gaussian whose transfer function has this value at half a cycle per pixel."""
    return float(np.sqrt(-2.0 * np.log(mtf_at_nyquist)) / np.pi)
