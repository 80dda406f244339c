"""Faults that were green once, from images: each is reported with its size, its item and its file, or named
among what the result cannot show.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import faults
import numpy as np
import pytest

from boresight.calib.finding import MOST_WORDS
from boresight.calib.reliability import blind_spots
from boresight.calib.verdict import Outcome
from boresight.pipeline.calibration.calibrate import DumpCalibration

files_exchanged, later, repaint, table, toml_number, write = (
    getattr(faults, name) for name in ("files_exchanged", "later", "repaint", "table", "toml_number", "write")
)
PITCH_MM = 0.12  # of a pixel of the remote-sensing camera
CONSISTENT, FINDINGS, REFUTED = Outcome.CONSISTENT, Outcome.FINDINGS, Outcome.REFUTED
Make = Callable[[Path], None]


@pytest.fixture
def told(with_fault) -> Callable[[str, Make], DumpCalibration]:
    """What a calibration of a fixture with a fault gives."""
    return lambda fixture, make: with_fault({"mini": "ground"}.get(fixture, fixture), make)


def late(dump: Path, **ms: float) -> None:
    for strip, by in ms.items():
        faults.rows_late((strip,), 1e-3 * by, dump)


def number(file: str, key: str, edit: Callable[[float], float], which: int | None = None) -> Make:
    return partial(toml_number, file, key, edit, which)


def two_at_once(dump: Path) -> None:
    files_exchanged("exposures.csv", [(2, 9)], dump)
    number(REMOTE, "x_offset_mm", lambda v: 0.0)(dump)


def every_second_early(dump: Path, keep: int = 0) -> None:
    """Exposures dated 40 ms early in turn, of so many a strip, evenly over it; 0: of all."""
    header, *rows = table(dump / "exposures.csv")
    at, left = header.index("utc_mid"), rows
    if keep:
        t_s = np.array([row[at] for row in rows], dtype="datetime64[ns]").astype(float) / 1e9
        strips = np.split(np.arange(len(rows)), np.flatnonzero(np.diff(t_s) > 5.0) + 1)
        left = [
            rows[own[k]] for own in strips for k in np.linspace(0, len(own) - 1, keep).round().astype(int)
        ]
    for row in left[1::2]:
        row[at] = later(row[at], -0.04)
    write(dump / "exposures.csv", [header, *left])


def lines_lost(dump: Path) -> None:
    """Eight lines of the only scan, in all CCDs; as many at its end are dark."""

    def shorter(image: np.ndarray) -> np.ndarray:
        return np.concatenate([image[:1000], image[1008:], np.zeros_like(image[:8])])

    for image in (dump / "strips").glob("sky01_*.tif"):
        repaint(image, shorter)


def of_two_ccds(dump: Path) -> None:
    header, *rows = table(dump / "strips.csv")
    at = [[n for n, row in enumerate(rows) if row[header.index("ccd")] == ccd] for ccd in ("0", "1")]
    files_exchanged("strips.csv", list(zip(*at)), dump)


def typo(dump: Path) -> None:
    header, *rows = table(dump / "targets.csv")
    at = header.index("lon_deg")
    assert rows[3][at].startswith("103.01")
    rows[3][at] = rows[3][at].replace("103.01", "103.10")
    write(dump / "targets.csv", [header, *rows])


def strips_again(dump: Path) -> None:
    header, *rows = table(dump / "strips.csv")
    again = [[f"r-{row[0]}", *row[1:]] for row in rows]
    assert header[0] == "id"
    write(dump / "strips.csv", [header, *rows, *again])


REMOTE, CLOCK = "remote_camera.toml", "clock of the rows"
IN_TURN = ("clock of the exposures, every second one", "all exposures", -40.0, "exposures.csv")
ROWS = [
    # fixture, fault, outcome, what is reported: (cause, item, size; None: not measured, file)
    ("mini", number(REMOTE, "x_offset_mm", lambda v: v + PITCH_MM, 0), REFUTED,
        [("place of a CCD, along the track", "CCD 0", 1.0, REMOTE)]),
    ("mini", number(REMOTE, "y_first_mm", lambda v: v + 5 * PITCH_MM, 2), FINDINGS,
        [("place of a CCD, across the track", "CCD 2", 5.0, REMOTE)]),
    ("mini", partial(late, s03=15.0), FINDINGS, [(CLOCK, "strip s03", 15.0, "strips.csv")]),
    (
        "mini",
        partial(late, s01=10.0, s03=5.0),
        REFUTED,  # of clocks only differences show: here against the mean of s01 and s03
        [(CLOCK, "strip s02", -8.0, "strips.csv"), (CLOCK, "strip s01", 5.0, "strips.csv")],
    ),
    ("mini", of_two_ccds, FINDINGS,
        [("files of two CCDs", f"CCD 0 and CCD 1 in strip s0{n}", None, "strips.csv") for n in (1, 2, 3)]),
    (
        "mini",
        two_at_once,
        REFUTED,
        [
            ("images or look directions of a CCD", "CCDs 0, 2", None, REMOTE),
            ("files or times of exposures", "exposures e0003 and e0010", None, "exposures.csv"),
        ],
    ),
    ("mini", strips_again, Outcome.CONSISTENT, []),
    ("sky", number("star_camera.toml", "focal_length_mm", lambda v: 0.9999 * v), REFUTED,
        [("focal length of the star camera", "all exposures", -0.01, "star_camera.toml")]),
    (
        "sky",  # of whose three stars none is where it must be
        number(REMOTE, "x_offset_mm", lambda v: v - 9 * PITCH_MM, 2),
        FINDINGS,
        [("place of a CCD, along the track", "CCD 2", -9.0, REMOTE)],
    ),
    ("sky", every_second_early, REFUTED, [("times of exposures", "all exposures", 40.0, "exposures.csv")]),
    ("sky", partial(every_second_early, keep=4), FINDINGS, [IN_TURN]),  # as four rows are no record
    ("mini", partial(every_second_early, keep=5), REFUTED, [IN_TURN]),
    ("sky", lines_lost, REFUTED, [("lines of a strip", "strip sky01 from line 1004 on", 8.0, "strips.csv")]),
    ("sky", partial(faults.period, ("sky01",), 0.01), REFUTED,
        [("row period", "strip sky01", 1.0, "strips.csv")]),
]  # fmt: skip


@pytest.mark.parametrize(("fixture", "make", "outcome", "causes"), ROWS)
def test_a_fault_is_told_with_its_size_and_nothing_else_is_accused(told, fixture, make, outcome, causes):
    verdict = told(fixture, make).verdict
    found = [one for one in verdict.findings if one.is_fault]
    assert [(one.cause, one.item, one.file) for one in found] == [(c, i, f) for c, i, _, f in causes]
    assert verdict.outcome is outcome
    for one, (_, _, size, _) in zip(found, causes):
        assert len(f"{one.cause} {one.item} {one.text}".split()) <= MOST_WORDS
        if size is not None:  # the tenth is what θ and other strips take up
            assert one.value == pytest.approx(size, abs=max(5.0 * one.sigma, 0.1 * abs(size)))


def test_a_row_of_the_table_that_no_strip_shows_is_told_with_its_distance_and_its_slip(told):
    verdict = told("mini", typo).verdict
    (found,) = [one for one in verdict.findings if one.is_fault]
    assert (found.cause, found.item, found.file) == ("coordinates or chip", "target s01-t04", "targets.csv")
    assert verdict.outcome is FINDINGS and "km from the nearest strip, s01" in found.text
    assert "lon_deg 103.01 for 103.10 (digits exchanged)" in found.text


def test_scans_in_one_direction_say_that_they_cannot_show_a_clock(told):
    """The matrix takes 10 ms up whole: 14 arcsec."""
    found = told("sky", partial(late, sky01=10.0))
    assert found.verdict.outcome is CONSISTENT
    spots = {(one.cause, one.item): one for one in blind_spots(found.verdict.tests)}
    clock = spots[CLOCK, "strip sky01"]
    assert clock.is_unseen and 10.0 * clock.effect_sigma > 50.0


def test_with_two_targets_nothing_can_be_checked(told):
    def of_two(dump: Path) -> None:
        write(dump / "targets.csv", table(dump / "targets.csv")[:3])

    assert told("mini", of_two).verdict.outcome is Outcome.NOT_CHECKABLE
