"""How far from its expected value chance takes what is measured, in standard deviations: one scale of three
marks for everything that finds, fits and names stars; and how many stars it takes to judge by.

Which mark holds depends on how many values are judged and on what a wrong judgement costs. The light of a
Gaussian star has the same distribution: the marks are radii of windows, too, in widths of the PSF.
"""

from __future__ import annotations

from math import log

__all__ = [
    "CLIP_SIGMA",
    "FEW_STARS",
    "LEAST_STARS",
    "LOST_BY_CHANCE",
    "MAD_SIGMA",
    "MEDIAN_CHI2",
    "NEVER_SIGMA",
    "NOISIER",
    "SELDOM_SIGMA",
]

# Of good values one in 370 is farther off: left out of a mean, they change it by nothing.
CLIP_SIGMA = 3.0
# One in 16 000: of the hundreds of stars or lines of an image none.
SELDOM_SIGMA = 4.0
# One in 1.7 million: of the pixels of an image one or two.
NEVER_SIGMA = 5.0
# Standard deviation of a normal distribution over its median absolute deviation.
MAD_SIGMA = 1.4826
# Median of a chi-square of two degrees of freedom.
MEDIAN_CHI2 = log(4.0)
# Noise of a part of an image over the usual one, from which it is unlike the rest (set by hand).
NOISIER = 1.5
# Probability of rejecting a good star by its place.
LOST_BY_CHANCE = 1e-4
# Fewest stars that anything is measured by: two agree on any rotation or width.
LEAST_STARS = 3
# Fewest stars whose median and scatter judge a PSF or a camera: both are then known to a third (set by hand).
FEW_STARS = 8
