"""What a dump gives twice is counted once, with its reason; clean dumps lose nothing."""

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import rasterio
from edits import rows_of, write_rows
from fixture_strips import FIXTURE
from handmade import write_handmade_dump, write_strip
from scipy.spatial.transform import Rotation

from boresight.gct_match.settings import MatchSettings
from boresight.pipeline.diagnosis.input_findings import contradicting_rows
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.attitude_files import AttitudeRows
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.repeats import common_errors, heads_once, targets_once
from boresight.pipeline.files.star_side import Head, SolvedAttitudes
from boresight.records.ledger import Reason

Row = dict[str, str]
Change = Callable[[list[Row], Path], list[Row]]


@pytest.fixture
def mini(tmp_path: Path) -> Path:
    """A copy of the fixture."""
    return Path(shutil.copytree(FIXTURE, tmp_path / "mini", ignore=shutil.ignore_patterns("truth")))


def change(table: Path, into: Callable[[list[Row]], list[Row]]) -> None:
    write_rows(table, into(rows_of(table)))


def later(utc: str, ms: int) -> str:
    whole, fraction = utc.split(".")
    return f"{whole}.{int(fraction) + ms * 10**6:09d}"


@pytest.mark.parametrize("name", ["mini", "sky"])
def test_the_fixtures_lose_nothing(name: str) -> None:
    dump = targets_once(open_dump(FIXTURE.parent / name), MatchSettings())
    assert dump.omissions == ()
    assert len(dump.targets) == (36 if name == "mini" else 0)  # three strips see twelve targets each


def under_other_ids(rows: list[Row], mini: Path) -> list[Row]:
    return [row | {"id": f"{row['id']}{more}"} for more in ("", *"abcdefgh") for row in rows]


def part_in_other_files(rows: list[Row], mini: Path) -> list[Row]:
    """CCDs 1 and 2 of s03 once more, compressed otherwise and 0.4 lines later."""
    copies = [row for row in rows if row["id"] == "s03" and row["ccd"] in "12"]
    for row in copies:
        with rasterio.open(mini / row["file"]) as image:
            write_strip(mini / f"again{row['ccd']}.tif", image.read(1))
    shift = {"id": "other", "utc_first_row": later(copies[0]["utc_first_row"], 0)[:-1] + "9"}
    return [*rows, *(row | shift | {"file": f"again{row['ccd']}.tif"} for row in copies)]


def one_ccd_twice(rows: list[Row], mini: Path) -> list[Row]:
    """s02 without CCD 3; CCDs 2 and 3 of it under another id."""
    of_s02 = {row["ccd"]: row for row in rows if row["id"] == "s02"}
    left = [row for row in rows if row is not of_s02["3"]]
    return [*left, of_s02["2"] | {"id": "part"}, of_s02["3"] | {"id": "part"}]


def one_file_twice(rows: list[Row], mini: Path) -> list[Row]:
    """The content of CCD 2 of s01 in the place of that of s03: which time is right is not known."""
    first = next(row for row in rows if row["id"] == "s01" and row["ccd"] == "2")
    shutil.copy(mini / first["file"], mini / "copy.tif")
    return [row | {"file": "copy.tif"} if (row["id"], row["ccd"]) == ("s03", "2") else row for row in rows]


def ccds_as_strips(rows: list[Row], mini: Path) -> list[Row]:
    """CCDs 2 and 3 of each strip as a strip of its own: same times, other CCDs."""
    return [row | {"id": row["id"] + ("b" if row["ccd"] in "23" else "")} for row in rows]


def exposures_doubled(copied: bool, rows: list[Row], mini: Path) -> list[Row]:
    """Each exposure once more a millisecond later, of the same file or of a copy."""
    every = []
    for row in rows:
        again = row | {"id": f"{row['id']}x", "utc_mid": later(row["utc_mid"], 1)}
        if copied:
            again["file"] = row["file"].replace(".png", "x.png")
            shutil.copy(mini / row["file"], mini / again["file"])
        every += [row, again]
    return every


def one_image_of_two(rows: list[Row], mini: Path) -> list[Row]:
    return [row | {"file": "exposures/e0020.png"} if row["id"] == "e0023" else row for row in rows]


def once_more(**cells: str) -> Change:
    """The first row once more under another id, with other cells; of an instant "later", by a millisecond."""

    def change(rows: list[Row], mini: Path) -> list[Row]:
        again = rows[0] | {"id": "again"} | cells
        if again.get("utc_mid") == "later":
            again["utc_mid"] = later(rows[0]["utc_mid"], 1)
        return sorted([*rows, again], key=lambda row: row.get("utc_mid", ""))

    return change


ELSEWHEN = {"ccd": "3", "utc_first_row": "2024-11-20T04:10:00.000000000"}
OTHER_IMAGE = {"utc_mid": "later", "file": "exposures/e0009.png"}
DOUBLED = dict.fromkeys((f"exposure e{n:04d}x" for n in range(1, 43)), Reason.REPEATED)
ROWS: list[tuple[str, Change, dict[str, Reason], str]] = [
    # Table, its change, what is left out and why, and how the reason of the last begins.
    ("strips", under_other_ids,
        {f"strip s0{n}{more}": Reason.REPEATED for more in "abcdefgh" for n in (1, 2, 3)},
        "it begins 0 s after CCD 0 in strip s03, which lasts 1.8 s"),
    ("strips", part_in_other_files, {"strip other": Reason.REPEATED}, ""),
    ("strips", one_ccd_twice, {"ccd part/2": Reason.REPEATED}, ""),
    ("strips", one_file_twice, {"ccd s01/2": Reason.SAME_PIXELS, "ccd s03/2": Reason.SAME_PIXELS},
        "copy.tif has the same content as strips/s01_ccd2.tif of CCD 2 in strip s01"),
    ("strips", ccds_as_strips, {}, ""),
    ("strips", once_more(), {"strip again": Reason.REPEATED}, ""),
    ("strips", once_more(**ELSEWHEN), {"ccd s01/0": Reason.SAME_PIXELS, "strip again": Reason.SAME_PIXELS},
        ""),
    ("exposures", partial(exposures_doubled, False), DOUBLED, "it begins 0.001 s after exposure e0042"),
    ("exposures", partial(exposures_doubled, True), DOUBLED, "it begins 0.001 s after exposure e0042"),
    ("exposures", one_image_of_two, {"exposure e0020": Reason.SAME_PIXELS,
        "exposure e0023": Reason.SAME_PIXELS}, ".* of exposure e0020: one of the two rows"),
    ("exposures", once_more(utc_mid="later"), {"exposure again": Reason.REPEATED}, ""),
    ("exposures", once_more(**OTHER_IMAGE),
        {"exposure again": Reason.SAME_TIME, "exposure e0001": Reason.SAME_TIME}, ""),
    ("targets", once_more(), {"target again": Reason.REPEATED}, ""),
]  # fmt: skip


@pytest.mark.parametrize(("table", "change", "left_out", "says"), ROWS)
def test_what_is_given_twice_is_left_out_by_name_and_the_rest_stays(mini, table, change, left_out, says):
    rows = change(rows_of(mini / f"{table}.csv"), mini)
    write_rows(mini / f"{table}.csv", rows)
    dump = targets_once(open_dump(mini), MatchSettings())
    entries = {f"{one.subject.kind} {one.subject.name}": one for one in dump.omissions}
    assert {name: one.reason for name, one in entries.items()} == left_out
    if left_out:
        assert re.match(says, entries[list(left_out)[-1]].text)
    kept = {
        "strips": [(one.strip_id, str(ccd)) for one in dump.strips for ccd in one.images.ccds],
        "exposures": [one.exposure_id for one in dump.exposures],
        "targets": [one.target_id for one in dump.targets],
    }[table]
    gone = {name.partition(" ")[2] for name in left_out}
    left = [row for row in rows if not {row["id"], f"{row['id']}/{row.get('ccd')}"} & gone]
    expected = [(row["id"], row["ccd"]) if table == "strips" else row["id"] for row in left]
    assert sorted(kept) == sorted(expected)
    causes = {finding.cause for finding in contradicting_rows(dump.omissions)}
    assert causes == {reason.value for reason in left_out.values()} - {Reason.REPEATED.value}


def test_other_ground_at_the_same_time_is_an_error_of_the_table(mini: Path) -> None:
    def copied(rows: list[Row]) -> list[Row]:
        utc = rows[0]["utc_first_row"]
        files = {(row["id"], row["ccd"]): mini / row["file"] for row in rows}
        for file, ccd in ((file, ccd) for (name, ccd), file in files.items() if name == "s03"):
            with rasterio.open(files["s01", ccd]) as there, rasterio.open(file) as here:
                first, other = there.read(1), here.read(1)
            middle = tuple(slice(n // 2 - 48, n // 2 + 48) for n in other.shape)
            other[middle] = first[middle]  # alike in one of the places that are compared
            write_strip(file, other)
        return [row | {"utc_first_row": utc} if row["id"] == "s03" else row for row in rows]

    change(mini / "strips.csv", copied)
    says = r"strips\.csv: utc_first_row: found the same time for s01 and s03"
    with pytest.raises(RawDataError, match=says):
        open_dump(mini)


def test_dead_detectors_of_two_strips_are_not_taken_for_copies(tmp_path: Path) -> None:
    dump = write_handmade_dump(tmp_path / "dump")
    write_strip(dump / "strips/0.tif", np.zeros((200, 64), np.uint8))
    text = (dump / "strips.csv").read_text()
    row = text.splitlines()[1].replace("s1,", "s2,").replace("03:40:19.900", "03:40:20.200")
    shutil.copy(dump / "strips/0.tif", dump / "strips/2.tif")
    (dump / "strips.csv").write_text(text + row.replace("0.tif", "2.tif") + "\n")
    assert open_dump(dump).omissions == ()


@pytest.mark.parametrize("common", [False, True])
def test_attitudes_with_the_error_of_the_row_before_are_copies(common: bool) -> None:
    """Forty attitudes, each followed after 2 ms by one with its error or with an error of its own."""
    rng, sigma = np.random.default_rng(3), np.array([5e-6, 5e-6, 4e-5])
    t_s = 0.25 * np.arange(40)
    errors = sigma * rng.standard_normal((2, 40, 3))
    both = np.sort(np.concatenate([t_s, t_s + 0.002]))
    noise = np.stack([errors[0], errors[0] if common else errors[1]], axis=1).reshape(-1, 3)
    smooth = Rotation.from_rotvec(np.outer(both, [2e-4, -1.1e-3, 3e-4]))
    rows = AttitudeRows(t_s=both, R_si=Rotation.from_rotvec(noise) * smooth)
    found = common_errors(rows, np.diag(sigma**2))
    assert found.sum() == (40 if common else 0)
    one = replace(rows, t_s=t_s, R_si=rows.R_si[::2])
    assert not common_errors(one, np.diag(sigma**2)).any()


def test_targets_with_the_same_pixels_are_counted_once(mini: Path) -> None:
    """Each target twice more: at its own place, and 20 m beside it with the same chip; another 500 m off."""

    def more(rows: list[Row]) -> list[Row]:
        beside = [
            row | {"id": f"{row['id']}-b", "lat_deg": f"{float(row['lat_deg']) + 2e-4:.9f}"} for row in rows
        ]
        far = rows[0] | {"id": "far", "lon_deg": f"{float(rows[0]['lon_deg']) + 6e-3:.9f}"}
        return [*rows, *(row | {"id": f"{row['id']}-a"} for row in rows), *beside, far]

    clean = open_dump(mini).targets
    change(mini / "targets.csv", more)
    dump = targets_once(open_dump(mini), MatchSettings())
    assert [one.target_id for one in dump.targets] == [*(one.target_id for one in clean), "far"]
    assert {one.reason for one in dump.omissions} == {Reason.REPEATED}
    found, beside = {one.subject.name: one.text for one in dump.omissions}, "from target s01-t02 and shares"
    assert found["s01-t02-a"].startswith(f"it lies 0 m {beside} 100% of its pixels")
    assert found["s01-t02-b"].startswith(f"it lies 22.2 m {beside} ")


def test_equal_times_of_two_exposures_are_refused_by_the_table(mini: Path) -> None:
    change(mini / "exposures.csv", lambda rows: once_more()(rows, mini))
    with pytest.raises(RawDataError, match="strictly increasing times"):
        open_dump(mini)


def heads_with(*rows: AttitudeRows) -> list[Head]:
    of_mini = open_dump(FIXTURE).heads[0]
    sources = (SolvedAttitudes(own, f"{n}.csv", "none", np.eye(3)[2]) for n, own in enumerate(rows))
    return [replace(of_mini, name=f"STR{n}", source=source) for n, source in enumerate(sources)]


def test_two_heads_with_the_same_attitudes_are_an_error_of_dump_toml() -> None:
    rows = AttitudeRows(t_s=np.arange(4.0), R_si=Rotation.from_rotvec(np.eye(4, 3)))
    other = replace(rows, R_si=Rotation.from_rotvec(2.0 * np.eye(4, 3)))
    assert heads_once(heads_with(rows, other))[1] == []
    says = r"attitudes of STR0: found 0\.csv has the same content as 1\.csv of"
    with pytest.raises(RawDataError, match=says):
        heads_once(heads_with(rows, rows))
