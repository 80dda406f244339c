"""Rendered sequences of a star camera of 1024² pixels: slews, a gap, a frame of glare; with their truth."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from frames import Sensor, star_frame
from scipy.spatial.transform import Rotation

from boresight.geometry.star_camera import StarCamera
from boresight.star_id.identification.triangle_index import StarIndex

CAMERA = StarCamera(focal_m=0.04, pixel_m=10e-6, width_px=1024, height_px=1024, principal_px=(517.3, 506.8))
INTERVAL_S, EXPOSURE_S = 0.1, 0.05
SENSOR = Sensor(faint_limit_v=10.0)  # the brightest pixel of a fainter star has a fifth of the noise


@dataclass(frozen=True)
class Sequence:
    images: list[np.ndarray]
    times_s: np.ndarray
    truth: Rotation  # of each frame
    glare: tuple[int, ...]  # frames without stars


def places_of(index: StarIndex):
    """The catalogue with its stars where an image without time has them."""
    x, y, z = index.u_i.T
    return replace(index.stars, ra_rad=np.arctan2(y, x), dec_rad=np.arcsin(z))


def sequence(index: StarIndex, seed: int, frames: int, *, fastest_deg_s: float = 2.0) -> Sequence:
    """A slew up to a rate and back; in the middle third five frames are missing, then one shows glare."""
    rng = np.random.default_rng(seed)
    R, axis = Rotation.random(random_state=rng), rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    missing, glare = range(frames // 6, frames // 6 + 5), frames // 2
    places, focal_px = places_of(index), CAMERA.focal_m / CAMERA.pixel_m
    images, times, truth, blind = [], [], [], []
    for k in range(frames):
        ramp = np.clip(min(k - frames // 6, frames - frames // 6 - k) / (frames / 6.0), 0.0, 1.0)
        rate = np.radians(fastest_deg_s) * ramp * axis
        R = Rotation.from_rotvec(-rate * INTERVAL_S) * R
        if k in missing:
            continue
        smear = (focal_px * rate[1] * EXPOSURE_S, -focal_px * rate[0] * EXPOSURE_S)
        image, _ = star_frame(CAMERA, R, places, replace(SENSOR, smear_px=smear), rng)
        if k == glare:
            image = np.clip(rng.normal(230.0, 25.0, image.shape), 0, 255).astype(np.uint8)
            blind.append(len(images))
        images.append(image)
        times.append(k * INTERVAL_S)
        truth.append(R)
    return Sequence(images, np.array(times), Rotation.concatenate(truth), tuple(blind))


@dataclass(frozen=True)
class LongSequence:
    paths: list[Path]  # of images, in the order of time
    times_s: np.ndarray
    truth: Rotation  # of each frame
    focal_px: np.ndarray  # of each frame
    glare: tuple[int, ...]  # frames without stars


def long_sequence(
    index: StarIndex, folder: Path, seed: int, frames: int, *, fastest_deg_s: float, focal_drift: float
) -> LongSequence:
    """A sequence whose rate swings about each axis and whose focal length drifts by a random walk,
    `focal_drift` of it in one second; a gap of ten frames and two frames of glare in each 250 frames."""
    rng, places = np.random.default_rng(seed), places_of(index)
    R, log_scale, period_s = Rotation.random(random_state=rng), 0.0, np.array([37.0, 23.0, 31.0])
    paths, times, truth, focal, blind = [], [], [], [], []
    for k in range(frames):
        rate = np.radians(fastest_deg_s) * np.sin(2.0 * np.pi * k * INTERVAL_S / period_s + np.arange(3.0))
        R = Rotation.from_rotvec(-rate * INTERVAL_S) * R
        log_scale += focal_drift * np.sqrt(INTERVAL_S) * rng.normal()
        if 100 <= k % 250 < 110:
            continue
        camera = replace(CAMERA, focal_m=CAMERA.focal_m * np.exp(log_scale))
        focal_px = camera.focal_m / camera.pixel_m
        smear = (focal_px * rate[1] * EXPOSURE_S, -focal_px * rate[0] * EXPOSURE_S)
        image, _ = star_frame(camera, R, places, replace(Sensor(), smear_px=smear), rng)
        if k % 250 in (180, 181):
            image = np.clip(rng.normal(230.0, 25.0, image.shape), 0, 255).astype(np.uint8)
            blind.append(len(paths))
        paths.append(folder / f"f{k:05d}.npy")
        np.save(paths[-1], image)
        times.append(k * INTERVAL_S)
        truth.append(R)
        focal.append(focal_px)
    return LongSequence(paths, np.array(times), Rotation.concatenate(truth), np.array(focal), tuple(blind))


def errors_of(found, truth: Rotation) -> tuple[np.ndarray, np.ndarray]:
    """Error (N, 3), rad, and its normalised square an axis (N,), of frames; NaN of lost ones."""
    error, square = np.full((len(found), 3), np.nan), np.full(len(found), np.nan)
    for n, state in enumerate(found.state):
        if state != "lost":
            error[n] = (truth[n] * found.R_si(n).inv()).as_rotvec()
            square[n] = error[n] @ np.linalg.solve(found.cov_s[n], error[n]) / 3.0
    return error, square
