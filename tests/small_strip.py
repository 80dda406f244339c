"""A small strip of two CCDs over an invented texture, rendered through the rigorous model, and chips of
its targets.

500 m circular-orbit geometry of the paper at a twelfth of its resolution: 6.4 m pixels, two staggered CCDs
of 420 px that overlap by 60, 700 lines. The mounting is bold and lopsided, the attitude oscillates by some
arc-seconds.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer
from scipy import ndimage
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation
from strips import pushbroom

from boresight.gct_match.records import Chip, Target
from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.constants import ARCSEC, GM_EARTH
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.installation import deviation_from_theta
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import Pushbroom, RowClock
from boresight.geometry.terrain import ConstantHeight

LINES, SAMPLES, OVERLAP = 700, 420, 60
PIXEL_M = 120e-6
GROUND_M = 3.2  # of the texture and of the chips: half a pixel of the strip
CAMERA_SIGMA_PX = 0.62  # Gaussian of MTF 0.15 at Nyquist
SURFACE = ConstantHeight(240.0)
MOUNTING = Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True)


@dataclass
class SmallStrip:
    """In memory; counts what is read of it."""

    images: dict[int, NDArray]
    pixels_read: int = 0

    @property
    def ccds(self) -> tuple[int, ...]:
        return tuple(sorted(self.images))

    def shape(self, ccd: int) -> tuple[int, int]:
        return self.images[ccd].shape

    def read(self, ccd: int, line0: int, line1: int, sample0: int, sample1: int) -> NDArray:
        lines, samples = self.images[ccd].shape
        assert 0 <= line0 < line1 <= lines and 0 <= sample0 < sample1 <= samples
        self.pixels_read += (line1 - line0) * (sample1 - sample0)
        return self.images[ccd][line0:line1, sample0:sample1]


@dataclass(frozen=True)
class Case:
    strip: SmallStrip
    pushbroom: Pushbroom  # at the wrong installation matrix
    true: Pushbroom
    targets: list[Target]
    chips: list[Chip]
    theta: NDArray


def true_pushbroom() -> Pushbroom:
    epoch = Epoch.from_utc("2024-06-21T10:00:00")
    t = np.arange(-12.0, 14.0)
    earth = EarthRotation.over(epoch, -12.0, 13.0, bundled_earth_orientation())
    radius = 6_378_137.0 + 530e3
    rate = np.sqrt(GM_EARTH / radius**3)
    plane = Rotation.from_euler("zx", [75.0, 97.5], degrees=True)
    angle = np.radians(42.0) + rate * t
    position = radius * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * t])
    velocity = radius * rate * np.column_stack([-np.sin(angle), np.cos(angle), 0.0 * t])
    orbit = Orbit(
        epoch=epoch,
        t_s=t,
        positions_m=plane.apply(position),
        velocities_m_s=plane.apply(velocity),
        frame="GCRF",
        degree=7,
        earth=earth,
        method="hermite",
    )
    exposures = np.arange(-0.6, 1.6, 0.2)
    wave = np.sin(2.0 * np.pi * (exposures[:, None] / [4.0, 5.5, 6.5] + [0.1, 0.4, 0.7]))
    R_co = Rotation.from_rotvec(8.0 * ARCSEC * wave)
    R_si = MOUNTING.inv() * R_co * orbit.R_oi(exposures)
    ccds = tuple(
        Ccd(
            n_px=SAMPLES,
            y_first_m=(k - 1.0) * (SAMPLES - OVERLAP) * PIXEL_M,
            x_offset_m=x,
            rotation_rad=turn,
            pixel_m=PIXEL_M,
            principal_sample=SAMPLES / 2.0,
        )
        for k, (x, turn) in enumerate(((4e-3, 1.5e-5), (-5e-3, -1e-5)))
    )
    attitude = AttitudeTrack(exposures, R_si, orbit)
    return pushbroom(LineCamera(10.0, ccds), RowClock(0.0, 0.9e-3), orbit, attitude, MOUNTING)


def texture(rng: np.random.Generator, side: int) -> NDArray:
    """Fields of several tones, roads and fractal detail, 0 to 255."""
    image = np.zeros((side, side), dtype=np.float32)
    for scale, share in ((40, 30.0), (12, 14.0), (4, 10.0), (1.5, 7.0)):
        noise = rng.standard_normal((side, side)).astype(np.float32)
        image += share * 2.0 * scale * cv2.GaussianBlur(noise, (0, 0), scale, borderType=cv2.BORDER_REFLECT)
    for _ in range(side * side // 900):
        x, y = rng.integers(0, side, 2)
        w, h = rng.integers(3, 26, 2)
        turn = float(rng.uniform(0.0, 90.0))
        box = cv2.boxPoints(((float(x), float(y)), (float(w), float(h)), turn)).astype(np.int32)
        cv2.fillPoly(image, [box], float(rng.normal(0.0, 45.0)))
    return np.clip(image + 120.0, 0.0, 255.0)


def make_case(
    rng: np.random.Generator, theta: NDArray, n_targets: int, chip_px: int = 192, *, noise_dn: float = 1.5
) -> Case:
    """A strip whose installation matrix is wrong by `theta`, with targets spread over both CCDs."""
    true = true_pushbroom()
    to_map = Transformer.from_crs(4978, 32600 + _zone(true), always_xy=True)
    spots = [(ccd, x, y) for ccd in (0, 1) for x in (0.0, SAMPLES) for y in (0.0, LINES)]
    east, north = np.array(
        [_map(true, to_map, ccd, np.array([x]), np.array([y]))[:, 0] for ccd, x, y in spots]
    ).T
    spare = 150 * GROUND_M
    origin = np.array([east.min() - spare, north.max() + spare])
    side = int(max(np.ptp(east), np.ptp(north)) / GROUND_M + 300)
    ground = texture(rng, side)
    seen = ndimage.spline_filter(cv2.GaussianBlur(ground, (0, 0), 2.0 * CAMERA_SIGMA_PX), order=3)
    images = {ccd: _rendered(true, to_map, ccd, seen, origin, rng, noise_dn) for ccd in (0, 1)}
    sharp = cv2.GaussianBlur(ground, (0, 0), 0.5)
    targets, chips = [], []
    for n in range(n_targets):
        ccd = n % 2
        sample, line = rng.uniform(60.0, SAMPLES - 60.0), 60.0 + (LINES - 120.0) * (n + 0.5) / n_targets
        p_e = true.ground_points(ccd, np.array([sample]), np.array([line]), SURFACE)[0]
        x, y, _ = to_map.transform(*p_e)
        column, row = int((x - origin[0]) / GROUND_M), int((origin[1] - y) / GROUND_M)
        a, b = column - chip_px // 2, row - chip_px // 2
        image = sharp[b : b + chip_px, a : a + chip_px] + rng.normal(0.0, noise_dn, (chip_px, chip_px))
        corner = origin + GROUND_M * np.array([a, -b])
        transform = (GROUND_M, 0.0, corner[0], 0.0, -GROUND_M, corner[1])
        valid = np.ones(image.shape, dtype=bool)
        targets.append(Target(f"t{n:02d}", p_e, np.full(3, 0.1)))
        crs = f"EPSG:{32600 + _zone(true)}"
        chips.append(Chip(f"t{n:02d}", image.astype(np.float32), transform, crs, valid))
    wrong = true.with_installation(deviation_from_theta(theta).inv() * MOUNTING)
    return Case(SmallStrip(images), wrong, true, targets, chips, theta)


def _zone(model: Pushbroom) -> int:
    p_e = model.ground_points(0, np.array([SAMPLES / 2.0]), np.array([LINES / 2.0]), SURFACE)
    lon, _, _ = Transformer.from_crs(4978, 4979, always_xy=True).transform(*p_e[0])
    return int((lon + 180.0) // 6.0) + 1


def _map(model: Pushbroom, to_map: Transformer, ccd: int, sample: NDArray, line: NDArray) -> NDArray:
    p_e = model.ground_points(ccd, sample, line, SURFACE)
    return np.array(to_map.transform(*p_e.T.tolist())[:2])


def _rendered(
    model: Pushbroom,
    to_map: Transformer,
    ccd: int,
    seen: NDArray,
    origin: NDArray,
    rng: np.random.Generator,
    noise_dn: float,
) -> NDArray:
    rows, columns = np.linspace(0.0, LINES - 1.0, 40), np.linspace(0.0, SAMPLES - 1.0, 22)
    line, sample = np.meshgrid(rows, columns, indexing="ij")
    east, north = _map(model, to_map, ccd, sample.ravel(), line.ravel()).reshape(2, *line.shape)
    full = np.arange(LINES), np.arange(SAMPLES)
    x = RectBivariateSpline(rows, columns, (east - origin[0]) / GROUND_M - 0.5)(*full)
    y = RectBivariateSpline(rows, columns, (origin[1] - north) / GROUND_M - 0.5)(*full)
    image = ndimage.map_coordinates(seen, [y, x], order=3, prefilter=False)
    return np.clip(np.round(image + rng.normal(0.0, noise_dn, image.shape)), 0, 255).astype(np.uint8)
