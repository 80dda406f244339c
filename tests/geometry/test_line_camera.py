"""Line cameras: what the numbers of Table 3 mean; samples and directions are each other's inverse."""

from dataclasses import fields

import numpy as np
import pytest

from boresight.geometry.line_camera import Ccd, LineCamera, LookAngleCamera, LookTable

# Ends of Table 3 and its principal sample; the values in between are not printed in the paper.
TABLE_3 = np.array([[56.0, 1077.2e-6], [203.0, 866.3e-6], [1500.0, 160e-6], [3067.0, 0.0], [5784.0, -930e-6]])


def ccd(k=0, **change):
    values = {
        "n_px": 6144,
        "y_first_m": -0.122 + k * 0.06,
        "x_offset_m": 0.004 * (-1) ** k,
        "rotation_rad": 2e-3 * (k - 1.3),
        "pixel_m": 1e-5,
        "principal_sample": 3067.0,
        "distortion_samples": TABLE_3[:, 0],
        "distortion_offsets_m": TABLE_3[:, 1] * (1.0 - 0.3 * k),
    }
    return Ccd(**(values | change))


CAMERA = LineCamera(10.0, tuple(ccd(k) for k in range(4)), tdi_stages=32, time_of_row="end")


def plain(**change):
    return ccd(**({"rotation_rad": 0.0, "distortion_samples": [], "distortion_offsets_m": []} | change))


@pytest.mark.parametrize("k", range(4))
def test_samples_come_back_from_their_directions(k):
    sample = np.random.default_rng(k).uniform(-200.0, 6344.0, 5000)
    u_c = CAMERA.directions_from_pixels(k, sample)
    assert np.abs(np.linalg.norm(u_c, axis=1) - 1.0).max() < 1e-15
    found, miss = CAMERA.samples_from_directions(k, u_c)
    assert np.abs(found - sample).max() < 1e-9  # px; the coordinates carry 1e-12
    assert np.abs(miss).max() < 1e-9


def test_the_look_direction_of_a_plain_detector_is_equation_1():
    # [0, -(y - y0), f]: a point of the focal plane at +y looks towards -y.
    camera = LineCamera(10.0, (plain(y_first_m=0.0, x_offset_m=0.0),))
    u_c = camera.directions_from_pixels(0, [0.0, 1000.0])
    assert u_c[0] == pytest.approx([0.0, 0.0, 1.0], abs=1e-15)
    assert u_c[1] == pytest.approx(np.array([0.0, -0.01, 10.0]) / np.hypot(10.0, 0.01), abs=1e-15)


def test_a_detector_ahead_in_the_focal_plane_looks_back():
    camera = LineCamera(10.0, (plain(x_offset_m=0.004),))
    assert camera.directions_from_pixels(0, [3000.0])[0, 0] == pytest.approx(-0.0004, rel=1e-4)


def test_distortion_is_what_the_table_says_at_its_samples_and_smooth_between():
    straight, distorted = plain(), plain(distortion_samples=TABLE_3[:, 0], distortion_offsets_m=TABLE_3[:, 1])
    shift = straight.focal_plane(TABLE_3[:, 0]) - distorted.focal_plane(TABLE_3[:, 0])
    assert shift[:, 1] == pytest.approx(TABLE_3[:, 1], abs=1e-15)  # m; real = ideal + offset
    assert np.abs(shift[:, 0]).max() == 0.0
    # a cubic polynomial is reproduced between its samples to rounding: 1e-12 m is 1e-7 px
    n = np.array([100.0, 900.0, 2200.0, 3900.0, 5300.0, 6100.0])
    offsets = lambda s: 1e-4 * ((s - 3067.0) / 3000.0) ** 3 - 2e-5 * ((s - 3067.0) / 3000.0)  # noqa: E731
    cubic = plain(distortion_samples=n, distortion_offsets_m=offsets(n))
    between = np.linspace(100.0, 6100.0, 1001)
    shift = plain().focal_plane(between) - cubic.focal_plane(between)
    assert np.abs(shift[:, 1] - offsets(between)).max() < 1e-12


def test_beyond_its_ends_the_table_goes_on_straight():
    distorted = plain(distortion_samples=TABLE_3[:, 0], distortion_offsets_m=TABLE_3[:, 1])
    beyond = distorted.focal_plane(np.array([5784.0, 5984.0, 6184.0]))[:, 1]
    assert np.diff(beyond, 2) == pytest.approx(0.0, abs=1e-15)
    slope = distorted.focal_plane_slope(np.array([5784.0 - 1e-6, 5784.0 + 1e-6]))[:, 1]
    assert slope[0] == pytest.approx(slope[1], abs=1e-14)  # m/px; no corner at the end


def test_rotation_turns_the_detector_about_its_principal_sample_from_x_to_y():
    turned = plain(rotation_rad=0.3, y_first_m=0.1, x_offset_m=0.02)
    centre = turned.focal_plane([3067.0])[0]
    assert centre == pytest.approx([0.02, 0.1 + 3067e-5], abs=1e-15)
    along = turned.focal_plane([4067.0])[0] - centre
    assert along == pytest.approx([-0.01 * np.sin(0.3), 0.01 * np.cos(0.3)], abs=1e-15)


def test_the_miss_across_the_detector_counts_towards_positive_x():
    u_c = CAMERA.directions_from_pixels(1, [2000.0, 4000.0])
    shifted = u_c + np.array([5e-6, 0.0, 0.0])  # 5 px of 1e-6 rad
    _, miss = CAMERA.samples_from_directions(1, shifted)
    assert miss == pytest.approx([5.0, 5.0], abs=1e-2)


@pytest.mark.parametrize("k", [0, 3])
def test_jacobian_is_the_derivative(k):
    sample = np.array([0.0, 57.0, 1234.5, 3066.0, 6143.0])
    h = 1e-2
    difference = (
        CAMERA.directions_from_pixels(k, sample + h) - CAMERA.directions_from_pixels(k, sample - h)
    ) / (2 * h)
    assert np.abs(CAMERA.sample_jacobian(k, sample) - difference).max() < 2e-14  # rad/px, of 1e-6


def test_rows_stand_for_the_middle_of_their_exposure():
    # 32 stages of 70 us: 1.12 ms from either end to the middle
    for time_of_row, delay in (("start", 1.12e-3), ("middle", 0.0), ("end", -1.12e-3)):
        camera = LineCamera(10.0, CAMERA.ccds, 32, time_of_row)
        assert camera.delay_to_middle_s(70e-6) == pytest.approx(delay, abs=1e-15)


def test_directions_behind_the_camera_have_no_sample():
    sample, miss = CAMERA.samples_from_directions(0, np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]))
    assert np.isnan(sample[0]) and np.isnan(miss[0]) and np.isfinite(sample[1])


def test_impossible_detectors_are_refused():
    with pytest.raises(ValueError, match="increasing order"):
        plain(distortion_samples=[5.0, 3.0], distortion_offsets_m=[0.0, 0.0])
    with pytest.raises(ValueError, match="offsets"):
        plain(distortion_samples=[3.0, 5.0], distortion_offsets_m=[0.0])
    with pytest.raises(ValueError, match="reverses the order"):
        plain(distortion_samples=[0.0, 6000.0], distortion_offsets_m=[0.0, 0.1])
    with pytest.raises(ValueError, match="at least one"):
        LineCamera(10.0, ())
    with pytest.raises(ValueError, match="time_of_row"):
        LineCamera(10.0, CAMERA.ccds, 32, "noon")


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_look_angles_are_inverted_in_either_order_along_the_line(sign):
    samples = np.linspace(0.0, 39_999.0, 41)
    tan_x = 8e-5 + 1e-6 * np.sin(samples / 9000.0)
    tan_y = sign * (-0.0142 + 7.11e-7 * samples + 1e-6 * np.cos(samples / 7000.0))
    camera = LookAngleCamera((LookTable(40_000, samples, tan_x, tan_y),))
    at = np.random.default_rng(2).uniform(-50.0, 40_050.0, 2000)
    u_c = camera.directions_from_pixels(0, at)
    found, miss = camera.samples_from_directions(0, u_c)
    assert np.abs(found - at).max() < 1e-8 and np.abs(miss).max() < 1e-8  # px
    _, miss = camera.samples_from_directions(0, u_c + np.array([7.11e-6, 0.0, 0.0]))
    assert miss == pytest.approx(np.full(len(at), 10.0), rel=1e-2)
    h = 1e-1
    beyond, before = (camera.directions_from_pixels(0, at + step) for step in (h, -h))
    difference = (beyond - before) / (2 * h)
    assert np.abs(camera.sample_jacobian(0, at) - difference).max() < 1e-14


def test_no_detector_has_a_number_that_is_not_finite():
    table = {"samples": [0.0, 5.0, 9.0], "tan_x": [0.1, 0.2, 0.1], "tan_y": [-0.1, 0.0, 0.1]}
    lists, arrays = (
        LookAngleCamera((LookTable(10, **of),))
        for of in (table, {key: np.array(value) for key, value in table.items()})
    )
    assert np.array_equal(lists.directions_from_pixels(0, [3.0]), arrays.directions_from_pixels(0, [3.0]))
    for key, value in table.items():
        with pytest.raises(ValueError, match="LookTable"):
            LookTable(10, **(table | {key: [value[0], np.nan, value[2]]}))
    across = {"across_offsets_m": 0.1 * TABLE_3[:, 1]}
    for key, value in {f.name: getattr(ccd(**across), f.name) for f in fields(Ccd) if f.init}.items():
        broken = np.where(np.arange(np.size(value)) == 1, np.nan, value) if np.ndim(value) else np.nan
        with pytest.raises(ValueError, match=r"finite|number|increasing"):
            ccd(**(across | {key: broken}))


def test_look_angles_that_double_back_are_refused():
    with pytest.raises(ValueError, match="monotone"):
        LookTable(10, np.arange(3.0), np.zeros(3), np.array([0.0, 1.0, 0.5]))


def test_the_angle_of_a_pixel_is_that_between_the_samples_around_the_middle_of_the_first_ccd():
    tables = []
    for bend in (6e-9, 2e-9):  # tan x and tan y of sample numbers from 0: steps grow towards the end
        sample = np.linspace(0.0, 6143.0, 60)
        tables.append(LookTable(6144, sample, bend * sample**1.5, 1e-6 * sample + bend * sample**2))
    camera = LookAngleCamera(tuple(tables))
    a, b = camera.directions_from_pixels(0, [3071.0, 3072.0])  # 6144 pixels: the middle is 3071.5
    assert camera.pixel_rad == pytest.approx(np.linalg.norm(np.cross(a, b)), rel=1e-5)
