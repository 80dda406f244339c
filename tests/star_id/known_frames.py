"""Sixty rendered star frames, four skies in each of fifteen conditions, and the record of what they and the
real ones of ../shared/data are answered: `known_answers.csv`, which `test_known_answers.py` compares.

    python tests/star_id/known_frames.py

writes that file anew from the present code; a difference is a decision, to be read before it is committed.
"""

import csv
import io
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from frames import PLACES, Sensor, star_frame

from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.files.images.image_file import open_image
from boresight.pipeline.files.images.star_images import read_star_image
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.field import LARGEST_FOV_RAD, SMALLEST_FOV_RAD, FieldSolution, solve_field
from boresight.star_id.identification.triangle_index import build_index
from boresight.star_id.settings import StarSettings

ANSWERS = Path(__file__).with_name("known_answers.csv")
REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "star_images"
SIDE = 640
FIELDS_DEG = (9.0, 14.0, 22.0, 35.0)  # of the four skies of a condition
SENSOR = Sensor(bits=16, read_noise_dn=2.5, e_per_dn=4.0, background_dn=30.0, flux_at_v7_dn=150.0)
BRIGHTEST = 10  # names that a record holds


def eight_bits(image, rng):
    return image.round().clip(0, 255).astype(np.uint8)


def more_bits(scale):
    return lambda image, rng: (image * scale).round().clip(0, 65535).astype(np.uint16)


def hot_columns(count, low_dn, high_dn):
    def spoiled(image, rng):
        columns = rng.choice(SIDE, count, replace=False)
        image[:, columns] += rng.uniform(low_dn, high_dn, count)
        return eight_bits(image + rng.normal(0.0, 0.8, (SIDE, 1)), rng)

    return spoiled


def jpeg(quality):
    def spoiled(image, rng):
        file = io.BytesIO()
        Image.fromarray(eight_bits(image, rng)).save(file, "JPEG", quality=quality)
        return np.array(Image.open(file))

    return spoiled


def vignetted(image, rng):
    y, x = np.mgrid[:SIDE, :SIDE] / SIDE - 0.5
    return eight_bits(image * (1.0 - x**2 - y**2), rng)


def mosaic(image, rng):
    share = np.tile([[0.5, 1.0], [1.0, 0.65]], (SIDE // 2, SIDE // 2))
    return eight_bits(image * share + rng.normal(0.0, 1.5, image.shape), rng)


def read_by_four(image, rng):
    return eight_bits(image + np.tile([[0.0, 2.0], [1.0, 3.0]], (SIDE // 2, SIDE // 2)), rng)


WHOLE = (SENSOR, eight_bits)
CONDITIONS: dict[str, tuple[Sensor, Callable]] = {
    "8 bits": WHOLE,
    "12 bits": (SENSOR, more_bits(4.0)),
    "16 bits": (SENSOR, more_bits(60.0)),
    "3 hot columns": (SENSOR, hot_columns(3, 10.0, 220.0)),
    "20 hot columns": (SENSOR, hot_columns(20, 10.0, 240.0)),
    "row noise": (SENSOR, lambda image, rng: eight_bits(image + rng.normal(0.0, 2.0, (SIDE, 1)), rng)),
    "vignetting": (replace(SENSOR, background_dn=80.0), vignetted),
    "JPEG 70": (SENSOR, jpeg(70)),
    "JPEG 40": (SENSOR, jpeg(40)),
    "colour mosaic": (replace(SENSOR, background_dn=60.0, flux_at_v7_dn=300.0), mosaic),
    "four readouts": (SENSOR, read_by_four),
    "cut off": (SENSOR, lambda image, rng: eight_bits(image - SENSOR.background_dn, rng)),
    "hot pixels": (replace(SENSOR, hot_pixels=2000), eight_bits),
    "trail": (replace(SENSOR, smear_px=(8.0, -4.0), flux_at_v7_dn=300.0), eight_bits),
    "wide stars": (replace(SENSOR, sigma_px=2.8, flux_at_v7_dn=300.0), eight_bits),
}


def rendered(condition, sky):
    """Frame number `sky` of a condition, and the direction (3,) of its middle."""
    sensor, spoiled = CONDITIONS[condition]
    rng = np.random.default_rng([*condition.encode(), sky])
    middle = 0.5 * (SIDE - 1)
    camera = StarCamera(
        focal_m=5e-6 * 0.5 * SIDE / np.tan(0.5 * np.radians(FIELDS_DEG[sky])),
        pixel_m=5e-6,
        width_px=SIDE,
        height_px=SIDE,
        principal_px=(middle, middle),
    )
    R_si = Rotation.random(random_state=rng)
    # as many stars in each field: those of a wide one are brighter
    sensor = replace(sensor, flux_at_v7_dn=sensor.flux_at_v7_dn * FIELDS_DEG[0] / FIELDS_DEG[sky])
    image, _ = star_frame(camera, R_si, PLACES, sensor, rng)
    axis = camera.directions_from_pixels(np.array([[middle, middle]]))
    return spoiled(image.astype(np.float64), rng), R_si.inv().apply(axis)[0]


def real(row):
    """A frame of the real ones' manifest, as `bs.identify` reads it."""
    return read_star_image(REAL / row["file"], row["file"])


def real_rows():
    """Rows of the real frames' manifest that are images; none where the folder is missing."""
    file = REAL / "manifest.csv"
    rows = csv.DictReader(file.open()) if file.exists() else []
    return [row for row in rows if open_image(REAL / row["file"], row["file"]).format]


def rows_asked():
    """The rows of a run of all tests, a third of each project's; with EVERY_FRAME (`make answers`) all."""
    return real_rows()[:: 1 if "EVERY_FRAME" in os.environ else 3]


def answer(name, found, index):
    """What a record holds of an image and its solution, if it has one."""
    if not isinstance(found, FieldSolution):
        return {"frame": name, "ra_deg": "", "dec_deg": "", "fov_deg": "", "matches": 0, "hip": ""}
    bright = np.argsort(index.stars.v_mag[found.rows], kind="stable")[:BRIGHTEST]
    return {
        "frame": name,
        "ra_deg": f"{np.degrees(found.ra_rad) % 360.0:.4f}",
        "dec_deg": f"{np.degrees(found.dec_rad):.4f}",
        "fov_deg": f"{np.degrees(found.fov_x_rad):.3f}",
        "matches": found.matches,
        "hip": " ".join(str(hip) for hip in np.sort(found.hip[bright])),
    }


def index_of_all_fields(year):
    """Index of the shipped catalogue for every field of view."""
    return build_index(hipparcos_stars(8.0).places, year, (float(SMALLEST_FOV_RAD), float(LARGEST_FOV_RAD)))


def main():
    index = index_of_all_fields(2019.0)
    every = [(condition, sky) for condition in CONDITIONS for sky in range(len(FIELDS_DEG))]
    frames = [(f"{condition} {sky}", rendered(condition, sky)[0]) for condition, sky in every]
    real_ones = real_rows()
    if not real_ones:
        raise SystemExit(f"real star images are not at {REAL}: nothing was written")
    frames += [(row["file"], real(row)) for row in real_ones]
    rows = [answer(name, solve_field(image, index, StarSettings()), index) for name, image in frames]
    with ANSWERS.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
