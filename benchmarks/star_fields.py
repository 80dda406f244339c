"""The real star images: which are identified, and do the fields of view of one lens repeat as stated?

    python benchmarks/star_fields.py

Needs the real star images beside the checkout (../shared/data). Nothing is known of cameras, places, times.
For each lens with three frames and more: fields, stated errors, the size of the stretch that the stars of
each frame show (`star_id.lens_misfit`), and chi-square of the fields' scatter. Errors contain that of focus
where the file names f-number and focal length; frames of one pointing are compared without it.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from record import SHARED, exit_status, head, judge_share, not_run, verdict
from scipy.stats import chi2

from boresight.features.sky_images.image_time import with_error_of_focus
from boresight.pipeline.files.images.image_file import open_image
from boresight.pipeline.files.images.star_images import read_star_image
from boresight.star_id.camera_fit import IdentifiedStars
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.field import LARGEST_FOV_RAD, SMALLEST_FOV_RAD, FieldSolution, solve_field
from boresight.star_id.field_fit import fit_attitude_and_lens
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.identification.triangle_index import StarIndex, build_index
from boresight.star_id.lens_misfit import LensErrors
from boresight.star_id.observer import proper_motion_covariance
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import select_for_calibration

FOLDER = SHARED / "star_images"
# name, files, largest chi-square of the fields a degree of freedom
LENSES = (
    ("tetra3, 35 mm", ("tetra3/*",), 2.0),
    ("GranaSAT", ("startrackerpy/*.jpg",), 2.0),
    ("Star_Tracker_Microcontroller, 16 mm", ("Star_Tracker_Microcontroller/[A-Z]*",), 2.0),
    ("PiFinder, 10.2 deg", ("PiFinder/pifinder*", "PiFinder/orion*"), 2.0),
    ("spel, 3 mm, two nights", ("spel*",), 2.0),
    ("cedar-solve, 507 px", ("cedar-solve/crappy*", "cedar-solve/orion*", "cedar-solve/roof*"), None),
)
NEAR = 0.1  # of the field: a pointing that is the manifest's
REPEATED = "spel*"  # files of a lens with several frames of each pointing, taken within a minute
SAME = np.radians(0.5)  # between the middles of frames of one pointing


@dataclass(frozen=True)
class Frame:
    """One image with what it states, and the stars that this rests on."""

    file: str
    found: FieldSolution
    errors: LensErrors
    used: IdentifiedStars  # covariances with the common variance


def main() -> None:
    if not FOLDER.is_dir():
        not_run("the real star images are not there (shared/data/star_images)")
    head("Real star images: identified, and fields of view of one lens")
    places = hipparcos_stars(8.0).places
    index = build_index(places, 2019.0, (float(SMALLEST_FOV_RAD), float(LARGEST_FOV_RAD)))
    rows = csv.DictReader((FOLDER / "manifest.csv").open())
    rows = [row for row in rows if open_image(FOLDER / row["file"], row["file"]).format]
    answers = {
        row["file"]: solve_field(read_star_image(FOLDER / row["file"], row["file"]), index, StarSettings())
        for row in rows
    }
    known = [row for row in rows if row["level"] != "none" and row["ra_deg"]]
    of_known = [answers[row["file"]] for row in known]
    right = [is_right(row, found) for row, found in zip(known, of_known) if isinstance(found, FieldSolution)]
    judge_share("real images of known pointing: identified", len(right), len(known), least=0.9)
    judge_share("real images identified: another pointing", len(right) - sum(right), len(right), most=0.0)
    others = sum(isinstance(answers[row["file"]], FieldSolution) for row in rows) - len(right)
    print(f"{others} of {len(rows) - len(known)} images of unknown pointing are identified, too")
    for name, files, most in LENSES:
        chosen = [row["file"] for row in rows if any(fnmatchcase(row["file"], file) for file in files)]
        chosen = [file for file in chosen if isinstance(answers[file], FieldSolution)]
        fields(name, [fitted(file, answers[file], index) for file in chosen], most)
    repeats([found for file, found in answers.items() if fnmatchcase(file, REPEATED)])
    raise SystemExit(exit_status())


def is_right(row: dict[str, str], found: FieldSolution) -> bool:
    """Whether the middle of the image lies where the manifest has it."""
    ra, dec = np.radians([float(row["ra_deg"]), float(row["dec_deg"])])
    known = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    return bool(np.arccos(np.clip(known @ middle_of(found), -1.0, 1.0)) < NEAR * found.fov_x_rad)


def middle_of(found: FieldSolution) -> NDArray:
    """Direction (3,) of the middle of the image, GCRS."""
    return found.R_si.inv().apply(found.camera.middle_axes()[:, 2])


def fitted(file: str, found: FieldSolution, index: StarIndex) -> Frame:
    settings = StarSettings()
    assert found.stars is not None
    stars, rows, camera = found.stars, found.detections, found.camera
    use = select_for_calibration(stars.centroids, rows, found.rows, camera, index, settings)
    moved = proper_motion_covariance(index, found.rows[use], camera, found.R_si, settings.epoch_error_years)
    xy, cov, u_i = found.xy_px[use], stars.cov_px[rows[use]] + moved, found.u_i[use]
    errors = fit_attitude_and_lens(camera, found.R_si, xy, cov, u_i).errors
    cov = cov + errors.common_px2 * np.eye(2)
    number = np.zeros(len(xy), dtype=np.int64)
    used = IdentifiedStars(xy_px=xy, cov_px=cov, u_i=u_i, frame=number, t_s=np.zeros(1))
    return Frame(Path(file).name, with_error_of_focus(found, FOLDER / file), errors, used)


def repeats(found: list[FieldSolution | NotIdentified]) -> None:
    """Print the scatter of the fields of view of one pointing about their mean, all pointings together: the
    same stars at the same pixels, through a lens as it is at that minute."""
    groups: list[list[FieldSolution]] = []
    for one in found:
        if isinstance(one, FieldSolution):
            near = [group for group in groups if middle_of(one) @ middle_of(group[0]) > np.cos(SAME)]
            near[0].append(one) if near else groups.append([one])
    total, dof = 0.0, 0
    for group in groups:
        field = np.array([one.fov_x_rad for one in group])
        weight = np.array([one.fov_x_sigma_rad for one in group]) ** -2.0
        total += float((weight * (field - np.average(field, weights=weight)) ** 2).sum())
        dof += len(group) - 1
    text = f"spel, 3 mm: chi2 of fields of one pointing a degree of freedom {total / dof:.2f}"
    verdict(text, "at most 2", total / dof <= 2.0, sum(map(len, groups)))


def fields(name: str, frames: list[Frame], most: float | None) -> None:
    """Print the fields of view and their scatter."""
    field = np.array([frame.found.fov_x_rad for frame in frames])
    sigma = np.array([frame.found.fov_x_sigma_rad for frame in frames])
    mean, dof = np.average(field, weights=sigma**-2.0), len(field) - 1
    print(f"\n{name}: {np.degrees(mean):.4f} deg")
    for frame, one, own in zip(frames, field, sigma):
        text = f"  {frame.file[:40]:40s} {1e6 * (one / mean - 1.0):+6.0f} ppm, stated {1e6 * own / mean:5.0f}"
        camera = frame.found.camera
        stretch = 2e6 * frame.errors.stretch_px / max(camera.width_px, camera.height_px)
        text += f", stretch {stretch:4.0f}" if stretch else " " * 14
        print(f"{text}; {len(frame.used.xy_px)} stars")
    total = float((((field - mean) / sigma) ** 2).sum())
    text = f"{name}: chi2 of {len(field)} fields a degree of freedom {total / dof:.2f}"
    if most is None:
        print(f"       {text}")
    else:
        chance = float(chi2(dof).sf(total))
        text += f", {100.0 * chance:.0f} of 100 by chance"
        verdict(text, f"at most {most:g}", total / dof <= most, len(field))


if __name__ == "__main__":
    main()
