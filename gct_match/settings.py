"""Settings of target matching. Lengths in pixels of the strip unless named otherwise."""

from __future__ import annotations

from boresight.geometry.record import record, scalar

__all__ = ["MatchSettings"]


@record(kw_only=True)
class MatchSettings:
    """Settings of target matching; the defaults serve every sensor."""

    template_px: int = scalar(
        "side of the predicted template: the error bound falls as 1/side, the cost grows as side²",
        default=128,
    )
    smallest_template_px: int = scalar(
        "smallest side of a template: below, a texture is seldom unique in a search window", default=32
    )
    margin_px: int = scalar(
        "search radius after the common rotation is known: three times its usual error", default=12
    )
    mtf_at_nyquist: float = scalar(
        "MTF of the camera with optics, detector and smear (usual design value 0.1 to 0.2)", default=0.15
    )
    chip_mtf_at_nyquist: float = scalar(
        "MTF of a chip at its own grid: an ortho-image that was resampled once", default=0.3
    )
    sigmas: float = scalar(
        "half-width of the search, standard errors of the installation matrix", default=3.0
    )
    candidates: int = scalar(
        "candidate positions of a target in the vote; the weight falls with the rank", default=100
    )
    coarse_template_px: int = scalar(
        "side of a chip in the coarse picture: a smaller one loses too many of its edges", default=32
    )
    coarse_pixels: float = scalar(
        "largest coarse picture of a strip, pixels: 48 MB of 8 bit, 192 MB with invalid pixels", default=48e6
    )
    read_block_px: int = scalar(
        "pixels read at once: few tiles of a file are decoded twice", default=16_000_000
    )
    probability_chance: float = scalar(
        "largest probability that a vote and its matches happen by chance", default=1e-6
    )
    probability_chance_match: float = scalar(
        "that a target is matched at a false position consistent with the others: 0 of 6120 were",
        default=1e-2,
    )
    probability_wrong: float = scalar("largest probability that a match is false", default=1e-4)
    sigma_px: float = scalar(
        "largest standard error of a match: false matches seldom have a smaller one", default=0.1
    )
    sigma_self_similar_px: float = scalar(
        "the same for self-similar chips: their parts differ by a pixel, which leaves 0.16 px in the median "
        "and less than 0.05 px in 1e-4 of cases (log-normal, 441 false matches in synthetic housing estates)",
        default=0.05,
    )
    consistency_sigma_px: float = scalar(
        "displacement of single targets by vibration, distortion and terrain", default=0.75
    )
    attitude_sigma_px: float = scalar(
        "displacement by the attitude error of a star exposure (0.3 arcsec), common to targets seen near it",
        default=1.5,
    )
    attitude_step_s: float = scalar(
        "interval of the star exposures, s: the attitude error is correlated over it", default=0.2
    )
    least_correlation: float = scalar(
        "smallest correlation, filtered and robustly weighted: below, most of the chip has changed",
        default=0.4,
    )
    saturation: float = scalar("grey values from here on are not used", default=float("inf"))
    no_data: float = scalar("grey value that marks missing data", default=float("nan"))
