"""Centroids of traces: maximum-likelihood fit of sample, line, charge and background, with covariance.

As `finding.centroid` does for exposures, with the images of `strip_stars.trace`. The width of the optics and
the gain are those that fit the bright stars of the strip best.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from boresight.records.record import Floats, array, record
from boresight.star_id.beyond_chance import CLIP_SIGMA
from boresight.star_id.finding.centroid import covariance_inflation
from boresight.star_id.finding.psf import LARGEST_STEP_PX, PsfImages, by_parameter, newton_step, start_state
from boresight.star_id.finding.windows import StarWindows
from boresight.star_id.strip_stars.trace import Motion, trace_curvatures, trace_images

__all__ = ["LEAST_GAIN", "TraceFits", "fit_traces", "gain_from_windows", "width_of"]

# Step, in standard errors, at which a fit has converged.
_CONVERGED = 0.05
# Largest bias that is corrected, in standard errors: more is no bias of second order, the star is hardly
# there.
_MOST_BIAS = 0.3
# Least share of the bias that the fitted place shows and by which it is divided; reached at an error of
# 0.14 px. A smaller one would add more scatter than it takes bias.
_LEAST_SHOWN = 0.67
# Widths of the optics that are searched, px: narrower ones are hidden by the pixel, wider ones out of
# focus.
_WIDTHS_PX = (0.2, 2.0)
# Least gain that is searched, electrons per DN: less has no detector, and what seems to be its noise is an
# image that is not of the model.
LEAST_GAIN = 0.1
_GAINS = (LEAST_GAIN, 1e4)  # beyond, photons add nothing
# Number of these, in factors of 1.2: a strip's stars tell the gain to 0.2 at best.
_GAIN_STEPS = 61


@record(kw_only=True)
class TraceFits:
    """Fits of N traces. Row n of every array is the same star."""

    offset: Floats = array("N, 2", "(sample, line) from the middle of the window, px")
    cov_px: Floats = array("N, 2, 2", "covariance of the place, px²")
    flux_dn: Floats = array("N", "whole image above the background, DN")
    snr: Floats = array("N", "flux over its error by background noise alone")
    chi2: Floats = array("N", "of the window's pixels")
    dof: Floats = array("N", "degrees of freedom of chi2")


def fit_traces(
    windows: StarWindows, offset: Floats, motion: Motion, sigma_px: float, gain_e_per_dn: float
) -> TraceFits:
    """Fits of the stars in N windows, from places near `offset` (N, 2). `gain_e_per_dn` may be infinite."""
    images = trace_images(offset, motion, sigma_px, windows.radius)
    state = start_state(windows, offset, images)
    for _ in range(12):  # Newton
        step, normal, residual, weight = newton_step(windows, images, state, gain_e_per_dn)
        in_sigmas = np.abs(step[:, :2] * np.sqrt(np.einsum("npp->np", normal)[:, :2]))
        if in_sigmas.max(initial=0.0) < _CONVERGED:
            break
        step[:, :2] = np.clip(step[:, :2], -LARGEST_STEP_PX, LARGEST_STEP_PX)
        state = state + step
        images = trace_images(state[:, :2], motion, sigma_px, windows.radius)
    chi2 = np.einsum("nm,nm,nm->n", residual, residual, weight).astype(float)
    dof = np.maximum(np.count_nonzero(weight, axis=1) - 4.0, 1.0)
    of_sky = np.einsum("nm,nm,nm->n", images.value, images.value, windows.good) / windows.noise2
    snr = state[:, 2] * np.sqrt(of_sky)
    inflation = covariance_inflation(chi2, dof, np.maximum(snr, 1.0))
    covariance = np.linalg.inv(normal)
    curvatures = trace_curvatures(state[:, :2], motion, sigma_px, windows.radius)
    return TraceFits(
        offset=state[:, :2] - _bias(images, curvatures, state, covariance, weight),
        cov_px=covariance[:, :2, :2] * inflation[:, None, None],
        flux_dn=state[:, 2],
        snr=snr,
        chi2=chi2,
        dof=dof,
    )


def _bias(
    images: PsfImages, curvatures: Floats, state: Floats, covariance: NDArray[Any], weight: NDArray[Any]
) -> Floats:
    """(N, 2) bias of the places, px, of second order in the noise: 0.06 of the standard error at SNR 7.

    An image at an uncertain place is wider than that at one place, by its second derivatives; what the fit
    takes of that for a displacement is the bias (Box 1971, J. R. Statist. Soc. B 33, 171, equation 2.27). It
    is a wave over the pixel, of which places that scatter by sigma show exp(-2 pi^2 sigma^2). `covariance`
    (N, 4, 4) is that of the state.
    """
    c, flux = covariance[:, :, :, None], state[:, 2:3]
    spread = (
        c[:, 0, 0] * curvatures[:, 0] + 2.0 * c[:, 0, 1] * curvatures[:, 1] + c[:, 1, 1] * curvatures[:, 2]
    )
    wider = flux * spread + 2.0 * (c[:, 0, 2] * images.d_x + c[:, 1, 2] * images.d_y)  # (N, M)
    slopes = np.einsum("npm,nm,nm->np", images.columns, weight, wider) * by_parameter(state, 4)
    variance = np.maximum(np.einsum("npp->np", covariance)[:, :2], 0.0)
    shown = np.maximum(np.exp(-2.0 * np.pi**2 * variance), _LEAST_SHOWN)
    bias = -0.5 * np.einsum("npq,nq->np", covariance, slopes)[:, :2] / shown
    most = _MOST_BIAS * np.sqrt(variance)
    return np.clip(bias, -most, most)


def width_of(windows: StarWindows, offset: Floats, motion: Motion) -> float:
    """Width of the optics (px) with which the stars of N windows, near `offset` (N, 2), leave the least
    residuals."""

    def misfit(sigma_px: float) -> float:
        fits = fit_traces(windows, offset, motion, sigma_px, np.inf)
        return float(
            np.log(fits.chi2 / fits.dof).sum()
        )  # a neighbour or an arm of a bright star counts little

    found = minimize_scalar(misfit, bounds=_WIDTHS_PX, method="bounded", options={"xatol": 2e-3})
    return float(found.x)


def gain_from_windows(windows: StarWindows, offset: Floats, motion: Motion, sigma_px: float) -> float:
    """Electrons per DN, from the scatter of the pixels of stars near `offset` (N, 2) in N windows.

    A pixel's variance is that of the background and its signal over the gain (photon transfer). The
    restricted likelihood (Patterson and Thompson 1971) of the residuals, free of what place, flux and
    background of each star take from them, gives the probability of each gain; returned is the inverse of
    the mean of 1 / gain, to which the variances are linear, so that few or faint stars err to neither side.
    What one star may say against a gain is limited: a neighbour or a particle in its window looks like
    noise.
    """
    offset = fit_traces(windows, offset, motion, sigma_px, np.inf).offset
    images = trace_images(offset, motion, sigma_px, windows.radius)
    state = start_state(windows, offset, images)
    gains = np.geomspace(*_GAINS, _GAIN_STEPS)
    deviance = np.stack([_deviance(windows, images, state, gain) for gain in gains.tolist()])  # (G, N)
    against = np.minimum(deviance - deviance.min(axis=0), CLIP_SIGMA**2).sum(axis=1)
    weight = np.exp(-0.5 * (against - against.min()))
    return float(weight.sum() / (weight / gains).sum())


def _deviance(windows: StarWindows, images: PsfImages, state: Floats, gain_e_per_dn: float) -> Floats:
    """(N,) -2 log of the restricted likelihood, the model taken as linear about the state (N, 4)."""
    step, normal, residual, weight = newton_step(windows, images, state, gain_e_per_dn)
    chi2 = np.einsum("nm,nm,nm->n", residual, residual, weight) - np.einsum(
        "na,nab,nb->n", step, normal, step
    )
    log_variance = -np.log(np.where(weight > 0.0, weight, 1.0)).sum(axis=1)
    return np.asarray(chi2 + log_variance + np.linalg.slogdet(normal)[1])
