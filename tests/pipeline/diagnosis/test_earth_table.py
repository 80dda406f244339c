"""The age of the Earth-orientation table at a dump's date, and a mission's table of other dates."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.utils import iers
from edits import replaced
from handmade import write_handmade_dump

from boresight.calib.finding import MOST_WORDS
from boresight.gct_match.records import Target
from boresight.geometry.orbit import Orbit
from boresight.pipeline.diagnosis.input_findings import check_earth_table, earth_findings
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.orbit_and_earth import bundled_table, orbit_of, read_earth_orientation
from boresight.pipeline.files.orbit_file import read_oem

DAY = 60634  # 2024-11-20, of the dump
EXACT = Target(target_id="p1", p_e=np.array([6_378_137.0, 0.0, 0.0]), sigma_m=np.zeros(3))
SURVEYED = [EXACT, replace(EXACT, target_id="p2", sigma_m=np.array([0.0, 0.0, 0.3]))]


def orbit_with(root: Path, table) -> Orbit:  # type: ignore[no-untyped-def]
    return orbit_of(read_oem(root / "orbit.oem", "orbit.oem"), "orbit.oem", table, allow_stale_eop=True)


def own_table(path: Path, days: range, values_of: int) -> Path:
    """A mission's table of `days` with the UT1 and pole that the IERS has `values_of` days later."""
    c04 = iers.IERS_B.open()
    mjd = c04["MJD"].value.astype(int)
    rows = [c04[int(np.flatnonzero(mjd == day + values_of)[0])] for day in days]
    text = [
        f"{day},{row['UT1_UTC'].value:.7f},{row['PM_x'].value:.6f},{row['PM_y'].value:.6f}"
        for day, row in zip(days, rows)
    ]
    path.write_text("\n".join(["mjd_utc,ut1_utc_s,x_arcsec,y_arcsec", *text]) + "\n")
    return path


def test_measured_values_of_the_bundled_table_are_no_finding(tmp_path: Path) -> None:
    root = write_handmade_dump(tmp_path / "dump")
    found = check_earth_table(orbit_with(root, bundled_table()), bundled_table(), bundled_table())
    assert found.sigma_m == 0.0 and found.difference_m == 0.0
    assert found.first_day <= DAY <= found.last_measured_day <= found.last_day
    assert not list(earth_findings(found, "", SURVEYED))


@pytest.mark.filterwarnings("ignore::boresight.geometry.earth_orientation.EarthOrientationWarning")
@pytest.mark.parametrize("days_ahead", [3, 200])
def test_predicted_values_are_told_with_metres_on_the_equator(days_ahead: int, tmp_path: Path) -> None:
    root = write_handmade_dump(tmp_path / "dump")
    old = replace(bundled_table(), mjd_last_measured=float(DAY - days_ahead))
    found = check_earth_table(orbit_with(root, old), old, old)
    # Bulletin A: 0.00025 s D^0.75 of UT1, 0.00068" D^0.80 of the pole; the dump is in the fourth hour of DAY
    ahead = days_ahead + 3.7 / 24.0
    ut1_m = 0.00025 * ahead**0.75 * 2.0 * np.pi * 6_378_137.0 / 86_164.1
    pole_m = np.radians(0.00068 / 3600.0) * ahead**0.80 * 6_371_000.0
    assert found.sigma_m == pytest.approx(np.hypot(ut1_m, pole_m), rel=0.01)
    (told,) = earth_findings(found, "", SURVEYED)
    assert not told.is_fault and told.unit == "m" and f"{found.sigma_m:.1f} m" in told.text
    assert len(f"{told.cause} {told.item} {told.text}".split()) <= MOST_WORDS


def test_table_of_another_year_is_told_with_its_ut1(tmp_path: Path) -> None:
    root = write_handmade_dump(tmp_path / "dump")
    days, years = range(DAY - 4, DAY + 5), -2000
    own = own_table(tmp_path / "own.csv", days, years)
    table = read_earth_orientation(own, "own.csv")
    found = check_earth_table(orbit_with(root, table), table, bundled_table())
    c04 = iers.IERS_B.open()
    mjd, ut1 = c04["MJD"].value.astype(int), c04["UT1_UTC"].value
    expected_s = float(ut1[mjd == DAY + years][0] - ut1[mjd == DAY][0])
    # 1 ms: both series change by less in the hours from midnight to the dump
    assert found.difference_ut1_s == pytest.approx(expected_s, abs=1e-3) and abs(expected_s) > 0.1
    rate = 2.0 * np.pi * 6_378_137.0 / 86_164.1
    assert found.difference_m == pytest.approx(abs(expected_s) * rate, rel=0.05)  # the pole adds some metres
    (told,) = earth_findings(found, "own.csv", SURVEYED)
    assert told.is_fault and told.file == "own.csv" and f"{found.difference_ut1_s:+.4f} s" in told.text
    assert len(f"{told.cause} {told.item} {told.text}".split()) <= MOST_WORDS
    # exact places are the mission's own model, computed with that table: told, and no fault
    assert [one.is_fault for one in earth_findings(found, "own.csv", [])] == [True]  # strips of the sky alone
    (told,) = earth_findings(found, "own.csv", [EXACT])
    assert not told.is_fault and told.value == found.difference_m
    assert len(f"{told.cause} {told.item} {told.text}".split()) <= MOST_WORDS


def test_one_value_for_several_days_is_the_missions_own_business(tmp_path: Path) -> None:
    root = write_handmade_dump(tmp_path / "dump")
    own = own_table(tmp_path / "own.csv", range(DAY - 4, DAY + 5), -1)
    table = read_earth_orientation(own, "own.csv")
    found = check_earth_table(orbit_with(root, table), table, bundled_table())
    assert 0.0 < found.difference_m < 1.6  # m: the value of the day before, a day longer by at most 3 ms
    assert not list(earth_findings(found, "own.csv", SURVEYED))


def test_dates_outside_the_missions_table_are_refused(tmp_path: Path) -> None:
    root = write_handmade_dump(tmp_path / "dump")
    own_table(root / "own.csv", range(DAY - 40, DAY - 30), 0)
    replaced(root / "dump.toml", "[files]", '[files]\nearth_orientation = "own.csv"')
    with pytest.raises(RawDataError, match=r"is past the table: .*own.csv\) holds 2024-10-11 to 2024-10-20"):
        open_dump(root)


def test_result_states_it(finished: tuple[Path, Path]) -> None:
    told = json.loads((finished[1] / "installation.json").read_text())["earth_orientation"]
    assert told["sigma_m"] == 0.0 and told["difference_m"] == 0.0 and "C04" in told["source"]


def test_a_table_whose_pole_is_elsewhere_too_differs_in_ut1_by_its_own_difference(tmp_path: Path) -> None:
    root, table = write_handmade_dump(tmp_path / "dump"), bundled_table()
    other = replace(
        table, ut1_utc_s=table.ut1_utc_s + 0.0321, xp_rad=table.xp_rad + 4e-7, yp_rad=table.yp_rad - 3e-7
    )
    found = check_earth_table(orbit_with(root, other), other, table)
    assert found.difference_ut1_s == pytest.approx(0.0321, abs=1e-7)  # s; the pole: 1e-7 of the turn
    turn = np.hypot(0.0321 * 7.292115e-5, np.hypot(4e-7, 3e-7))
    assert found.difference_m == pytest.approx(turn * 6_378_137.0, rel=1e-3)
