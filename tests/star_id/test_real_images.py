"""Frames of real cameras, fields of view unknown: each with stars is identified, each without is not.

The images are not part of the project; without them beside the checkout these tests are skipped.
"""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from star_id.catalogue import hipparcos_stars
from star_id.field import LARGEST_FOV_RAD, SMALLEST_FOV_RAD, FieldSolution, solve_field
from star_id.identify import NotIdentified
from star_id.settings import StarSettings
from star_id.triangles import build_index

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "data" / "star_images"
ROWS = list(csv.DictReader((FOLDER / "manifest.csv").open())) if FOLDER.is_dir() else []
pytestmark = pytest.mark.skipif(not ROWS, reason=f"real star images are not at ../shared/data ({FOLDER})")


@pytest.fixture(scope="module")
def index():
    fields = (float(SMALLEST_FOV_RAD), float(LARGEST_FOV_RAD))
    return build_index(hipparcos_stars(8.0).places, 2019.0, fields)


def solved(row, index):
    image = cv2.imread(str(FOLDER / row["file"]), cv2.IMREAD_UNCHANGED)
    if image.ndim == 3:
        image = cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2GRAY)
    return solve_field(image, index, StarSettings())


@pytest.mark.parametrize("row", [r for r in ROWS if r["level"] == "verified"], ids=lambda row: row["file"])
def test_a_frame_with_stars_is_identified(row, index):
    found = solved(row, index)
    assert isinstance(found, FieldSolution), found
    ra, dec = np.radians([float(row["ra_deg"]), float(row["dec_deg"])])
    cosine = np.sin(dec) * np.sin(found.dec_rad)
    cosine += np.cos(dec) * np.cos(found.dec_rad) * np.cos(ra - found.ra_rad)
    # Solvers agree to 0.04 deg where the lens bends most, and to a thousandth elsewhere; the field to 1 %.
    assert np.degrees(np.arccos(min(cosine, 1.0))) < 0.1
    assert np.degrees(found.fov_x_rad) == pytest.approx(float(row["fov_deg"]), rel=0.01)
    if row["roll_convention"] == "anet":
        # That solver counts rows upwards, and states the angle where its pattern lies: up to half a field
        # away meridians have turned by half a field times tan(dec).
        turned = 0.5 * float(row["fov_deg"]) * abs(np.tan(found.dec_rad))
        difference = np.degrees(found.roll_rad) + 180.0 - float(row["roll_deg"])
        assert abs((difference + 180.0) % 360.0 - 180.0) < 1.0 + turned


@pytest.mark.parametrize("row", [r for r in ROWS if r["level"] != "verified"], ids=lambda row: row["file"])
def test_a_dark_frame_is_not_identified(row, index):
    assert isinstance(solved(row, index), NotIdentified)
