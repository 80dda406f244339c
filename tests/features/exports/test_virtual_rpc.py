"""RPCs of virtual CCDs with smooth attitudes, through GDAL, against places of the raw pixels."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from command_line import ran
from orbiting_camera import EPOCH, R_CS
from rasterio.rpc import RPC
from rasterio.transform import RPCTransformer
from scipy.spatial.transform import Rotation
from strips import pushbroom

from boresight.features.exports.ground_error import GroundError, ground_error
from boresight.features.exports.rpc import fit_rpc, rpc_heights, rpc_metadata
from boresight.features.exports.virtual_ccd import VirtualStrip
from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.constants import GM_EARTH, WGS84
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import Pushbroom, RowClock
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.files.terrain_files import surface_of
from boresight.pipeline.results.strip_model import open_calibrated, whole_strip_model

MOST_PX = 0.01  # asked of every export read back against `geolocate`
PERIOD_S = 7e-5
SECONDS = 12.0
LINES = round(SECONDS / PERIOD_S)


def jittery(latitude_argument: float, node_deg: float, hz: float) -> Pushbroom:
    """0.53 m pixels, three staggered, turned CCDs that begin at different rows, off nadir on two axes;
    jitter of 5 µrad (5 px) about each axis, and a drift that grows with the square of time.
    """
    t = np.arange(-10.0, 30.0)
    earth = EarthRotation.over(EPOCH, t[0], t[-1], bundled_earth_orientation())
    radius = 6_908_137.0
    rate = np.sqrt(GM_EARTH / radius**3)
    turn = Rotation.from_euler("ZX", [node_deg, 97.5], degrees=True)
    u = latitude_argument + rate * t
    p = radius * turn.apply(np.column_stack([np.cos(u), np.sin(u), 0.0 * u]))
    v = radius * rate * turn.apply(np.column_stack([-np.sin(u), np.cos(u), 0.0 * u]))
    orbit = Orbit(epoch=EPOCH, t_s=t, positions_m=p, velocities_m_s=v, frame="GCRF", degree=7, earth=earth)
    t_star = np.arange(-1.0, SECONDS + 2.0, 0.03)
    jitter = 5e-6 * np.sin(2.0 * np.pi * hz * t_star[:, None] + [0.0, 1.0, 2.5])
    drift = np.outer(((t_star - 3.0) / SECONDS) ** 2, [3e-4, -5e-4, 8e-4])
    R_ci = Rotation.from_rotvec(jitter + drift) * Rotation.from_euler("xy", [0.12, -0.2]) * orbit.R_oi(t_star)
    ccds = [
        Ccd(
            n_px=4000,
            y_first_m=-0.055 + 0.0385 * k,
            x_offset_m=(0.002, -0.004, 0.003)[k],
            rotation_rad=(1.2e-3, -8e-4, 2e-4)[k],
            pixel_m=1e-5,
            principal_sample=1000.0,
        )
        for k in range(3)
    ]
    rows = RowClock(0.3, PERIOD_S, {0: 0.0, 1: 412.37, 2: -97.5})
    attitude = AttitudeTrack(t_star, R_CS.inv() * R_ci, orbit)
    return pushbroom(LineCamera(10.0, tuple(ccds), 16, "end"), rows, orbit, attitude, R_CS)


def by_gdal(rpc: RPC, p_e: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of places, (0, 0) the middle of the first pixel; GDAL counts from its corner."""
    lat, lon, height = geodetic_from_ecef(p_e, WGS84)
    with RPCTransformer(rpc) as gdal:
        rows, columns = gdal.rowcol(np.degrees(lon), np.degrees(lat), zs=height, op=np.asarray)
    return np.column_stack([columns, rows]) - 0.5


@pytest.mark.parametrize(
    ("latitude_argument", "node_deg", "hz", "north", "east"),
    [(-0.6, 60.0, 1.0, False, False), (0.7, -110.0, 2.0, True, True), (3.9, 100.0, 1.3, False, True)],
)
def test_an_rpc_of_the_virtual_ccd_finds_the_places_of_the_raw_pixels(
    latitude_argument: float, node_deg: float, hz: float, north: bool, east: bool
) -> None:
    model = jittery(latitude_argument, node_deg, hz)
    rng = np.random.default_rng(3)
    for height in (0.0, 900.0):
        surface = ConstantHeight(height)
        strip = VirtualStrip(model.tabulated(0.0, LINES - 1.0), surface, smooth_rows=(-0.5, LINES - 0.5))
        rpc, _ = fit_rpc(strip.virtual, 0, LINES, rpc_heights(surface))
        gdal = RPC.from_gdal(rpc_metadata(rpc, GroundError(bias_m=1.0, random_m=1.0)))
        for ccd, begin, end in strip.seams(0.5 * LINES):
            sample, line = rng.uniform(begin, end, 100), rng.uniform(2000.0, LINES - 2000.0, 100)
            raw = strip.source_pixels(ccd, sample, line)
            p_e = model.ground_points(ccd, *raw, surface)
            lat, lon, _ = geodetic_from_ecef(p_e, WGS84)
            assert (lat > 0.0).all() == north and (lon > 0.0).all() == east
            miss = np.hypot(*(by_gdal(gdal, p_e) - np.column_stack([sample, line])).T)
            assert miss.max() < MOST_PX
    # an RPC of the raw image would miss by the jitter
    assert fit_rpc(model, 1, LINES - 1000, (0.0, 900.0))[1].largest_px > 1.0


def test_the_file_has_the_rpc_in_its_tags_and_beside_it(finished: tuple[Path, Path], tmp_path: Path) -> None:
    dump, result = finished
    out = tmp_path / "s.tif"
    told = ran("virtual-ccd", result, "--dump", dump, "--strip", "s01", "--out", out)
    assert "its RPC misses the virtual camera by up to 0.0" in told.output
    calibrated = open_calibrated(result, dump)
    model, surface = whole_strip_model(calibrated, "s01"), surface_of(calibrated.dump.terrain)
    middle = 2, model.strip.ccd_lines[2], sum(surface.height_range_m()) / 2.0  # of four CCDs
    smooth = -0.5, model.strip.lines - 0.5
    strip = VirtualStrip(model.pushbroom, surface, smooth_rows=smooth)
    line = np.linspace(50.0, model.strip.lines - 50.0, 20)
    beside = tmp_path / "s_RPC.TXT"
    for use_text in (True, False):
        if not use_text:
            beside.unlink()
        with rasterio.open(out) as image:
            rpc = image.rpcs
        error = ground_error(calibrated, model, *middle)
        assert (rpc.err_bias, rpc.err_rand) == pytest.approx((error.bias_m, error.random_m), abs=5e-5)  # m
        for ccd, begin, end in strip.seams(float(line.mean())):
            sample = np.linspace(begin + 2.0, end - 2.0, 20)
            raw = strip.source_pixels(ccd, sample, line)
            pixels = np.column_stack([sample, line])
            off = by_gdal(rpc, model.pushbroom.ground_points(ccd, *raw, surface)) - pixels
            assert np.hypot(*off.T).max() < MOST_PX
