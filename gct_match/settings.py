"""Settings of target matching. Lengths in pixels of the strip unless named otherwise."""

from __future__ import annotations

from boresight.records.record import check_numbers, record, scalar

__all__ = ["MatchSettings"]

LEAST_SIDE_PX = 8  # of any template: that of one of its blocks


@record(kw_only=True)
class MatchSettings:
    """Settings of target matching; the defaults serve every sensor."""

    template_px: int = scalar("side of the template: error falls as 1/side, cost grows as side²", default=128)
    smallest_template_px: int = scalar(
        "smallest side, 8 at least: below, textures are seldom unique", default=32
    )
    margin_px: int = scalar("search radius at the common rotation: three times its usual error", default=12)
    mtf_at_nyquist: float = scalar("MTF of camera: optics, detector, smear (usual 0.1 to 0.2)", default=0.15)
    chip_mtf_at_nyquist: float = scalar("MTF of a chip at its grid: an ortho-image, resampled", default=0.3)
    sigmas: float = scalar("half-width of the search, sigmas of the installation matrix", default=3.0)
    candidates: int = scalar("candidate positions of a target in the vote, by falling weight", default=100)
    coarse_template_px: int = scalar("side of a chip in the coarse picture: less loses its edges", default=32)
    coarse_pixels: float = scalar("size of a coarse strip: 48 MB of 8 bit, 192 MB with gaps", default=48e6)
    read_block_px: int = scalar("pixels read at once: few tiles are decoded twice", default=16_000_000)
    probability_chance: float = scalar("largest probability of vote and matches by chance", default=1e-6)
    probability_chance_match: float = scalar(
        "of a match at a false position consistent with the others: 0 of 6120 were", default=1e-2
    )
    probability_wrong: float = scalar("largest probability that a match is false", default=1e-2)
    sigma_px: float = scalar("largest standard error: beyond, another peak may be as near", default=1.5)
    # Parts of a self-similar chip differ by a pixel, which leaves 0.16 px in the median and less than 0.05 px
    # in 1e-4 of cases (log-normal, 441 false matches in synthetic housing estates).
    sigma_self_similar_px: float = scalar("largest standard error with a self-similar chip", default=0.05)
    consistency_sigma_px: float = scalar(
        "error of single targets: vibration, distortion, terrain", default=0.75
    )
    attitude_sigma_px: float = scalar("error of a star exposure's attitude (0.3 arcsec)", default=1.5)
    attitude_step_s: float = scalar("interval of star exposures, s: attitude errors correlate", default=0.2)
    least_correlation: float = scalar(
        "of edges, or filtered grey values: below, nothing is common", default=0.02
    )
    saturation_dn: float = scalar("grey values from here on are not used", default=float("inf"))
    no_data: float = scalar("grey value that marks missing data", default=float("nan"))

    def __post_init__(self) -> None:
        limits = ("probability_chance", "probability_chance_match", "probability_wrong", "least_correlation")
        zero = ("margin_px", "attitude_sigma_px", *limits)
        check_numbers(self, any_value=("saturation_dn", "no_data"), zero=zero)
        if self.smallest_template_px < LEAST_SIDE_PX:
            least = f"at least {LEAST_SIDE_PX}: a side of {self.smallest_template_px} pixels shows no texture"
            raise ValueError(f"MatchSettings.smallest_template_px must be {least}")
