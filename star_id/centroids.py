"""Centroids of one image as other programs deliver them: all that identification and calibration need."""

from __future__ import annotations

from boresight.records.record import Bools, Floats, array, record, scalar

__all__ = ["Centroids"]


@record(kw_only=True)
class Centroids:
    """Stars found in one image, brightest first. Row n of every array is the same star."""

    xy_px: Floats = array("N, 2", "(column, row), distortion not removed")
    cov_px: Floats = array("N, 2, 2", "covariances of the centroids, px²")
    blended: Bools = array("N", "displaced by a neighbour: identified, but not used for calibration")
    snr: Floats = array("N", "flux over its standard error by background noise alone; NaN: not stated")
    psf_sigma_px: float = scalar("width of the point spread function, of a Gaussian")
