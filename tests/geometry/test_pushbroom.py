"""The rigorous model of a strip: against physics worked out in the inertial frame; there and back again."""

import erfa
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from strips import EARTH, LINES, PERIOD_S, R_CS, attitude, orbit, states, strip

from boresight.geometry.constants import SPEED_OF_LIGHT, WGS84
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.groundlight import LightEffects, apparent_ground_directions
from boresight.geometry.orbit import OrbitGapError
from boresight.geometry.pushbroom import RowClock
from boresight.geometry.terrain import ConstantHeight, TerrainGrid

NO_AIR = LightEffects(light_time=True, aberration=True, refraction=False)


def pixels(number, seed=1):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.0, 6143.0, number), rng.uniform(0.0, LINES, number)


def relief(model, amplitude_m, seed=4):
    """Fractal relief on a grid of 0.0004 deg around a strip."""
    ends = np.array([0.0, 6143.0, 0.0, 6143.0]), np.array([0.0, 0.0, LINES, LINES])
    corners = np.vstack([model.ground_points(k, *ends, ConstantHeight(0.0)) for k in (0, 3)])
    lat, lon, _ = np.degrees(geodetic_from_ecef(corners, WGS84))
    n, west, north = 1024, lon.min() - 0.05, lat.max() + 0.05
    step_x, step_y = (lon.max() + 0.05 - west) / n, (north - lat.min() + 0.05) / n
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n)))
    frequency[0, 0] = 1.0
    noise = np.random.default_rng(seed).normal(size=(n, n))
    z = np.fft.ifft2(np.fft.fft2(noise) * frequency**-2.2).real
    z = 150.0 + amplitude_m * (z - z.min()) / np.ptp(z)
    return TerrainGrid.from_raster(z, (step_x, 0.0, west, 0.0, -step_y, north), "EPSG:4326", None)


def test_pixels_look_where_light_comes_from_by_inertial_physics():
    # Everything in GCRS, instant by instant, aberration by ERFA: 3e-13 rad is 3e-7 px; measured 1.2e-13.
    model = strip(12.0, -7.0, NO_AIR)
    sample, line = pixels(50)
    ground_e = model.ground_points(1, sample, line, ConstantHeight(1234.0))
    u_i, t_s = model.look_i(1, sample, line)
    for u, t, p_e in zip(u_i, t_s, ground_e):
        satellite, velocity = (value[0] for value in states(np.array([t])))
        emitted = t
        for _ in range(6):
            source = EARTH.rotations_ie(np.array([emitted])).apply(p_e)[0]
            emitted = t - np.linalg.norm(source - satellite) / SPEED_OF_LIGHT
        natural = (source - satellite) / np.linalg.norm(source - satellite)
        beta = velocity / SPEED_OF_LIGHT
        seen = erfa.ab(natural, beta, 1e12, np.sqrt(1.0 - beta @ beta))  # the Sun too far to matter
        assert np.linalg.norm(seen - u) < 3e-13


@pytest.mark.parametrize(("roll", "pitch"), [(0, 0), (30, 0), (-30, 0), (0, 30), (0, -30), (20, -20)])
@pytest.mark.parametrize("ccd", [0, 3])
def test_ground_leads_back_to_the_pixel_it_is_seen_in(roll, pitch, ccd):
    # 1e-4 px over swath, heights and +-30 deg, as asked; measured 1e-8 px, and 2e-6 px 4 km above the
    # ellipsoid.
    model = strip(roll, pitch)
    sample, line = pixels(300)
    for height in (-50.0, 900.0, 4000.0):
        found = model.pixels_from_ground(ccd, model.ground_points(ccd, sample, line, ConstantHeight(height)))
        assert np.abs(found[0] - sample).max() < 1e-4 and np.abs(found[1] - line).max() < 1e-4


@pytest.mark.parametrize(("roll", "pitch"), [(0, 0), (30, 0), (0, -30)])
def test_terrain_leads_back_to_the_pixel_it_is_seen_in(roll, pitch):
    # 5000 pixels go through the table over the rows and the assumed heights; measured 3e-5 px.
    model = strip(roll, pitch)
    surface = relief(model, 2500.0)
    sample, line = pixels(5000)
    ground_e = model.ground_points(2, sample, line, surface)
    assert np.isfinite(ground_e).all()
    lat, lon, height = geodetic_from_ecef(ground_e, WGS84)
    assert np.abs(height - surface.height_m(lat, lon)).max() < 1e-3  # m, on the terrain
    found = model.pixels_from_ground(2, ground_e)
    assert np.abs(found[0] - sample).max() < 1e-4 and np.abs(found[1] - line).max() < 1e-4


@pytest.mark.parametrize("yaw", [180.0, 170.0, -40.0])
def test_a_camera_that_flies_backwards_or_askew_is_inverted_too(yaw):
    model = strip(8.0, 5.0, yaw_deg=yaw)
    sample, line = pixels(200)
    found = model.pixels_from_ground(1, model.ground_points(1, sample, line, ConstantHeight(50.0)))
    assert np.abs(found[0] - sample).max() < 1e-6 and np.abs(found[1] - line).max() < 1e-6  # px


def test_many_pixels_and_few_pixels_agree():
    # Many go through a table over the rows, few through orbit and attitude themselves: 1e-6 px of 0.5 m.
    model = strip(5.0, 8.0)
    sample, line = pixels(3000)
    many = model.ground_points(0, sample, line, ConstantHeight(300.0))
    few = np.vstack(
        [
            model.ground_points(0, sample[k : k + 100], line[k : k + 100], ConstantHeight(300.0))
            for k in range(0, 600, 100)
        ]
    )
    assert np.abs(many[:600] - few).max() < 5e-7  # m
    table = model.tabulated(-10.0, LINES)
    assert np.abs(table.ground_points(0, sample, line, ConstantHeight(300.0)) - many).max() < 5e-7
    from_table, alone = table.pixels_from_ground(0, few), model.pixels_from_ground(0, few[:3])
    assert np.abs(np.array(from_table)[:, :3] - np.array(alone)).max() < 1e-6  # px


def test_light_effects_have_the_sizes_that_physics_gives_them():
    # v/c = 2.53e-5 times 530 km; the Earth's turn in 1.8 ms at 36 deg N; refraction vanishes at nadir.
    nothing = LightEffects(light_time=False, aberration=False, refraction=False)
    sample, line = np.full(5, 3000.0), np.linspace(0.0, LINES, 5)
    bare = strip(0.0, 0.0, nothing).ground_points(1, sample, line, ConstantHeight(0.0))
    for name, low, high in (("aberration", 13.0, 13.9), ("light_time", 0.6, 0.75), ("refraction", 0.0, 0.05)):
        effects = LightEffects(**{n: n == name for n in ("light_time", "aberration", "refraction")})
        moved = strip(0.0, 0.0, effects).ground_points(1, sample, line, ConstantHeight(0.0)) - bare
        size = np.linalg.norm(moved, axis=1)
        assert low <= size.min() and size.max() <= high, name


def test_the_rows_instant_is_the_middle_of_its_tdi_exposure():
    # 64 stages: a label at the end of the exposure is 32 periods late, so line n + 32 looks where line n did.
    labelled_middle, labelled_end = strip(tdi_stages=64), strip(tdi_stages=64, time_of_row="end")
    sample, line = pixels(20)
    u, t = labelled_middle.look_i(2, sample, line)
    later, same = labelled_end.look_i(2, sample, line + 32.0)
    assert np.abs(later - u).max() < 1e-14 and np.abs(same - t).max() < 1e-12
    assert RowClock(1.0, 0.5).row(RowClock(1.0, 0.5).instant([4.25])) == pytest.approx([4.25])


def test_attitude_and_installation_make_the_look_direction():
    model = strip()
    sample, line = pixels(30)
    u_i, t_s = model.look_i(0, sample, line)
    u_c = (R_CS * model.attitude.R_si(t_s)).apply(u_i)
    assert np.abs(u_c - model.camera.directions_from_pixels(0, sample)).max() < 1e-15
    turned = Rotation.from_rotvec([0.003, -0.002, 0.001]) * R_CS
    other, _ = model.with_installation(turned).look_i(0, sample, line)
    assert np.abs((turned * model.attitude.R_si(t_s)).apply(other) - u_c).max() < 1e-15


def test_a_table_turns_with_the_installation_matrix():
    # Against the model without a table: 1e-7 m of position and 1e-13 rad of attitude are 3e-13 rad seen
    # from 530 km; a turn of the wrong sense or order would be milliradians.
    turned = Rotation.from_rotvec([0.2, -0.3, 0.4]) * R_CS
    exact, table = strip(5.0, 8.0), strip(5.0, 8.0).tabulated(-10.0, LINES).with_installation(turned)
    sample, line = pixels(30)
    p_e = exact.ground_points(2, sample, line, ConstantHeight(100.0))
    seen = exact.with_installation(turned).directions_c(p_e, line)
    assert np.abs(table.directions_c(p_e, line) - seen).max() < 1e-12
    u_i, _ = apparent_ground_directions(p_e, exact.instants(line), exact.orbit, EARTH, exact.effects)
    assert np.abs((turned * exact.attitude.R_si(exact.instants(line))).apply(u_i) - seen).max() < 1e-12


def test_jacobian_tells_how_a_shift_in_the_image_turns_the_look_direction():
    # Shift the pixel, ask where its ground was seen at the unshifted instant: that is the change of u_c.
    model = strip(15.0, 10.0)
    sample, line = pixels(20)
    ccds, xy_px = np.ones(len(line), dtype=int), np.column_stack([sample, line])
    J = model.directions_and_jacobian(ccds, xy_px, height_m=200.0)[1]
    u_c = model.camera.directions_from_pixels(1, sample)
    for axis, (ds, dl) in enumerate([(0.5, 0.0), (0.0, 0.5)]):
        seen = []
        for sign in (1.0, -1.0):
            ground = model.ground_points(1, sample + sign * ds, line + sign * dl, ConstantHeight(200.0))
            frozen = [  # a camera stopped at the instant of the row, by a row period that never ends
                np.array(model._apparent_c(ground[k : k + 1], model._states(line[k : k + 1]))[0][0])
                for k in range(len(line))
            ]
            seen.append(np.array(frozen))
        assert np.abs(seen[0] - seen[1] - J[:, :, axis]).max() < 2e-12  # rad/px, of 1e-6
    assert np.abs(np.einsum("ni,nij->nj", u_c, J)).max() < 1e-12
    # one line is one row period of ground motion: 0.93 px of the row pitch at this height
    assert np.linalg.norm(J[:, :, 1], axis=1) == pytest.approx(np.full(20, 7.3e3 * PERIOD_S / 560e3), rel=0.1)


def test_what_is_never_seen_has_no_pixel():
    model = strip()
    ground = model.ground_points(0, np.array([100.0, 3000.0]), np.array([50.0, 9000.0]), ConstantHeight(0.0))
    behind_the_earth = -ground[:1]
    later = np.array([30.0])
    far_ahead = EARTH.rotations_ie(later).inv().apply(states(later)[0]) * (6.371 / 6.908)
    unknown = np.full((1, 3), np.nan)
    sample, line = model.pixels_from_ground(0, np.vstack([behind_the_earth, ground, far_ahead, unknown]))
    assert np.isnan(sample[[0, 3, 4]]).all() and np.isnan(line[[0, 3, 4]]).all()
    assert sample[1:3] == pytest.approx([100.0, 3000.0], abs=1e-6)
    none = model.pixels_from_ground(0, unknown)
    assert np.isnan(none[0]).all() and len(model.pixels_from_ground(0, np.zeros((0, 3)))[0]) == 0


def test_pixels_off_the_detector_are_found_all_the_same():
    model = strip()
    sample = np.array([-500.0, 7000.0])
    ground = model.ground_points(1, sample, np.array([100.0, 200.0]), ConstantHeight(0.0))
    assert model.pixels_from_ground(1, ground)[0] == pytest.approx(sample, abs=1e-6)


def test_rows_outside_orbit_or_attitude_are_refused():
    model = strip()
    with pytest.raises(ValueError, match="outside the exposures"):
        model.look_i(0, [10.0], [60_000.0])
    with pytest.raises((OrbitGapError, ValueError)):
        model.ground_points(0, [10.0], [1e6], ConstantHeight(0.0))


def test_the_track_of_exposures_is_what_the_model_was_given():
    path = orbit()
    track = attitude(path)
    assert track.span_s == pytest.approx((-0.5, 2.5), abs=1e-9)


def test_ground_behind_the_horizon_has_no_pixel():
    # The line of sight goes on through the Earth and leaves it again: that point lies in the same direction.
    model = strip(20.0, -10.0, LightEffects(light_time=False, aberration=False, refraction=False))
    sample, line = pixels(20)
    near_e = model.ground_points(1, sample, line, ConstantHeight(0.0))
    satellite_e = model.orbit.positions_e(model.instants(line))
    along = (near_e - satellite_e) / np.linalg.norm(near_e - satellite_e, axis=1, keepdims=True)
    scale = np.array([WGS84.semi_major_m, WGS84.semi_major_m, WGS84.semi_minor_m])
    a, p = along / scale, near_e / scale
    far_e = near_e - along * (2.0 * (a * p).sum(axis=1) / (a * a).sum(axis=1))[:, None]
    assert np.abs(geodetic_from_ecef(far_e, WGS84)[2]).max() < 1e-3  # m: on the ellipsoid, 12 000 km on
    assert np.isfinite(model.pixels_from_ground(1, near_e)[0]).all()
    assert np.isnan(model.pixels_from_ground(1, far_e)[0]).all()
