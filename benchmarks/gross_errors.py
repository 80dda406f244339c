"""One gross error of a target at a time, on the design of `fixtures/mini`: is it found, are others kept?

    python benchmarks/gross_errors.py [--draws 10000]

The design, and what all errors of the dump make of the measured directions, is that of its calibration;
errors are drawn with noise of their own, linear about the estimate, and the first step of the search
rejects a target or none. Beside the share found stands the power of the test of that target alone (Baarda
1968): without a higher rate of false alarms no search finds more. The least probability of a rejection is
chosen by these draws. Single errors through the whole estimate: tests/calib/test_gross_errors.py.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from record import ROOT, arguments_of, exit_status, head, judge_share
from scipy.linalg import block_diag
from scipy.special import chdtrc, chndtr, softmax

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.gross_errors import LEAST_PROBABILITY, SEPARABLE_ODDS
from boresight.calib.joint_solution import Problem, linearised
from boresight.calib.settings import CalibrationSettings
from boresight.calib.strips import prepare_strip
from boresight.geometry.attitude_estimate import with_attitudes
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.run.executor import InOrder
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.run.unit_store import UnitStore
from boresight.records.record import Floats, Ints

SHIFTS_PX = (0.3, 0.4, 0.5, 0.7, 1.0, 2.0)
MORE = 0.01  # share of good targets rejected beside false alarms


@dataclass(frozen=True)
class Design:
    """The linear problem, its unknowns eliminated. Whitened residuals r of J targets have covariance C Cᵀ."""

    C: Floats  # (2 J, 2 J)
    M: Floats  # (2 J, 2 J) takes r to the whitened residuals of the fit, premultiplied by their weights
    blocks: Floats  # (J, 2, 2) of M on its diagonal: information of an error of r
    whitener: Floats  # (J, 2, 2) takes an error along x and y of frame c, rad, to r

    @classmethod
    def of(
        cls, strips: list[StripSightings], estimate: InstallationEstimate, settings: CalibrationSettings
    ) -> Design:
        strips = with_attitudes(strips, settings.attitudes)
        problem = Problem.of([prepare_strip(strip, settings) for strip in strips], settings)
        lines = linearised(problem, estimate.R_cs).strips
        own = block_diag(*(X @ X.T for line in lines for X in line.X_q))
        common = np.concatenate([one for line in lines for one in line.along(np.eye(line.n_common))])
        by_theta, shared = common[:, :3], common[:, 3:]
        S = np.eye(len(own)) + own + shared @ np.linalg.solve(problem.prior_shared, shared.T)
        inverse = np.linalg.inv(S)
        M = inverse @ (
            np.eye(len(S)) - by_theta @ np.linalg.solve(by_theta.T @ inverse @ by_theta, by_theta.T @ inverse)
        )
        blocks = M.reshape(len(M) // 2, 2, -1, 2).diagonal(axis1=0, axis2=2).transpose(2, 0, 1)
        whitener = np.concatenate([line.whitener.reshape(-1, 2, 2) for line in lines])
        return cls(np.linalg.cholesky(S), M, blocks, whitener)

    def rejected(self, r: Floats, limit: float) -> Ints:
        """The target that each row of r (N, 2 J) has rejected, -1 for none: the first step of the search."""
        e = (r @ self.M).reshape(len(r), -1, 2)
        T = np.einsum("nja,jab,njb->nj", e, np.linalg.inv(self.blocks), e)
        information = np.swapaxes(self.whitener, 1, 2) @ self.blocks @ self.whitener
        rival = T > T.max(axis=1, keepdims=True) - 2.0 * np.log(SEPARABLE_ODDS)
        scores = np.where(rival, 0.5 * (T - np.linalg.slogdet(information)[1]), -np.inf)
        first, rows = T.argmax(axis=1), np.arange(len(r))
        sure = softmax(scores, axis=1)[rows, first] >= LEAST_PROBABILITY
        return np.where((T[rows, first] > limit) & sure, first, -1)


def main() -> int:
    draws = arguments_of(__doc__, ("--draws", 10_000, "errors of each size")).draws
    head("Single gross errors of targets, fixtures/mini")
    dump = open_dump(ROOT / "fixtures" / "mini")
    with tempfile.TemporaryDirectory() as folder:
        found = calibrate_dump(dump, Settings(), UnitStore(Path(folder)), InOrder())
    camera, strips = dump.line_camera, list(found.strips)
    pixel_rad = camera.ccds[0].pixel_m / camera.focal_m
    plain = calibrate_strips(strips, dump.R_cs0, found.settings)
    assert isinstance(plain, InstallationEstimate)
    test, design = plain.rejection, Design.of(strips, plain, found.settings)
    smallest, largest = (edge(plain.targets.detectable_rad) / pixel_rad for edge in (np.min, np.max))
    print(f"limit {test.limit:.2f}; false alarms: {found.settings.probability_false_alarm:g} a target")
    print(f"detectable: {smallest:.2f} to {largest:.2f} px, along the worst axis")
    rng, rows, J = np.random.default_rng(0), np.arange(draws), len(design.blocks)
    most = 1.0 - (1.0 - chdtrc(2, test.limit)) ** J + MORE
    information = np.swapaxes(design.whitener, 1, 2) @ design.blocks @ design.whitener
    for shift_px in SHIFTS_PX:
        noise = rng.standard_normal((draws, len(design.C))) @ design.C.T
        culprit, angle = rng.integers(0, J, draws), rng.uniform(0.0, 2.0 * np.pi, draws)
        shift = shift_px * pixel_rad * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        r = noise.reshape(draws, -1, 2).copy()
        r[rows, culprit] += np.einsum("nab,nb->na", design.whitener[culprit], shift)
        out = design.rejected(r.reshape(noise.shape), test.limit)
        innocent = (out >= 0) & (out != culprit) & (out != design.rejected(noise, test.limit))
        noncentral = np.einsum("na,nab,nb->n", shift, information[culprit], shift)
        power = 1.0 - float(np.mean(chndtr(test.limit, 2, noncentral)))
        right = int((out == culprit).sum())
        print(f"{shift_px:4.1f} px: rejected {right / draws:.3f}, power of its own test {power:.3f}")
        judge_share(
            f"a target {shift_px:g} px off: good ones rejected",
            int(innocent.sum()),
            draws,
            most=round(most, 4),
        )
        if shift_px >= 1.0:
            judge_share(f"a target {shift_px:g} px off: rejected", right, draws, least=0.95)
    return exit_status()


if __name__ == "__main__":
    sys.exit(main())
