"""The star side at other levels than images, several heads, coloured noise: 40 campaigns of vectors each.

    python benchmarks/star_levels.py > benchmarks/results/star_levels.txt

One mission as stars and as the attitudes that its star camera would solve from them (full covariance, and
sigmas about three axes alone): difference of the results and loss against the bound. Two and three heads with
the noise of Sentinel-2A's trackers: normalised errors squared of all matrices together; how often the one
head that moves from strip to strip is named.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from record import exit_status, head, verdict
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.settings import CalibrationSettings
from boresight.calib.verdict import assess
from boresight.geometry.attitude_estimate import with_attitudes
from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.geometry.sightings import StripSightings, exposure_without_stars, solved_attitudes
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips
from boresight.simulator.head_attitudes import HeadPlan, with_heads

MATRICES = [
    Rotation.from_euler("xyz", angles, degrees=True)
    for angles in ([40, -65, 110], [-75, 20, 35], [15, 80, -60])
]
SHAKEN = Rotation.from_rotvec([2e-3, -1e-3, 3e-3])
PLAN = StripPlan(strips=4, sigma_position_m=2.0, sigma_clock_s=1e-4, sigma_vibration_rad=0.1 * ARCSEC)
SETTINGS = CalibrationSettings(sigma_distortion_rad=0.0)
# white, correlated, correlation time (s), constant: arc-seconds about x, y, z of the head
NOISE = [
    [[0.6, 0.9, 6.0], [0.4, 0.7, 4.7], [0.5, 0.8, 1.2], [0.3, 0.3, 2.3]],
    [[0.9, 0.7, 6.8], [0.7, 0.35, 4.9], [1.2, 0.4, 0.9], [0.3, 0.4, 2.2]],
    [[0.8, 0.8, 6.4], [0.5, 0.5, 4.8], [0.8, 0.6, 1.0], [0.3, 0.35, 2.2]],
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=40)
    seeds = parser.parse_args().seeds
    head("the star side at other levels, several heads, coloured noise")
    levels(seeds)
    for count in (1, 2, 3):
        nees(count, seeds)
    for count in (2, 3):
        naming(count, seeds)
    raise SystemExit(exit_status())


def estimated(strips: list[StripSightings]) -> InstallationEstimate:
    found = calibrate_strips(strips, SHAKEN * MATRICES[0], SETTINGS)
    assert isinstance(found, InstallationEstimate)
    return found


def levels(seeds: int) -> None:
    """Stars against the attitudes solved from them."""
    loss: dict[str, list[float]] = {"covariance": [], "sigmas": []}
    apart: dict[str, list[float]] = {"covariance": [], "sigmas": []}
    for seed in range(seeds):
        strips, _ = draw_strips(PLAN, CameraPair(MATRICES[0]), np.random.default_rng(seed))
        whole = estimated(strips)
        for name in loss:
            found = estimated([as_attitudes(strip, name == "sigmas") for strip in with_attitudes(strips)])
            difference = theta_between(found.R_cs, whole.R_cs)
            apart[name].append(float(np.max(np.abs(difference) / whole.sigma_theta)))
            loss[name].append(float(np.max(found.sigma_theta / whole.sigma_theta)) - 1.0)
    for name in loss:
        largest, mean = max(apart[name]), float(np.mean(loss[name]))
        text = f"attitudes with {name}, {seeds} campaigns: sigma {100 * mean:+.2f} % against stars, "
        verdict(text + f"largest difference {largest:.4f} sigma", mean <= 0.1)


def as_attitudes(strip: StripSightings, sigmas_only: bool) -> StripSightings:
    """The strip with the attitudes of its exposures as if the star camera had solved them."""
    fit = strip.attitudes
    assert fit is not None
    covariance = fit.covariance_s * np.eye(3) if sigmas_only else fit.covariance_s
    solved = solved_attitudes(Rotation.from_matrix(fit.R_si), covariance)
    exposures = tuple(exposure_without_stars(one.exposure_id, one.t_s) for one in strip.exposures)
    return replace(strip, exposures=exposures, attitudes=solved)


def flown(seed: int, count: int, wrong: int = -1) -> list[StripSightings]:
    rng = np.random.default_rng(seed)
    strips, truth = draw_strips(PLAN, CameraPair(MATRICES[0]), rng)
    heads = [
        HeadPlan(
            "ABC"[n], MATRICES[n], of(NOISE[n]), shift_s=0.033 * n, wrong_rad=8.0 * ARCSEC * (n == wrong)
        )
        for n in range(count)
    ]
    alignment = [SHAKEN * MATRICES[0].inv() * head.R_ch for head in heads[1:]]
    return with_heads(strips, truth, heads, alignment, PLAN.duration_s, rng)


def of(values: list[list[float]]) -> AttitudeNoise:
    white, correlated, time_s, constant = map(np.array, values)
    return AttitudeNoise(
        white_rad=white * ARCSEC,
        correlated_rad=correlated * ARCSEC,
        correlation_time_s=time_s,
        constant_rad=constant * ARCSEC,
    )


def nees(count: int, seeds: int) -> None:
    """Normalised errors squared of all matrices together, and the heads' agreement."""
    total, agreement, dof = 0.0, 0.0, 0
    for seed in range(seeds):
        found = estimated(flown(seed, count))
        error = np.concatenate([theta_between(one.R_cs, R) for one, R in zip(found.heads, MATRICES)])
        total += float(error @ np.linalg.solve(found.cov_heads, error))
        agreement, dof = agreement + found.agreement.chi2, dof + found.agreement.dof
    low, high = chi2(3 * count * seeds).ppf([0.0005, 0.9995]) / seeds
    heads = f", heads among one another chi2 / dof {agreement / dof:.3f}" if dof else ""
    sigma = ", ".join(f"{value:.2f}" for value in found.sigma_theta / ARCSEC)
    text = f"{count} head(s), coloured noise, {seeds} campaigns: NEES {total / seeds:.2f} of {3 * count}"
    text += f" (band {low:.2f} to {high:.2f}){heads}; sigma of the first {sigma} arcsec"
    verdict(text, low < total / seeds < high)


def naming(count: int, seeds: int) -> None:
    """How often the head that moves by 8 arcsec from strip to strip is named, and nothing else."""
    right = 0
    for wrong in range(count):
        for seed in range(seeds):
            found = estimated(flown(1000 + seed, count, wrong)).with_reference("A")
            named = {group for check in assess(found, []).refuted_by for group in check.names}
            right += named == {("ABC"[wrong],)}
    share = right / (count * seeds)
    verdict(f"{count} heads, one wrong: named in {100 * share:.1f} % of {count * seeds}", share >= 0.95)


if __name__ == "__main__":
    main()
