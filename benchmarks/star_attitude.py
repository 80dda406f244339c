"""Accuracy of the attitude from one image of the sky: raw frames of the paper's camera, known truth.

    python benchmarks/star_attitude.py [--frames 300] [--seed 1]

5120 x 3840 px, 8 bit, PSF sigma 1.25 px, read noise 2 DN, 40 e-/DN, 2000 hot pixels, SNR 8 at V = 7; the
Hipparcos sky as a satellite sees it in 2026 (proper motion, parallax, aberration, deflection) and below it
random stars to V = 11. Each frame passes detection, identification, outlier rejection and the attitude fit;
as a mission's exposure, as an image that `boresight identify` is given with its camera, and as one of which
nothing is known but a field of view 5 % wrong. Saturated stars are measured by their wings, in the bound too.
Printed beside the attitude's error is its Cramér-Rao bound, from the true positions, fluxes and noise of the
stars used, and the mean normalised error squared of the stated covariance.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from record import band_of_mean_nees, exit_status, head, verdict
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from frames import PAPER_CAMERA, Sensor, as_seen, star_frame

from boresight.geometry.attitude_estimate import fit_attitudes
from boresight.geometry.constants import ARCSEC
from boresight.geometry.epoch import Epoch
from boresight.geometry.sightings import information_of_directions
from boresight.geometry.star_camera import StarCamera
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.field import solve_field
from boresight.star_id.finding.psf import Psf
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.identification.triangle_index import build_index, equivalent_fov
from boresight.star_id.observer import Observer
from boresight.star_id.score import cramer_rao_px
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import sight_stars

CAMERA = replace(PAPER_CAMERA, principal_px=(2571.3, 1893.2))  # a detector beside the axis, as all are
SENSOR = Sensor(hot_pixels=2000)
EPOCH = Epoch.from_utc("2026-03-20T00:00:00Z")
P_I, V_I = np.array([6.9e6, 0.0, 0.0]), np.array([0.0, 1.0e3, 7.5e3])  # m, m/s: an orbit 500 km up
ROUNDING = 1.0 / 12.0  # DN^2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    places, settings = hipparcos_stars(8.0).places, StarSettings()
    fov = equivalent_fov(CAMERA.width_px, CAMERA.height_px, CAMERA.focal_m / CAMERA.pixel_m)
    index = build_index(places, 2026.2, fov)
    fov_x = CAMERA.fov_x_rad
    wide = build_index(places, 2026.2, (np.radians(15.0), np.radians(24.0)))
    mission, camera_known, lens_unknown = _Errors(), _Errors(), _Errors()
    bounds, chi2, dof, stars = [], 0.0, 0, 0
    for k in range(arguments.frames):
        rng = np.random.default_rng([arguments.seed, k])
        t_s = float(rng.uniform(0.0, 3.0e7))  # anywhere in a year: the Earth's velocity goes round
        R_si = Rotation.random(random_state=rng)
        observer = Observer(EPOCH, t_s, P_I, V_I)
        image, truth = star_frame(CAMERA, R_si, as_seen(places, observer), SENSOR, rng)
        seen = sight_stars(str(k), image, CAMERA, index, observer, settings)
        if isinstance(seen, NotIdentified):
            print(seen.reason)
            continue
        attitude = fit_attitudes(seen.u_s, seen.u_i, seen.cov_s, np.array([0, len(seen.u_s)]))
        mission.add(Rotation.from_matrix(attitude.R_si[0]), R_si, CAMERA, attitude.covariance_s[0])
        bounds.append(np.linalg.inv(_information(seen.u_s, seen.xy_px, truth)))
        chi2, dof, stars = chi2 + float(attitude.chi2[0]), dof + int(attitude.dof[0]), stars + len(seen.u_s)
        for errors, sky, known in (
            (camera_known, index, {"camera": CAMERA}),
            (lens_unknown, wide, {"fov_x_rad": 1.05 * fov_x}),
        ):
            found = solve_field(image, sky, settings, observer=observer, **known)
            if isinstance(found, NotIdentified):
                print(found.reason)
            else:
                errors.add(found.R_si, R_si, found.camera, found.cov_s)
    n = len(bounds)
    head(
        f"star_id: attitude of {n} of {arguments.frames} rendered full frames (OpenCV {cv2.__version__}, one"
        " thread)"
    )
    print(f"stars used {stars / n:.1f} a frame, their residuals' chi2 per degree of freedom {chi2 / dof:.3f}")
    _print("as a mission's exposure", mission, np.array(bounds))
    _print("boresight identify, the camera known", camera_known, np.array(bounds))
    _print("boresight identify, the field of view 5 % wrong, the lens unknown", lens_unknown, None)


class _Errors:
    """What became of the frames, on one way."""

    def __init__(self) -> None:
        self.turns: list = []  # of the image's middle, about the axes of s
        self.squares: list[float] = []  # normalised

    def add(self, found: Rotation, truth: Rotation, camera: StarCamera, cov_s) -> None:
        turn = (truth * found.inv()).as_matrix() @ camera.middle_axes() @ CAMERA.middle_axes().T
        delta = -Rotation.from_matrix(turn).as_rotvec()
        self.turns.append(delta)
        self.squares.append(delta @ np.linalg.solve(cov_s, delta))


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


def _print(title, found: _Errors, bounds):
    errors, nees = np.array(found.turns), np.array(found.squares)
    n = len(errors)
    print(f"\n{title}, {n} frames")
    if bounds is None:
        x, y, z = np.sqrt((errors**2).mean(axis=0)) / ARCSEC
        print(f'rms error of the direction of the middle, about x, y, z of s: {x:.3f}", {y:.3f}", {z:.3f}"')
    else:
        _print_against(errors, bounds)
    spread = nees.std() / np.sqrt(n) / 3.0
    mean, (low, high) = nees.mean() / 3.0, (band / 3.0 for band in band_of_mean_nees(n))
    print(f"mean normalised error squared of the stated covariance, per axis: {mean:.3f} ({spread:.3f})")
    if bounds is None:  # lenses as odd as the prior allows would have one; this one is an ordinary lens
        verdict(f"the normalised error squared is not above its 99.9 % band, {high:.3f}", mean < high)
    else:
        inside = low < mean < high
        verdict(f"the normalised error squared is in its 99.9 % band, {low:.3f} to {high:.3f}", inside)


def _print_against(errors, bounds):
    n = len(errors)
    print("axis of s   rms error   rms bound   x bound  (standard error)")
    variance = np.einsum("nii->ni", bounds)
    for axis, name in enumerate("xyz"):
        rms, bound = np.sqrt((errors[:, axis] ** 2).mean()), np.sqrt(variance[:, axis].mean())
        ratio = rms / bound
        print(
            f'{name:9s}   {rms / ARCSEC:8.3f}"   {bound / ARCSEC:8.3f}"   {ratio:7.3f}'
            f"  ({ratio / np.sqrt(2.0 * n):.3f})"
        )
    against_bound = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(bounds), errors)
    whole = np.sqrt(against_bound.mean() / 3.0)
    print(f"all axes, each in units of its bound: {whole:.3f} ({whole / np.sqrt(6.0 * n):.3f})")
    verdict("the attitude's error is within 1.1 of its bound", whole <= 1.1)


if __name__ == "__main__":
    main()
    raise SystemExit(exit_status())
