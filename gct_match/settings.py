"""The tunables of the ground half. Lengths in pixels of the strip unless named otherwise."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["MatchSettings"]


@dataclass(frozen=True, slots=True)
class MatchSettings:
    """One default for every sensor; each value with its unit and the reason for it."""

    template_px: int = (
        128  # side of the predicted template: the bound falls as 1/side, the cost grows as side²
    )
    smallest_template_px: int = 32  # below, a texture is seldom unique within a search window
    margin_px: int = 12  # search radius of the fine stage: three times what the vote leaves over
    mtf_at_nyquist: float = (
        0.15  # of the camera, optics with detector and smear (usual design value 0.1 to 0.2)
    )
    chip_mtf_at_nyquist: float = 0.3  # of the chip at its own grid: an ortho-image that was resampled once
    sigmas: float = 3.0  # half-width of the search in standard errors of the installation matrix
    candidates: int = (
        100  # best places of a target that take part in the vote; its weight falls with its rank
    )
    coarse_template_px: int = 32  # of a chip on the coarse picture: coarser, it loses too many of its edges
    coarse_pixels: float = 48e6  # of the coarse strip that one search may hold: 48 MB of 8 bit, 192 with gaps
    read_block_px: int = 16_000_000  # pixels read at once: few tiles of a file are decoded twice
    probability_chance: float = 1e-6  # a vote, and the places it led to, that chance gives more often is none
    chance_of_a_place: float = (
        1e-2  # that a target is placed, in accord with the others, where it is not: 0 of 6120 were placed
    )
    probability_wrong: float = 1e-4  # a place that is more likely wrong than this is refused
    sigma_px: float = (
        0.1  # placed worse than this is refused: what merely looks alike is seldom placed better
    )
    sigma_self_similar_px: float = (
        0.05  # the same, where the chip holds things alike: their parts disagree by a pixel, which leaves
        # 0.16 px in the median, below 0.05 in 1e-4 (log-normal, 441 look-alikes in invented estates)
    )
    consistency_sigma_px: float = 0.75  # by which vibration, distortion and terrain move single targets
    attitude_sigma_px: float = (
        1.5  # by which a star exposure's attitude (0.3 arcsec) moves those seen near it
    )
    attitude_step_s: float = 0.2  # from one star exposure to the next: over it that error stays alike
    least_correlation: float = 0.4  # filtered and robustly weighted: below, most of the chip has changed
    saturation: float = float("inf")  # grey values from here on are not used
    no_data: float = float("nan")  # this grey value means that there is none
