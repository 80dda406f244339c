"""Small generator of raw star frames with known truth, for tests and benchmarks of `star_id` alone.

Stars are Gaussians integrated over pixels; noise is photon noise of the stars, read noise and rounding. The
sky is the shipped catalogue (directions as they stand in it, no light effects) and, below its limit, uniform
faint stars as numerous as the real ones (2.9 times more per magnitude).
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from boresight.geometry.star_camera import StarCamera
from boresight.geometry.starlight import apparent_star_directions, refract_by_air
from boresight.simulator.cameras import star_camera
from boresight.simulator.scenario import StarCameraSettings
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.centroids import Centroids
from boresight.star_id.finding.star_list import StarList

PAPER_CAMERA = star_camera(StarCameraSettings())  # Table 2
# The same lens before a detector of a sixteenth of the pixels, its axis off the middle.
SMALL_CAMERA = replace(
    PAPER_CAMERA, pixel_m=25.6e-6, width_px=1280, height_px=960, principal_px=(641.3, 477.2)
)
# A wide lens, and the stars that it shows.
PLACES = hipparcos_stars(8.0).places
WIDE = StarCamera(
    focal_m=0.011, pixel_m=5e-6, width_px=2048, height_px=2048, principal_px=(1030.2, 1019.4), q1=-3e-4
)

STARS_AT_ONCE = 500  # rendered as one array, of 10 MB for the longest trails
FAINT_SNR = 4.0  # stars of which no image shows how their trails are made


@dataclass(frozen=True)
class FrameTruth:
    hip: np.ndarray  # (N,) 0 for stars that are not in the catalogue
    xy_px: np.ndarray  # (N, 2)
    flux_dn: np.ndarray  # (N,)
    R_si: Rotation


@dataclass(frozen=True)
class Sensor:
    sigma_px: float = 1.25
    read_noise_dn: float = 2.0
    e_per_dn: float = 40.0
    background_dn: float = 20.0
    gradient_dn: float = 0.0
    hot_pixels: int = 0
    bits: int = 8
    flux_at_v7_dn: float = 71.0  # SNR 8 for sigma 1.25 px, noise 2 DN
    faint_limit_v: float = 11.0
    smear_px: tuple[float, float] = (0.0, 0.0)


def direction(ra, dec):
    return np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


@lru_cache(maxsize=2)  # one catalogue is seen from many attitudes
def directions_of(places):
    return direction(places.ra_rad, places.dec_rad)


def stars_in_view(camera, R_si, places):
    """Index into `places` and pixels of the stars on the detector."""
    u_s = R_si.apply(directions_of(places))
    near = np.flatnonzero(u_s[:, 2] > np.cos(camera.field_radius_rad * 1.02))
    xy = camera.pixels_from_directions(u_s[near])
    with np.errstate(invalid="ignore"):
        inside = camera.contains(xy)
    return near[inside], xy[inside]


def listed_stars(camera, R_si, places, rng, *, brightest=260.0):
    """Stars of SNR 6 to `brightest` as `find_stars` hands them over, their errors those of the bound."""
    rows, xy = stars_in_view(camera, R_si, places)
    snr = 8.0 * 10 ** (-0.4 * (places.v_mag[rows] - 7.0))
    keep = np.flatnonzero((snr > 6) & (snr < brightest))
    keep = keep[np.argsort(-snr[keep], kind="stable")]
    sigma, n = 1.8 / snr[keep], len(keep)
    xy = xy[keep] + rng.normal(size=(n, 2)) * sigma[:, None]
    no = np.zeros(n, dtype=bool)
    cov = sigma[:, None, None] ** 2 * np.eye(2)
    stars = Centroids(xy_px=xy, cov_px=cov, blended=no, snr=snr[keep], psf_sigma_px=1.25)
    return StarList.of_centroids(stars, snr[keep], (camera.width_px, camera.height_px))


def as_seen(places, observer):
    """The catalogue with each star where its light comes from for an observer."""
    u = apparent_star_directions(places, observer.epoch, observer.t_s, observer.p_i, observer.v_i)
    x, y, z = (u if observer.air is None else refract_by_air(u, observer.air)).T
    return replace(places, ra_rad=np.arctan2(y, x), dec_rad=np.arcsin(np.clip(z, -1.0, 1.0)))


def add_trails(signal, xy, flux, sensor, step_px, reach):
    """Add stars to `signal`: Gaussians out to `reach` sigma; a trail is a sum of them, `step_px` apart."""
    s, (sx, sy) = sensor.sigma_px, sensor.smear_px
    half = int(np.ceil(reach * s + 0.5 * np.hypot(sx, sy))) + 1
    grid = np.arange(2 * half + 2) - 0.5
    beside = int(np.ceil(np.hypot(sx, sy) / (2.0 * step_px)))
    nodes = np.arange(-beside, beside + 1) / (2 * beside + 1)
    corner = np.rint(xy).astype(int) - half
    x, y = ((corner - xy).T)[:, :, None, None]
    fx = np.diff(ndtr((grid + x - nodes[:, None] * sx) / s))  # (N, nodes, columns)
    fy = np.diff(ndtr((grid + y - nodes[:, None] * sy) / s))
    stamps = (flux[:, None, None] / len(nodes) * fy.swapaxes(1, 2)) @ fx
    height, width = signal.shape
    for (x0, y0), stamp in zip(corner.tolist(), stamps):
        q, t = max(0, -x0), max(0, -y0)
        r, b = min(2 * half + 1, width - x0), min(2 * half + 1, height - y0)
        if r > q and b > t:
            signal[y0 + t : y0 + b, x0 + q : x0 + r] += stamp[t:b, q:r]


def render(xy, flux, width, height, sensor, rng):
    """Raw image with the given stars."""
    signal = np.zeros((height, width), np.float32)
    faint = flux < FAINT_SNR * 2.0 * np.sqrt(np.pi) * sensor.sigma_px * sensor.read_noise_dn
    for these, step_px, reach in ((~faint, 0.22, 6.0), (faint, 0.6 * sensor.sigma_px, 4.0)):
        for some in np.array_split(np.flatnonzero(these), these.sum() // STARS_AT_ONCE + 1):
            add_trails(signal, xy[some], flux[some], sensor, step_px, reach)
    image = rng.standard_normal((height, width), dtype=np.float32)
    image *= np.sqrt(sensor.read_noise_dn**2 + signal / sensor.e_per_dn)
    image += signal
    image += sensor.background_dn + sensor.gradient_dn * (np.linspace(-0.5, 0.5, width, dtype=np.float32))
    if sensor.hot_pixels:
        where = rng.integers(0, height * width, sensor.hot_pixels)
        image.ravel()[where] += rng.uniform(20, 200, sensor.hot_pixels).astype(np.float32)
    top = 2**sensor.bits - 1
    return np.clip(np.rint(image), 0, top).astype(np.uint8 if sensor.bits == 8 else np.uint16)


def star_frame(camera, R_si, places, sensor, rng):
    """One frame of the sky and its truth."""
    index, xy = stars_in_view(camera, R_si, places)
    flux = sensor.flux_at_v7_dn * 10 ** (-0.4 * (places.v_mag[index] - 7.0))
    hip = places.hip[index]
    limit = places.v_mag.max()
    if sensor.faint_limit_v > limit:
        total = len(index) * (2.9 ** (sensor.faint_limit_v - limit) - 1)
        v = limit + np.log(
            1 + rng.random(rng.poisson(total)) * (2.9 ** (sensor.faint_limit_v - limit) - 1)
        ) / np.log(2.9)
        extra = rng.uniform([-0.5, -0.5], [camera.width_px - 0.5, camera.height_px - 0.5], (len(v), 2))
        xy = np.vstack([xy, extra])
        flux = np.append(flux, sensor.flux_at_v7_dn * 10 ** (-0.4 * (v - 7.0)))
        hip = np.append(hip, np.zeros(len(v), dtype=hip.dtype))
    image = render(xy, flux, camera.width_px, camera.height_px, sensor, rng)
    return image, FrameTruth(hip, xy, flux, R_si)
