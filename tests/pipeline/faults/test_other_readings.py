"""Tables that mean something else than they say: read as meant, they are those of the sound dump again, and a
calibration that has no matrix names the reading.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import fault_dumps
import faults
import numpy as np
import pytest

from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.diagnosis.other_readings import other_readings
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import Dump, open_dump

GPS_MINUS_UTC_S, TAI_MINUS_UTC_S = 18.0, 37.0  # since 2017, IERS Bulletin C 52
LAST_LINE, LAST_SAMPLE = 1999, 511  # of the CCDs of the dump, from 0
Row = dict[str, str]


@pytest.fixture(scope="module")
def sound(made_once) -> Path:
    """Measured points of three strips and two heads, without a fault."""
    return (
        made_once("measured-points", lambda folder: fault_dumps.sound_dump("points", 1, folder)) / "points-1"
    )


def late(seconds: float, row: Row) -> None:
    row["utc_first_row"] = faults.later(row["utc_first_row"], seconds)


def from_the_other_end(column: str, last: int, row: Row) -> None:
    row[column] = repr(last - float(row[column]))


def exchanged(one: str, other: str, row: Row) -> None:
    row[one], row[other] = row[other], row[one]


def negative(column: str, row: Row) -> None:
    row[column] = repr(-float(row[column]))


def other_strip(row: Row) -> None:
    row["strip"] = {"s01": "s03", "s03": "s01"}.get(row["strip"], row["strip"])


READINGS: list[tuple[str, Callable[[Row], None], str, str]] = [
    ("strips.csv", partial(late, GPS_MINUS_UTC_S), "scale of times", "GPS time (-18 s)"),
    ("strips.csv", partial(late, TAI_MINUS_UTC_S), "scale of times", "TAI (-37 s)"),
    ("points.csv", partial(from_the_other_end, "line", LAST_LINE), "origin of the lines", "the last"),
    ("points.csv", partial(from_the_other_end, "sample", LAST_SAMPLE), "origin of the samples", "other end"),
    ("points.csv", partial(negative, "lat_deg"), "sign of the latitudes", "sign"),
    ("points.csv", partial(negative, "lon_deg"), "sign of the longitudes", "sign"),
    ("points.csv", other_strip, "points of two strips", "exchanged"),
]


def places(dump: Dump) -> dict[tuple[str, str], np.ndarray]:
    """Time of the strip's first row, image point and place on the ground of every measurement."""
    first_row = {strip.strip_id: strip.t_first_row_s for strip in dump.strips}
    return {
        (points.strip_id, target.target_id): np.array([first_row[points.strip_id], *xy, *target.p_e])
        for points in dump.points
        for target, xy in zip(points.targets, points.xy_px)
    }


@pytest.mark.parametrize(("file", "change", "cause", "words"), READINGS)
def test_one_reading_alone_makes_the_sound_dump(sound, tmp_path, file, change, cause, words):
    fault_dumps.linked(sound, tmp_path / "dump")
    faults.edited(file, change, tmp_path / "dump")
    meant = places(open_dump(sound))

    def restores(dump: Dump) -> bool:
        """To the digits of the tables: 1 nm in place, 1 ns, 1e-9 px."""
        found = places(dump)
        return found.keys() == meant.keys() and all(
            np.allclose(found[name], meant[name], rtol=0.0, atol=1e-6) for name in meant
        )

    (right,) = [one for one in other_readings(open_dump(tmp_path / "dump")) if restores(one.dump)]
    assert (right.cause, right.file) == (cause, file)
    assert words in right.changed


@pytest.mark.parametrize("number", [0, 1, 5])
def test_a_calibration_without_a_matrix_names_the_reading(sound, tmp_path, number):
    """Not those within the pre-launch uncertainty: 0.003 rad are 250 px of an image of 512 x 2000 px."""
    file, change, cause, _ = READINGS[number]
    fault_dumps.linked(sound, tmp_path / "dump")
    faults.edited(file, change, tmp_path / "dump")
    with pytest.raises(DataNotSufficientError, match=f"^{cause}, .*3 of 3 strips see .* in {file}"):
        calibrate_dump(open_dump(tmp_path / "dump"))
