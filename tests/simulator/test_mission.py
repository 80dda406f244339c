"""A whole mission: the same seed gives the same bytes, truth stays in its place, errors are as asked for."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.installation import theta_between
from boresight.geometry.orbit import Orbit
from boresight.geometry.terrain import TerrainGrid
from boresight.simulator.mission import render_mission
from boresight.simulator.mission_records import Mission
from boresight.simulator.scenario import scenario_from_dict


def values_in(record, seen=()):
    """Every array, rotation and number that a record leads to, rendering functions excepted."""
    if dataclasses.is_dataclass(record):
        for field in dataclasses.fields(record):
            if not field.name.startswith("_"):
                yield from values_in(getattr(record, field.name))
    elif isinstance(record, tuple | list):
        for item in record:
            yield from values_in(item)
    else:
        yield record


def test_the_seed_alone_decides_the_mission(stars, tables):
    few = {"per_strip": 1, "check_points_per_strip": 1, "chip_size_px": 40}
    tiny = scenario_from_dict({"based_on": "mini", "strips": {"count": 1, "lines": 80}, "targets": few})
    one, same, other = (render_mission(tiny, stars, *tables, seed=seed) for seed in (11, 11, 12))
    for a, b in ((one, same), (one, other)):
        alike = [
            np.array_equal(a.exposures[3].image(), b.exposures[3].image()),
            np.array_equal(a.orbit.positions_m, b.orbit.positions_m),
            np.array_equal(a.chips[0].image, b.chips[0].image),
            np.array_equal(next(a.strips[3].blocks(80)), next(b.strips[3].blocks(80))),
        ]
        assert alike == [b is same] * 4


def test_a_strip_does_not_depend_on_the_size_of_its_blocks(mission):
    blocks = [list(mission.strips[2].blocks(rows)) for rows in (7, 1000)]
    assert [len(block) for block in blocks[0][:-1]] == [7] * (len(blocks[0]) - 1)
    assert np.array_equal(np.concatenate(blocks[0]), np.concatenate(blocks[1]))
    assert np.concatenate(blocks[0]).shape == (300, 512)


def test_nothing_that_the_mission_knows_is_the_truth(mission):
    public = dataclasses.replace(mission, truth=None)
    true_R_cs = mission.truth.R_cs
    for value in values_in(public):
        if isinstance(value, Rotation):
            assert (value * true_R_cs.inv()).magnitude() > 1e-3
    known = [np.ravel(value) for value in values_in(public) if isinstance(value, np.ndarray)]
    secrets = [mission.truth.orbit.positions_m, mission.truth.line_camera.ccds[0].distortion_offsets_m]
    for secret in secrets:
        assert not any(len(k) == secret.size and np.allclose(k, secret.ravel(), rtol=1e-12) for k in known)
    assert {f.name for f in dataclasses.fields(Mission) if "truth" in f.name.lower()} == {"truth"}


def test_the_installation_is_wrong_by_what_the_scenario_says(mission):
    theta = theta_between(mission.truth.R_cs, mission.installation.R_cs)
    assert np.allclose(theta, [0.003, 0.002, 0.001], rtol=0.0, atol=1e-12)  # rad, rounding
    z_s = mission.installation.R_cs.apply([0.0, 0.0, 1.0])
    assert np.degrees(np.arccos(-z_s[2])) == pytest.approx(40.0, abs=1e-9)


def test_reported_positions_are_wrong_by_one_draw_for_each_strip(mission, tables):
    epoch, times = mission.epoch, mission.orbit.t_s
    earth = EarthRotation.over(epoch, times[0], times[-1], tables[0])
    told, true = (
        Orbit(
            epoch=epoch,
            t_s=o.t_s,
            positions_m=o.positions_m,
            velocities_m_s=o.velocities_m_s,
            frame="ITRF",
            degree=7,
            earth=earth,
        )
        for o in (mission.orbit, mission.truth.orbit)
    )
    for strip, truth in zip(mission.strips[::4], mission.truth.strips):
        t = strip.t_first_row_s + np.linspace(0.0, strip.lines * strip.row_period_s, 9)
        error = told.positions_e(t) - true.positions_e(t)
        # Constant within what the 1 Hz nodes' polynomial carries over from the neighbouring strip: 1 mm.
        assert np.allclose(error, truth.position_error_m, rtol=0.0, atol=1e-3)
    draws = np.array([strip.position_error_m for strip in mission.truth.strips])
    assert 0.5 < draws.std() < 6.0  # m; six draws of 2 m


def test_velocities_are_the_rate_of_the_positions(mission):
    o = mission.orbit
    rate = (o.positions_m[2:] - o.positions_m[:-2]) / 2.0
    third = (o.velocities_m_s[2:] - 2.0 * o.velocities_m_s[1:-1] + o.velocities_m_s[:-2]) / 6.0
    # Central differences with their next term; what is left is of fifth order, and the error's own jerk.
    assert np.abs(rate - third - o.velocities_m_s[1:-1]).max() < 0.03  # m/s


def test_rows_are_reported_with_the_clock_s_error(mission):
    plan = mission.scenario.strips
    for strip in mission.strips:
        n = int(strip.strip_id[1:]) - 1
        true = plan.first_s + n * plan.spacing_s
        offset = mission.truth.strips[n].clock_offset_s
        assert strip.t_first_row_s - true == pytest.approx(offset, abs=1e-12)
        assert 0.0 < abs(offset) < 5e-4  # s, five sigma


def test_exposures_surround_every_row(mission):
    times = np.array([exposure.t_s for exposure in mission.exposures])
    for strip in mission.strips:
        end = strip.t_first_row_s + strip.lines * strip.row_period_s
        assert (times < strip.t_first_row_s).sum() >= 2
        assert (times > end).sum() >= 2
        assert ((times > strip.t_first_row_s - 1.0) & (times < end + 1.0)).sum() >= 4
    assert np.allclose(np.mod(times * 5.0 + 0.5, 1.0), 0.5, atol=1e-9)  # on the star camera's 5 Hz


def test_all_errors_can_be_switched_off(quiet_mission):
    clean = quiet_mission

    assert np.allclose(clean.orbit.positions_m, clean.truth.orbit.positions_m, rtol=0.0, atol=1e-9)
    assert all(strip.clock_offset_s == 0.0 for strip in clean.truth.strips)
    for told, true in zip(clean.line_camera.ccds, clean.truth.line_camera.ccds):
        assert np.array_equal(told.distortion_offsets_m, true.distortion_offsets_m)
    true = {point.point_id: point for point in clean.truth.targets}
    for target in clean.targets:
        point = true[target.target_id]
        assert target.lat_deg == pytest.approx(point.lat_deg, abs=1e-9)  # 0.1 mm
        assert target.lon_deg == pytest.approx(point.lon_deg, abs=1e-9)


def test_vibration_has_the_size_that_was_asked_for(mission):
    attitude = mission.truth
    angles = (attitude.R_ci[1:] * attitude.R_ci[:-1].inv()).as_rotvec()[:200]
    # Steps of 1 ms over 0.2 s: the slow motion is a straight line, what is left is the vibration's step.
    trend = np.polynomial.polynomial.polyfit(np.arange(200), angles, 2)
    left = angles - np.polynomial.polynomial.polyval(np.arange(200), trend).T
    step = left.std(axis=0) / ARCSEC
    # 0.1 arcsec rms at 30 to 80 Hz steps by 0.1 * 2 pi f / 1000 = 0.019 to 0.05 arcsec a millisecond.
    assert np.all((step > 0.012) & (step < 0.06))


def test_targets_and_check_points_are_seen_by_some_ccd(mission):
    ids = {point.point_id for point in mission.truth.targets}
    chips = {chip.target_id for chip in mission.chips}
    assert ids == {target.target_id for target in mission.targets} == chips
    assert len(ids) == 8
    for point in (*mission.truth.targets, *mission.truth.check_points):
        assert -0.5 <= point.sample <= 511.5
        assert -0.5 <= point.line <= 299.5


@pytest.fixture(scope="module")
def rough_mission(small, stars, tables):
    """The small mission with heights that are wrong by 3 m."""
    terrain = dataclasses.replace(small.terrain, error_m=3.0)
    return render_mission(dataclasses.replace(small, terrain=terrain), stars, *tables, seed=11)


def test_the_terrain_that_the_user_gets_is_wrong_by_its_stated_error(mission, rough_mission):
    told, exact = rough_mission.terrain, mission.terrain
    error = (told.heights_m.astype(float) - exact.heights_m)[np.isfinite(exact.heights_m)]
    assert (told.sigma_m, exact.sigma_m) == (3.0, 0.0)
    assert error.std() == pytest.approx(3.0, rel=4.0 / np.sqrt(2 * error.size))  # 4 sigma
    assert abs(error.mean()) < 4.0 * 3.0 / np.sqrt(error.size)


def test_points_lie_on_the_true_terrain_and_not_on_the_one_of_the_user(mission, rough_mission, tables):
    for one, low_m, high_m in ((mission, 0.0, 1e-3), (rough_mission, 0.9, 4.5)):  # interpolation averages
        told = one.terrain
        grid = TerrainGrid.from_raster(told.heights_m, told.affine, "EPSG:4326", tables[1])
        points = one.truth.check_points
        lat, lon, height = np.array([(p.lat_deg, p.lon_deg, p.height_ellipsoidal_m) for p in points]).T
        assert low_m < (grid.height_m(np.radians(lat), np.radians(lon)) - height).std() < high_m


def test_stated_errors_are_those_of_the_draws(mission):
    errors, stated = mission.scenario.errors, mission.errors
    assert stated.position_m == errors.gps_m == 2.0
    assert stated.clock_s == errors.clock_s == 1e-4
    assert stated.vibration_arcsec == errors.vibration_arcsec
    assert stated.look_distortion_px == errors.distortion_px
    assert mission.terrain.sigma_m == mission.scenario.terrain.error_m
