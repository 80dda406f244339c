"""Every reader of files from outside with a sound file each, and what may come of a file that is not sound.

The tests of this folder and `benchmarks/fuzz_readers.py` change the sound files and ask for one of two
outcomes: something is read, or one of the errors in `DOCUMENTED` is raised.
"""

import gzip
import json
import random
import shutil
import tarfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import rasterio
import rasterio.control
from astropy.io import fits
from handmade import write_handmade_dump, write_strip
from handmade_dimap import as_version_2, dimap_text
from handmade_sentinel2 import DATASTRIP, SPAMOD, VIEDIR, write_sentinel2
from image_mutants import with_checksums
from rasters import write_raster
from scipy.spatial.transform import Rotation

from boresight.calib.information import InformationPairs
from boresight.features.geolocate.positions import read_pixels
from boresight.features.operators.gipp_files import find_gipp_files, gipp_root
from boresight.features.operators.point_import import PointErrors, read_measured_points
from boresight.features.operators.sentinel2_product import read_sentinel2
from boresight.features.planning import campaign_plan
from boresight.features.planning.campaign_plan import read_plan
from boresight.features.sky_images.centroid_report import _read_truth
from boresight.features.sky_images.frame_facts import observers_of
from boresight.features.sky_images.image_time import Whereabouts
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.epoch import Epoch
from boresight.geometry.groundlight import LightEffects
from boresight.geometry.sightings import StarSightings
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.attitude_files import read_attitudes
from boresight.pipeline.files.centroid_files import read_centroids
from boresight.pipeline.files.dimap_metadata import read_dimap
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.ground_points import ChipFile, read_points
from boresight.pipeline.files.images.star_images import read_exposure, read_star_image
from boresight.pipeline.files.images.tiff import StripFiles, check_strip_file
from boresight.pipeline.files.orbit_file import read_oem, read_segments
from boresight.pipeline.files.record_tables import record_from_table, table_from_record
from boresight.pipeline.files.scenario_file import named_scenario
from boresight.pipeline.files.table_files import fixed_list
from boresight.pipeline.files.terrain_files import TerrainFiles, _read_terrain
from boresight.pipeline.results.reading import read_pairs, read_saved_result
from boresight.pipeline.results.sightings_tables import pairs_table
from boresight.pipeline.results.status import run_status, status_lines
from boresight.pipeline.run.settings import read_settings
from boresight.pipeline.run.unit_store import UnitStore, read_meta
from boresight.pipeline.stages.strip import MatchedTargets, read_chip
from boresight.simulator.scenario import ScenarioError

__all__ = ["DOCUMENTED", "READERS", "Reader", "mutated", "write_sound_files"]

DOCUMENTED = (RawDataError, DataNotSufficientError, ScenarioError)
WIDTH, HEIGHT = 48, 40
STRIP = (64, 200)


@dataclass(frozen=True, slots=True)
class Reader:
    """`read(folder)` reads the file `file` of a folder that `write_sound_files` made."""

    name: str
    file: str
    read: Callable[[Path], Any]

    @property
    def is_text(self) -> bool:
        return Path(self.file).suffix in ".toml .csv .oem .aem .xml .DBL .json .points .gcp".split()


def of_path(name: str, file: str, read: Callable[..., Any], *more: Any) -> Reader:
    """A reader of a path, with further arguments."""
    return Reader(name, file, lambda folder: read(folder / file, *more))


def of_named(name: str, file: str, read: Callable[..., Any], *more: Any, **named: Any) -> Reader:
    """A reader of a path and its name in messages, with further arguments."""
    return Reader(name, file, lambda folder: read(folder / file, file, *more, **named))


def write_sound_files(folder: Path) -> Path:
    """One sound file for each reader."""
    root = write_handmade_dump(folder / "dump")
    _write_terrain(root / "dem.tif")
    head = (root / "dump.toml").read_text()
    head = head.replace('"targets.csv"', '"targets.csv"\nterrain = "dem.tif"')
    (root / "dump.toml").write_text(head + '\n[terrain]\nheight_kind = "ellipsoidal"\nsigma_m = 5\n')
    counts = np.random.default_rng(8).integers(0, 255, (HEIGHT, WIDTH)).astype(np.uint8)
    for suffix in (".png", ".jpg", ".bmp"):
        assert cv2.imwrite(str(folder / f"sky{suffix}"), counts)
    assert cv2.imwrite(str(folder / "colour.png"), np.dstack([counts, counts, counts]))
    assert cv2.imwrite(str(folder / "deep.png"), 256 * counts.astype(np.uint16))
    write_strip(folder / "sky.tif", counts)
    fits.PrimaryHDU(counts.astype(np.uint16)).writeto(folder / "sky.fits")
    (folder / "plan.toml").write_text(PLAN)
    (folder / "settings.toml").write_text(SETTINGS)
    (folder / "scenario.toml").write_text(SCENARIO)
    (folder / "truth.csv").write_text("file,x_px,y_px,flux_dn\nsky.png,10.5,20.25,300\nsky.png,1,2,3\n")
    (folder / "times.csv").write_text(
        "file,utc_mid\nsky.png,2024-11-20T03:40:20.5Z\na.png,2016-12-31T23:59:60\n"
    )
    (folder / "pixels.csv").write_text("ccd,sample,line\n0,1.5,2.5\n1,3,4\n")
    (folder / "dimap.xml").write_text(dimap_text())
    (folder / "dimap2.xml").write_text(as_version_2(dimap_text()))
    (folder / "dimap2_list.xml").write_text(as_version_2(dimap_text(), listed=True, microseconds=True))
    _write_gcps(folder / "gcps.tif")
    for name, text in (ATTITUDES | POINTS).items():
        (folder / name).write_text(text)
    write_sentinel2(folder)
    _write_packed(folder)
    _write_result(folder / "result")
    _write_units(folder)
    return folder


def _write_packed(folder: Path) -> None:
    """Messages and GIPP files as distributed: compressed, in archives; an OEM 3.0, one of two segments."""
    oem = (folder / "dump/orbit.oem").read_text()
    own = "CCSDS_OEM_VERS = 3.0\nCLASSIFICATION = none\nMESSAGE_ID = 7"
    (folder / "third.oem").write_text(oem.replace("CCSDS_OEM_VERS = 2.0", own, 1))
    meta = oem[oem.index("META_START") :]
    (folder / "segments.oem").write_text(oem + meta.replace("2024-11-20T", "2024-11-21T"))
    (folder / "orbit.oem.gz").write_bytes(gzip.compress(oem.encode(), mtime=0))
    (folder / "attitudes.aem.gz").write_bytes(gzip.compress((folder / "attitudes.aem").read_bytes(), mtime=0))
    (folder / "dbl").mkdir()
    for name in (SPAMOD, VIEDIR):
        shutil.copy(folder / f"{name}.xml", folder / "dbl" / f"{name}.DBL")
    for name, mode in (("gipp.tar", "w:"), ("gipp.tgz", "w:gz")):
        with tarfile.open(folder / name, mode) as archive:
            archive.add(folder / "dbl", "GIPP")


def _write_gcps(path: Path) -> None:
    gcps = [
        rasterio.control.GroundControlPoint(r, c, 20.0 + c / 9, 50.0 - r / 9, 3.0)
        for r in (1, 30)
        for c in (2, 40)
    ]
    write_raster(path, np.zeros((HEIGHT, WIDTH), np.uint8), gcps=gcps, crs="EPSG:4326")


def _write_terrain(path: Path) -> None:
    heights = np.random.default_rng(3).normal(100.0, 20.0, (30, 30)).astype(np.float32)
    transform = rasterio.Affine(0.01, 0, 102.85, 0, -0.01, 0.15)
    write_raster(path, heights, crs="EPSG:4326", transform=transform, nodata=-32768)


def _write_result(result: Path) -> None:
    (result / "sightings").mkdir(parents=True)
    content = {"quaternion": [0.5, -0.5, 0.5, 0.5], "theta_rad": [1e-3, 2e-3, 3e-3], "version": "0.1.0"}
    content |= {"covariance_rad2": np.diag([1e-12, 1e-12, 1e-11]).tolist()}
    content |= {"settings": {"run": {"exposure_margin_s": 1.0}}}
    (result / "installation.json").write_text(json.dumps(content))
    matrices = {"R_si": np.eye(3), "covariance_s": 1e-12 * np.eye(3)}
    exposures = {"exposure_id": ["e1", "e2"], "t_s": [0.0, 20.0], "usable": [True, True]}
    exposures |= {name: fixed_list(np.tile(one, (2, 1, 1))) for name, one in matrices.items()}
    pq.write_table(pa.table(exposures), result / "sightings/exposures.parquet", write_page_checksum=True)
    R_cs = Rotation.from_quat([0.5, -0.5, 0.5, 0.5])
    pair = InformationPairs(np.array(["s1"]), 1e12 * np.eye(3)[None], np.zeros((1, 3)), R_cs)
    pq.write_table(pairs_table(pair), result / "sightings/strips.parquet", write_page_checksum=True)


def _write_units(folder: Path) -> None:
    (folder / "run").mkdir()
    rng, store = np.random.default_rng(1), UnitStore(folder / "run" / "work")
    u = rng.normal(size=(9, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    hip, cov = np.arange(9) + 1, np.tile(1e-10 * np.eye(3), (9, 1, 1))
    stars = StarSightings(
        exposure_id="e1", t_s=1.0, hip=hip, xy_px=rng.uniform(0, 99, (9, 2)), u_s=u, u_i=u, cov_s=cov
    )
    store.write("exposures", "e1", "0" * 32, *table_from_record(stars))
    none = dict.fromkeys(("correlation", "probability_wrong"), np.zeros(0))
    none |= dict.fromkeys(("xy_px", "predicted_px"), np.zeros((0, 2)))
    none |= dict.fromkeys(("cov_px", "affine"), np.zeros((0, 2, 2)))
    none |= {"target_id": np.array([], dtype=str), "ccd": np.zeros(0, dtype=np.int64)}
    matched = MatchedTargets(strip_id="s1", pictures=(), omissions=(), **none)
    store.write("matching-1", "s1", "0" * 32, *table_from_record(matched))


def _dump(folder: Path) -> Any:
    return open_dump(folder / "dump")


def _plan(folder: Path) -> Any:
    with pytest.MonkeyPatch.context() as patch:  # of few example strips: it is only read
        patch.setattr(campaign_plan, "DRAWS", 1)
        patch.setattr(campaign_plan, "PLAN_DRAWS", 1)
        return campaign_plan.forecast_plan(read_plan(folder / "plan.toml"), 1.0)


def _pixels(folder: Path) -> Any:
    calibrated: Any = SimpleNamespace(dump=SimpleNamespace(line_camera=SimpleNamespace(n_ccds=2)))
    return read_pixels(folder / "pixels.csv", calibrated)


def _times(folder: Path, **where: Any) -> Any:
    return observers_of([folder / "sky.png"], Whereabouts(folder / "times.csv", **where))


def _times_aboard(folder: Path) -> Any:
    orbit = folder / "dump/orbit.oem"
    return observers_of([folder / "sky.png"], Whereabouts(folder / "times.csv", orbit))


def _strip(folder: Path) -> Any:
    path, (samples, lines) = folder / "dump/strips/0.tif", STRIP
    check_strip_file(path, "0.tif", lines=lines, samples=samples, bit_depth=8)
    return StripFiles({0: path}, {0: "0.tif"}, {0: (lines, samples)}).read(0, 10, 90, 5, 60)


def _chip_image(folder: Path) -> Any:
    return read_chip(ChipFile("t0", "chips/0.tif", folder / "dump/chips/0.tif"))


def _terrain(folder: Path) -> Any:
    files = TerrainFiles(("dem.tif",), (folder / "dump/dem.tif",), "ellipsoidal")
    surface = _read_terrain.__wrapped__(files, ())
    return surface.height_m(np.zeros(3), np.radians([102.9, 103.0, 103.1]))


def _sentinel2(folder: Path) -> Any:
    return read_sentinel2(folder / DATASTRIP, folder, "B04")


def _gipp(name: str) -> Callable[[Path], Any]:
    def read(folder: Path) -> Any:
        found = find_gipp_files(folder / name, SPAMOD)
        if SPAMOD not in found:
            raise RawDataError(name, "members", "another name", SPAMOD)
        return gipp_root(found[SPAMOD], SPAMOD)

    return read


def _result(folder: Path) -> Any:
    return read_saved_result(folder / "result")


def _star_unit(folder: Path) -> Any:
    table = UnitStore(folder / "run/work").read("exposures", "e1", "0" * 32)
    return None if table is None else record_from_table((StarSightings,), table, read_meta(table))


def _strip_unit(folder: Path) -> Any:
    table = UnitStore(folder / "run/work").read("matching-1", "s1", "0" * 32)
    return None if table is None else record_from_table((MatchedTargets,), table, read_meta(table))


EARTH = bundled_earth_orientation()
STAR_UNIT = PurePosixPath("run", "work", "exposures", f"e1.{'0' * 32}.parquet").as_posix()
STRIP_UNIT = PurePosixPath("run", "work", "matching-1", f"s1.{'0' * 32}.parquet").as_posix()


EPOCH = Epoch.from_utc("2024-11-20T03:40:00")
IN_FILE = (EPOCH, None, None)  # a message states its frame and the sense of its rotation
STATED = (EPOCH, "GCRF", "head to inertial")
POINT_ERRORS = PointErrors(sigma_px=0.3, sigma_m=(1.0, 1.0, 1.0), height_m=10.0)
SIDES = {"width": WIDTH, "height": HEIGHT}
DUMP_FILES = "dump star_camera remote_camera installation".split(), "exposures strips targets".split()
READERS = (
    *(Reader(f"{name}.toml", f"dump/{name}.toml", _dump) for name in DUMP_FILES[0]),
    *(Reader(f"{name}.csv", f"dump/{name}.csv", _dump) for name in DUMP_FILES[1]),
    of_named("orbit.oem", "dump/orbit.oem", read_oem),
    of_path("settings", "settings.toml", read_settings),
    Reader("scenario", "scenario.toml", lambda folder: named_scenario(str(folder / "scenario.toml"), [])),
    of_path("plan", "plan.toml", read_plan),
    Reader("plan, forecast", "plan.toml", _plan),
    of_path("centroids --truth", "truth.csv", _read_truth),
    Reader("identify --times", "times.csv", _times),
    Reader("identify --times --site", "times.csv", partial(_times, site_deg_m=(50.0, 8.0, 100.0))),
    Reader("identify --times --orbit", "times.csv", _times_aboard),
    Reader("identify --orbit", "dump/orbit.oem", _times_aboard),
    Reader("geolocate --pixels", "pixels.csv", _pixels),
    of_named("exposure, PNG", "sky.png", read_exposure, bit_depth=8, **SIDES),
    of_named("exposure, TIFF", "sky.tif", read_exposure, bit_depth=8, **SIDES),
    of_named("exposure, FITS", "sky.fits", read_exposure, bit_depth=16, **SIDES),
    of_named("star image, PNG", "deep.png", read_star_image),
    of_named("star image, colour PNG", "colour.png", read_star_image),
    of_named("star image, TIFF", "sky.tif", read_star_image),
    of_named("star image, FITS", "sky.fits", read_star_image),
    of_named("star image, JPEG", "sky.jpg", read_star_image),
    of_named("star image, BMP", "sky.bmp", read_star_image),
    Reader("strip, TIFF", "dump/strips/0.tif", _strip),
    Reader("chip, GeoTIFF", "dump/chips/0.tif", _chip_image),
    Reader("terrain, GeoTIFF", "dump/dem.tif", _terrain),
    of_path("DIMAP V1", "dimap.xml", read_dimap, EARTH, LightEffects()),
    of_path("DIMAP V2", "dimap2.xml", read_dimap, EARTH, LightEffects()),
    of_path("DIMAP V2, list", "dimap2_list.xml", read_dimap, EARTH, LightEffects()),
    of_named("attitudes, CSV", "attitudes.csv", read_attitudes, *STATED),
    of_named("attitudes, AEM", "attitudes.aem", read_attitudes, *IN_FILE),
    of_named("attitudes, ACM", "attitudes.acm", read_attitudes, *IN_FILE),
    of_named("attitudes, AEM in XML", "attitudes.xml", read_attitudes, *IN_FILE),
    of_named("centroids", "stars.csv", read_centroids),
    of_named("measured points", "points.csv", read_points, {}),
    of_path("points, QGIS", "gcps.points", read_measured_points, POINT_ERRORS),
    of_path("points, ASP", "gcps.gcp", read_measured_points, POINT_ERRORS),
    of_path("points, GeoTIFF", "gcps.tif", read_measured_points, POINT_ERRORS),
    Reader("Sentinel-2 datastrip", DATASTRIP, _sentinel2),
    Reader("Sentinel-2 mounting", f"{SPAMOD}.xml", _sentinel2),
    Reader("Sentinel-2 looks", f"{VIEDIR}.xml", _sentinel2),
    Reader("GIPP file, DBL", f"dbl/{SPAMOD}.DBL", _gipp("dbl")),
    Reader("GIPP files, tar", "gipp.tar", _gipp("gipp.tar")),
    Reader("GIPP files, tgz", "gipp.tgz", _gipp("gipp.tgz")),
    of_named("OEM 3.0", "third.oem", read_oem),
    of_named("OEM, segments", "segments.oem", read_segments),
    of_named("OEM, gzip", "orbit.oem.gz", read_oem),
    of_named("attitudes, AEM, gzip", "attitudes.aem.gz", read_attitudes, *IN_FILE),
    Reader("installation.json", "result/installation.json", _result),
    Reader("exposures.parquet", "result/sightings/exposures.parquet", _result),
    Reader("strips.parquet", "result/sightings/strips.parquet", lambda folder: read_pairs(folder / "result")),
    Reader("unit of an exposure", STAR_UNIT, _star_unit),
    Reader("unit of a strip", STRIP_UNIT, _strip_unit),
    Reader("status", STAR_UNIT, lambda folder: status_lines(run_status(folder / "run"))),
)

_TIMES = [f"2024-11-20T03:40:10.{n}" for n in range(3)]
_STATE = "<attitudeState><quaternionState><EPOCH>{}</EPOCH>"
_STATE += "<quaternion><Q1>0</Q1><Q2>0.6</Q2><Q3>0</Q3><QC>0.8</QC>"
_META = {"REF_FRAME_A": "ICRF", "REF_FRAME_B": "ST_1", "TIME_SYSTEM": "UTC", "ATTITUDE_TYPE": "QUATERNION"}
ATTITUDES = {
    "attitudes.csv": "utc,qx,qy,qz,qw,sigma_x_arcsec,sigma_y_arcsec,sigma_z_arcsec,valid\n"
    + "".join(f"{t},0,0.6,0,0.8,1,1,7,{int(n != 1)}\n" for n, t in enumerate(_TIMES)),
    "attitudes.aem": "CCSDS_AEM_VERS = 1.0\nMETA_START\n"
    + "".join(f"{key} = {value}\n" for key, value in _META.items())
    + "QUATERNION_TYPE = LAST\nATTITUDE_DIR = A2B\nMETA_STOP\nDATA_START\n"
    + "".join(f"{t} 0 0.6 0 0.8\n" for t in _TIMES)
    + "DATA_STOP\n",
    "attitudes.acm": "CCSDS_ACM_VERS = 2.0\nMETA_START\nTIME_SYSTEM = UTC\nEPOCH_TZERO = 2024-325T03:40:10\n"
    "META_STOP\nAD_START\nSENSOR_START\nSENSOR_NUMBER = 1\nSENSOR_STOP\nAD_STOP\nATT_START\n"
    "REF_FRAME_A = J2000\nREF_FRAME_B = ST_1\nATT_TYPE = QUATERNION\n"
    "0 0 0.6 0 0.8\n0.1 0 0.6 0 0.8\n0.2 0 0.6 0 0.8\nATT_STOP\n",
    "attitudes.xml": '<aem version="2.0"><body><segment><metadata>'
    + "".join(f"<{key}>{value}</{key}>" for key, value in _META.items())
    + "</metadata><data>"
    + "".join(_STATE.format(t) + "</quaternion></quaternionState></attitudeState>" for t in _TIMES)
    + "</data></segment></body></aem>",
}
POINTS = {
    "stars.csv": "file,x_px,y_px,sigma_x_px,sigma_y_px,cov_xy_px2,flux_dn,snr,saturated,blended"
    ",psf_sigma_px\n"
    "e.png,10.5,20.25,0.05,0.06,0.0001,300,40,False,False,1.1\ne.png,1,2,0.1,0.1,0,200,20,False,True,1.1\n",
    "points.csv": "id,strip,ccd,sample,line,sigma_sample_px,sigma_line_px,lat_deg,lon_deg,height_m"
    ",height_kind,sigma_east_m,sigma_north_m,sigma_up_m\np1,s1,0,12.5,30,0.3,0.3,1.5,103,20,ellipsoidal,1,1,2\n",
    "gcps.points": "#CRS: EPSG:4326\nmapX,mapY,sourceX,sourceY,enable,dX,dY,residual\n"
    "103,1.5,12.5,-30,1,0,0,0\n",
    "gcps.gcp": "# WKT: WGS84\n0 1.5 103 20 1 1 2 left.tif 12 30 0.5 0.5\n",
}
PLAN = """
[cameras]
star_from_zenith_deg = 15.0
star_focal_mm = 100.0
star_width_px = 5120
n_ccds = 4
[strips]
count = 8
duration_s = 1.8
exposures = 5
stars = 12
star_sigma_px = 0.06
height_km = 530.0
[targets]
count = 12
sigma_px = 0.3
across = [-1.0, 1.0]
along = [0.0, 1.0]
[errors]
position_m = 2.0
clock_s = 1e-4
"""
SETTINGS = """
[match]
template_px = 96
[run]
rounds = 3
exposure_margin_s = 1.5
[calibration]
sigma_clock_s = 2e-4
[stars]
false_alarms_per_frame = 0.1
gain_e_per_dn = 40.0
"""
SCENARIO = """
based_on = "mini"
name = "mine"
epoch_utc = "2024-11-20T03:40:00"
[orbit]
altitude_km = 530.0
descending = true
[strips]
count = 2
lines = 1000
[star_camera]
principal_px = [512.0, 384.0]
[line_camera]
distortion_um = [[5.0, 1077.2], [17.0, 866.3]]
[[attitude.waves]]
axis = "roll"
amplitude_arcsec = 8.0
period_s = 5.3
"""


PIECES = [
    *("nan", "-nan", "inf", "-inf", "-1", "0", "1e999", "-1e308", "5e-324", "9" * 400, "9" * 5000, "1_0"),
    *("٣", "", " ", "\n", "\r", "\r\n", "\t", "\x00", "\x1b[2J", "\ufeff", "\u202e", "é", "𝄞"),
    *("'", '"', '"""', "'''", *"[ ] [[ { } = , ; # . : < > & \\ / | %s %n .. ../".split()),
    *("/etc/passwd", "C:\\x", "file:///etc/passwd", "http://[", "~", "a." * 50, "[" * 300),
    *("true", "false", "null", "{}", "[]", "2024-13-45T99:99:99", "2016-12-31T23:59:60"),
    *("1971-01-01T00:00:00", "9999-12-31T23:59:59", "0001-01-01T00:00:00", "0x" + "f" * 5000, "<!DOCTYPE x>"),
    *("&a;", "<![CDATA[", "__import__('os')", "!!python/object", "=cmd|' /C calc'!A0", "${jndi:x}"),
    *("<script>", "COMMENT", "META_START"),
]  # fmt: skip
NUMBERS = (0, 1, 2, 7, 8, 15, 16, 127, 128, 255, 256, 32767, 32768, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1)


def mutated(chance: random.Random, sound: bytes, text: bool) -> bytes:
    """The file with one to five changes: of bytes, of numbers, of lines, or cut short."""
    raw = bytearray(sound)
    for _ in range(chance.choice((1, 1, 1, 2, 2, 3, 5))):
        change = chance.choice(_TEXT_CHANGES if text and chance.random() < 0.8 else _BYTE_CHANGES)
        change(chance, raw)
    if raw.startswith(b"\x89PNG") and chance.random() < 0.7:
        return with_checksums(bytes(raw))
    return bytes(raw)


def _set_byte(chance: random.Random, raw: bytearray) -> None:
    if raw:
        raw[chance.randrange(len(raw))] = chance.randrange(256)


def _flip_bit(chance: random.Random, raw: bytearray) -> None:
    if raw:
        raw[chance.randrange(len(raw))] ^= 1 << chance.randrange(8)


def _set_number(chance: random.Random, raw: bytearray) -> None:
    """A whole number of 2 or 4 bytes; headers come first, so early places are preferred."""
    size = chance.choice((2, 4))
    if len(raw) >= size:
        at = int((len(raw) - size) * chance.random() ** chance.choice((1, 4)))
        number = chance.choice(NUMBERS) % 256**size
        raw[at : at + size] = number.to_bytes(size, chance.choice(("little", "big")))


def _cut(chance: random.Random, raw: bytearray) -> None:
    del raw[chance.randrange(len(raw) + 1) :]


def _remove(chance: random.Random, raw: bytearray) -> None:
    at = chance.randrange(len(raw) + 1)
    del raw[at : at + chance.choice((1, 2, 4, 16, 100))]


def _repeat(chance: random.Random, raw: bytearray) -> None:
    at, length = chance.randrange(len(raw) + 1), chance.choice((1, 4, 30, 200))
    raw[at:at] = raw[at : at + length] * chance.choice((1, 2, 20))


def _insert(chance: random.Random, raw: bytearray) -> None:
    at = chance.randrange(len(raw) + 1)
    raw[at:at] = chance.randbytes(chance.choice((1, 2, 4, 40)))


def _hostile_piece(chance: random.Random, raw: bytearray) -> None:
    at = chance.randrange(len(raw) + 1)
    raw[at : at + chance.choice((0, 0, 1, 5))] = chance.choice(PIECES).encode("utf-8", "surrogatepass")


def _words(raw: bytearray) -> list[tuple[int, int]]:
    """Where words of letters, digits and the signs of numbers begin and end."""
    ends, begin = [], -1
    for at, byte in enumerate(raw):
        inside = chr(byte).isalnum() or byte in b"+-._"
        if inside and begin < 0:
            begin = at
        elif not inside and begin >= 0:
            ends.append((begin, at))
            begin = -1
    return ends


def _replace_word(chance: random.Random, raw: bytearray) -> None:
    if words := _words(raw):
        begin, end = chance.choice(words)
        other = chance.choice(words)
        piece = chance.choice((*PIECES, *map(str, NUMBERS))).encode()
        raw[begin:end] = piece if chance.random() < 0.7 else raw[other[0] : other[1]]


def _other_digit(chance: random.Random, raw: bytearray) -> None:
    if places := [at for at, byte in enumerate(raw) if byte in b"0123456789"]:
        raw[chance.choice(places)] = chance.choice(b"0123456789")


def _change_lines(chance: random.Random, raw: bytearray) -> None:
    lines = bytes(raw).split(b"\n")
    one, other = chance.randrange(len(lines)), chance.randrange(len(lines))
    how = chance.randrange(3)
    if how == 0:
        lines[one], lines[other] = lines[other], lines[one]
    elif how == 1:
        del lines[one]
    else:
        lines.insert(one, lines[other])
    raw[:] = b"\n".join(lines)


_BYTE_CHANGES = (_set_byte, _flip_bit, _set_number, _set_number, _cut, _remove, _repeat, _insert)
_TEXT_CHANGES = (_hostile_piece, _hostile_piece, _replace_word, _replace_word, _change_lines)
_TEXT_CHANGES = (*_TEXT_CHANGES, _other_digit, _other_digit)
