"""Directions and motion of stars in a strip of the sky of which no term vanishes.

Eight stages, rows labelled by the start of their exposure, an oblique scan off the rate of the stages,
correlated errors of sample and line.
"""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from lopsided import EPOCH
from scipy.spatial.transform import Rotation

from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.geometry.orbit import Orbit
from boresight.geometry.starlight import StarPlaces, SurveyedStars
from boresight.pipeline.diagnosis.readings import orders_of
from boresight.pipeline.files.images.tiff import StripFiles
from boresight.pipeline.files.strip_table import Strip
from boresight.pipeline.stages import sky_strip
from boresight.pipeline.stages.sky_side import SkySide
from boresight.pipeline.stages.sky_strip import NamedStars, SkyTask, sky_sightings, strip_motion
from boresight.star_id.strip_stars.find import StripStars
from boresight.star_id.strip_stars.settings import StripStarSettings

STAGES, PERIOD, FIRST_S, LINES = 8, 0.8e-3, 13.7, 2500
FOCAL_M, PITCH_M, TURN_RAD = 10.0, 10e-6, 0.03
CCDS = ((-0.021, 0.004), (0.0012, -0.006))  # y_f of sample 0, x_f of the detector, m
N_PX = 2000
MOUNTING = Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True)
RATE_C = np.array([1.3e-4, 1.62e-3, -7e-4])  # rad/s: 1.3 pixels a row along the stages, and across them
R_CI = Rotation.from_euler("zxz", [-155.0, 112.0, 33.0], degrees=True)  # at the first row's label
MAS = np.radians(1.0 / 3.6e6)
SIGMA, SIGMA_PM = np.array([0.7, 1.9, 4.0]) * MAS, np.array([0.9, 0.4, 2.2]) * MAS  # the latter a year
CCD, XY = np.array([0, 1, 1]), np.array([[210.25, 301.5], [77.0, 1999.75], [1650.5, 903.25]])
COV_PX = np.array(
    [[[0.04, 0.025], [0.025, 0.09]], [[0.01, -0.015], [-0.015, 0.16]], [[0.3, 0.1], [0.1, 0.05]]]
)


def camera_from_gcrs(t_s: float) -> np.ndarray:
    """R_ci: a camera that turns by +RATE_C sees the sky turn by minus that."""
    return (Rotation.from_rotvec(-RATE_C * (t_s - FIRST_S)) * R_CI).as_matrix()


def look(ccd: int, sample: float) -> np.ndarray:
    """u_c of a sample, by hand: a line through the principal sample, turned, imaged upside down."""
    first, offset = CCDS[ccd]
    along = (sample - 1000.0) * PITCH_M
    x_f, y_f = offset - along * np.sin(TURN_RAD), first + 1000.0 * PITCH_M + along * np.cos(TURN_RAD)
    ray = np.array([-x_f, -y_f, FOCAL_M])
    return ray / np.linalg.norm(ray)


def middle_of_row(line: float) -> float:
    """A row labelled by its start is exposed for eight periods."""
    return FIRST_S + line * PERIOD + 4.0 * PERIOD


@pytest.fixture(scope="module")
def task() -> SkyTask:
    earth = EarthRotation.over(EPOCH, -100.0, 100.0, bundled_earth_orientation())
    t = np.arange(-60.0, 90.0, 10.0)
    angle, radius = 1.1e-3 * t + 0.7, 6.9e6
    plane = Rotation.from_euler("zx", [75.0, 97.5], degrees=True)
    circle = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * t])
    forward = np.column_stack([-np.sin(angle), np.cos(angle), 0.0 * t])
    states = {
        "positions_m": plane.apply(radius * circle),
        "velocities_m_s": plane.apply(1.1e-3 * radius * forward),
    }
    orbit = Orbit(epoch=EPOCH, t_s=t, **states, frame="GCRF", degree=7, earth=earth, method="hermite")
    of_all = {"n_px": N_PX, "rotation_rad": TURN_RAD, "pixel_m": PITCH_M, "principal_sample": 1000.0}
    ccds = tuple(Ccd(y_first_m=first, x_offset_m=offset, **of_all) for first, offset in CCDS)
    times = FIRST_S + np.linspace(-0.5, 2.6, 9)
    R_ci = Rotation.from_matrix(np.array([camera_from_gcrs(t) for t in times]))
    rows = {
        "t_first_row_s": FIRST_S,
        "row_period_s": PERIOD,
        "lines": LINES,
        "ccd_lines": {0: LINES, 1: LINES},
    }
    images = {"images": StripFiles({}, {}, {}), "first_row": {0: 0.0, 1: 0.0}}
    attitude = {"t_attitude_s": times, "R_si": MOUNTING.inv() * R_ci, "covariance_c": np.zeros((9, 3, 9, 3))}
    camera = {"camera": LineCamera(FOCAL_M, ccds, STAGES, "start"), "stages": STAGES, "bit_depth": 12}
    mounting = {"R_cs0": MOUNTING, "settings": StripStarSettings(), "carrier": ""}
    strip = Strip(strip_id="sky", kind="sky", **rows, **images)
    return SkyTask(strip=strip, orbit=orbit, **camera, **attitude, **mounting)


@pytest.fixture(scope="module")
def named() -> NamedStars:
    n = len(CCD)
    zero, good = np.zeros(n), np.zeros(n, dtype=bool)
    light = {"flux_dn": 100.0 + zero, "snr": 20.0 + zero, "saturated": good, "blended": good}
    image = {"psf_sigma_px": 0.5, "gain_e_per_dn": 10.0, "misshapen": 0}
    found = StripStars(ccd=CCD, xy_px=XY, cov_px=COV_PX, **light, **image)
    radec = {
        "ra_rad": np.array([0.4, 2.1, 5.5]),
        "dec_rad": np.array([-0.6, 0.9, -1.2]),
        "epoch_jyear": 1991.25,
    }
    still = "pm_ra_rad_yr pm_dec_rad_yr parallax_arcsec radial_velocity_km_s b_v".split()
    places = StarPlaces(hip=np.arange(n) + 7, v_mag=6.0 + zero, **radec, **dict.fromkeys(still, zero))
    sigma = {"sigma_rad": SIGMA, "sigma_pm_rad_yr": SIGMA_PM}
    survey = SurveyedStars(name="HIP", places=places, single=~good, **sigma)
    return NamedStars("sky", found, np.arange(n), survey, zero, ())


def test_a_row_is_the_middle_of_all_its_stages(task: SkyTask, named: NamedStars) -> None:
    seen = sky_sightings(task, named)
    np.testing.assert_allclose(seen.t_s, [middle_of_row(line) for line in XY[:, 1]], rtol=0, atol=1e-12)  # s


def test_errors_of_sample_and_line_move_the_direction_as_the_scan_does(task, named):
    """The direction in the sky that a place means, differentiated by numbers, in the axes of its row."""
    seen, step = sky_sightings(task, named), 0.5
    for n, (ccd, (sample, line)) in enumerate(zip(CCD.tolist(), XY.tolist())):

        def in_the_sky(x: float, y: float, ccd: int = ccd) -> np.ndarray:
            return camera_from_gcrs(middle_of_row(y)).T @ look(ccd, x)

        slopes = [
            in_the_sky(sample + step * dx, line + step * dy)
            - in_the_sky(sample - step * dx, line - step * dy)
            for dx, dy in ((1, 0), (0, 1))
        ]
        J = camera_from_gcrs(middle_of_row(line)) @ np.column_stack(slopes)
        # rad²; a pixel is 1e-6 rad. The differences leave out terms of 1e-6 of these
        np.testing.assert_allclose(seen.cov_c[n], J @ COV_PX[n] @ J.T, rtol=0, atol=1e-17)


def test_errors_of_the_catalogue_are_those_of_the_strip_s_date(task: SkyTask, named: NamedStars) -> None:
    seen = sky_sightings(task, named)
    years = 2025.838 - 1991.25  # 3 November 2025, Hipparcos
    expected = SIGMA**2 + (SIGMA_PM * years) ** 2
    variance = np.trace(seen.cov_target_i, axis1=1, axis2=2) / 2.0  # two axes across the direction
    np.testing.assert_allclose(variance, expected, rtol=1e-4)  # a thousandth of a year


def test_the_motion_of_a_trace_is_that_of_a_star_that_stands_still_in_the_sky(task: SkyTask) -> None:
    """Along the stages a star moves as the ground does, towards -x of frame c."""
    motion = strip_motion(task)
    assert motion.stages == STAGES
    for ccd in (0, 1):
        for k in (0, 16, 32):
            t, middle = middle_of_row(float(motion.lines[k])), 0.5 * (N_PX - 1.0)
            star_i = camera_from_gcrs(t).T @ look(ccd, middle)
            before, after = (camera_from_gcrs(t + half) @ star_i for half in (-PERIOD / 2, PERIOD / 2))
            x, y = FOCAL_M / PITCH_M * (after[:2] / after[2] - before[:2] / before[2])  # px a row
            # the detector's axis is (sin, -cos) of its turn in x and y of c; its normal (cos, sin)
            rate = -(x * np.cos(TURN_RAD) + y * np.sin(TURN_RAD))
            drift = x * np.sin(TURN_RAD) - y * np.cos(TURN_RAD)
            assert rate > 1.1 and abs(drift) > 0.05
            assert motion.rate[ccd, k] == pytest.approx(rate, abs=1e-4)  # px; second order of a row's motion
            assert motion.drift[ccd, k] == pytest.approx(drift, abs=1e-4)


def test_rows_and_columns_in_reverse_begin_at_the_other_end(task, named) -> None:
    side = SkySide(tasks=(task,), found=(named.found,), omissions=())
    columns, rows = (order.apply(side).found[0].xy_px for order in orders_of(task.strip))
    np.testing.assert_allclose(rows, np.column_stack([XY[:, 0], LINES - 1.0 - XY[:, 1]]))
    np.testing.assert_allclose(columns, np.column_stack([N_PX - 1.0 - XY[:, 0], XY[:, 1]]))


def test_a_strip_without_stars_tells_its_size_or_its_one_grey_level(task: SkyTask) -> None:
    shapes = {0: (7, 300), 2: (40, 25), 5: (8, 1000)}
    for level, unlike in ((4094, 0), (4095, 0), (4094, 1), (4094, -1)):  # 4095 is full scale
        counts = {ccd: np.full(shape, level) for ccd, shape in shapes.items()}
        counts[5][4, 999] += unlike  # the last pixel of the last middle line
        images = Mock(shapes=shapes, read=lambda ccd, *at, of=counts: of[ccd][slice(*at[:2]), slice(*at[2:])])
        text = f"grey level {level} throughout{', saturated' * (level == 4095)}: no star in it"
        found = sky_strip._without_stars(replace(task, strip=replace(task.strip, images=images)), 4095.0)
        assert found == ("no star in its 1.11e+04 pixels" if unlike else text)
