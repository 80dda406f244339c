"""Tables 1 to 3 as the simulations use them, and what follows from them, beside the paper's printed values.

Table 1 is simulated: each error alone, with perfect attitude and matrix, at ground points. Tables 2 and 3 are
those of the scenario `paper`, evaluated by its camera models.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd

from boresight.features.paper.geometry_search import covariance_shapes
from boresight.features.paper.geopositioning import GroundErrors, check_point_errors
from boresight.features.paper.paper_tables import (
    TABLE_1_GROUND_M,
    TABLE_2,
    TABLE_3,
    TABLE_3_DISTORTION_UM,
    TEXT_VALUES,
)
from boresight.geometry.constants import ARCSEC, GM_EARTH, WGS84
from boresight.simulator.cameras import calibrated_line_camera, star_camera
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips
from boresight.simulator.scenario import paper_scenario

__all__ = ["inputs"]

# source, item, unit, place on the axis of a curve, paper, ours, what arithmetic gives
Row = tuple[str, str, str, float, float, float, float]
# Of the table: `at` is the abscissa, `expected` the value by formula.
COLUMNS = ["source", "item", "unit", "at", "paper", "ours", "expected"]
HEIGHT_M, NONE = 530e3, float("nan")  # height of the paper's satellite; a number that there is not


def inputs(cameras: CameraPair, seed: int, strips: int) -> pd.DataFrame:
    """Long-form table of printed inputs: paper, ours, and the value by arithmetic where there is one.

    Errors on the ground are those of `strips` drawn strips. Curves (distortion of both cameras) have one row
    per point `at`: mm from the principal point along the diagonal, with (5) evaluated literally as `paper`,
    and samples of a CCD, with the printed samples only.
    """
    rows = [*_table1(cameras, seed, strips), *_table2(), *_table3(), *_text(cameras)]
    return pd.DataFrame(rows, columns=COLUMNS)


def _table1(cameras: CameraPair, seed: int, n_strips: int) -> Iterator[Row]:
    errors, pixel_m = paper_scenario().errors, cameras.pixel_rad * HEIGHT_M
    vibration = errors.vibration_arcsec * ARCSEC
    radius = WGS84.semi_major_m + HEIGHT_M
    ground_speed = np.sqrt(GM_EARTH / radius) * WGS84.semi_major_m / radius
    plain = StripPlan(strips=n_strips, targets=20, stars=2, exposures=2)
    plans = {
        "GPS": (replace(plain, sigma_position_m=errors.gps_m), errors.gps_m),
        "vibration": (replace(plain, sigma_vibration_rad=vibration), vibration * HEIGHT_M),
        "clock": (replace(plain, sigma_clock_s=errors.clock_s), errors.clock_s * ground_speed),
        "distortion": (
            replace(
                plain, sigma_distortion_rad=errors.distortion_px * cameras.pixel_rad, distortion_scope="strip"
            ),
            errors.distortion_px * pixel_m,
        ),
    }
    for n, (name, (plan, expected)) in enumerate(plans.items()):
        strips, truth = draw_strips(plan, cameras, np.random.default_rng([seed, n]))
        looks = (R_ci.inv().apply(look_c) for R_ci, look_c in zip(truth.R_ci, truth.look_c))
        parts = [check_point_errors(strip, look_i) for strip, look_i in zip(strips, looks)]
        found = GroundErrors(
            np.concatenate([part.along_m for part in parts]),
            np.concatenate([part.across_m for part in parts]),
        )
        for direction, rms in zip(("along", "across"), found.rms_m):
            if name == "clock" and direction == "across":
                continue  # it acts along the orbit only
            yield "Table 1", f"{name}, {direction}", "m", NONE, TABLE_1_GROUND_M[name], rms, expected


def _table2() -> Iterator[Row]:
    s = paper_scenario().star_camera
    camera = star_camera(s)
    middle = 0.5 * (camera.width_px - 1)
    top, bottom = camera.directions_from_pixels([[middle, -0.5], [middle, camera.height_px - 0.5]])
    ours = {
        "focal length": ("mm", s.focal_mm),
        "field of view in x": ("deg", np.degrees(camera.fov_x_rad)),
        "field of view in y": ("deg", np.degrees(np.arccos(top @ bottom))),
        "data rate": ("Hz", s.rate_hz),
        "principal point x": ("px", s.principal_px[0]),
        "principal point y": ("px", s.principal_px[1]),
        "pixel": ("um", s.pixel_um),
        "p1": ("1/mm", s.p1),
        "p2": ("1/mm", s.p2),
        "q1": ("1/mm2", s.q1),
        "q2": ("1/mm4", s.q2),
    }
    for name, (unit, value) in ours.items():
        yield "Table 2", name, unit, NONE, TABLE_2[name], float(value), NONE
    p1, p2, q1, q2 = (TABLE_2[name] for name in ("p1", "p2", "q1", "q2"))
    pixel_mm, half = camera.pixel_m * 1e3, np.array([camera.width_px, camera.height_px]) / 2.0
    for share in np.linspace(0.0, 1.0, 21):
        x, y = ideal = share * half * pixel_mm
        r2 = x**2 + y**2
        dx = x * (q1 * r2 + q2 * r2**2) + p1 * (r2 + 2 * x**2) + 2 * p2 * x * y  # (5), literally
        dy = y * (q1 * r2 + q2 * r2**2) + p2 * (r2 + 2 * y**2) + 2 * p1 * x * y
        seen = camera.pixels_from_directions([[-x, -y, s.focal_mm]])[0] - np.array(s.principal_px)
        values = np.hypot(dx, dy) / pixel_mm, np.linalg.norm(seen - ideal / pixel_mm)
        yield "Table 2", "distortion", "px", float(np.sqrt(r2)), float(values[0]), float(values[1]), NONE


def _table3() -> Iterator[Row]:
    s = paper_scenario().line_camera
    ours = {
        "focal length": ("m", s.focal_m),
        "pixels of a CCD": ("px", s.samples),
        "pixel": ("m", s.pixel_um * 1e-6),
        "principal point": ("px", s.principal_sample),
    }
    for name, (unit, value) in ours.items():
        yield "Table 3", name, unit, NONE, TABLE_3[name], float(value), NONE
    ccd, printed = calibrated_line_camera(s).ccds[0], TABLE_3_DISTORTION_UM
    for sample in sorted({*printed, *np.linspace(0.0, s.samples - 1.0, 25)}):
        # (4): measured = ideal + offset, so the ideal place is that on a bare detector less the offset
        offset = ccd.bare.focal_plane([sample])[0, 1] - ccd.focal_plane([sample])[0, 1]
        yield (
            "Table 3",
            "distortion",
            "um",
            float(sample),
            printed.get(sample, NONE),
            1e6 * float(offset),
            NONE,
        )


def _text(cameras: CameraPair) -> Iterator[Row]:
    line, splice_m, elevation_m = paper_scenario().line_camera, 2e-6, 1250e3  # section 3.1
    pixel_m = line.pixel_um * 1e-6
    pixel_on_ground_m = pixel_m / line.focal_m * HEIGHT_M
    parallax = splice_m * elevation_m / HEIGHT_M / pixel_m
    across = np.sqrt(np.diag(covariance_shapes(cameras)[0])[:2].mean() * 0.05**2 / 30) / ARCSEC
    computed = {
        "resolution along the orbit": ("m", pixel_on_ground_m),
        "offset by 1250 km of elevation": ("px", parallax),
        "star camera at 0.05 px, 3 sigma": ("arcsec", 3.0 * across),
    }
    for name, (unit, value) in computed.items():
        yield "text", name, unit, NONE, TEXT_VALUES[name], float(value), NONE
