"""What a dump may say in the operator's way: look tables, effects of light left out, Earth orientation."""

from pathlib import Path

import numpy as np
import pytest
from edits import replaced
from handmade import write_handmade_dump

from boresight.geometry.constants import ARCSEC, EARTH_ROTATION_RATE
from boresight.geometry.line_camera import LookAngleCamera
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.orbit_and_earth import bundled_table

LOOKS = """
model = "look tables"
looks = "looks.csv"
directions = "{directions}"
bit_depth = 8
[[ccds]]
n_px = 64
[[ccds]]
n_px = 64
"""


def tabulated_dump(root: Path, directions: str, angle_of=lambda tangent: tangent) -> Path:
    """The handmade dump with its camera's own look directions as a table."""
    write_handmade_dump(root)
    camera = open_dump(root).line_camera
    rows = ["ccd,sample,x,y"]
    for ccd in (0, 1):
        for sample in range(64):
            u = camera.directions_from_pixels(ccd, np.array([float(sample)]))[0]
            x, y = (float(angle_of(u[k] / u[2])) for k in (0, 1))
            rows.append(f"{ccd},{sample},{x!r},{y!r}")
    (root / "looks.csv").write_text("\n".join(rows) + "\n")
    (root / "remote_camera.toml").write_text(LOOKS.format(directions=directions))
    return root


@pytest.mark.parametrize("directions, angle_of", [("tangents", lambda t: t), ("angles", np.arctan)])
def test_a_camera_of_look_tables_is_that_of_its_hardware(tmp_path, directions, angle_of):
    write_handmade_dump(tmp_path / "hardware")
    hardware = open_dump(tmp_path / "hardware").line_camera
    tables = open_dump(tabulated_dump(tmp_path / "tables", directions, angle_of)).line_camera
    assert isinstance(tables, LookAngleCamera) and tables.n_ccds == 2
    at = np.array([0.0, 3.25, 40.0, 63.4])
    for ccd in (0, 1):
        off = tables.directions_from_pixels(ccd, at) - hardware.directions_from_pixels(ccd, at)
        assert np.abs(off).max() < 1e-14  # rad; a pixel is 1e-6
    assert tables.pixel_rad == pytest.approx(hardware.pixel_rad, rel=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "file", "field"),
    [
        ("0,5,", "7,5,", "looks.csv", "ccd"),
        ("0,5,", "0,4,", "looks.csv", "CCD 0"),
        ("0,5,", "0,5,9", "looks.csv", "line 7, x"),
        ("ccd,sample", "ccd,pixel", "looks.csv", "column sample"),
    ],
)
def test_damaged_look_tables_are_refused(tmp_path, old, new, file, field):
    root = tabulated_dump(tmp_path / "dump", "tangents")
    replaced(root / "looks.csv", old, new, 1)
    with pytest.raises(RawDataError) as error:
        open_dump(root)
    assert error.value.file == file and error.value.field == field


def test_effects_that_the_dump_leaves_out_are_left_out(tmp_path):
    write_handmade_dump(tmp_path / "dump")
    head = tmp_path / "dump" / "dump.toml"
    assert open_dump(tmp_path / "dump").light.light_time
    head.write_text(head.read_text() + "\n[light]\nlight_time = false\nrefraction = false\n")
    effects = open_dump(tmp_path / "dump").light
    assert (effects.light_time, effects.aberration, effects.refraction) == (False, True, False)


def test_the_missions_own_earth_orientation_turns_the_earth(tmp_path):
    # UT1 - UTC of 0.1 s more than the bundled value turns the Earth by 0.1 s of its rate (1.5 arc-seconds).
    root = write_handmade_dump(tmp_path / "dump")
    plain = open_dump(root).orbit.earth
    table = bundled_table()
    first = int(np.searchsorted(table.mjd_utc, 60630.0))  # 2024-11-16, four days before
    rows = ["mjd_utc,ut1_utc_s,x_arcsec,y_arcsec"]
    for n in range(first, first + 10):
        pole = table.xp_rad[n] / ARCSEC, table.yp_rad[n] / ARCSEC
        rows.append(f"{int(table.mjd_utc[n])},{table.ut1_utc_s[n] + 0.1},{pole[0]},{pole[1]}")
    (root / "eop.csv").write_text("\n".join(rows) + "\n")
    replaced(root / "dump.toml", "[files]\n", '[files]\nearth_orientation = "eop.csv"\n')
    own = open_dump(root).orbit.earth
    turned = own.rotations_ie([10.0]) * plain.rotations_ie([10.0]).inv()
    assert turned.as_rotvec()[0, 2] == pytest.approx(0.1 * EARTH_ROTATION_RATE, abs=5e-9)  # 1 mas: dX, dY
    (root / "eop.csv").write_text("\n".join(rows[:4]) + "\n")
    with pytest.raises(RawDataError, match="consecutive days"):
        open_dump(root)
