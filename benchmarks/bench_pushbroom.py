"""Accuracy and speed of the rigorous pushbroom model: pixels to the ground, with and without terrain, and
back.

    python benchmarks/bench_pushbroom.py

The camera is the paper's (10 m, four CCDs of 6144 px, 26 000 rows), the orbit 530 km, the attitude oscillates
by 12", and all light effects are on. Times are CPU seconds of one core, the least of three; accuracy is that
of the same calls.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer
from record import exit_status, head, judge_largest
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.constants import GM_EARTH, WGS84
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.groundlight import LightEffects
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import Pushbroom, RowClock
from boresight.geometry.terrain import ConstantHeight, TerrainGrid

Array = NDArray[np.float64]
N, LINES, SAMPLES = 1_000_000, 26_000, 6144
R_CS = Rotation.from_euler("xyz", [150.0, -25.0, 70.0], degrees=True)


def strip(roll_deg: float, pitch_deg: float) -> Pushbroom:
    epoch = Epoch.from_utc("2024-03-05T10:20:30Z")
    earth = EarthRotation.over(epoch, -40.0, 60.0, bundled_earth_orientation())
    t_s, radius, tilt = np.arange(-30.0, 50.0), 6_908e3, 1.7
    rate = np.sqrt(GM_EARTH / radius**3)
    c, s = np.cos(rate * t_s + 0.7), np.sin(rate * t_s + 0.7)
    p = radius * np.stack([c, s * np.cos(tilt), s * np.sin(tilt)], axis=-1)
    v = radius * rate * np.stack([-s, c * np.cos(tilt), c * np.sin(tilt)], axis=-1)
    orbit = Orbit(epoch=epoch, t_s=t_s, positions_m=p, velocities_m_s=v, frame="GCRF", degree=7, earth=earth)
    knots, offsets = np.array([0.0, 1500, 3067, 4600, 6143]), np.array([18e-6, 6e-6, 0, -5e-6, -17e-6])
    ccds = [
        Ccd(
            n_px=SAMPLES,
            y_first_m=-0.122 + k * 0.0604,
            x_offset_m=0.001 * (-1) ** k,
            rotation_rad=1e-4 * (k - 1.5),
            pixel_m=1e-5,
            principal_sample=3067.0,
            distortion_samples=knots,
            distortion_offsets_m=offsets,
        )
        for k in range(4)
    ]
    t_star = np.arange(-0.4, 2.6, 0.2)
    wave = 6e-5 * np.sin(2.0 * np.pi * t_star[:, None] / [3.1, 4.7, 5.0] + [0.0, 1.0, 2.0])
    R_co = Rotation.from_euler("xy", [roll_deg, pitch_deg], degrees=True) * Rotation.from_rotvec(wave)
    attitude = AttitudeTrack(t_star, R_CS.inv() * R_co * orbit.R_oi(t_star), orbit)
    camera = LineCamera(10.0, tuple(ccds), tdi_stages=32)
    return Pushbroom(
        camera=camera,
        rows=RowClock(0.013, 6.6e-5),
        orbit=orbit,
        earth=earth,
        attitude=attitude,
        R_cs=R_CS,
        effects=LightEffects(),
    )


def relief(model: Pushbroom, amplitude_m: float, utm: bool) -> TerrainGrid:
    """Fractal relief of 1024 x 1024 heights around a strip, in degrees or in the zone's UTM."""
    ends = np.array([0.0, 6143.0, 0.0, 6143.0]), np.array([0.0, 0.0, LINES, LINES])
    corners = np.vstack([model.ground_points(k, *ends, ConstantHeight(0.0)) for k in (0, 3)])
    lat, lon, _ = np.degrees(geodetic_from_ecef(corners, WGS84))
    crs = f"EPSG:{(32600 if lat.mean() > 0 else 32700) + int((lon.mean() + 180.0) // 6.0) + 1}"
    x, y, edge = (lon, lat, 0.05) if not utm else (*_transformed(lon, lat, crs), 5000.0)
    n, west, north = 1024, x.min() - edge, y.max() + edge
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n)))
    frequency[0, 0] = 1.0
    z = np.fft.ifft2(np.fft.fft2(np.random.default_rng(1).normal(size=(n, n))) * frequency**-2.2).real
    z = 100.0 + amplitude_m * (z - z.min()) / np.ptp(z)
    transform = ((x.max() + edge - west) / n, 0.0, west, 0.0, -(north - y.min() + edge) / n, north)
    return TerrainGrid.from_raster(z, transform, crs if utm else "EPSG:4326", None)


def _transformed(lon: Array, lat: Array, crs: str) -> tuple[Array, Array]:
    x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    return np.asarray(x), np.asarray(y)


def timed(work: Callable[[], Any], repeats: int = 3) -> tuple[float, Any]:
    """Least CPU time of some calls, and the last one's result."""
    best, result = np.inf, None
    for _ in range(repeats):
        start = time.process_time()
        result = work()
        best = min(best, time.process_time() - start)
    return best, result


def to_the_ground(worst: dict[str, float]) -> None:
    print(f"{N:,} pixels of CCD 2, in any order, to the ground, and every fifth back: CPU time per million,")
    print("points per second, largest distance from where they began. Roll and pitch in degrees; relief is a")
    print("grid of 1024 x 1024 heights.")
    print(
        " roll pitch  ground                      to ground             back             there and back, px"
    )
    rng = np.random.default_rng(0)
    sample, line = rng.uniform(0.0, SAMPLES - 1.0, N), rng.uniform(0.0, LINES - 1.0, N)
    for roll, pitch in ((0, 0), (30, 0), (0, -30), (20, 20)):
        model = strip(roll, pitch)
        surfaces = {"height 100 m": ConstantHeight(100.0)}
        surfaces |= {
            f"relief {a:4.0f} m, {'UTM' if u else 'degrees'}": relief(model, a, u)
            for a, u in ((300.0, False), (3000.0, False), (3000.0, True))
        }
        for name, surface in surfaces.items():
            there_s, ground = timed(lambda m=model, s=surface: m.ground_points(2, sample, line, s))
            some = ground[::5]
            back_s, found = timed(lambda m=model, p=some: m.pixels_from_ground(2, p), 1)
            error = max(np.abs(found[0] - sample[::5]).max(), np.abs(found[1] - line[::5]).max())
            back_rate = len(some) / back_s
            print(
                f" {roll:4d} {pitch:5d}  {name:24s} {there_s:8.3f} s {N / there_s / 1e3:8.0f} k/s"
                f" {1e6 / back_rate:8.2f} s {back_rate / 1e3:6.0f} k/s   {error:12.1e}",
                flush=True,
            )
            worst["error"] = max(worst["error"], float(error))
            worst["back"] = min(worst["back"], back_rate)
            if (roll, pitch) == (0, 0) and "degrees" in name:
                worst["terrain"] = max(worst["terrain"], there_s)
    print()


def main() -> int:
    head("Rigorous pushbroom model")
    worst = {"error": 0.0, "back": np.inf, "terrain": 0.0}
    to_the_ground(worst)
    judge_largest("pixel to ground to pixel, all views and surfaces", worst["error"], 1e-4, "px", 16 * N // 5)
    judge_largest("a million pixels to terrain at nadir", worst["terrain"], 1.0, "s CPU", 3)
    judge_largest("100 000 points of the ground to pixels", 1e5 / worst["back"], 1.0, "s CPU", 16)
    return exit_status()


if __name__ == "__main__":
    raise SystemExit(main())
