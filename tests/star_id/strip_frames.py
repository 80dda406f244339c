"""Strips of the sky in memory: images of stars by brute force, noise, hot columns; nothing on trial."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

STEPS = 16  # in which a row's exposure is divided


def trace(x, y, rate, drift, stages, sigma_px, half, charge=1.0):
    """Image (2 half + 1, 2 half + 1) of a star that crosses at (x, y) from its middle: every stage, `STEPS`
    instants a row."""
    k = np.arange(-half, half + 1.0)[:, None, None]
    j = (np.arange(stages) - (stages - 1) / 2)[None, :, None]
    t = k + j + ((np.arange(STEPS) + 0.5) / STEPS - 0.5)
    along, beside = rate * (t - y) - j, x + drift * (t - y)
    share = ndtr((along + 0.5) / sigma_px) - ndtr((along - 0.5) / sigma_px)
    edges = np.arange(-half - 0.5, half + 1.0)
    columns = np.diff(ndtr((edges - beside[..., None]) / sigma_px), axis=-1)
    return charge * abs(rate) / (stages * STEPS) * np.einsum("kjq,kjqn->kn", share, columns)


@dataclass
class Strip:
    """One image a CCD, as `find_strip_stars` reads it."""

    images: dict

    @property
    def ccds(self):
        return tuple(self.images)

    def shape(self, ccd):
        return self.images[ccd].shape

    def read(self, ccd, line0, line1, sample0, sample1):
        return self.images[ccd][line0:line1, sample0:sample1]


def noise_strip(rng, lines=1500, samples=384, ccds=2, hot=0, level=12.0, noise=0.9, stars=()):
    """A strip of noise with `hot` bright columns in each CCD and stars (ccd, sample, line, charge in DN)."""
    images = {}
    for ccd in range(ccds):
        signal = np.full((lines, samples), level)
        for column in rng.integers(0, samples, hot):
            signal[:, column] += rng.uniform(2.0, 60.0)
        for _, x, y, charge in (star for star in stars if star[0] == ccd):
            i, j = round(y), round(x)
            signal[i - 8 : i + 9, j - 8 : j + 9] += trace(x - j, y - i, 1.0, 0.0, 1, 0.55, 8, charge)
        image = signal + rng.standard_normal(signal.shape) * np.sqrt(noise**2 + (signal - level) / 60.0)
        images[ccd] = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    return Strip(images)
