"""Whether one prior holds for cameras whose residual distortion is one curve over the field and for cameras
whose CCDs have residuals of their own: NEES of campaigns of vectors of either kind.

    python benchmarks/distortion_kinds.py > benchmarks/results/distortion_kinds.txt

Either kind has the stated rms of 0.3 px in all: the CCDs' shift, slope and bend each 0.3 px / sqrt(3). Only
that number is stated, with the default shares of the CCDs.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from record import exit_status, head, verdict

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.settings import CalibrationSettings
from boresight.features.paper.vector_experiments import MATRIX_28, TABLE_1
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.files.dump_schema import OF_LOOK_DISTORTION
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips, installation_by_tilt
from boresight.simulator.sky_campaign import draw_sky_strips

CAMERAS = CameraPair(installation_by_tilt(np.radians(15.0)))
R_CS0 = deviation_from_theta(np.array(MATRIX_28)).inv() * CAMERAS.R_cs
SIGMA = 0.3 * CAMERAS.pixel_rad
GROUND = replace(
    TABLE_1, strips=3, exposures=11, distortion_length_px=1500.0, distortion_pixel_rad=CAMERAS.pixel_rad
)
SKY = replace(
    GROUND, strips=2, targets=14, duration_s=10.8, exposures=28, stars=128, sigma_c_px=0.05
)  # at a sixth of the imaging rate
KINDS = {
    "one curve over the field": {"sigma_distortion_rad": SIGMA},
    "shift, slope and bend of each CCD": {
        "sigma_distortion_rad": 0.0,
        "sigma_ccd_rad": (SIGMA / np.sqrt(3.0),) * 3,
    },
}
Draw = Callable[[StripPlan, np.random.Generator], list[StripSightings]]


def stated(plan: StripPlan, share: float) -> CalibrationSettings:
    """What a dump states that knows the size of the distortion, and not its kind."""
    return CalibrationSettings(
        sigma_distortion_rad=SIGMA,
        distortion_length_px=plan.distortion_length_px,
        distortion_pixel_rad=CAMERAS.pixel_rad,
        sigma_ccd_shift_rad=share * SIGMA,
        sigma_ccd_slope_rad=share * SIGMA,
        sigma_ccd_bend_rad=share * SIGMA,
        ccd_px=(CAMERAS.ccd_px,) * CAMERAS.n_ccds,
    )


def campaigns(plan: StripPlan, draw: Draw, runs: int, seed: int) -> dict[float, tuple[float, ...]]:
    """NEES, then the ratios rms / stated sigma and the stated sigma about X, Y, Z, arcsec, by share."""
    rng, found = np.random.default_rng(seed), {0.0: [], OF_LOOK_DISTORTION: []}
    for _ in range(runs):
        strips = draw(plan, rng)
        for share, rows in found.items():
            one = calibrate_strips(strips, R_CS0, stated(plan, share))
            assert isinstance(one, InstallationEstimate)
            error = theta_between(one.R_cs, CAMERAS.R_cs)
            rows.append((error @ np.linalg.solve(one.cov_theta, error), *error**2, *np.diag(one.cov_theta)))
    means = {share: np.mean(rows, axis=0) for share, rows in found.items()}
    return {
        share: (mean[0], *np.sqrt(mean[1:4] / mean[4:]), *np.sqrt(mean[4:]) / ARCSEC)
        for share, mean in means.items()
    }


def ground(plan: StripPlan, rng: np.random.Generator) -> list[StripSightings]:
    return draw_strips(plan, CAMERAS, rng)[0]


def sky(plan: StripPlan, rng: np.random.Generator) -> list[StripSightings]:
    return draw_sky_strips(plan, CAMERAS, rng, rates_rad_s=(0.0024, -0.0024))


def table(title: str, plan: StripPlan, draw: Draw, runs: int, seed: int) -> None:
    print(f"{title}, {runs} campaigns of each kind; stated: 0.3 px, one curve over the field, and CCDs")
    print(f"{'':34s}  share  NEES   rms / sigma X, Y, Z    stated sigma X, Y, Z, arcsec")
    for kind, changes in KINDS.items():
        for share, row in campaigns(replace(plan, **changes), draw, runs, seed).items():
            ratios, sigmas = (" ".join(f"{one:6.3f}" for one in part) for part in (row[1:4], row[4:]))
            print(f"{kind:34s}  {share:5.1f}  {row[0]:5.2f}  {ratios}   {sigmas}", flush=True)
            if share:
                verdict(f"NEES {row[0]:.2f}: 2.7 to 3.3", 2.7 <= row[0] <= 3.3)
    print()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--campaigns", type=int, default=200)
    runs = parser.parse_args().campaigns
    head("calib: one prior for two kinds of residual distortion")
    print(f"a mean NEES of {runs} campaigns has a standard error of {np.sqrt(6.0 / runs):.2f}")
    start = time.process_time()
    table("three strips of the ground, every error of Table 1", GROUND, ground, runs, seed=11)
    table("two strips of the sky", SKY, sky, runs, seed=12)
    print(f"{time.process_time() - start:.0f} s CPU")
    raise SystemExit(exit_status())


if __name__ == "__main__":
    main()
