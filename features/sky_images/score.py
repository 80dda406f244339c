"""Comparison of centroids with truth: completeness, false detections, error over the Cramer-Rao bound,
pixel-phase bias.

The bound is that of an unbiased estimate of column, row, flux and background from independent pixels of known
variance (Winick 1986): the inverse of the Fisher information at the true position.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from boresight.records.record import Bools, Floats, Ints, array, record, scalar
from boresight.star_id.beyond_chance import CLIP_SIGMA, NEVER_SIGMA
from boresight.star_id.finding.psf import Psf, psf_images
from boresight.star_id.finding.star_list import BRIGHT_SNR, StarList

__all__ = ["SNR_EDGES", "CentroidScore", "cramer_rao_px", "score_centroids"]


# Limits of the bins of signal-to-noise ratio by which errors of centroids are reported.
SNR_EDGES = (5.0, 7.0, 8.0, 10.0, 14.0, 20.0, 40.0, 80.0, 160.0, 1e4)
# Parts of a pixel by which bias is reported.
PHASES = 10
# Flux of a neighbour within the windows of both over the star's own from which the star is not isolated.
_RELEVANT_FLUX = 0.002


@record(kw_only=True)
class CentroidScore:
    """Figures of isolated, unsaturated stars in B bins of signal-to-noise ratio and P bins of pixel phase."""

    snr_edges: Floats = array("B + 1", "limits of the bins, SNR_EDGES")
    stars: Ints = array("B", "true stars")
    found: Ints = array("B", "true stars detected")
    rms_px: Floats = array("B", "root mean square error along one axis, px")
    bound_px: Floats = array("B", "root mean square of the bound for the detected stars, px")
    rms_error_px: Floats = array("B", "standard error of rms_px")
    chi2: Floats = array("B", "mean squared normalised error along one axis")
    chi2_error: Floats = array("B", "standard error of chi2")
    false: int = scalar("detections without a true star")
    phase_bias_px: Floats = array("P, 2", "weighted mean error by pixel phase (column, row), px")
    phase_error_px: Floats = array("P, 2", "standard error of phase_bias_px")

    @property
    def over_bound(self) -> Floats:
        """(B,) rms_px over bound_px."""
        return self.rms_px / self.bound_px

    @property
    def over_bound_error(self) -> Floats:
        """(B,) standard error of over_bound."""
        return self.rms_error_px / self.bound_px


def cramer_rao_px(
    xy_px: Floats,
    flux_dn: Floats,
    noise_dn: Floats,
    psf: Psf,
    gain_e_per_dn: float,
    *,
    full_dn: float = np.inf,
) -> Floats:
    """Cramer-Rao bound (N,) of the centroid error, px, root mean square of both axes.

    Stars of `flux_dn` (N,) stand at the true positions `xy_px` (N, 2), with background noise `noise_dn` (N,).
    Pixels that a star raises by `full_dn` or more above the background are saturated and have no weight.
    """
    sigma = psf.sigma_at(xy_px)
    radius = int(np.ceil(5.0 * sigma.max(initial=0.0) + 0.5 * np.hypot(*psf.smear_px)))
    images = psf_images(xy_px - np.rint(xy_px), sigma, psf.smear_px, radius)
    value, flux = images.value.astype(float), flux_dn[:, None]
    J = np.stack([flux * images.d_x, flux * images.d_y, value, np.ones_like(value)], axis=1)
    weight = 1.0 / (noise_dn[:, None] ** 2 + np.maximum(flux * value, 0.0) / gain_e_per_dn)
    weight *= flux * value < full_dn
    covariance = np.linalg.inv((J * weight[:, None]) @ J.transpose(0, 2, 1))
    return np.asarray(np.sqrt(0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1])))


def score_centroids(
    lists: list[StarList],
    truths: list[tuple[Floats, Floats]],
    *,
    saturation_dn: float,
    psf: Psf | None = None,
    gain_e_per_dn: float | None = None,
) -> CentroidScore:
    """Score of star lists of images whose true positions (N, 2), px, and fluxes (N,), DN, are known.

    `psf` and the gain are the true ones where known; otherwise those that each list was made with.
    """
    parts = [
        _matched(stars, xy, flux, saturation_dn, psf or stars.psf, gain_e_per_dn or stars.gain_e_per_dn)
        for stars, (xy, flux) in zip(lists, truths)
    ]
    snr, found, bound = (np.concatenate([part[k] for part in parts]) for k in range(3))
    error, variance, phase = (np.concatenate([part[k] for part in parts]) for k in range(3, 6))
    edges = np.array(SNR_EDGES)
    cell = np.digitize(snr, edges) - 1
    bins = len(edges) - 1
    inside = (cell >= 0) & (cell < bins)
    seen = cell[inside & found]
    count = np.bincount(seen, minlength=bins)

    def mean(values: Floats) -> Floats:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.bincount(seen, values[inside[found]], bins) / count)

    def mean_and_error(values: Floats) -> tuple[Floats, Floats]:
        average = mean(values)
        spread = np.maximum(mean(values**2) - average**2, 0.0)
        return average, np.sqrt(spread / np.maximum(count, 1))

    square, square_error = mean_and_error(0.5 * (error**2).sum(axis=1))
    chi2, chi2_error = mean_and_error(0.5 * (error**2 / variance).sum(axis=1))
    bias, bias_error = _by_phase(error, variance, phase, snr[found] > BRIGHT_SNR)
    return CentroidScore(
        snr_edges=edges,
        stars=np.bincount(cell[inside], minlength=bins),
        found=count,
        rms_px=np.sqrt(square),
        bound_px=np.sqrt(mean(bound[found] ** 2)),
        rms_error_px=0.5 * square_error / np.sqrt(square),
        chi2=chi2,
        chi2_error=chi2_error,
        false=sum(part[6] for part in parts),
        phase_bias_px=bias,
        phase_error_px=bias_error,
    )


def _matched(
    stars: StarList, xy: Floats, flux: Floats, saturation: float, psf: Psf, gain: float
) -> tuple[Floats, Bools, Floats, Floats, Floats, Floats, int]:
    """SNR, whether found, and bound of isolated, unsaturated true stars; error, variance and phase of the
    found ones; number of false detections."""
    sigma = float(psf.sigma_px)
    level, noise = stars.background.at(xy)
    images = psf_images(np.zeros((1, 2)), np.array([sigma]), psf.smear_px, 5 + int(3 * sigma))
    snr = flux * np.sqrt(float((images.value.astype(float) ** 2).sum())) / noise
    peak = flux * float(images.value.max()) + level
    border = 8.0 * sigma
    size = np.array([psf.width_px, psf.height_px])
    usable = (peak < 0.95 * saturation) & (xy > border).all(axis=1) & (xy < size - 1 - border).all(axis=1)
    tree = cKDTree(xy)
    pairs = tree.query_pairs(2.0 * NEVER_SIGMA * sigma, output_type="ndarray")
    for a, b in (pairs.T, pairs.T[::-1]):
        usable[a[flux[b] > _RELEVANT_FLUX * flux[a]]] = False
    reach = CLIP_SIGMA * sigma
    near, _ = tree.query(stars.xy_px, distance_upper_bound=reach)
    false = int(np.count_nonzero(~np.isfinite(near)))
    back, detection = cKDTree(stars.xy_px).query(xy, distance_upper_bound=reach)
    found = np.isfinite(back)
    rows = np.flatnonzero(usable)
    seen = rows[found[rows]]
    error = stars.xy_px[detection[seen]] - xy[seen]
    variance = np.einsum("nii->ni", stars.cov_px[detection[seen]])
    bound = cramer_rao_px(xy[rows], flux[rows], noise[rows], psf, gain)
    phase = xy[seen] - np.floor(xy[seen] + 0.5)
    return snr[rows], found[rows], bound, error, variance, phase, false


def _by_phase(error: Floats, variance: Floats, phase: Floats, bright: Bools) -> tuple[Floats, Floats]:
    bias, bias_error = np.full((PHASES, 2), np.nan), np.full((PHASES, 2), np.nan)
    cell = np.clip(((phase + 0.5) * PHASES).astype(int), 0, PHASES - 1)
    for k in range(PHASES):
        for axis in range(2):
            here = bright & (cell[:, axis] == k)
            if here.any():
                weight = 1.0 / variance[here, axis]
                bias[k, axis] = (weight * error[here, axis]).sum() / weight.sum()
                bias_error[k, axis] = 1.0 / np.sqrt(weight.sum())
    return bias, bias_error
