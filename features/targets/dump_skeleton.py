"""A skeleton of a dump: every text file with comments, to be filled in (`boresight dump init`)."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from boresight.pipeline.console.arguments import option
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.whole_file import is_vacant
from boresight.records.record import record

__all__ = ["Skeleton", "write_skeleton"]

# Templates of the files; names in braces are fields of `Skeleton` and what follows from them.
DUMP = """# A dump for boresight; docs/dump-format.md describes every key.
format = "boresight-dump"
format_version = 1
mission = "{mission}"

[conventions]                  # stated, so that a writer checks them; no other value is accepted
inertial_frame = "GCRS"
earth_fixed_frame = "ITRS"
time_scale = "UTC"
quaternions = "scalar-last"
image_origin = "centre of first pixel is (0, 0)"

[files]                        # paths relative to this folder
{star_files}remote_camera = "remote_camera.toml"
orbit = "orbit.oem"
strips = "strips.csv"
{ground_file}
# terrain = "terrain/dem.tif"  # with the table [terrain] below

[errors]                       # 1-sigma of errors of the mission's data; better too large than too small
position_m = {position_m}
clock_s = {clock_s}
vibration_arcsec = 0.1
look_distortion_px = 0.3
look_distortion_length_px = 1500.0

# [terrain]
# height_kind = "egm96"        # or "ellipsoidal"
# sigma_m = 5.0
{heads}"""
STAR_FILES = """star_camera = "star_camera.toml"
installation = "installation.toml"
exposures = "exposures.csv"
"""
HEADS = """
[[star_cameras]]               # one table for each head; the first is the reference
name = "STR1"
level = "attitudes"
installation = "installation.toml"
attitudes = "str1.csv"         # or a CCSDS AEM or ACM, without the three keys that follow: it states its own
frame = "GCRF"                 # or "ICRF", "EME2000"
rotation = "head to inertial"  # what the quaternions do with vectors, or "inertial to head"
time_scale = "UTC"             # or "TAI", "GPS", with a column tai or gps in place of utc
aberration_removed = "annual and orbital"   # by the head: or "annual", "none"
# line_of_sight = [0.0, 0.0, 1.0]           # needed with these two: unit vector, axes of quaternions

[star_cameras.noise]           # 1-sigma about x, y, z of frame s; `boresight noise --write` estimates it
white_arcsec = [2.0, 2.0, 10.0]
origin = "assumed"
"""
STAR_CAMERA = """# Frame s: z along the optical axis; x and y opposite to column and row.
focal_length_mm = {star_focal_mm}
pixel_pitch_um = {star_pixel_um}
width_px = {star_width_px}
height_px = {star_height_px}
principal_point_px = [{x0}, {y0}]   # `boresight star-camera-calibrate` measures it
bit_depth = {bit_depth}

[distortion]                   # zeros: a lens without distortion
p1_per_mm = 0.0
p2_per_mm = 0.0
q1_per_mm2 = 0.0
q2_per_mm4 = 0.0
"""
REMOTE_CAMERA = """# Frame c: x along the direction of flight, y along the detectors, z to the ground.
focal_length_m = {focal_m}
tdi_stages = 1
time_of_row = "middle"         # which instant of its exposure the time of a row is: start, middle, end
bit_depth = {bit_depth}
"""
CCD = """
[[ccds]]                       # CCD {n}
n_px = {ccd_px}
pixel_pitch_um = {pixel_um}
y_first_mm = {y_first_mm:.6f}
x_offset_mm = 0.0
rotation_mrad = 0.0
principal_sample = {principal:.1f}
distortion_samples = []
distortion_offsets_um = []
"""
INSTALLATION = """# R_cs takes star-camera vectors to the remote-sensing camera; x y z w, w the scalar.
# This is the unit quaternion: replace it by the one measured before launch.
quaternion_cs = [0.0, 0.0, 0.0, 1.0]
sigma_rad = [0.003, 0.003, 0.003]   # 1-sigma of its error; targets are searched within 3 sigma
"""
ORBIT = """CCSDS_OEM_VERS = 2.0
CREATION_DATE = 2000-01-01T00:00:00
ORIGINATOR = FILL_IN

META_START
COMMENT replace this file by the mission's OEM: 1 Hz or denser, beyond all exposures and rows by 4 states
OBJECT_NAME = {mission}
OBJECT_ID = 0000-000A
CENTER_NAME = EARTH
REF_FRAME = GCRF
TIME_SYSTEM = UTC
START_TIME = 2000-01-01T00:00:00
STOP_TIME = 2000-01-01T00:00:00
META_STOP

"""
# Heads of the tables.
STRIPS = "id,ccd,file,utc_first_row,row_period_s,lines\n"
EXPOSURES = "id,file,utc_mid,exposure_s\n"
ATTITUDES = "utc,qx,qy,qz,qw\n"
PLACE = "lat_deg,lon_deg,height_m,height_kind,sigma_east_m,sigma_north_m,sigma_up_m"
TARGETS = f"id,{PLACE},chip\n"
POINTS = f"id,strip,ccd,sample,line,sigma_sample_px,sigma_line_px,{PLACE}\n"


@record(kw_only=True)
class Skeleton:
    """What is known of a mission before its dump is written."""

    mission: str = option("Name of the mission.", "my mission")
    star_focal_mm: float = option("Star camera: focal length.", 100.0, min=1.0)
    star_pixel_um: float = option("Star camera: pixel pitch.", 6.4, min=0.1)
    star_width_px: int = option("Star camera: columns.", 5120, min=16)
    star_height_px: int = option("Star camera: rows.", 3840, min=16)
    focal_m: float = option("Remote-sensing camera: focal length.", 10.0, min=1e-3)
    pixel_um: float = option("Remote-sensing camera: pixel pitch.", 10.0, min=0.1)
    ccds: int = option("Remote-sensing camera: CCDs.", 1, min=1, max=64)
    ccd_px: int = option("Remote-sensing camera: samples of a CCD.", 6144, min=16)
    bit_depth: int = option("Bits of a count of both.", 8, min=8, max=16)
    position_m: float = option("1-sigma of the orbit.", 2.0, min=0.0)
    clock_s: float = option("1-sigma of the strips' times.", 1e-4, min=0.0)


def write_skeleton(
    folder: Path, known: Skeleton, *, attitudes: bool = False, points: bool = False
) -> list[Path]:
    """Write the files and the folders for images into a new or empty folder; their paths.

    With `attitudes` the star side is what a head has solved itself, in place of star images; with `points`
    the ground side is measured image points, in place of targets and images of strips. `RawDataError` where
    the folder has files.
    """
    if not is_vacant(folder):
        raise RawDataError(str(folder), "folder", "not empty", "a new or empty folder")
    values = asdict(known)
    values["mission"] = known.mission.replace("\\", " ").replace('"', "'")
    middle = {"x0": 0.5 * (known.star_width_px - 1), "y0": 0.5 * (known.star_height_px - 1)}
    length_mm, first_mm = known.ccd_px * known.pixel_um * 1e-3, 0.5 * known.pixel_um * 1e-3
    left_mm = first_mm - 0.5 * known.ccds * length_mm
    ccds = [
        CCD.format(n=n, y_first_mm=left_mm + n * length_mm, principal=0.5 * (known.ccd_px - 1), **values)
        for n in range(known.ccds)
    ]
    files = {
        "dump.toml": DUMP.format(
            star_files="" if attitudes else STAR_FILES,
            ground_file='points = "points.csv"' if points else 'targets = "targets.csv"',
            heads=HEADS if attitudes else "",
            **values,
        ),
        **({} if attitudes else {"star_camera.toml": STAR_CAMERA.format(**values, **middle)}),
        "remote_camera.toml": REMOTE_CAMERA.format(**values) + "".join(ccds),
        "installation.toml": INSTALLATION,
        "orbit.oem": ORBIT.format(**values),
        **({"str1.csv": ATTITUDES} if attitudes else {"exposures.csv": EXPOSURES}),
        "strips.csv": STRIPS,
        **({"points.csv": POINTS} if points else {"targets.csv": TARGETS}),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name in ([] if attitudes else ["exposures"]) + ([] if points else ["strips", "chips"]):
        (folder / name).mkdir()
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return [folder / name for name in files]
