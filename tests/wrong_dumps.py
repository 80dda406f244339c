"""What may be wrong in a table or text of the handmade dump, and what must be said of it."""

import os
from collections.abc import Callable
from pathlib import Path

D, S, R, I, X, B, T, O = (  # noqa: E741
    *("dump.toml", "star_camera.toml", "remote_camera.toml", "installation.toml", "exposures.csv"),
    *("strips.csv", "targets.csv", "orbit.oem"),
)
# File, text in it, what takes its place, field that is named, and a pattern of the rest of the message.
WRONG: list[tuple[str, str, str, str, str]] = [
    (D, "[files]", "[files", "line 13", r"found \[files.* TOML 1.0"),
    (D, "boresight-dump", "dump", "format", "found dump.*boresight"),
    (D, "format_version = 1", "format_version = 2", "format_version", "found 2.* 1"),
    (D, "[errors]", "[errors]\nspeed = 1", "errors.speed", "found an unknown key.* keys"),
    (D, "clock_s = 1e-4", "", "errors.clock_s", "found nothing.* the key clock_s"),
    (D, '"GCRS"', '"J2000"', "conventions.inertial_frame", 'found J2000.* "GCRS"'),
    (D, "position_m = 2", "position_m = nan", "errors.position_m", "found nan.* finite"),
    (D, "position_m = 2", "position_m = 1e6", "errors.position_m", r"at most 100000 \(orbit"),
    (D, '"orbit.oem"', '"../orbit.oem"', "files.orbit", r"found \.\./orbit.* inside the dump"),
    (D, '"targets.csv"', '"targets.csv"\nterrain = "dem.tif"', "file", r"table \[terrain\].*together or"),
    (S, "bit_depth", "bitdepth", "bitdepth", "found an unknown key.* bit_depth"),
    (S, "= 100.0", '= "100 mm"', "focal_length_mm", "found 100 mm.* a number without quotes and unit"),
    (S, "_mm = 100.0", "_mm: 100.0", "line 2", "found focal_length_mm: 100.0.* KEY = VALUE"),
    (S, "= 100.0", "= 0.1", "focal_length_mm", r"found 0.1.* at least 1 \(focal length, mm"),
    (S, "= 100.0", "= 1e308", "focal_length_mm", "at most 100 m"),
    (S, "width_px = 64", "width_px = 64.5", "width_px", "found 64.5.* an integer"),
    (S, "-9.30e-7", "-9.30", "distortion", "not invertible.*1/mm"),
    (R, "= 10.0", "= 0", "focal_length_m", "found 0.* at least 0.001"),
    (R, "= -0.64", "= 9e15", "ccds.0.y_first_mm", r"focal plane, mm\)"),
    (I, "[0.5, -0.5, 0.5, 0.5]", "[1, 0, 0, 0.5]", "file", "must have length 1.* 1.118.* possible together"),
    (I, "[0.5, -0.5, 0.5, 0.5]", "[1, 0, 0]", "quaternion_cs", r"4 values, not 3 \(R_cs .*, scalar last\)"),
    (I, "0.003,", "10,", "sigma_rad.0", "found 10.* at most 3.15 .*1-sigma rotation about .*at most 180°"),
    (X, "exposures/1.png", "/etc/passwd", "line 3, file", "found /etc/passwd.* inside the dump"),
    (X, "utc_mid", "utc", "column utc_mid", "found no such column.* utc_mid"),
    (X, "0001,", "0000,", "id", "found 0000 2 times.* once"),
    (X, "19.800", "19.500", "line 3, utc_mid", "19.500.* after .*19.600.* strictly increasing"),
    (X, "19.800", "19.600", "line 3, utc_mid", "strictly increasing"),
    (X, "0002,", "../x,", "line 4, id", r"found \.\./x.*letters, digits"),
    (X, "0001,", "=cmd|' /C calc'!A0,", "line 3, id", "letters, digits"),
    (X, "0001,", "@SUM(1),", "line 3, id", "letters, digits"),
    (X, "0000,", "con.7,", "line 2, id", "no device of Windows"),
    (X, "0000,", "COM1,", "line 2, id", "no device of Windows"),
    (X, "0000,", "x.,", "line 2, id", "no . at the end"),
    (X, "2024-11-20T03:40:19.600", "nan", "line 2, utc_mid", "found nan"),
    (X, "2024-11-20T03:40:19.600", "20/11/2024 03:40", "line 2, utc_mid", "found 20/11/2024.*UTC as 2026-"),
    (X, ",0.03", ",nan", "line 2, exposure_s", "finite number"),
    (X, ",0.03", ",1e308", "line 2, exposure_s", "trails"),
    (B, "strips/0.tif", r"..\0.tif", "line 2, file", "found .*0.tif.* inside the dump"),
    (B, "19.900", "60.000", "utc_first_row", "found .*60.* exist"),
    (B, "03:40:19.900", "25:40:19.900", "utc_first_row", "no such time of day"),
    (B, "s1,1", "s1,2", "line 3, ccd", "found 2.* 0 to 1"),
    (B, "0.001", "inf", "line 2, row_period_s", "finite number"),
    (B, "0.001", "9e15", "line 2, row_period_s", "moves 7 km"),
    (B, ",200", ",1e9", "line 2, lines", "integer"),
    (T, "chip\n", "chip,note\n", "column note", "found an unknown.* chip"),
    (T, ",chips/1.tif", "", "line 3", "found 8 cells.* 9 cells"),
    (T, "0.00,", '"0.00\n",extra,', "line 3", "10 cells"),
    (T, "t1,", '"t1,', "line 3", "unexpected end of data"),
    (T, "t1,", "t1\x00,", "line 3, id", r"found t1\\x00, expected .*letters, digits"),
    (T, "t1,", "T0,", "id", "ids that differ in more than case"),
    (T, "103.0", "NaN", "line 2, lon_deg", "found NaN.* finite number"),
    (T, ",103.0,100,", ",103.0,,", "line 2, height_m", "found nothing.* a finite number"),
    (T, "0.00", "91", "line 2, lat_deg", r"found 91.* at most 90 \(geodetic latitude, degrees\)"),
    (T, "ellipsoidal", "egm08", "line 2, height_kind", 'found egm08.* "ellipsoidal", "egm96"'),
    (T, ",0.1,", ",1e308,", "line 2, sigma_east_m", "target's coordinate"),
    (O, "CCSDS_OEM_VERS", "OEM", "line 1", "found OEM = 2.0.* CCSDS_OEM_VERS"),
    (O, "= EARTH", "= MARS", "line 8, CENTER_NAME", "found MARS.* EARTH"),
    (O, "GCRF", "GTOD", "line 9, REF_FRAME", "found GTOD.* GCRF, ICRF, EME2000, TEME, TOD or ITRF"),
    (O, "6908.000000000 0", "6908000.000 0", "state 1, position", "found 6908000.*unit km"),
    (O, "6908.000000000 0", "nan 0", "line 15, X", "found nan.* finite"),
    (O, "03:40:05.000", "03:40:03.000", "state 6, time", "strictly increasing"),
    (O, "03:40:05.000", "nan", "line 20, time", "expected a time"),
]  # fmt: skip


def link_outside(root: Path) -> None:
    (root.parent / "outside.toml").write_text("secret = 1\n")
    (root / I).unlink()
    os.symlink(root.parent / "outside.toml", root / I)


# Other damages: what is done, and the message as above.
OTHERWISE: dict[str, tuple[Callable[[Path], object], str, str, str]] = {
    "no dump.toml": (lambda root: (root / D).unlink(), D, "file", "found no such file.*boresight dump init"),
    "no table": (lambda root: (root / B).unlink(), B, "file", "found no such file.* a readable file"),
    "link": (link_outside, D, "files.installation", "a link to a place outside.* inside the dump"),
    "not UTF-8": (lambda root: (root / T).write_bytes(b"id,lat_deg\n\xff\xfe"), T, "byte 11", "0xff.* UTF-8"),
    "UTF-16": (lambda root: (root / T).write_text("id\n", "utf-16"), T, "byte 0", "0xff.* CSV UTF-8"),
    "semicolons": (lambda root: (root / T).write_text("id;lat_deg\n"), T, "header", "by ';'.* by commas"),
}  # fmt: skip
