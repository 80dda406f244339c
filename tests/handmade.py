"""A small dump written by hand after docs/dump-format.md, without the program's own writer.

A circular orbit, four noise exposures of 64 x 48 px, one strip of two CCDs of 64 x 200 px, two targets with
chips. Everything can be read; nothing in it can be calibrated.
"""

from pathlib import Path

import cv2
import numpy as np
from rasterio.transform import Affine
from rasters import write_raster

HEAD = """
format = "boresight-dump"
format_version = 1
mission = "by hand"

[conventions]
inertial_frame = "GCRS"
earth_fixed_frame = "ITRS"
time_scale = "UTC"
quaternions = "scalar-last"
image_origin = "centre of first pixel is (0, 0)"

[files]
star_camera = "star_camera.toml"
remote_camera = "remote_camera.toml"
installation = "installation.toml"
orbit = "orbit.oem"
exposures = "exposures.csv"
strips = "strips.csv"
targets = "targets.csv"

[errors]
position_m = 2
clock_s = 1e-4
vibration_arcsec = 0.1
look_distortion_px = 0.3
look_distortion_length_px = 1500
"""

STAR_CAMERA = """
focal_length_mm = 100.0
pixel_pitch_um = 6.4
width_px = 64
height_px = 48
principal_point_px = [32.0, 24.0]
bit_depth = 8

[distortion]
p1_per_mm = 2.29e-5
p2_per_mm = -2.96e-5
q1_per_mm2 = -9.30e-7
q2_per_mm4 = -4.25e-9
"""

# An entry of a head that delivers attitudes, in the order of its keys in docs/dump-format.md.
ATTITUDE_HEAD = """
[[star_cameras]]
name = "STR1"
level = "attitudes"
installation = "installation.toml"
attitudes = "str1.csv"
frame = "GCRF"
rotation = "{rotation}"
aberration_removed = "{removed}"
line_of_sight = [0.0, 0.0, 1.0]
"""

CCD = """
[[ccds]]
n_px = 64
pixel_pitch_um = 10.0
y_first_mm = {y}
x_offset_mm = 0.0
rotation_mrad = 0.0
principal_sample = 31.5
distortion_samples = []
distortion_offsets_um = []
"""

REMOTE_CAMERA = """
focal_length_m = 10.0
tdi_stages = 1
time_of_row = "middle"
bit_depth = 8
"""

INSTALLATION = "quaternion_cs = [0.5, -0.5, 0.5, 0.5]\nsigma_rad = [0.003, 0.003, 0.003]\n"

OEM_HEAD = """CCSDS_OEM_VERS = 2.0
CREATION_DATE = 2024-11-20T00:00:00
ORIGINATOR = HAND

META_START
OBJECT_NAME = HAND
OBJECT_ID = 2024-000A
CENTER_NAME = EARTH
REF_FRAME = GCRF
TIME_SYSTEM = UTC
START_TIME = {day}T03:40:00
STOP_TIME = {day}T03:40:39
META_STOP

"""


def write_handmade_dump(root: Path, day: str = "2024-11-20") -> Path:
    """Write the dump into `root` and return it."""
    for folder in ("exposures", "strips", "chips"):
        (root / folder).mkdir(parents=True)
    (root / "dump.toml").write_text(HEAD)
    (root / "star_camera.toml").write_text(STAR_CAMERA)
    (root / "remote_camera.toml").write_text(REMOTE_CAMERA + CCD.format(y=-0.64) + CCD.format(y=-0.05))
    (root / "installation.toml").write_text(INSTALLATION)
    (root / "orbit.oem").write_text(OEM_HEAD.format(day=day) + "\n".join(_states(day)) + "\n")
    rng = np.random.default_rng(11)
    rows = ["id,file,utc_mid,exposure_s"]
    for n in range(4):
        cv2.imwrite(str(root / f"exposures/{n}.png"), rng.integers(5, 15, (48, 64)).astype(np.uint8))
        rows.append(f"{n:04d},exposures/{n}.png,{day}T03:40:{19.6 + 0.2 * n:.3f},0.03")
    (root / "exposures.csv").write_text("\n".join(rows) + "\n")
    rows = ["id,ccd,file,utc_first_row,row_period_s,lines"]
    for ccd in range(2):
        write_strip(root / f"strips/{ccd}.tif", rng.integers(0, 255, (200, 64)).astype(np.uint8))
        rows.append(f"s1,{ccd},strips/{ccd}.tif,{day}T03:40:19.900,0.001,200")
    (root / "strips.csv").write_text("\n".join(rows) + "\n")
    rows = ["id,lat_deg,lon_deg,height_m,height_kind,sigma_east_m,sigma_north_m,sigma_up_m,chip"]
    for n in range(2):
        write_chip(root / f"chips/{n}.tif", rng.integers(0, 255, (32, 32)).astype(np.uint8))
        rows.append(f"t{n},0.0{n},103.0,100,ellipsoidal,0.1,0.1,0.2,chips/{n}.tif")
    (root / "targets.csv").write_text("\n".join(rows) + "\n")
    return root


def _states(day: str) -> list[str]:
    radius, rate = 6908.0, 7.5963 / 6908.0  # km, rad/s
    return [
        f"{day}T03:40:{n:02d}.000 {radius * np.cos(rate * n):.9f} {radius * np.sin(rate * n):.9f} 0.0 "
        f"{-radius * rate * np.sin(rate * n):.12f} {radius * rate * np.cos(rate * n):.12f} 0.0"
        for n in range(40)
    ]


def give_heads(root: Path, heads: str) -> None:
    """Put `[[star_cameras]]` in the place of the star images that a dump names."""
    text = (root / "dump.toml").read_text()
    for name in ("star_camera", "installation", "exposures"):
        text = text.replace(f'{name} = "{name}', f'#{name} = "{name}')
    (root / "dump.toml").write_text(text + heads)


def write_strip(path: Path, image: np.ndarray) -> None:
    """A tiled TIFF without georeference."""
    write_raster(path, image, compress="deflate")


def write_chip(path: Path, image: np.ndarray) -> None:
    """A GeoTIFF in UTM zone 48 north, 0.5 m pixels."""
    write_raster(path, image, crs="EPSG:32648", transform=Affine(0.5, 0, 277_000, 0, -0.5, 1000))
