"""Windowed centroids: no bias by pixel phase or shape, an honest covariance, and agreement with the fit."""

from __future__ import annotations

import numpy as np
import pytest
from frames import Sensor, render

from boresight.star_id.finding.background import estimate_background
from boresight.star_id.finding.centroid import Counts, fit_stars
from boresight.star_id.finding.psf import Psf
from boresight.star_id.finding.star_list import list_stars
from boresight.star_id.finding.windowed_centroid import windowed_centroids
from boresight.star_id.score import cramer_rao_px
from boresight.star_id.settings import StarSettings

SIZE = 1500
PSF = Psf(1.25, 1.25, (0.0, 0.0), SIZE, SIZE)
COUNTS = Counts(gain_e_per_dn=40.0, saturation_dn=255.0)


def places(rng, step=37):
    """Far enough apart for the sky between them to be found as it is."""
    x, y = np.meshgrid(np.arange(20, SIZE - 20, step), np.arange(20, SIZE - 20, step))
    return np.column_stack([x.ravel(), y.ravel()]) + rng.uniform(-0.5, 0.5, (x.size, 2))


def placed(method, image, xy, psf=PSF):
    near = np.rint(xy).astype(int)
    return method(image, near, np.zeros_like(xy), estimate_background(image), psf, COUNTS)


@pytest.mark.parametrize(("snr", "limit"), [(8, 1.06), (20, 1.06), (150, 1.1)])
def test_errors_are_near_the_bound_and_as_large_as_stated(snr, limit):
    rng = np.random.default_rng(snr)
    xy = places(rng)
    flux = np.full(len(xy), snr * 9.1)  # DN in units of the SNR, noise 2 DN
    image = render(xy, flux, SIZE, SIZE, Sensor(), rng)
    stars = placed(windowed_centroids, image, xy)
    assert stars.converged.mean() > 0.99
    error = (stars.xy_px - xy)[stars.converged]
    bound = cramer_rao_px(xy, flux, np.full(len(xy), 2.02), PSF, 40.0)
    # 3200 coordinates: 1.3 % on the rms, 2.5 % on chi2 (1 sigma)
    assert np.sqrt((error**2).mean() / (bound**2).mean()) < limit
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(stars.cov_px[stars.converged]), error) / 2.0
    assert 0.9 < chi2.mean() < 1.1


def test_it_agrees_with_the_fit_far_better_than_either_with_the_truth():
    rng = np.random.default_rng(1)
    xy = places(rng)
    image = render(xy, np.full(len(xy), 40 * 9.1), SIZE, SIZE, Sensor(), rng)
    window, fit = placed(windowed_centroids, image, xy), placed(fit_stars, image, xy)
    apart = np.sqrt(((window.xy_px - fit.xy_px) ** 2).mean())
    assert 0.0 < apart < 0.2 * np.sqrt(((fit.xy_px - xy) ** 2).mean())
    assert window.flux_dn == pytest.approx(fit.flux_dn, rel=0.02)


@pytest.mark.parametrize("shape", ["narrow", "Gaussian", "with a halo"])
def test_no_bias_over_pixel_phase(shape):
    rng = np.random.default_rng(2)
    xy = places(rng)
    flux = np.full(len(xy), 1400.0)
    quiet = {"read_noise_dn": 0.3, "e_per_dn": 1e4, "background_dn": 40.0, "bits": 16}
    sigma = 0.7 if shape == "narrow" else 1.25
    image = render(xy, flux, SIZE, SIZE, Sensor(sigma_px=sigma, **quiet), rng)
    if shape == "with a halo":
        image = image + render(xy, 0.5 * flux, SIZE, SIZE, Sensor(sigma_px=2.5, **quiet), rng)
    stars = placed(windowed_centroids, image, xy, Psf(sigma, sigma, (0.0, 0.0), SIZE, SIZE))
    error, phase = stars.xy_px - xy, xy - np.rint(xy)
    for axis in range(2):
        cell = np.clip(((phase[:, axis] + 0.5) * 10).astype(int), 0, 9)
        bias = np.bincount(cell, error[:, axis]) / np.bincount(cell)
        # noise: 0.0005 px a star, 160 stars a phase; a narrow star's light lies in few pixels
        assert np.abs(bias).max() < (0.006 if shape == "narrow" else 0.001)


def test_the_method_is_chosen_by_the_settings_and_saturated_stars_are_fitted():
    rng = np.random.default_rng(3)
    xy = places(rng, step=100)
    flux = np.full(len(xy), 900.0)
    flux[0] = 9000.0
    image = render(xy, flux, SIZE, SIZE, Sensor(), rng)
    fit, window = (list_stars(image, StarSettings(centroid_method=m)) for m in ("fit", "window"))
    full_fit, full_window = (s.xy_px[s.saturated] for s in (fit, window))
    assert len(full_fit) == 1
    assert np.array_equal(full_fit, full_window)
    assert not np.array_equal(fit.xy_px, window.xy_px)
    with pytest.raises(ValueError, match="fit or window"):
        StarSettings(centroid_method="unknown")
