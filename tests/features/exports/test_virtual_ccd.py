"""The virtual CCD: its place by least squares, and that stitched strips show no seam."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.fft import irfft2, rfft2, rfftfreq
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter
from strips import PERIOD_S, R_CS, attitude, orbit, pushbroom

from boresight.features.exports.virtual_ccd import VirtualStrip, _nodes, virtual_camera
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef, local_axes_e
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.geometry.pushbroom import RowClock
from boresight.geometry.terrain import ConstantHeight, TerrainGrid

WIDTH, OVERLAP, LINES, HEIGHT_M = 400, 64, 2400, 250.0
STEP_M = 0.5  # of the texture
ALL_LINES = dict.fromkeys(range(4), LINES)


def small_camera():
    """Four CCDs of 400 px, overlapping by 64, staggered by 200 px, each with its own turn and distortion."""
    n = np.array([0.0, 100.0, 200.0, 300.0, 399.0])
    bend = np.array([9e-6, 3e-6, 0.0, -2e-6, -8e-6])
    return LineCamera(
        10.0,
        tuple(
            Ccd(
                n_px=WIDTH,
                y_first_m=(k * (WIDTH - OVERLAP) - 700) * 1e-5,
                x_offset_m=1e-3 * (-1) ** k + 1e-4 * k,
                rotation_rad=1e-3 * (k - 1.4),
                pixel_m=1e-5 * (1.0 + 1e-4 * k),
                principal_sample=200.0,
                distortion_samples=n,
                distortion_offsets_m=bend * (1.0 - 0.7 * k),
            )
            for k in range(4)
        ),
        tdi_stages=16,
        time_of_row="end",
    )


def small_strip():
    path = orbit()
    track = attitude(path, 4.0, -3.0, wave_rad=1.5e-4)
    return pushbroom(small_camera(), RowClock(0.5, PERIOD_S), path, track, R_CS)


class Ground:
    """A band-limited random texture on the plane of a place, wavelengths from 2.5 m, sampled at 0.5 m."""

    def __init__(self, model, rng):
        corners = np.vstack(
            [
                model.ground_points(
                    k,
                    [0.0, WIDTH - 1.0] * 2,
                    [-500.0, -500.0, LINES + 500.0, LINES + 500.0],
                    ConstantHeight(HEIGHT_M),
                )
                for k in (0, 3)
            ]
        )
        lat, lon, _ = geodetic_from_ecef(corners, WGS84)
        self.origin = ecef_from_geodetic(lat.mean(), lon.mean(), HEIGHT_M, WGS84)
        self.axes = local_axes_e(lat.mean(), lon.mean())[:, :2]
        en = (corners - self.origin) @ self.axes
        self.low = en.min(axis=0) - 30.0
        size = np.ceil((np.ptp(en, axis=0) + 60.0) / STEP_M).astype(int)
        noise = rng.normal(size=size)
        f = np.hypot(*np.meshgrid(np.fft.fftfreq(size[0], STEP_M), rfftfreq(size[1], STEP_M), indexing="ij"))
        texture = irfft2(rfft2(noise) * (f < 0.4) / np.maximum(f, 0.01), s=size)
        self.texture = spline_filter(100.0 + 30.0 * texture / texture.std(), order=5)

    def seen_at(self, p_e):
        at = ((p_e - self.origin) @ self.axes - self.low) / STEP_M
        return map_coordinates(self.texture, at.T, order=5, prefilter=False, mode="nearest")


@pytest.fixture(scope="module")
def scene():
    """The strip and its four raw images of flat textured ground."""
    model = small_strip().tabulated(-600.0, LINES + 600.0)
    ground = Ground(model, np.random.default_rng(11))
    sample, line = (a.ravel() for a in np.meshgrid(np.arange(float(WIDTH)), np.arange(float(LINES))))
    raw = [
        ground.seen_at(model.ground_points(k, sample, line, ConstantHeight(HEIGHT_M))).reshape(LINES, WIDTH)
        for k in range(4)
    ]
    return model, ground, raw


def reader(raw):
    return lambda ccd, line0, line1, sample0, sample1: raw[ccd][line0:line1, sample0:sample1]


def shift_between(a, b):
    """(line, sample) shift of b against a by least squares on gradients, of images without finest detail."""
    a, b = gaussian_filter(a, 1.5), gaussian_filter(b, 1.5)
    g0, g1 = np.gradient(0.5 * (a + b))
    inner = (slice(4, -4), slice(4, -4))
    G = np.column_stack([g0[inner].ravel(), g1[inner].ravel(), np.ones(g0[inner].size)])
    return np.linalg.lstsq(G, (a - b)[inner].ravel(), rcond=None)[0][:2]


def test_the_virtual_line_is_the_least_squares_line_through_all_pixels():
    camera = small_camera()
    points = np.vstack([ccd.focal_plane(np.arange(WIDTH)) for ccd in camera.ccds])
    a, b = np.polyfit(points[:, 1], points[:, 0], 1)
    ideal, pitch = virtual_camera(camera), np.mean([ccd.pixel_m for ccd in camera.ccds])
    n = np.arange(ideal.n_px(0), dtype=float)
    on_line = ideal.ccds[0].focal_plane(n)
    assert np.abs(on_line[:, 0] - (a * on_line[:, 1] + b)).max() < 1e-12  # m
    steps = np.linalg.norm(np.diff(on_line, axis=0), axis=1)
    assert steps == pytest.approx(np.full(len(n) - 1, pitch), abs=1e-15)
    assert on_line[0, 1] == pytest.approx(points[:, 1].min(), abs=1e-12)
    assert points[:, 1].max() - 1e-5 < on_line[-1, 1] <= points[:, 1].max()
    # an ideal pinhole: look directions are those of the line, without distortion
    u_c = ideal.directions_from_pixels(0, n)
    assert np.abs(-u_c[:, :2] / u_c[:, 2:] * 10.0 - on_line).max() < 1e-14


def test_a_plain_detector_is_its_own_virtual_ccd():
    place = {"y_first_m": -0.01, "x_offset_m": 0.003, "rotation_rad": 0.02, "principal_sample": 250.0}
    plain = LineCamera(10.0, (Ccd(n_px=500, pixel_m=1e-5, **place),))
    ideal = virtual_camera(plain)
    n = np.array([0.0, 123.0, 498.0])
    difference = ideal.directions_from_pixels(0, n) - plain.directions_from_pixels(0, n)
    assert np.abs(difference).max() < 1e-12  # rad; the pitch is along the line


def test_every_virtual_pixel_finds_the_ground_in_the_real_image(scene):
    model, _, _ = scene
    strip = VirtualStrip(model, ConstantHeight(HEIGHT_M))
    for ccd, begin, end in strip.seams(1200.0):
        at = np.linspace(max(begin, 0.0), min(end, strip.width_px - 1.0), 20), np.full(20, 1200.0)
        sample, line = strip.source_pixels(ccd, *at)
        # the Earth turns by 10 px between the rows
        assert sample.min() > -12.0 and sample.max() < WIDTH + 12.0
        ground = strip.virtual.ground_points(0, *at, ConstantHeight(HEIGHT_M))
        real = model.ground_points(ccd, sample, line, ConstantHeight(HEIGHT_M))
        assert np.abs(real - ground).max() < 1e-5  # m


def test_no_shift_is_left_along_any_seam_of_a_stitched_strip(scene):
    # 0.05 px rms, as asked, along the whole seam; measured 0.007, all of it the rounding to 1/32 px.
    model, _, raw = scene
    strip = VirtualStrip(model, ConstantHeight(HEIGHT_M))
    parts = strip.seams(1200.0)
    for (left, _, seam), (right, _, _) in pairwise(parts):
        window = (int(seam) - 20, int(seam) + 20)
        both = [strip.resampled(k, reader(raw), LINES, (250, LINES - 250), window) for k in (left, right)]
        shifts = np.array(
            [
                shift_between(both[0][top : top + 50], both[1][top : top + 50])
                for top in range(0, len(both[0]) - 49, 50)
            ]
        )
        assert len(shifts) == 38 and np.isfinite(shifts).all()
        assert np.sqrt((shifts**2).mean(axis=0)).max() < 0.05  # px
        assert np.abs(shifts.mean(axis=0)).max() < 0.01


def test_the_stitched_image_is_the_one_the_virtual_ccd_would_take(scene):
    # Grey values have sigma 30 and change by 6 a pixel: 0.05 px is 0.3.
    model, ground, raw = scene
    strip = VirtualStrip(model, ConstantHeight(HEIGHT_M))
    image = strip.stitched(reader(raw), ALL_LINES, (1000, 1300))
    assert image.shape == (300, strip.width_px)
    line, sample = (a.ravel() for a in np.mgrid[1000.0:1300.0, 0 : strip.width_px])
    places = strip.virtual.ground_points(0, sample.astype(float), line, ConstantHeight(HEIGHT_M))
    truth = ground.seen_at(places)
    known = np.isfinite(image)
    assert known[:, 6:-6].all()
    assert np.sqrt(((image - truth.reshape(image.shape))[known] ** 2).mean()) < 1.0


def test_a_terrain_takes_the_place_of_the_plane(scene):
    model, _, raw = scene
    lat, lon, _ = np.degrees(
        geodetic_from_ecef(model.ground_points(1, [200.0], [1100.0], ConstantHeight(0.0)), WGS84)
    )
    flat = TerrainGrid.from_raster(
        np.full((50, 50), HEIGHT_M), (0.004, 0.0, lon[0] - 0.1, 0.0, -0.004, lat[0] + 0.1), "EPSG:4326", None
    )
    plane, terrain = (
        VirtualStrip(model, s).stitched(reader(raw), ALL_LINES, (800, 830))
        for s in (ConstantHeight(HEIGHT_M), flat)
    )
    assert np.nanmax(np.abs(plane - terrain)) < 0.05  # grey values: places rounded alike


def test_what_no_detector_saw_stays_unknown(scene):
    model, _, raw = scene
    strip = VirtualStrip(model, ConstantHeight(HEIGHT_M))
    first = strip.stitched(reader(raw), ALL_LINES, (0, 40))  # half of the CCDs look ahead, half behind
    assert np.isnan(first).any() and np.isfinite(first).any()
    assert np.isnan(strip.stitched(reader(raw), ALL_LINES, (-400, -300))).all()
    with pytest.raises(TypeError, match="LineCamera"):
        VirtualStrip(replace(model, camera=None), ConstantHeight(0.0))


@pytest.mark.parametrize(("first", "last", "step", "count"), [(5000.0, 5300.0, 64, 5), (7.0, 9.0, 64, 4)])
def test_nodes_are_no_denser_than_asked_for_and_end_with_the_pixels(first, last, step, count):
    nodes = _nodes(np.arange(first, last + 1.0), step)
    assert np.allclose(nodes, first + (last - first) * np.arange(count + 1) / count, rtol=1e-15)
