"""Fields of view of real lenses, each frame by itself: do they repeat as stated, and did one lens take them?

    python benchmarks/star_fields.py > benchmarks/results/star_fields.txt

Needs the real star images beside the checkout (../shared/data). Nothing is known of cameras, places, times.
For each lens with three frames and more: fields, stated errors, the size of the stretch that the stars of
each frame show (`star_id.lens_misfit`), and chi-square of the fields' scatter.

Then, whether one lens took the frames: the log evidence of one camera and one smooth distortion for all, each
frame with a rotation and a stretch of its own, less that of a lens for each frame. Sizes of stretch and
distortion, the same for all frames, are the most probable ones of either. Before the stars are seen, focal
lengths of several lenses differ by 1 %. What displaces the stars of one frame smoothly, as trails that bend
do (GranaSAT, exposures of 8 and 30 s), counts against one lens.
"""

from __future__ import annotations

import csv
import itertools
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path

import cv2
import numpy as np
from record import exit_status, head, verdict
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.geometry.star_camera import StarCamera
from boresight.star_id.camera_fit import IdentifiedStars, fit_camera
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.field import LARGEST_FOV_RAD, SMALLEST_FOV_RAD, FieldSolution, solve_field
from boresight.star_id.field_fit import _prior_sigmas, fit_attitude_and_lens
from boresight.star_id.identification.triangle_index import StarIndex, build_index
from boresight.star_id.lens_misfit import _TERMS, LensEquations, LensErrors
from boresight.star_id.observer import proper_motion_covariance
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import select_for_calibration

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data" / "star_images"
# name, files, largest chi-square of the fields a degree of freedom
LENSES = (
    ("tetra3, 35 mm", ("tetra3/*",), 2.0),
    ("GranaSAT", ("startrackerpy/*.jpg",), 2.0),
    ("Star_Tracker_Microcontroller, 16 mm", ("Star_Tracker_Microcontroller/[A-Z]*",), 2.0),
    ("cedar-solve, 507 px", ("cedar-solve/crappy*", "cedar-solve/orion*", "cedar-solve/roof*"), None),
)
STRETCHES, WARPS_PX = (0.0, 1e-4, 2e-4, 3e-4, 5e-4, 1e-3), (0.05, 0.1, 0.2, 0.3)
FOCAL = 0.01  # 1-sigma difference of focal lengths of several lenses


@dataclass(frozen=True)
class Frame:
    """One image with what it states, and the stars that this rests on."""

    file: str
    found: FieldSolution
    errors: LensErrors
    used: IdentifiedStars  # covariances with the common variance


def main() -> None:
    if not FOLDER.is_dir():
        raise SystemExit(f"real star images are not at ../shared/data ({FOLDER})")
    head("fields of view of real lenses")
    places = hipparcos_stars(8.0).places
    index = build_index(places, 2019.0, (float(SMALLEST_FOV_RAD), float(LARGEST_FOV_RAD)))
    rows = [row for row in csv.DictReader((FOLDER / "manifest.csv").open()) if row["level"] == "verified"]
    for name, files, most in LENSES:
        chosen = [row["file"] for row in rows if any(fnmatchcase(row["file"], file) for file in files)]
        frames = [fitted(file, index) for file in chosen]
        fields(name, frames, most)
        one_lens(frames)
    raise SystemExit(exit_status())


def fitted(file: str, index: StarIndex) -> Frame:
    image = cv2.imread(str(FOLDER / file), cv2.IMREAD_UNCHANGED)
    if image.ndim == 3:
        image = cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2GRAY)
    settings = StarSettings()
    found = solve_field(image, index, settings)
    assert isinstance(found, FieldSolution) and found.stars is not None
    stars, rows, camera = found.stars, found.detections, found.camera
    use = select_for_calibration(stars.centroids, rows, found.rows, camera, index, settings)
    moved = proper_motion_covariance(index, found.rows[use], camera, found.R_si, settings.epoch_error_years)
    xy, cov, u_i = found.xy_px[use], stars.cov_px[rows[use]] + moved, found.u_i[use]
    errors = fit_attitude_and_lens(camera, found.R_si, xy, cov, u_i).errors
    cov = cov + errors.common_px2 * np.eye(2)
    number = np.zeros(len(xy), dtype=np.int64)
    used = IdentifiedStars(xy_px=xy, cov_px=cov, u_i=u_i, frame=number, t_s=np.zeros(1))
    return Frame(Path(file).name, found, errors, used)


def fields(name: str, frames: list[Frame], most: float | None) -> None:
    """Print the fields of view and their scatter."""
    field = np.array([frame.found.fov_x_rad for frame in frames])
    sigma = np.array([frame.found.fov_x_sigma_rad for frame in frames])
    mean, dof = np.average(field, weights=sigma**-2.0), len(field) - 1
    print(f"\n{name}: {np.degrees(mean):.4f} deg")
    for frame, one, own in zip(frames, field, sigma):
        text = f"  {frame.file[:40]:40s} {1e6 * (one / mean - 1.0):+6.0f} ppm, stated {1e6 * own / mean:5.0f}"
        stretch = 1e6 * frame.errors.stretch_px / half_px(frame.found.camera)
        text += f", stretch {stretch:4.0f}" if stretch else " " * 14
        print(f"{text}; {len(frame.used.xy_px)} stars")
    total = float((((field - mean) / sigma) ** 2).sum())
    text = f"{name}: chi2 of fields {total / dof:.2f} a degree of freedom ({dof}), exceeded by chance in "
    text += f"{100.0 * float(chi2(dof).sf(total)):.0f} of 100"
    if most is None:
        print(f"       {text}")
    else:
        verdict(f"{text}; at most {most}", total / dof <= most)


def half_px(camera: StarCamera) -> float:
    return 0.5 * max(camera.width_px, camera.height_px)


def one_lens(frames: list[Frame]) -> None:
    """Print the evidence of one lens."""
    each = equations(frames)
    half = half_px(each[0].camera)
    sizes = list(itertools.product(STRETCHES, WARPS_PX))
    one = {size: together(each, size[0] * half, size[1]) for size in sizes}
    several = {
        size: sum(of_frame(e, size[0] * half, size[1]).solved(0.0).log_evidence for e in each)
        for size in sizes
    }
    sharing, own = (max(evidence, key=evidence.__getitem__) for evidence in (one, several))
    sizes_of = [f"{1e6 * stretch:.0f} ppm and {warp} px" for stretch, warp in (sharing, own)]
    print(f"       log evidence of one lens over several {one[sharing] - several[own]:+.1f}; stretch and")
    print(f"       distortion of one: {sizes_of[0]}, of several: {sizes_of[1]}")
    rigid = max(value for (stretch, _), value in one.items() if stretch == 0.0)
    print(
        f"       of one lens: with a stretch of each frame over without {one[sharing] - rigid:+.1f}",
        flush=True,
    )


def equations(frames: list[Frame]) -> list[LensEquations]:
    """Of each frame, for rotation and camera, about the camera that fits all best."""
    number = np.repeat(np.arange(len(frames)), [len(frame.used.xy_px) for frame in frames])
    every = IdentifiedStars(
        xy_px=np.vstack([frame.used.xy_px for frame in frames]),
        cov_px=np.concatenate([frame.used.cov_px for frame in frames]),
        u_i=np.vstack([frame.used.u_i for frame in frames]),
        frame=number,
        t_s=np.zeros(len(frames)),
    )
    best = min(frames, key=lambda frame: frame.found.fov_x_sigma_rad).found.camera
    prior = _prior_sigmas(best)
    middle = (0.5 * (best.width_px - 1), 0.5 * (best.height_px - 1))
    ideal = replace(best, principal_px=middle, p1=0.0, p2=0.0, q1=0.0, q2=0.0)
    start = Rotation.concatenate([frame.found.R_si for frame in frames])
    fit = fit_camera(every, best, start, prior=prior, expected=ideal)
    u_s = fit.rotations[number].apply(every.u_i)
    prior |= {"focal_m": FOCAL * best.focal_m}
    kept = [replace(fit, keep=fit.keep & (number == k)) for k in range(len(frames))]
    return [LensEquations.of(one, u_s, every.cov_px, prior) for one in kept]


def of_frame(plain: LensEquations, stretch_px: float, warp_px: float) -> LensEquations:
    """With a stretch and a smooth distortion of these sizes."""
    distorted = (plain.stretched(stretch_px) if stretch_px else plain).distorted()
    decay = np.tile([2.0 ** (-0.5 * (i + j)) for i, j in _TERMS], 2)
    return replace(distorted, sigma=np.append(distorted.sigma, warp_px * decay))


def together(each: list[LensEquations], stretch_px: float, warp_px: float) -> float:
    """Log evidence of one camera and distortion for all frames; rotation and stretch are each frame's own."""
    parts = [of_frame(one, stretch_px, warp_px) for one in each]
    own = [*range(3), *((10, 11) if stretch_px else ())]
    shared = [k for k in range(len(parts[0].sigma)) if k not in own]
    columns = [part.columns for part in parts]
    blocks = [
        np.vstack([one[:, :, own] * (k == j) for j, one in enumerate(columns)]) for k in range(len(columns))
    ]
    sigma = parts[0].sigma
    joint = replace(
        parts[0],
        residual_px=np.vstack([part.residual_px for part in parts]),
        cov_px=np.concatenate([part.cov_px for part in parts]),
        u_s=np.vstack([part.u_s for part in parts]),
        xy_px=np.vstack([part.xy_px for part in parts]),
        columns=np.concatenate([*blocks, np.vstack([one[:, :, shared] for one in columns])], axis=2),
        slopes=np.zeros((len(own) * len(parts) + len(shared), 4)),
        sigma=np.append(np.tile(sigma[own], len(parts)), sigma[shared]),
    )
    return joint.solved(0.0).log_evidence


if __name__ == "__main__":
    main()
