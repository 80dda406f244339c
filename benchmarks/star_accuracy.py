"""Stars, centroids and the attitude of one image: full raw frames of the paper's camera, known truth.

    python benchmarks/star_accuracy.py [--frames 6] [--filled 2] [--seed 1]

5120 x 3840 px, 8 bit, PSF sigma 1.25 px, read noise 2 DN, 40 e-/DN, 2000 hot pixels, SNR 8 at V = 7; the
Hipparcos sky as a satellite sees it in 2026 (proper motion, parallax, aberration, deflection) and below it
random stars to V = 11. Scored are completeness, error over the Cramér-Rao bound and chi2 by SNR, false
detections. A sky holds few bright stars, so other frames are filled with stars of all SNR alike, on the same
faint background. The attitude is that of a mission's exposure, of an image that `boresight identify` is given
with its camera, and of one of which nothing is known but a field of view 5 % wrong; its bound is from the
true positions, fluxes and noise of the stars used.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from record import ROOT, arguments_of, exit_status, head, judge_largest, judge_nees, judge_share
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import ndtr
from scipy.stats import chi2

sys.path.insert(0, str(ROOT / "tests"))

from frames import PAPER_CAMERA, Sensor, as_seen, render, star_frame

from boresight.features.sky_images.centroid_report import score_lines
from boresight.features.sky_images.score import SNR_EDGES, cramer_rao_px, score_centroids
from boresight.geometry.attitude_estimate import fit_attitudes
from boresight.geometry.constants import ARCSEC
from boresight.geometry.epoch import Epoch
from boresight.geometry.sightings import information_of_directions
from boresight.geometry.star_camera import StarCamera
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.field import solve_field
from boresight.star_id.finding.psf import Psf
from boresight.star_id.finding.star_list import StarList, list_stars
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.identification.triangle_index import build_index, equivalent_fov
from boresight.star_id.observer import Observer
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import sight_stars

CAMERA = replace(PAPER_CAMERA, principal_px=(2571.3, 1893.2))  # a detector beside the axis, as all are
SENSOR = Sensor(hot_pixels=2000)
EPOCH = Epoch.from_utc("2026-03-20T00:00:00Z")
P_I, V_I = np.array([6.9e6, 0.0, 0.0]), np.array([0.0, 1.0e3, 7.5e3])  # m, m/s: an orbit 500 km up
ROUNDING = 1.0 / 12.0  # DN^2


@dataclass
class Errors:
    """What became of the frames, on one way."""

    turns: list[NDArray] = field(default_factory=list)  # of the image's middle, about the axes of s
    squares: list[float] = field(default_factory=list)  # normalised

    def add(self, found: Rotation, truth: Rotation, camera: StarCamera, cov_s: NDArray) -> None:
        turn = (truth * found.inv()).as_matrix() @ camera.middle_axes() @ CAMERA.middle_axes().T
        delta = -Rotation.from_matrix(turn).as_rotvec()
        self.turns.append(delta)
        self.squares.append(float(delta @ np.linalg.solve(cov_s, delta)))


def skies(frames: int, seed: int) -> None:
    """Frames of the sky: places of their stars, and attitudes in three ways."""
    places, settings = hipparcos_stars(8.0).places, StarSettings()
    fov = equivalent_fov(CAMERA.width_px, CAMERA.height_px, CAMERA.focal_m / CAMERA.pixel_m)
    index = build_index(places, 2026.2, fov)
    wide = build_index(places, 2026.2, (np.radians(15.0), np.radians(24.0)))
    names = ("a mission's exposure", "identify, camera known", "identify, lens unknown")
    ways = {name: Errors() for name in names}
    mission, *of_identify = ways.values()
    known = ((index, {"camera": CAMERA}), (wide, {"fov_x_rad": 1.05 * CAMERA.fov_x_rad}))
    bounds, lists, truths = [], [], []
    for k in range(frames):
        rng = np.random.default_rng([seed, k])
        t_s = float(rng.uniform(0.0, 3.0e7))  # anywhere in a year: the Earth's velocity goes round
        R_si, observer = Rotation.random(random_state=rng), Observer(EPOCH, t_s, P_I, V_I)
        image, truth = star_frame(CAMERA, R_si, as_seen(places, observer), SENSOR, rng)
        lists.append(list_stars(image, settings))
        truths.append((truth.xy_px, truth.flux_dn))
        seen = sight_stars(str(k), image, CAMERA, index, observer, settings)
        if isinstance(seen, NotIdentified):
            print(seen.reason)
            continue
        attitude = fit_attitudes(seen.u_s, seen.u_i, seen.cov_s, np.array([0, len(seen.u_s)]))
        mission.add(Rotation.from_matrix(attitude.R_si[0]), R_si, CAMERA, attitude.covariance_s[0])
        bounds.append(np.linalg.inv(_information(seen.u_s, seen.xy_px, truth)))
        for errors, (sky, about) in zip(of_identify, known):
            found = solve_field(image, sky, settings, observer=observer, **about)
            if isinstance(found, NotIdentified):
                print(found.reason)
            else:
                errors.add(found.R_si, R_si, found.camera, found.cov_s)
    judge_places("frames of the sky", lists, truths, SENSOR)
    for name, errors in ways.items():
        turns, n = np.array(errors.turns), len(errors.turns)
        print(f"{name}: rms about x, y, z {(np.sqrt((turns**2).mean(axis=0)) / ARCSEC).round(3)} arcsec")
        judge_share(f"{name}: identified", n, frames, least=0.99)
        judge_nees(f"{name}: attitude", errors.squares)
        if name != "identify, lens unknown":
            bound = np.mean([np.diag(one) for one in bounds], axis=0)
            whole = float(np.sqrt(np.mean((turns**2).mean(axis=0) / bound)))
            most = max(1.1, float(np.sqrt(chi2(3 * n).ppf(0.9995) / (3 * n))))
            judge_largest(f"{name}: error of the attitude over its bound", whole, most, "", n)


def _information(u_s, xy_px, truth):
    """(3, 3) Fisher information of the attitude by the stars at `xy_px`, from what is true of them."""
    row = cKDTree(truth.xy_px).query(xy_px)[1]
    psf = Psf(SENSOR.sigma_px, SENSOR.sigma_px, (0.0, 0.0), CAMERA.width_px, CAMERA.height_px)
    noise = np.full(len(row), np.sqrt(SENSOR.read_noise_dn**2 + ROUNDING))
    full = 2**SENSOR.bits - 1 - SENSOR.background_dn
    sigma = cramer_rao_px(truth.xy_px[row], truth.flux_dn[row], noise, psf, SENSOR.e_per_dn, full_dn=full)
    J = CAMERA.pixel_jacobian(xy_px)
    W = information_of_directions(u_s, sigma[:, None, None] ** 2 * (J @ J.transpose(0, 2, 1)))
    x, y, z = u_s.T
    zero = np.zeros(len(u_s))
    A = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)  # -[u x]
    return (A.transpose(0, 2, 1) @ W @ A).sum(axis=0)


def filled(frames: int, seed: int, sensor: Sensor) -> None:
    """Frames with stars of all SNR."""
    lists, truths = [], []
    for k in range(frames):
        image, xy, flux = filled_frame(sensor, np.random.default_rng([seed, 1000 + k]))
        truths.append((xy, flux))
        lists.append(list_stars(image, StarSettings(max_stars=5000)))
    print(f"\n{frames} frames filled with stars of all SNR alike")
    judge_places("filled frames", lists, truths, sensor)


def filled_frame(sensor: Sensor, rng: np.random.Generator) -> tuple[NDArray, NDArray, NDArray]:
    """Image, places and fluxes of stars kept apart, equally many for each bin of the score, among faint
    ones."""
    size = np.array([PAPER_CAMERA.width_px, PAPER_CAMERA.height_px])
    share = np.diff(ndtr((np.arange(-12, 14) - 0.5) / sensor.sigma_px))  # of a row of pixels
    snr_of_one_dn = (share**2).sum() / np.hypot(sensor.read_noise_dn, 12**-0.5)
    brightest = (0.94 * (2**sensor.bits - 1) - sensor.background_dn) / share.max() ** 2 * snr_of_one_dn
    x, y = np.meshgrid(*(np.arange(90, side - 90, 160) for side in size))
    xy = np.column_stack([x.ravel(), y.ravel()]) + rng.uniform(-50.0, 50.0, (x.size, 2))
    edges = np.log(np.minimum(SNR_EDGES, brightest))
    k = rng.integers(0, len(edges) - 1, len(xy))
    flux = np.exp(rng.uniform(edges[k], edges[k + 1])) / snr_of_one_dn
    v_mag = 8.0 + np.log(rng.uniform(1.0, 2.9**3, 3000)) / np.log(
        2.9
    )  # as many as the sky of these frames has
    faint_dn = sensor.flux_at_v7_dn * 10.0 ** (-0.4 * (v_mag - 7.0))
    xy, flux = np.vstack([xy, rng.uniform(0.0, size - 1.0, (3000, 2))]), np.append(flux, faint_dn)
    return render(xy, flux, *size, sensor, rng), xy, flux


def judge_places(
    name: str, lists: list[StarList], truths: list[tuple[NDArray, NDArray]], sensor: Sensor
) -> None:
    """The table by SNR, and verdicts on completeness and on places of SNR 8 and more."""
    psf = Psf(sensor.sigma_px, sensor.sigma_px, (0.0, 0.0), PAPER_CAMERA.width_px, PAPER_CAMERA.height_px)
    score = score_centroids(lists, truths, saturation_dn=255.0, psf=psf, gain_e_per_dn=sensor.e_per_dn)
    print("\n".join(score_lines(score, len(lists))))
    rows = score.snr_edges[:-1] >= 8.0
    found, stars = score.found[rows], score.stars[rows]
    judge_share(f"{name}: stars from SNR 8 detected", int(found.sum()), int(stars.sum()), least=0.98)
    squares = [np.nansum(found * np.square(part[rows])) for part in (score.rms_px, score.bound_px)]
    over = float(np.sqrt(squares[0] / squares[1]))
    n = int(found.sum())
    judge_largest(f"{name}: rms error of places over the bound", over, 1.1 + 1.65 / np.sqrt(n), "", n)
    text = f"{name}: chi2 of places"
    judge_largest(text, float(np.nansum(found * score.chi2[rows]) / n), 1.1 + 3.3 / np.sqrt(n), "", n)
    judge_largest(f"{name}: false detections a frame", score.false / len(lists), 2.0, "", len(lists))


def main() -> int:
    options = arguments_of(
        __doc__,
        ("--frames", 6, "frames of the sky"),
        ("--filled", 2, "frames filled with stars of all SNR alike"),
        ("--seed", 1, "of the frames"),
    )
    cv2.setNumThreads(1)
    head("star_id: stars, centroids and attitude of rendered full frames")
    skies(options.frames, options.seed)
    filled(options.filled, options.seed, SENSOR)
    return exit_status()


if __name__ == "__main__":
    sys.exit(main())
