"""What a dump gives twice is counted once, with its reason; clean dumps lose nothing."""

import shutil
from collections.abc import Callable
from dataclasses import replace
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
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.repeats import common_errors, heads_once, targets_once
from boresight.pipeline.files.star_side import Head, SolvedAttitudes
from boresight.records.ledger import Reason

Row = dict[str, str]


@pytest.fixture
def mini(tmp_path: Path) -> Path:
    """A copy of the fixture."""
    return Path(shutil.copytree(FIXTURE, tmp_path / "mini", ignore=shutil.ignore_patterns("truth")))


def change(table: Path, into: Callable[[list[Row]], list[Row]]) -> None:
    write_rows(table, into(rows_of(table)))


def later(utc: str, ms: int) -> str:
    whole, fraction = utc.split(".")
    return f"{whole}.{int(fraction) + ms * 10**6:09d}"


def reasons(dump: Dump) -> dict[str, str]:
    assert {o.reason for o in dump.omissions} <= {Reason.REPEATED, Reason.SAME_PIXELS, Reason.SAME_TIME}
    return {f"{o.subject.kind} {o.subject.name}": o.text for o in dump.omissions}


@pytest.mark.parametrize("name", ["mini", "sky"])
def test_the_fixtures_lose_nothing(name: str) -> None:
    dump = targets_once(open_dump(FIXTURE.parent / name), MatchSettings())
    assert dump.omissions == ()
    assert len(dump.targets) == (36 if name == "mini" else 0)  # three strips see twelve targets each


@pytest.mark.parametrize("times", [3, 9])
def test_strips_under_other_ids_are_left_out_by_name(mini: Path, times: int) -> None:
    clean = open_dump(mini)
    change(
        mini / "strips.csv",
        lambda rows: [
            row | {"id": f"{row['id']}{'abcdefgh'[k - 1] if k else ''}"} for k in range(times) for row in rows
        ],
    )
    dump = open_dump(mini)
    assert [one.strip_id for one in dump.strips] == [one.strip_id for one in clean.strips]
    found = reasons(dump)
    assert len(found) == 3 * (times - 1)
    assert found["strip s02b"].startswith("it begins 0 s after CCD 0 in strip s02, which lasts 1.8 s")


def test_a_part_of_a_strip_in_other_files_loses_its_ccds(mini: Path) -> None:
    """CCDs 1 and 2 of s03 once more, compressed otherwise and 0.4 lines later."""

    def again(rows: list[Row]) -> list[Row]:
        copies = [row for row in rows if row["id"] == "s03" and row["ccd"] in "12"]
        for row in copies:
            with rasterio.open(mini / row["file"]) as image:
                write_strip(mini / f"again{row['ccd']}.tif", image.read(1))
        shift = {"id": "other", "utc_first_row": later(copies[0]["utc_first_row"], 0)[:-1] + "9"}
        return [*rows, *(row | shift | {"file": f"again{row['ccd']}.tif"} for row in copies)]

    change(mini / "strips.csv", again)
    dump = open_dump(mini)
    assert [one.strip_id for one in dump.strips] == ["s01", "s02", "s03"]
    assert list(reasons(dump)) == ["strip other"]


def test_one_ccd_given_twice_leaves_the_others(mini: Path) -> None:
    """s02 without CCD 3; CCDs 2 and 3 of it under another id."""

    def split(rows: list[Row]) -> list[Row]:
        of_s02 = {row["ccd"]: row for row in rows if row["id"] == "s02"}
        rows = [row for row in rows if row is not of_s02["3"]]
        return [*rows, of_s02["2"] | {"id": "part"}, of_s02["3"] | {"id": "part"}]

    change(mini / "strips.csv", split)
    dump = open_dump(mini)
    part = next(one for one in dump.strips if one.strip_id == "part")
    assert part.images.ccds == (3,) and list(part.ccd_lines) == [3]
    assert list(reasons(dump)) == ["ccd part/2"]


def test_equal_files_with_other_times_are_both_left_out(mini: Path) -> None:
    def mistake(rows: list[Row]) -> list[Row]:
        first = next(row for row in rows if row["id"] == "s01" and row["ccd"] == "2")
        shutil.copy(mini / first["file"], mini / "copy.tif")
        return [
            row | {"file": "copy.tif"} if (row["id"], row["ccd"]) == ("s03", "2") else row for row in rows
        ]

    change(mini / "strips.csv", mistake)
    found = reasons(open_dump(mini))
    assert set(found) == {"ccd s01/2", "ccd s03/2"}
    assert found["ccd s03/2"].startswith(
        "copy.tif has the same content as strips/s01_ccd2.tif of CCD 2 in strip s01"
    )


def test_other_ground_at_the_same_time_is_an_error_of_the_table(mini: Path) -> None:
    def copied(rows: list[Row]) -> list[Row]:
        utc = rows[0]["utc_first_row"]
        return [row | {"utc_first_row": utc} if row["id"] == "s03" else row for row in rows]

    change(mini / "strips.csv", copied)
    with pytest.raises(
        RawDataError, match=r"strips\.csv: utc_first_row: found the same time for s01 and s03"
    ):
        open_dump(mini)


def test_dead_detectors_of_two_strips_are_not_taken_for_copies(tmp_path: Path) -> None:
    dump = write_handmade_dump(tmp_path / "dump")
    write_strip(dump / "strips/0.tif", np.zeros((200, 64), np.uint8))
    text = (dump / "strips.csv").read_text()
    row = text.splitlines()[1].replace("s1,", "s2,").replace("03:40:19.900", "03:40:20.200")
    shutil.copy(dump / "strips/0.tif", dump / "strips/2.tif")
    (dump / "strips.csv").write_text(text + row.replace("0.tif", "2.tif") + "\n")
    assert open_dump(dump).omissions == ()


@pytest.mark.parametrize("copied", [False, True])
def test_exposures_doubled_one_millisecond_apart_are_counted_once(mini: Path, copied: bool) -> None:
    clean = open_dump(mini)

    def doubled(rows: list[Row]) -> list[Row]:
        every = []
        for row in rows:
            again = row | {"id": f"{row['id']}x", "utc_mid": later(row["utc_mid"], 1)}
            if copied:
                again["file"] = row["file"].replace(".png", "x.png")
                shutil.copy(mini / row["file"], mini / again["file"])
            every += [row, again]
        return every

    change(mini / "exposures.csv", doubled)
    dump = open_dump(mini)
    assert [one.exposure_id for one in dump.exposures] == [one.exposure_id for one in clean.exposures]
    found = reasons(dump)
    assert len(found) == 42 and found["exposure e0001x"].startswith("it begins 0.001 s after exposure e0001")


def test_one_image_for_two_exposures_is_used_for_neither(mini: Path) -> None:
    change(
        mini / "exposures.csv",
        lambda rows: [row | {"file": "exposures/e0020.png"} if row["id"] == "e0023" else row for row in rows],
    )
    dump = open_dump(mini)
    assert set(reasons(dump)) == {"exposure e0020", "exposure e0023"}
    assert "of exposure e0020: one of the two rows" in reasons(dump)["exposure e0023"]


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
    found = reasons(dump)
    assert found["target s01-t02-a"].startswith(
        "it lies 0 m from target s01-t02 and shares 100% of its pixels"
    )
    assert found["target s01-t02-b"].startswith("it lies 22.2 m from target s01-t02 and shares ")


def again(**cells: str) -> Callable[[list[Row]], list[Row]]:
    """The first row once more under another id, with other cells."""
    return lambda rows: sorted(
        [*rows, rows[0] | {"id": "again"} | cells], key=lambda row: row.get("utc_mid", "")
    )


@pytest.mark.parametrize(
    ("table", "inject", "entries"),
    [
        ("strips", again(), {"strip again": Reason.REPEATED}),
        (
            "strips",
            again(ccd="3", utc_first_row="2024-11-20T04:10:00.000000000"),
            {"ccd s01/0": Reason.SAME_PIXELS, "strip again": Reason.SAME_PIXELS},
        ),
        ("exposures", again(), None),  # equal times are refused by the table
        ("exposures", again(utc_mid="later"), {"exposure again": Reason.REPEATED}),
        (
            "exposures",
            again(utc_mid="later", file="exposures/e0009.png"),
            {"exposure again": Reason.SAME_TIME, "exposure e0001": Reason.SAME_TIME},
        ),
        ("targets", again(), {"target again": Reason.REPEATED}),
    ],
)
def test_each_kind_is_counted_once_or_contradicts(mini: Path, table, inject, entries) -> None:
    def into(rows: list[Row]) -> list[Row]:
        made = inject(rows)
        for row in made:
            if row.get("utc_mid") == "later":
                row["utc_mid"] = later(rows[0]["utc_mid"], 1)
        return sorted(made, key=lambda row: row.get("utc_mid", ""))

    change(mini / f"{table}.csv", into)
    if entries is None:
        with pytest.raises(RawDataError, match="strictly increasing times"):
            open_dump(mini)
        return
    dump = targets_once(open_dump(mini), MatchSettings())
    assert {f"{o.subject.kind} {o.subject.name}": o.reason for o in dump.omissions} == entries
    causes = {finding.cause for finding in contradicting_rows(dump.omissions)}
    assert causes == {reason.value for reason in entries.values()} - {Reason.REPEATED.value}


def heads_with(*rows: AttitudeRows) -> list[Head]:
    of_mini = open_dump(FIXTURE).heads[0]
    sources = (
        SolvedAttitudes(own, f"{n}.csv", "none", np.array([0.0, 0.0, 1.0])) for n, own in enumerate(rows)
    )
    return [replace(of_mini, name=f"STR{n}", source=source) for n, source in enumerate(sources)]


def test_two_heads_with_the_same_attitudes_are_an_error_of_dump_toml() -> None:
    rows = AttitudeRows(t_s=np.arange(4.0), R_si=Rotation.from_rotvec(np.eye(4, 3)))
    other = replace(rows, R_si=Rotation.from_rotvec(2.0 * np.eye(4, 3)))
    assert heads_once(heads_with(rows, other))[1] == []
    with pytest.raises(
        RawDataError, match=r"attitudes of STR0: found 0\.csv has the same content as 1\.csv of"
    ):
        heads_once(heads_with(rows, rows))


def test_two_ccds_of_one_camera_at_one_time_are_no_repeats_under_two_ids(mini: Path) -> None:
    """CCDs 2 and 3 of each strip as a strip of its own: same times, other CCDs."""
    change(
        mini / "strips.csv",
        lambda rows: [row | {"id": row["id"] + ("b" if row["ccd"] in "23" else "")} for row in rows],
    )
    dump = open_dump(mini)
    assert len(dump.strips) == 6 and dump.omissions == ()
