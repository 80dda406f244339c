"""Every row of a dump's tables is used or has a reason; coordinates that contradict a chip name the slip."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from edits import rows_of, write_rows

from boresight.calib.finding import MOST_WORDS
from boresight.pipeline.calibration.calibrate import DumpCalibration
from boresight.pipeline.diagnosis import unused_rows
from boresight.pipeline.diagnosis.input_findings import outside_chips
from boresight.pipeline.diagnosis.unused_rows import Rows, unneeded_exposures, unseen_targets
from boresight.pipeline.files.coordinate_slips import likeliest, slips
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.results.writing import verdict_json
from boresight.records.ledger import Entry, Kind, Reason, Subject


def with_targets(dump: Path, root: Path, more: dict[str, tuple[int, str, str]]) -> Dump:
    """A copy of a dump with further targets: for each the row whose chip it has, latitude and longitude."""
    shutil.copytree(dump, root)
    rows = rows_of(root / "targets.csv")
    rows += [
        rows[n] | {"id": name, "lat_deg": lat or rows[n]["lat_deg"], "lon_deg": lon or rows[n]["lon_deg"]}
        for name, (n, lat, lon) in more.items()
    ]
    write_rows(root / "targets.csv", rows)
    return open_dump(root)


# s01-t07 lies at 35.9905089269, 102.9703245563.
SLIPPED = {
    "exchanged": (6, "", "102.9073245563", "lon_deg 102.970 for 102.907 (digits exchanged)"),
    "far": (6, "", "109.2703245563", "lon_deg 102.97 for 109.27 (digits exchanged)"),
    "south": (6, "-35.9905089269", "", "lat_deg 35.9905 for -35.9905 (sign)"),
    "digit": (6, "38.9905089269", "", "lat_deg 35.99 for 38.99 (one digit)"),
    "other": (6, "36.0512054924", "102.9177612136", "not in chips/s01-t07.tif but in chips/s01-t01.tif"),
    "none": (6, "36.7512054924", "103.1177612136", " km from the middle of its chip; correct"),
}


def test_a_target_in_no_strip_has_its_distance_and_the_slip_that_explains_it(calibration, finished, tmp_path):
    more = {name: case[:3] for name, case in SLIPPED.items()}
    dump = with_targets(finished[0], tmp_path / "dump", more)
    clean, tasks, matched = open_dump(finished[0]), calibration.tasks, calibration.matched
    assert unseen_targets(clean, tasks, matched) == []
    found = {one.subject.name: one for one in unseen_targets(dump, tasks, matched)}
    assert set(found) == set(more)
    for name, (_, _, _, text) in SLIPPED.items():
        assert text in found[name].text and found[name].reason is Reason.OUTSIDE_CHIP, found[name]
    assert found["exchanged"].text.startswith("it lies in a gap between the CCDs of strip s01; ")
    assert 7950 < float(found["south"].text.split()[2]) < 8050  # km: twice 36 degrees of latitude
    for finding in outside_chips(list(found.values())):
        assert len(f"{finding.cause} {finding.item} {finding.text}".split()) <= MOST_WORDS
        assert finding.is_fault and finding.file == "targets.csv"


def test_coordinates_that_are_off_together_accuse_no_target_that_a_slip_does_not_explain() -> None:
    """All 0.36 km off: of most a changed digit would put them right, of one none does."""

    def outside(name: str, slip: str) -> Entry:
        subject = Subject(Kind.TARGET, strip="s01", ccd=0, id=name)
        return Entry(subject, Reason.OUTSIDE_CHIP, "19 px outside", slip=slip)

    off = [*(outside(f"t{n}", "lon_deg (one digit)") for n in range(5)), outside("t9", "")]
    assert [one.item for one in outside_chips(off)] == ["5 targets", "1 target"]
    assert [one.item for one in outside_chips(off[-1:])] == ["target t9"]


def test_a_target_elsewhere_in_its_own_chip_is_not_accused(calibration, finished):
    """A list of a whole country: the chip of each target lies around it, far from the strip."""
    dump = open_dump(finished[0])
    kept = [one.target_id != "s01-t05" for one in dump.targets]
    far = replace(calibration.matched[0], target_id=np.where(kept, calibration.matched[0].target_id, "x"))
    strip = replace(calibration.tasks[0].strip, ccd_lines=dict.fromkeys(range(4), 40))
    tasks = [replace(calibration.tasks[0], strip=strip)]
    (one,) = unseen_targets(dump, tasks, [far])
    assert one.reason is Reason.OUT_OF_VIEW and "strip, s01" in one.text
    assert list(outside_chips([one])) == []


@pytest.mark.parametrize(
    ("stated", "meant", "words"),
    [
        ((36.05, 102.1977612), (36.05, 102.9177612), "lon_deg 102.91 for 102.19 (digits exchanged)"),
        ((36.05, 102.1977612), (36.07, 102.9177612), ""),  # two slips
        ((47.1234567, 11.7654321), (11.7654321, 47.1234567), "lat_deg and lon_deg exchanged"),
        ((-33.5, -70.6), (-33.5, 70.6), "lon_deg 70.6 for -70.6 (sign)"),
        ((0.1234567, 9.5), (0.1834567, 9.5), "lat_deg 0.18 for 0.12 (one digit)"),
    ],
)
def test_slips_of_every_kind_are_found(stated, meant, words):
    found = likeliest(slips(*stated), lambda places: np.abs(places - meant).max(axis=1) < 1e-6)
    assert (found.words if found else "") == words


def test_rows_that_nothing_needs_are_counted(calibration, finished):
    dump = open_dump(finished[0])
    assert dump.listed == {"targets": 12, "points": 0, "strips": 1, "exposures": 14}
    told = ["12 of 12 targets", "1 of 1 strips", "14 of 14 exposures"]
    assert [str(one) for one in calibration.rows] == told
    assert "used" not in verdict_json(calibration.verdict, calibration.rows)["sentence"]
    partly = verdict_json(calibration.verdict, [Rows("targets", 35, 36), Rows("strips", 3, 3)])
    assert partly["sentence"].endswith("; used: 35 of 36 targets")
    assert unneeded_exposures(dump, 1.0) == []
    outside = [one.subject.name for one in unneeded_exposures(dump, 0.3)]
    assert outside == ["e0001", "e0014"]  # 0.4 s outside the strip


def test_a_ccd_without_a_measurement_has_its_reason(calibration: DumpCalibration) -> None:
    (task,), (matched,) = calibration.tasks, calibration.matched
    without_measurement = unused_rows.without_measurement
    assert without_measurement([task.strip], [matched]) == []
    elsewhere = replace(matched, ccd=np.where(matched.ccd == 2, 1, matched.ccd))
    (empty,) = without_measurement([task.strip], [elsewhere])
    assert (empty.subject.name, empty.text) == ("s01/2", "no target lies in it")
    lost = tuple(
        Entry(Subject(Kind.TARGET, strip="s01", ccd=2, id=f"t{n}"), Reason.LOW_CORRELATION, "cloud")
        for n in range(3)
    )
    (cloudy,) = without_measurement([task.strip], [replace(elsewhere, omissions=lost)])
    assert cloudy.text == "none of its 3 targets was matched"
