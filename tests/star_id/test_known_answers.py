"""Frames once named stay named, with the same stars: sixty rendered ones, and the real ones of
../shared/data. `known_frames.py` makes the record of the answers."""

import csv
import warnings

import numpy as np
import pytest
from known_frames import ANSWERS, CONDITIONS, FIELDS_DEG, REAL, answer, real_rows, rendered, rows_asked

from boresight.star_id.field import solve_field
from boresight.star_id.settings import StarSettings

ROWS = rows_asked()
KNOWN = {row["frame"]: row for row in csv.DictReader(ANSWERS.open())}
# Stars of a record that may be missing in another answer, and the share of its matches that must be there:
# stars near the detection limit differ from machine to machine.
MAY_MISS, STILL_MATCHED = 1, 0.9


def difference(name, found, index):
    """How the answer of an image, by its solution, differs from the recorded one; empty if it does not."""
    known, now = KNOWN[name], answer(name, found, index)
    if not known["hip"]:
        return f"{name}: named, where it was not" if now["hip"] else ""
    if not now["hip"]:
        return f"{name}: not named any more ({known['matches']} stars before)"
    lost = set(known["hip"].split()) - set(now["hip"].split())
    if len(lost) > MAY_MISS:
        return f"{name}: of its brightest stars {', '.join(sorted(lost))} are not named any more"
    if now["matches"] < STILL_MATCHED * int(known["matches"]):
        return f"{name}: {now['matches']} stars, {known['matches']} before"
    off = np.degrees(np.arccos(min(1.0, float(direction(known) @ direction(now)))))
    # a hundredth of the field: places of stars at its edge follow the fit of the lens
    is_near = off < 0.01 * float(known["fov_deg"])
    return "" if is_near else f"{name}: {off:.3f} deg from the recorded direction"


def direction(row):
    ra, dec = np.radians([float(row["ra_deg"]), float(row["dec_deg"])])
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


@pytest.mark.parametrize("condition", CONDITIONS)
def test_rendered_frames_are_answered_as_recorded(condition, wide):
    names = [f"{condition} {sky}" for sky in range(len(FIELDS_DEG))]
    frames = [rendered(condition, sky) for sky in range(len(FIELDS_DEG))]
    solved = [solve_field(image, wide, StarSettings()) for image, _ in frames]
    changed = [difference(name, found, wide) for name, found in zip(names, solved)]
    assert not any(changed), [text for text in changed if text]
    for name, (_, middle) in zip(names, frames):  # and the record is true
        if KNOWN[name]["hip"]:
            assert direction(KNOWN[name]) @ middle > np.cos(np.radians(0.05))


def test_real_images_are_at_hand():
    if not ROWS:
        warnings.warn(f"real star images are not at {REAL}: their answers are not compared", stacklevel=1)
        pytest.skip(f"real star images are not at ../shared/data ({REAL}): their answers are not compared")
    assert len(real_rows()) >= len(KNOWN) - len(CONDITIONS) * len(FIELDS_DEG)  # each recorded image is there


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row["file"])
def test_a_real_frame_is_answered_as_recorded(row, solution, wide):
    assert not difference(row["file"], solution(row), wide)


def test_the_record_names_every_frame_that_is_verified():
    frames = len(CONDITIONS) * len(FIELDS_DEG)
    assert frames == 60
    assert sum(1 for name in KNOWN if "/" in name and KNOWN[name]["hip"]) >= 101
    assert sum(1 for name in KNOWN if "/" not in name and KNOWN[name]["hip"]) >= 58
