"""Strips that scan the sky, at the level of vectors: stars in both cameras, with the errors of `campaign`.

The satellite turns at a constant rate about an axis of the remote-sensing camera, with waves on all axes, so
that stars move along the columns as the ground does; a rate of the other sign scans backwards. No position of
the satellite, no refraction, no map has a part in it. The scans lie before t = 0, where a campaign of the
ground begins. SI units, radians.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.sightings import GroundSightings, StripSightings, isotropic_covariance
from boresight.simulator.campaign import (
    CameraPair,
    DistortionCurve,
    StripPlan,
    draw_exposures,
    looks_across,
    noisy,
    strip_every_s,
    unit,
)

__all__ = ["DrawnSkyScan", "draw_sky_strips"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class DrawnSkyScan:
    """Attitude of the remote-sensing camera during a scan: a constant rate and waves."""

    begin_s: float  # of the scan
    R_ci0: Rotation  # nominal attitude there
    rate_c: Array  # (3,) of the camera about its axes, rad/s
    amplitude: Array  # (3,)
    omega: Array  # (3,)
    phase: Array  # (3,)

    @classmethod
    def draw(
        cls, plan: StripPlan, begin_s: float, rate_rad_s: float, rng: np.random.Generator
    ) -> DrawnSkyScan:
        """A scan of a field drawn at random, about the axis y of frame c."""
        return cls(
            begin_s,
            Rotation.random(rng=rng),
            np.array([0.0, rate_rad_s, 0.0]),
            rng.uniform(*plan.wave_rad, 3),
            2 * np.pi / rng.uniform(*plan.wave_s, 3),
            rng.uniform(0, 2 * np.pi, 3),
        )

    def R_oi(self, t: Array) -> Rotation:
        """Nominal attitudes (N,) at instants (N,), s."""
        return Rotation.from_rotvec(-np.outer(t - self.begin_s, self.rate_c)) * self.R_ci0

    def R_ci(self, t: Array) -> Rotation:
        """Attitudes (N,) with the waves, without vibration."""
        waves = self.amplitude * np.sin(self.omega * (t - self.begin_s)[:, None] + self.phase)
        return Rotation.from_rotvec(waves) * self.R_oi(t)


def draw_sky_strips(
    plan: StripPlan,
    cameras: CameraPair,
    rng: np.random.Generator,
    *,
    rates_rad_s: tuple[float, ...] = (-0.0145, 0.0145),
    sigma_star_rad: float = 0.0,
    curve: DistortionCurve | None = None,
) -> list[StripSightings]:
    """Strips of one campaign of `plan.strips` scans, at the rates in turn (10 m camera: a row of 1 µrad in
    0.07 ms). `plan.targets` is the number of stars a strip, `sigma_star_rad` the error of their catalogue,
    `curve` the camera's distortion; None: drawn here.
    """
    curve = curve or DistortionCurve.draw(plan, cameras, rng)
    strips = []
    for n in range(plan.strips):
        begin_s, rate = -(n + 1) * strip_every_s(plan), rates_rad_s[n % len(rates_rad_s)]
        scan = DrawnSkyScan.draw(plan, begin_s, rate, rng)
        strips.append(_draw_strip(f"sky{n:04d}", plan, scan, cameras, curve, sigma_star_rad, rng))
    return strips


def _draw_strip(
    name: str,
    plan: StripPlan,
    scan: DrawnSkyScan,
    cameras: CameraPair,
    curve: DistortionCurve,
    sigma_star_rad: float,
    rng: np.random.Generator,
) -> StripSightings:
    margin, J = plan.exposure_margin_s, plan.targets
    since: Array = np.linspace(-margin, plan.duration_s + margin, plan.exposures, dtype=np.float64)
    t_stars = scan.begin_s + since
    exposures, _ = draw_exposures(name, t_stars, plan, cameras, scan.R_ci(t_stars), rng)
    t = scan.begin_s + plan.duration_s * np.sort(rng.uniform(*plan.along, J))
    ccd, sample, true_c, assumed_c = looks_across(rng.uniform(*plan.across, J), cameras)
    t_true = t + rng.normal(0.0, plan.sigma_clock_s) - plan.clock_bias_s
    vibration = rng.normal(0.0, plan.sigma_vibration_rad, (J, 3))  # that the exposures do not follow
    R_ic = (Rotation.from_rotvec(vibration) * scan.R_ci(t_true)).inv()
    catalogue_i = noisy(R_ic.apply(true_c), sigma_star_rad, rng)
    seen = unit(assumed_c + np.pad(curve.at(ccd, sample), ((0, 0), (0, 1))))
    sigma = plan.sigma_c_px * cameras.pixel_rad
    measured = noisy(seen, sigma, rng)
    stars = GroundSightings(
        target_id=np.array([f"HIP {1000 * int(name[3:]) + j}" for j in range(J)], dtype=str),
        ccd=ccd,
        xy_px=np.column_stack([sample, t - scan.begin_s]),
        t_s=t,
        u_c=measured,
        u_i=catalogue_i,
        cov_c=isotropic_covariance(measured, sigma),
        range_m=np.full(J, np.inf),
        v_rel_i=np.zeros((J, 3)),
        cov_target_i=isotropic_covariance(catalogue_i, sigma_star_rad),
        earth_i=np.zeros((len(catalogue_i), 3, 3)),
    )
    return StripSightings(
        strip_id=name,
        exposures=exposures,
        ground=stars,
        R_oi_exposures=scan.R_oi(t_stars),
        R_oi_targets=scan.R_oi(t),
    )
