"""Rounding moves no installation matrix."""

from dataclasses import replace

import numpy as np
from drawn_campaigns import CAMERAS, R_CS0, TABLE_1
from rounding import assert_unmoved, nudged

from boresight.calib.calibration import calibrate_strips
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.installation import theta_between
from boresight.simulator.campaign import draw_strips

CASES = {"every error": {}, "gross": {"gross_stars": 0.2, "gross_targets": 0.2}, "few stars": {"stars": 5}}


def test_no_matrix_is_moved():
    def strips(changed, seed):
        plan = replace(TABLE_1, **{"strips": 3, "exposures": 5, "stars": 15, "targets": 8} | changed)
        drawn, _ = draw_strips(plan, CAMERAS, np.random.default_rng(3))
        if seed is None:
            return drawn
        return [
            replace(
                strip,
                ground=replace(strip.ground, u_c=nudged(strip.ground.u_c, seed)),
                exposures=tuple(replace(e, u_s=nudged(e.u_s, seed)) for e in strip.exposures),
            )
            for strip in drawn
        ]

    def matrix(drawn):
        found = calibrate_strips(drawn, R_CS0, CalibrationSettings())
        return theta_between(found.R_cs, R_CS0), np.sqrt(np.diag(found.cov_theta))

    assert_unmoved("matrices", matrix, [lambda seed, of=of: strips(of, seed) for of in CASES.values()])
