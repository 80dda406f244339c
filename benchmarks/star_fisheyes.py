"""Fisheyes identified and calibrated from lists of stars: error of the pixel map, in the middle and near the
rim, over what is stated.

    python benchmarks/star_fisheyes.py [--seeds 2] [--frames 8] [--kinds stereographic] [--fields 140 160]

Lenses are functions of the angle from the axis, written here and shared with no code of `star_id`, before a
detector of 2000 x 1500 px whose principal point is 31 and -22 px off its middle; centroids have errors of
0.05 px; a third of the detections are false, a fifth are missing. Stars to 92.5 deg from the axis are imaged.
Columns: images identified, stars used, projection chosen (q3, size of the smooth distortion), reduced chi2;
root mean square of the map's error along one axis, apart from a rotation, px, over the half of the field
around the axis and over its outermost tenth, with what is stated there; mean squared ratio of the two over
the whole field (NEES) and over that rim.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from record import exit_status, head, verdict
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from frames import directions_of

from boresight.star_id.camera_calibration import CameraCalibration, SkyFrame, calibrate_camera
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.field import nominal_camera
from boresight.star_id.finding.background import Background
from boresight.star_id.finding.psf import Psf
from boresight.star_id.finding.star_list import StarList
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.identification.triangle_index import build_index
from boresight.star_id.settings import StarSettings

KINDS: dict[str, Callable[[NDArray], NDArray]] = {
    "equidistant": lambda t: t,
    "equisolid": lambda t: np.sin(0.5 * t) / 0.5,
    "stereographic": lambda t: np.tan(0.5 * t) / 0.5,
    "orthographic": np.sin,
    "Nikkor 10.5 mm": lambda t: 1.47 * np.sin(0.713 * t),
}
FIELDS_DEG = (80, 110, 140, 160, 172)
SIZE = np.array([2000, 1500])
PRINCIPAL_PX = 0.5 * (SIZE - 1.0) + [31.0, -22.0]
NOISE_PX = 0.05
LIMIT_MAG = 4.7
# Angle from the axis, rad, to which stars are imaged, and to which an orthographic lens has a slope left.
IMAGED_RAD, ORTHOGRAPHIC_RAD = np.radians(92.5), np.radians(89.0)


class Lens:
    """A kind of lens with a field of view along columns, deg."""

    def __init__(self, kind: str, field_deg: int) -> None:
        self.radius = KINDS[kind]
        self.last_rad = ORTHOGRAPHIC_RAD if kind == "orthographic" else IMAGED_RAD
        self.focal_px = 0.5 * SIZE[0] / float(self.radius(np.radians(0.5 * field_deg)))

    def seen(self, u_s: NDArray) -> NDArray:
        """(N,) which directions (N, 3) are imaged on the detector."""
        with np.errstate(invalid="ignore"):
            xy = self.pixels(u_s)
            return (u_s[:, 2] > np.cos(self.last_rad)) & ((xy > -0.5) & (xy < SIZE - 0.5)).all(axis=1)

    def pixels(self, u_s: NDArray) -> NDArray:
        """(N, 2) of directions (N, 3)."""
        off = np.hypot(u_s[:, 0], u_s[:, 1])
        r = self.focal_px * self.radius(np.arctan2(off, u_s[:, 2])) / np.maximum(off, 1e-15)
        return PRINCIPAL_PX - r[:, None] * u_s[:, :2]

    def stars(self, R_si: Rotation, rng: np.random.Generator) -> StarList:
        """List of the stars of one image."""
        places = hipparcos_stars(8.0).places
        rows = np.flatnonzero(places.v_mag < LIMIT_MAG)
        u_s = R_si.apply(directions_of(places)[rows])
        rows, u_s = (part[self.seen(u_s)] for part in (rows, u_s))
        xy = self.pixels(u_s) + rng.normal(0.0, NOISE_PX, (len(rows), 2))
        snr = 8.0 * 10.0 ** (0.4 * (LIMIT_MAG - places.v_mag[rows]))
        false = len(rows) // 2
        xy = np.vstack([xy, rng.uniform(-0.5, SIZE - 0.5, (false, 2))])
        snr = np.append(snr, rng.choice(snr, false))
        kept = np.argsort(-snr, kind="stable")[rng.random(len(snr)) > 0.2]
        return listed(xy[kept], snr[kept])


def listed(xy: NDArray, snr: NDArray) -> StarList:
    """Detections as `find_stars` hands them over, brightest first."""
    no = np.zeros(len(xy), dtype=bool)
    return StarList(
        xy_px=xy,
        cov_px=np.tile(NOISE_PX**2 * np.eye(2), (len(xy), 1, 1)),
        flux_dn=snr,
        snr=snr,
        saturated=no,
        blended=no,
        psf=Psf(1.25, 1.25, (0.0, 0.0), *SIZE.tolist()),
        psf_stars=50,
        background=Background(np.full((8, 10), 20.0), np.full((8, 10), 2.0), *SIZE.tolist()),
        gain_e_per_dn=40.0,
        threshold=5.5,
        hot_pixels=0,
        misshapen_px=np.empty((0, 2)),
        saturation_dn=255.0,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=[*KINDS])
    parser.add_argument("--fields", nargs="+", type=int, default=[*FIELDS_DEG])
    arguments = parser.parse_args()
    head("star_id: fisheyes")
    print(
        f"{'':15s} deg seed found stars model            chi2/dof  middle  stated     rim  stated  NEES   rim"
    )
    for kind in arguments.kinds:
        tried = [(deg, seed) for deg in arguments.fields for seed in range(arguments.seeds)]
        rows = [_run(kind, *one, arguments.frames) for one in tried]
        judged = np.array([row for row in rows if row])
        if kind == "orthographic":  # its slope vanishes at 90 deg: the widest may be refused
            verdict(f"{kind}: {len(judged)} of {len(rows)} sets calibrated, the others refused", True)
        else:
            verdict(f"{kind}: {len(judged)} of {len(rows)} sets calibrated", len(judged) == len(rows))
        if len(judged):
            share, middle, rim, nees = judged.mean(axis=0)
            verdict(f"{kind}: {share:.3f} of the images identified, 0.95", share >= 0.95)
            ratios = f"{np.sqrt(middle):.2f} in the middle, {np.sqrt(rim):.2f} near the rim"
            verdict(f"{kind}: error over what is stated {ratios}, 1.3", max(middle, rim) <= 1.3**2)
            verdict(f"{kind}: NEES over the field {nees:.2f}, at most 1.4", nees <= 1.4)


def _run(kind: str, field_deg: int, seed: int, frames: int) -> tuple[float, float, float, float] | None:
    """Share of the images identified, and mean squared ratios of errors in the middle, near the rim and over
    the field; None if the lens is refused."""
    rng, lens = np.random.default_rng([seed, field_deg, *kind.encode()]), Lens(kind, field_deg)
    places = hipparcos_stars(8.0).places
    index = build_index(places, places.epoch_jyear, (np.radians(20.0), np.radians(60.0)))
    sky = [SkyFrame(str(k), lens.stars(Rotation.random(random_state=rng), rng)) for k in range(frames)]
    nominal = nominal_camera(tuple(SIZE.tolist()), np.radians(min(1.03 * field_deg, 175.0)))
    found = calibrate_camera(sky, nominal, index, StarSettings())
    name = f"{kind:14s} {field_deg:4d} {seed:4d}"
    if not isinstance(found, CameraCalibration) or not found.explained:
        reason = (
            found.reason if isinstance(found, NotIdentified) else f"{found.unmodelled_px:.2f} px are left"
        )
        print(f"{name}  refused: {reason[:90]}", flush=True)
        return None
    u_s, error, sigma = map_error(lens, found)
    square = 0.5 * (error**2).sum(axis=1)
    angle = np.arccos(u_s[:, 2])
    middle, rim = angle < 0.5 * angle.max(), angle > 0.9 * angle.max()
    q3 = "q3" if found.camera.q3 else "  "
    numbers = [np.sqrt(part[rows].mean()) for rows in (middle, rim) for part in (square, sigma**2)]
    ratio = square / sigma**2
    print(
        f"{name} {len(found.frames_used):2d}/{frames:2d} {len(found.xy_px):5d}"
        f" {found.camera.projection:13s} {q3} {found.smooth_size_px:4.2f} {found.chi2 / found.dof:5.3f}"
        + "".join(f" {number:7.4f}" for number in numbers)
        + f" {ratio.mean():5.2f} {ratio[rim].mean():5.2f}",
        flush=True,
    )
    return len(found.frames_used) / frames, ratio[middle].mean(), ratio[rim].mean(), ratio.mean()


def map_error(lens: Lens, found: CameraCalibration) -> tuple[NDArray, NDArray, NDArray]:
    """True directions (N, 3) of a grid of pixels, error (N, 2) px of the calibrated map there, apart from the
    best rotation, and stated error (N,) px; where the camera has a direction."""
    x, y = np.meshgrid(np.linspace(0.0, SIZE[0] - 1.0, 61), np.linspace(0.0, SIZE[1] - 1.0, 46))
    xy = np.column_stack([x.ravel(), y.ravel()])
    u_s = found.camera.directions_from_pixels(xy)
    has = np.isfinite(u_s).all(axis=1)
    xy, u_s = xy[has], u_s[has]
    sigma = found.model_sigma_px(xy)

    def error(turn: NDArray) -> NDArray:
        return (lens.pixels(Rotation.from_rotvec(1e-3 * turn).apply(u_s)) - xy) / sigma[:, None]

    turn = least_squares(lambda turn: error(turn).ravel(), np.zeros(3)).x
    return u_s, error(turn) * sigma[:, None], sigma


if __name__ == "__main__":
    main()
    raise SystemExit(exit_status())
