"""Every complaint names the file, the field, what was found and what was expected."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from handmade import write_handmade_dump, write_strip
from wrong_dumps import OTHERWISE, WRONG, replaced

from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.remote_camera import read_remote_camera


def names_file_and_field(dump: Path, file: str, field: str, says: str) -> None:
    with pytest.raises(RawDataError) as caught:
        open_dump(dump)
    error = caught.value
    assert (error.file, error.field) == (file, field), str(error)
    assert re.search(says, str(error)) and str(error).isprintable(), str(error)
    assert [part for part in (file, field, error.found, error.expected) if part not in str(error)] == []


@pytest.mark.parametrize(("file", "old", "new", "field", "says"), WRONG)
def test_wrong_text_is_named_with_field_found_and_expected(file, old, new, field, says, handmade):
    replaced(handmade, file, old, new)
    names_file_and_field(handmade, file, field, says)


@pytest.mark.parametrize("name", OTHERWISE)
def test_wrong_file_is_named_with_field_found_and_expected(name: str, handmade: Path) -> None:
    damage, *told = OTHERWISE[name]
    damage(handmade)
    names_file_and_field(handmade, *told)


def test_orthometric_height_of_a_target_is_raised_by_the_geoid(handmade: Path) -> None:
    # Test point of NGA's EGM96 program F477: the geoid lies 43.575 m below the ellipsoid (its grid: 0.3 m).
    text = (handmade / "targets.csv").read_text().splitlines()
    text[1] = text[1].replace("t0,0.00,103.0,100,ellipsoidal", "t0,46.8743190,102.4487290,100,egm96")
    (handmade / "targets.csv").write_text("\n".join(text) + "\n")
    _, _, height = geodetic_from_ecef(open_dump(handmade).targets[0].p_e, WGS84)
    assert height == pytest.approx(100.0 - 43.575, abs=0.3)


def test_hand_written_dump_is_read_without_complaint(handmade: Path) -> None:
    dump = open_dump(handmade)
    assert (len(dump.exposures), len(dump.strips), len(dump.targets), dump.omissions) == (4, 1, 2, ())
    # 19.6 s after the first state, which is the epoch; decimal seconds are exact to 1e-12 s.
    assert dump.exposures[0].t_s == pytest.approx(19.6, abs=1e-12)


@pytest.mark.parametrize(
    ("wrong", "cause"),
    [
        (lambda values: 0.0 * values, "velocities are zero"),
        (lambda values: -values, "velocities are reversed"),
        (lambda values: 5.0 * values, r"multiplied by a factor: 5 \(units\?\)"),
        (lambda values: values[[1, 2, 0]], "not the rate of change"),
    ],
)
def test_orbit_that_contradicts_itself_is_refused_with_its_cause(
    wrong: Callable[[np.ndarray], np.ndarray], cause: str, handmade: Path
) -> None:
    lines = (handmade / "orbit.oem").read_text().splitlines()
    first = lines.index("META_STOP") + 1
    for n in range(first, len(lines)):
        if words := lines[n].split():
            numbers = wrong(np.array(words[4:7], dtype=float))
            lines[n] = " ".join([*words[:4], *(f"{value:.12f}" for value in numbers)])
    (handmade / "orbit.oem").write_text("\n".join(lines) + "\n")
    with pytest.raises(RawDataError, match=cause) as caught:
        open_dump(handmade)
    assert caught.value.file == "orbit.oem"


@pytest.mark.parametrize(("day", "where"), [("1971-11-20", "1972"), ("2031-11-20", "2027|2026")])
def test_date_outside_the_earth_orientation_table_names_its_limit(
    tmp_path: Path, day: str, where: str
) -> None:
    with pytest.raises(RawDataError) as caught:
        open_dump(write_handmade_dump(tmp_path / "dump", day))
    assert caught.value.file == "orbit.oem"
    assert re.search(where, str(caught.value)), str(caught.value)


def truncated(name: str, keep: float = 0.6) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        raw = (root / name).read_bytes()
        (root / name).write_bytes(raw[: int(keep * len(raw))])

    return damage


def zero_length(name: str) -> Callable[[Path], None]:
    return lambda root: (root / name).write_bytes(b"")


def other_strip(width: int, height: int, dtype: type) -> Callable[[Path], None]:
    return lambda root: write_strip(root / "strips/0.tif", np.ones((height, width), dtype))


def claims_to_be_huge(root: Path) -> None:
    """A TIFF of a few hundred bytes whose header says a million by a million pixels."""
    import struct

    tags = [(256, 4, 1, 10**6), (257, 4, 1, 10**6), (258, 3, 1, 8), (259, 3, 1, 1), (262, 3, 1, 1)]
    tags += [(273, 4, 1, 8), (277, 3, 1, 1), (278, 4, 1, 10**6), (279, 4, 1, 10)]
    head = struct.pack("<2sHI", b"II", 42, 8) + struct.pack("<H", len(tags))
    head += b"".join(struct.pack("<HHII", *tag) for tag in tags) + struct.pack("<I", 0)
    (root / "strips/0.tif").write_bytes(head)


BAD_STRIPS = {
    "missing": (lambda root: (root / "strips/0.tif").unlink(), "file: found no such file"),
    "zero length": (zero_length("strips/0.tif"), "byte 0: found an empty file, expected a TIFF"),
    "truncated": (truncated("strips/0.tif"), "found .* expected"),
    "another size": (other_strip(64, 100, np.uint8), "size: found 64 x 100 px, expected 64 x 200 px"),
    "another depth": (other_strip(64, 200, np.uint16), "bit depth: found 16 bits, expected 8 bits"),
    "floating point": (other_strip(64, 200, np.float32), "depth: found float32, expected uint8 or uint16"),
    "a million by a million": (claims_to_be_huge, "size: found 1000000 x 1000000 px, expected 64 x 200"),
}


@pytest.mark.parametrize("name", BAD_STRIPS)
def test_bad_strip_image_is_left_out_with_its_reason_and_the_rest_goes_on(name: str, handmade: Path) -> None:
    damage, reason = BAD_STRIPS[name]
    damage(handmade)
    dump = open_dump(handmade)
    (omission,) = dump.omissions
    assert (omission.subject.kind, omission.subject.name, omission.file) == ("ccd", "s1/0", "strips/0.tif")
    assert re.search(reason, omission.text), omission.text
    assert dump.strips[0].images.ccds == (1,)


def test_strip_without_any_readable_image_is_left_out_as_a_whole(handmade: Path) -> None:
    for ccd in range(2):
        (handmade / f"strips/{ccd}.tif").unlink()
    dump = open_dump(handmade)
    assert dump.strips == ()
    assert [(o.subject.kind, o.subject.name) for o in dump.omissions] == [
        ("ccd", "s1/0"),
        ("ccd", "s1/1"),
        ("strip", "s1"),
    ]


def test_leap_second_inside_a_strip_is_time_like_any_other(tmp_path: Path) -> None:
    root = write_handmade_dump(tmp_path / "dump", "2016-12-31")
    text = (root / "orbit.oem").read_text().replace("T03:40:", "T23:59:")
    lines = text.splitlines()
    for n in range(40):  # states 23:59:30 ... 23:59:60, 00:00:00 ...
        second = 30 + n
        late = second > 60
        stamp = f"2017-01-01T00:00:{second - 61:02d}.000" if late else f"2016-12-31T23:59:{second}.000"
        index = next(k for k, line in enumerate(lines) if line.startswith(f"2016-12-31T23:59:{n:02d}.000 "))
        lines[index] = "#" + stamp + lines[index][23:]
    text = "\n".join(line.removeprefix("#") for line in lines) + "\n"
    text = text.replace("START_TIME = 2016-12-31T23:59:00", "START_TIME = 2016-12-31T23:59:30")
    text = text.replace("STOP_TIME = 2016-12-31T23:59:39", "STOP_TIME = 2017-01-01T00:00:08")
    (root / "orbit.oem").write_text(text)
    strips = (root / "strips.csv").read_text()
    (root / "strips.csv").write_text(strips.replace("2016-12-31T03:40:19.900", "2016-12-31T23:59:60.900"))
    rows = ["id,file,utc_mid,exposure_s"]
    stamps = ["2016-12-31T23:59:60.700", "2016-12-31T23:59:60.900"]
    stamps += ["2017-01-01T00:00:00.100", "2017-01-01T00:00:00.3"]
    rows += [f"{n:04d},exposures/{n}.png,{stamp},0.03" for n, stamp in enumerate(stamps)]
    (root / "exposures.csv").write_text("\n".join(rows) + "\n")
    dump = open_dump(root)
    # SI seconds run on through the leap second: 30.7, 30.9, 31.1, 31.3 s after 23:59:30.
    assert [e.t_s for e in dump.exposures] == pytest.approx([30.7, 30.9, 31.1, 31.3], abs=1e-9)
    assert dump.strips[0].t_first_row_s == pytest.approx(30.9, abs=1e-9)


def test_damaged_chip_is_named_when_it_is_read(handmade: Path) -> None:
    from boresight.pipeline.files.images.rasters import read_grid

    truncated("chips/0.tif", 0.3)(handmade)
    with pytest.raises(RawDataError) as caught:
        read_grid(handmade / "chips/0.tif", "chips/0.tif", max_pixels=10**6)
    assert caught.value.file == "chips/0.tif"


@pytest.mark.parametrize(
    ("tan_y", "says"),
    [
        ((-0.004, -0.002, 0.0, 0.002, 0.004), ""),
        ((-0.004, 0.003, 0.0, 0.002, 0.004), "tan_y must be strictly monotone"),
        ((-0.004, -0.00399, 0.0039, 0.00395, 0.004), "reverses the order of the samples"),  # between its rows
    ],
)
def test_looks_that_run_to_and_fro_are_refused_with_their_file(tan_y, says: str, tmp_path: Path) -> None:
    path, head = tmp_path / "camera.toml", 'model = "look tables"\nlooks = "l.csv"\ndirections = "tangents"\n'
    path.write_text(f"{head}[[ccds]]\nn_px = 17\n")
    rows = [f"0,{4 * n},0.001,{y}" for n, y in enumerate(tan_y)]
    (tmp_path / "l.csv").write_text("\n".join(["ccd,sample,x,y", *rows]) + "\n")
    if not says:
        assert read_remote_camera(tmp_path, path, "camera.toml")[0].n_px(0) == 17
        return
    with pytest.raises(RawDataError, match=rf"l\.csv: .*{says}"):
        read_remote_camera(tmp_path, path, "camera.toml")
