"""Accuracy of star detection, centroids and identification: full frames of the paper's camera, known truth.

    python benchmarks/star_accuracy.py [--frames 24] [--filled 20] [--told-gain]

5120 x 3840 px, 8 bit, PSF sigma 1.25 px, read noise 2 DN, 40 e-/DN, 2000 hot pixels, SNR 8 at V = 7; the
Hipparcos sky and below it random stars to V = 11. Prints CPU time (one thread), completeness, error over the
Cramér-Rao bound and chi2 by SNR, bias over pixel phase, false detections, and the attitude's error over its
bound. A sky holds few bright stars, so other frames are filled with stars of all SNR alike, on the same
faint background and hot pixels: these are measured by both methods.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from record import head
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from boresight.geometry.star_camera import StarCamera

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from frames import PAPER_CAMERA, Sensor, render, star_frame

from boresight.features.sky_images.centroid_report import score_lines
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.field import FieldSolution, solve_list
from boresight.star_id.finding.psf import Psf
from boresight.star_id.finding.star_list import StarList, list_stars
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.identification.triangle_index import StarIndex, build_index, equivalent_fov
from boresight.star_id.score import SNR_EDGES, score_centroids
from boresight.star_id.settings import StarSettings

RUNS = 5  # of each frame: on a shared machine the least tells what the work costs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--filled", type=int, default=20, help="frames filled with stars of all SNR alike")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--gradient", type=float, default=0.0, help="DN from the left edge to the right")
    parser.add_argument("--told-gain", action="store_true")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    sensor = Sensor(hot_pixels=2000, gradient_dn=arguments.gradient)
    settings = StarSettings(gain_e_per_dn=sensor.e_per_dn if arguments.told_gain else None)
    head(f"star_id: accuracy on rendered full frames (OpenCV {cv2.__version__}, one thread)")
    _skies(arguments.frames, arguments.seed, sensor, settings)
    _filled(arguments.filled, arguments.seed, sensor, settings)


def _skies(frames: int, seed: int, sensor: Sensor, settings: StarSettings) -> None:
    camera, places = PAPER_CAMERA, hipparcos_stars(8.0).places
    focal_px = camera.focal_m / camera.pixel_m
    index = build_index(places, places.epoch_jyear, equivalent_fov(5120, 3840, focal_px))
    lists, truths, find_ms, whole_ms, nees, hot = [], [], [], [], [], 0
    for k in range(frames):
        rng = np.random.default_rng([seed, k])
        R_si = Rotation.random(random_state=rng)
        image, truth = star_frame(camera, R_si, places, sensor, rng)
        list_stars(image, settings)  # the first call of a process pays for memory
        runs = [_chain(image, camera, index, settings) for _ in range(RUNS)]
        stars, field = runs[0][:2]
        find_ms.append([run[2] for run in runs])
        whole_ms.append([run[3] for run in runs])
        lists.append(stars)
        truths.append((truth.xy_px, truth.flux_dn))
        hot += _hot_taken(stars, image, truth.xy_px)
        if isinstance(field, NotIdentified):
            print(f"frame {k}: {field.reason}")
            continue
        delta = (field.R_si * R_si.inv()).as_rotvec()
        nees.append(delta @ np.linalg.solve(field.cov_s, delta) / 3.0)
    print(f"{frames} frames of the sky, {len(nees)} identified")
    print(f"CPU ms of {RUNS} runs a frame; load of the machine, mean of a minute, {os.getloadavg()[0]:.1f}")
    for name, spent in (("find and place", find_ms), ("raw image to attitude", whole_ms)):
        middle, least = np.median(np.min(spent, axis=1)), np.min(spent)
        print(
            f"{name:22s} median {np.median(spent):.1f}  of each frame's least {middle:.1f}  least {least:.1f}"
        )
    print(f"attitude: mean normalised error squared {np.mean(nees):.2f} (1 expected) over {len(nees)} frames")
    print(f"PSF sigma found {np.mean([s.psf.sigma_px for s in lists]):.4f} px, true {sensor.sigma_px}")
    print(f"hot pixels taken for stars {hot / frames:.2f} a frame of {sensor.hot_pixels}")
    print("\n".join(_score_lines(lists, truths, sensor)))


def _chain(
    image: NDArray, camera: StarCamera, index: StarIndex, settings: StarSettings
) -> tuple[StarList, FieldSolution | NotIdentified, float, float]:
    """Stars and attitude of a raw image, and CPU ms for the stars and for all."""
    start = time.process_time()
    stars = list_stars(image, settings)
    found_at = time.process_time()
    field = solve_list(stars, (camera.width_px, camera.height_px), index, settings, camera=camera)
    ended = time.process_time()
    return stars, field, 1e3 * (found_at - start), 1e3 * (ended - start)


def _filled(frames: int, seed: int, sensor: Sensor, settings: StarSettings) -> None:
    lists, truths = [], []
    for k in range(frames):
        image, xy, flux = filled_frame(sensor, np.random.default_rng([seed, 1000 + k]))
        truths.append((xy, flux))
        lists.append(list_stars(image, replace(settings, max_stars=5000)))
    print(f"\n{frames} frames filled with stars of all SNR alike")
    print("\n".join(_score_lines(lists, truths, sensor)))


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


def _score_lines(lists: list[StarList], truths: list[tuple[NDArray, NDArray]], sensor: Sensor) -> list[str]:
    psf = Psf(sensor.sigma_px, sensor.sigma_px, (0.0, 0.0), PAPER_CAMERA.width_px, PAPER_CAMERA.height_px)
    score = score_centroids(lists, truths, saturation_dn=255.0, psf=psf, gain_e_per_dn=sensor.e_per_dn)
    return score_lines(score, len(lists))


def _hot_taken(stars: StarList, image: NDArray, xy_px: NDArray) -> int:
    """Detections without a true star within 3 px whose brightest pixel stands alone."""
    far = cKDTree(xy_px).query(stars.xy_px)[0] > 3.0
    taken = 0
    for x, y in np.rint(stars.xy_px[far]).astype(int):
        window = image[y - 2 : y + 3, x - 2 : x + 3].astype(float)
        taken += window.size == 25 and window.max() - np.sort(window.ravel())[-2] > 15.0
    return taken


if __name__ == "__main__":
    main()
