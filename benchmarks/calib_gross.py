"""Wrong star identities and wrong target matches: error against the bound of what is left.

OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/calib_gross.py [runs]
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
from record import band_of_mean_nees, exit_status, head, verdict

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.settings import CalibrationSettings
from boresight.features.paper.vector_experiments import MATRIX_28, NO_NUISANCES, TABLE_1
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips, installation_by_tilt

CAMERAS = CameraPair(installation_by_tilt(np.radians(15.0)))


def report(name: str, plan: StripPlan, settings: CalibrationSettings, runs: int) -> None:
    rng = np.random.default_rng(7)
    R_cs0 = deviation_from_theta(np.array(MATRIX_28)).inv() * CAMERAS.R_cs
    errors, covariances = [], []
    wrong = missed = good = lost = 0
    for _ in range(runs):
        strips, truth = draw_strips(plan, CAMERAS, rng)
        estimate = calibrate_strips(strips, R_cs0, settings)
        assert isinstance(estimate, InstallationEstimate)
        errors.append(theta_between(estimate.R_cs, CAMERAS.R_cs))
        covariances.append(estimate.cov_theta)
        out = {(r.strip_id, int(r.name.split("/")[1])) for r in estimate.rejected if r.kind == "target"}
        wrong, missed = wrong + len(truth.wrong_targets), missed + len(truth.wrong_targets - out)
        good += plan.strips * plan.targets - len(truth.wrong_targets)
        lost += len(out - truth.wrong_targets)
    off, covariance = np.array(errors), np.array(covariances)
    bound = np.sqrt(np.mean(np.diagonal(covariance, axis1=1, axis2=2), axis=0))
    ratio = np.sqrt(np.mean(off**2, axis=0)) / bound
    nees = float(np.mean(np.einsum("ra,rab,rb->r", off, np.linalg.inv(covariance), off)))
    low, high = band_of_mean_nees(runs)
    print(
        f"{name}\n       bound {np.array2string(bound / ARCSEC, precision=3)} arcsec; "
        f"NEES {nees:.2f} ({low:.2f} to {high:.2f}); "
        f"wrong targets kept {missed} of {wrong}, good ones lost {lost} of {good}"
    )
    verdict(
        f"rms / bound X {ratio[0]:.3f} Y {ratio[1]:.3f} Z {ratio[2]:.3f} (<= 1.15)",
        bool((ratio <= 1.15).all()),
    )


if __name__ == "__main__":
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    head(f"calib: gross errors, {runs} runs of 8 strips, wrong ones of stars and of targets alike")
    for share in (0.0, 0.1, 0.2):
        gross = {"gross_stars": share, "gross_targets": share}
        report(f"{share:4.0%} gross, white noise only", replace(StripPlan(), **gross), NO_NUISANCES, runs)
        report(
            f"{share:4.0%} gross, every error of Table 1",
            replace(TABLE_1, **gross),
            CalibrationSettings(),
            runs,
        )
    near = {"gross_stars": 0.2, "gross_targets": 0.2, "gross_reach_px": 15.0}
    report(" 20% gross, wrong matches within 15 px", replace(TABLE_1, **near), CalibrationSettings(), runs)
    raise SystemExit(exit_status())
