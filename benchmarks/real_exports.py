"""Every number that leaves is right for a camera whose detectors begin at different times: Sentinel-2A.

Two bands are imported with the operator's refined attitude and its location grid as measured points, and
calibrated. By the command line alone

1. `geolocate` gives places of all grid rows, against the operator's, with its interpolation and with ours,
   and by both raw star trackers, whose errors are to be as stated;
2. every export is read back by a chain of its own (GDAL for RPCs; the USGS line scanner for ISDs; SPICE for
   the CK; text, ERFA and an ellipsoid for messages and lists) and compared with `geolocate`, in pixels.

The data (`../shared/data/sentinel2`) are not part of the project: without them the script says so and stops.
5 minutes of CPU time.

    python benchmarks/real_exports.py [--folder DATA]
"""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path

import erfa
import numpy as np
import spiceypy
from rasterio.rpc import RPC
from rasterio.transform import RPCTransformer
from real_sentinel2 import BULLETIN, grid_of, imported, places_e, points_csv, real_folder
from record import exit_status, head, judge_largest, verdict
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "features" / "exports"))
from line_scanner import LineScanner

from boresight.features.operators.sentinel2_product import read_sentinel2
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import ecef_from_geodetic
from boresight.geometry.geoid import egm96
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.orbit_and_earth import read_earth_orientation
from boresight.pipeline.files.stated_noise import state_noise
from boresight.pipeline.head_noise.of_dump import noise_of_heads
from boresight.pipeline.run.settings import Settings

PIXEL_M = 10.0
A, B = WGS84.semi_major_m, WGS84.semi_minor_m
Pixel = tuple[int, float, float]  # detector from 0, sample, line


def boresight(*arguments: object) -> str:
    """Standard output of a command; what it says on failure is printed."""
    ran = subprocess.run(
        [sys.executable, "-m", "boresight", *map(str, arguments)], capture_output=True, text=True
    )
    if ran.returncode not in (0, 5):  # 5: findings
        print(ran.stdout + ran.stderr)
    return ran.stdout


def geolocated(work: Path, result: Path, band: str, pixels: list[Pixel], name: str) -> np.ndarray:
    """ITRS places (N, 3) that `geolocate` gives."""
    table = work / f"{name}.csv"
    rows = [f"{ccd},{sample!r},{line!r}\n" for ccd, sample, line in pixels]
    table.write_text("ccd,sample,line\n" + "".join(rows))
    out = work / f"{name}_places.csv"
    boresight("geolocate", result, "--strip", band, "--pixels", table, "--out", out)
    read = np.genfromtxt(out, delimiter=",", names=True)
    return ecef_from_geodetic(
        np.radians(read["lat_deg"]), np.radians(read["lon_deg"]), read["height_m"], WGS84
    )


def calibrated(work: Path, real: Path, band: str, interpolation: str) -> Path:
    """The result of `import` and `calibrate`."""
    strip = read_sentinel2(next(real.glob("*MTD_L1B_DS*.xml")), real, band)
    (work / "points.csv").write_text(points_csv(strip, grid_of(real, band)))
    dump, result = work / f"{band}-{interpolation}", work / f"{band}-{interpolation}-result"
    options = ("--band", band, "--attitudes", "refined", "--points", work / "points.csv")
    table = ("--earth-orientation", work / "bulletin.csv")
    datastrip = next(real.glob("*MTD_L1B_DS*.xml"))
    boresight("import", "sentinel2", datastrip, dump, "--gipp", real, *options, *table)
    text = (dump / "dump.toml").read_text()
    (dump / "dump.toml").write_text(text.replace('"taylor"', f'"{interpolation}"'))
    boresight("calibrate", dump, "--out", result, "--quiet")
    return result


def against_grid(work: Path, real: Path, band: str, interpolation: str, limit_m: float) -> Path:
    """`geolocate` of the rows of the operator's grid."""
    result, grid = calibrated(work, real, band, interpolation), grid_of(real, band)
    pixels = [(int(row[0]) - 1, float(row[2]), float(row[1]) - 1.0) for row in grid]
    off = np.linalg.norm(geolocated(work, result, band, pixels, "grid") - places_e(grid), axis=1)
    for name, here in (("odd", grid[:, 0] % 2 == 1), ("even", grid[:, 0] % 2 == 0)):
        largest = float(off[here].max())
        text = f"`geolocate` to the operator's grid, {band}, {interpolation}, {name} detectors: largest"
        judge_largest(text, 1e3 * largest, 1e3 * limit_m, "mm", int(here.sum()))
    return result


def by_raw_trackers(work: Path, real: Path, band: str, gyro: bool) -> None:
    """`geolocate` of the rows of the operator's grid by the raw records of both trackers; orbit and looks are
    the operator's, so that their stated errors are left out.
    """
    strip, grid = read_sentinel2(next(real.glob("*MTD_L1B_DS*.xml")), real, band), grid_of(real, band)
    name = f"{band}, raw trackers {'with' if gyro else 'without'} gyro"
    table = read_earth_orientation(work / "bulletin.csv", "bulletin.csv")
    dump = imported(work / name, [strip], "raw", points_csv(strip, grid), table, exact=False)
    text = (dump / "dump.toml").read_text()
    text = re.sub(r"(?m)^(position_m|clock_s|vibration_arcsec|look_distortion_px) = .*$", r"\1 = 0.0", text)
    (dump / "dump.toml").write_text(text if gyro else re.sub(r"(?s)\[gyro\].*?(?=\[errors\])", "", text))
    noise = noise_of_heads(open_dump(dump), Settings())
    state_noise(dump, dict(zip(noise.names, noise.fit.heads)))
    boresight("calibrate", dump, "--out", work / f"{name}-result", "--quiet")
    pixels = [(int(row[0]) - 1, float(row[2]), float(row[1]) - 1.0) for row in grid]
    off = geolocated(work, work / f"{name}-result", band, pixels, name) - places_e(grid)
    stated = np.genfromtxt(work / f"{name}_places.csv", delimiter=",", names=True)
    stated2 = stated["sigma_along_m"] ** 2 + stated["sigma_across_m"] ** 2
    distance = np.linalg.norm(off, axis=1)
    for detector in np.unique(grid[:, 0]):
        here = grid[:, 0] == detector
        rms = float(np.sqrt(np.mean(distance[here] ** 2)))
        judge_largest(f"{name}, detector {detector:.0f}: rms", rms, 3.0, "m", int(here.sum()))
    judge_largest(f"{name}: largest", float(distance.max()), 8.0, "m", len(grid))
    # One draw of errors that go on over the strip: as some ten independent ones, 0.3 to 2.2.
    ratio = float(np.mean(distance**2) / np.mean(stated2))
    verdict(f"{name}: {ratio:.2f} of the stated variance", "0.3 to 2.2", 0.3 < ratio < 2.2, len(grid))


class Chain:
    """Pixel to ground from the texts of a dump: states, look tables, ERFA's rotation, an ellipsoid."""

    def __init__(self, dump: Path) -> None:
        rows = [line.split() for line in (dump / "orbit.oem").read_text().splitlines() if line[:2] == "20"]
        values = 1e3 * np.array([[float(word) for word in row[1:]] for row in rows])
        self.zero = datetime.fromisoformat(rows[0][0][:26])
        self.orbit = CubicHermiteSpline(self.seconds([row[0] for row in rows]), values[:, :3], values[:, 3:])
        looks = np.loadtxt(dump / "looks.csv", delimiter=",", skiprows=1)
        self.looks = [looks[looks[:, 0] == ccd, 2:] for ccd in np.unique(looks[:, 0])]
        strips = list(csv.DictReader((dump / "strips.csv").open()))
        self.first_s = self.seconds([row["utc_first_row"] for row in strips])
        self.period_s = float(strips[0]["row_period_s"])

    def seconds(self, utc: list[str]) -> np.ndarray:
        """Of nanosecond texts; no leap second is near."""
        whole = [(datetime.fromisoformat(text[:19]) - self.zero).total_seconds() for text in utc]
        return np.array(whole) + np.array([float("0" + text[19:].rstrip("Z")) for text in utc])

    def instants(self, pixels: list[Pixel]) -> np.ndarray:
        """UTC seconds of the lines, each of its own detector."""
        return np.array([self.first_s[ccd] + line * self.period_s for ccd, _, line in pixels])

    def looks_of(self, pixels: list[Pixel]) -> np.ndarray:
        """Directions (N, 3) in the camera, at whole samples."""
        tangents = np.array([self.looks[ccd][round(sample)] for ccd, sample, _ in pixels])
        return np.column_stack([tangents, np.ones(len(pixels))])

    def to_e(self, t_s: np.ndarray) -> np.ndarray:
        """(N, 3, 3), GCRS to ITRS by ERFA's IAU 2006/2000A with the bulletin's values."""
        table = np.array([row.split(",") for row in BULLETIN.split()[1:]], dtype=float)
        out = []
        for t in t_s.tolist():
            moment = self.zero + timedelta(seconds=t)
            day, fraction = erfa.dtf2d(b"UTC", moment.year, moment.month, moment.day, 0, 0, 0.0)
            fraction += (moment.hour * 3600 + moment.minute * 60) / 86400.0
            fraction += (
                self.zero.second
                + self.zero.microsecond * 1e-6
                + t
                - ((moment.hour - self.zero.hour) * 3600 + (moment.minute - self.zero.minute) * 60)
            ) / 86400.0
            mjd = day - 2400000.5 + fraction
            ut1, x, y = (lagrange(table[:, 0], table[:, k], mjd) for k in (1, 2, 3))
            tt = erfa.taitt(*erfa.utctai(day, fraction))
            arcsec = np.pi / 648000.0
            out.append(erfa.c2t06a(*tt, *erfa.utcut1(day, fraction, ut1), x * arcsec, y * arcsec))
        return np.array(out)

    def places(self, pixels: list[Pixel], R_ic: np.ndarray, height_m: np.ndarray) -> np.ndarray:
        """ITRS places (N, 3) at ellipsoidal heights, for attitudes camera to GCRS (N, 3, 3)."""
        t_s = self.instants(pixels)
        u_e = np.einsum("nij,njk,nk->ni", self.to_e(t_s), R_ic, self.looks_of(pixels))
        return on_ellipsoid(self.orbit(t_s), u_e, height_m)


def lagrange(days: np.ndarray, values: np.ndarray, mjd: float) -> float:
    """Through the four days around a date, as the operator does."""
    near = slice(first := int(np.searchsorted(days, mjd)) - 2, first + 4)
    x, y = days[near], values[near]
    return float(sum(y[k] * np.prod([(mjd - m) / (x[k] - m) for m in x if m != x[k]]) for k in range(4)))


def on_ellipsoid(p: np.ndarray, u: np.ndarray, height_m: np.ndarray) -> np.ndarray:
    """Points of rays at geodetic heights, by Newton's method on the height."""
    u = u / np.linalg.norm(u, axis=1, keepdims=True)
    length = np.linalg.norm(p, axis=1) - 6.37e6
    for _ in range(20):
        lon, lat, height = erfa.gc2gde(A, 1.0 - B / A, p + length[:, None] * u)
        up = np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        length = length + (height_m - height) / np.einsum("ni,ni->n", up, u)
    return p + length[:, None] * u


def degrees(p_e: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Latitude and longitude, degrees, and height."""
    lon, lat, height = erfa.gc2gde(A, 1.0 - B / A, p_e)
    return np.degrees(lat), np.degrees(lon), height


def lists_of_points(exports: Path, band: str, n_ccds: int) -> Iterator[tuple[str, list[Pixel], np.ndarray]]:
    """Name of a format, its pixels, (0, 0) the middle of the first, and latitude, longitude, height."""
    found = json.loads((exports / "targets.geojson").read_text())["features"]
    about = [one["properties"] for one in found]
    pixels = [(one["ccd"], one["sample"], one["line"]) for one in about]
    yield "geojson", pixels, np.array([one["geometry"]["coordinates"] for one in found])[:, [1, 0, 2]]
    asp, envi, qgis = [], [], []
    for ccd in range(n_ccds):
        text = {end: (exports / f"{band}.ccd{ccd}.{end}").read_text() for end in ("gcp", "pts", "points")}
        for row in (line.split() for line in text["gcp"].splitlines() if line[0] != "#"):
            assert len(row) == 12 and row[7] == f"{band}.ccd{ccd}", row
            asp.append([ccd, float(row[8]), float(row[9]), *map(float, row[1:4])])
        for row in (line.split() for line in text["pts"].splitlines() if line[0] != ";"):
            lon, lat, height, x, y = map(float, row)
            height += float(egm96().undulation_m(np.radians([lat]), np.radians([lon]))[0])
            envi.append([ccd, x - 1.5, y - 1.5, lat, lon, height])
        for row in csv.DictReader(text["points"].splitlines()[1:]):
            x, y, lon, lat = (float(row[key]) for key in ("sourceX", "sourceY", "mapX", "mapY"))
            qgis.append([ccd, x - 0.5, -y - 0.5, lat, lon, np.nan])
    for name, rows in (("asp", asp), ("envi", envi), ("qgis", qgis)):
        yield name, [(row[0], row[1], row[2]) for row in rows], np.array(rows)[:, 3:]


def read_back(work: Path, result: Path, band: str) -> None:
    """Every export against `geolocate`."""
    exports = result / "exports"
    boresight("export", result, "--format", "rpc,csm-isd,asp,envi,qgis,geojson,aem,acm,spice,spice-ck")
    chain = Chain(work / result.name.removesuffix("-result"))
    known: dict[Pixel, np.ndarray] = {}
    for name, pixels, place in lists_of_points(exports, band, len(chain.looks)):
        rounded = [(ccd, round(sample, 3), round(line, 3)) for ccd, sample, line in pixels]
        seen = geolocated(work, result, band, rounded, name)
        known = dict(zip(pixels, seen)) if name == "geojson" else known
        heights = np.where(np.isfinite(place[:, 2]), place[:, 2], degrees(seen)[2])
        listed = ecef_from_geodetic(np.radians(place[:, 0]), np.radians(place[:, 1]), heights, WGS84)
        told(name, np.linalg.norm(listed - seen, axis=1) / PIXEL_M)
    rng = np.random.default_rng(2)
    pixels = [list(known)[n] for n in rng.choice(len(known), 300, replace=False)]
    seen = np.array([known[pixel] for pixel in pixels])
    height = degrees(seen)[2]
    for name, R_ic in attitudes(exports, band, chain, pixels):
        told(name, np.linalg.norm(chain.places(pixels, R_ic, height) - seen, axis=1) / PIXEL_M)
    miss = [
        nearest_m(LineScanner((exports / f"{band}.ccd{ccd}.json").read_text()), sample, line, place)
        for (ccd, sample, line), place in zip(pixels, seen)
    ]
    told("csm-isd", np.array(miss) / PIXEL_M)
    by_rpc(exports, band, pixels, seen)


def nearest_m(model: LineScanner, sample: float, line: float, place: np.ndarray) -> float:
    """Distance of a place from the line scanner's ray."""
    origin, direction = model.ray(line + 0.5, sample + 0.5)
    return float(np.linalg.norm(np.cross(place - origin, direction)))


def attitudes(
    exports: Path, band: str, chain: Chain, pixels: list[Pixel]
) -> Iterator[tuple[str, np.ndarray]]:
    """Name of a format and its attitudes, camera to GCRS (N, 3, 3), at the lines of pixels."""
    t_s = chain.instants(pixels)
    lines = (exports / f"{band}.aem").read_text().splitlines()
    rows = [one.split() for one in lines[lines.index("DATA_START") + 1 : lines.index("DATA_STOP")]]
    t, q = chain.seconds([row[0] for row in rows]), np.array([row[1:] for row in rows], dtype=float)
    yield "aem", Slerp(t, Rotation.from_quat(q))(t_s).as_matrix()
    lines = (exports / f"{band}.acm").read_text().splitlines()
    zero = next(line.split(" = ")[1] for line in lines if line.startswith("EPOCH_TZERO"))
    rows = [one.split() for one in lines[lines.index("ATT_TYPE = QUATERNION") + 1 : lines.index("ATT_STOP")]]
    states = np.array(rows, dtype=float)
    at = chain.seconds([zero])[0] + states[:, 0]
    yield "acm", Slerp(at, Rotation.from_quat(states[:, 1:]))(t_s).as_matrix()
    spiceypy.kclear()
    for kernel in ("installation.tf", "clock.tsc", "camera.ti", f"{band}.bc"):
        spiceypy.furnsh(str(exports / kernel))
    # UTC + 37 s + 32.184 s is TT; ephemeris time differs by 1.657 ms sin E (NAIF's leap-second kernel)
    tt = (chain.zero - datetime(2000, 1, 1, 12)).total_seconds() + t_s + 69.184
    M = 6.239996 + 1.99096871e-7 * tt
    et = tt + 1.657e-3 * np.sin(M + 1.671e-2 * np.sin(M))
    yield "spice-ck", np.array([spiceypy.pxform("BORESIGHT_REMOTE_CAMERA", "J2000", one) for one in et])
    spiceypy.kclear()


def by_rpc(exports: Path, band: str, pixels: list[Pixel], seen: np.ndarray) -> None:
    """GDAL's pixels of places, within the error that each RPC states."""
    lat, lon, height = degrees(seen)
    miss, stated = [], []
    for n, (ccd, sample, line) in enumerate(pixels):
        text = (exports / f"{band}.ccd{ccd}_RPC.TXT").read_text()
        values = dict(row.split(": ") for row in text.splitlines())
        numbers = {key: float(value.split()[0]) for key, value in values.items()}
        poly = {
            f"{a}_{b}_coeff": [numbers[f"{a}_{b}_COEFF_{k}".upper()] for k in range(1, 21)]
            for a in ("line", "samp")
            for b in ("num", "den")
        }
        single = {
            f"{a}_{b}": numbers[f"{a}_{b}".upper()]
            for a in ("line", "samp", "lat", "long", "height")
            for b in ("off", "scale")
        }
        with RPCTransformer(RPC(**single, **poly)) as gdal:
            row, column = gdal.rowcol([lon[n]], [lat[n]], zs=[height[n]], op=float)
        miss.append(np.hypot(column[0] - 0.5 - sample, row[0] - 0.5 - line))
        stated.append(numbers["ERR_RAND"])
    # A cubic does not follow the attitude of 22 s: the files' random error, m, contains it; pixels of 10 m.
    rms_m = 10.0 * float(np.sqrt(0.5 * np.mean(np.square(miss))))
    judge_largest(
        "export rpc, raw strip: rms over 1.1 of the stated", rms_m, 1.1 * max(stated), "m", len(miss)
    )


def told(name: str, miss_px: np.ndarray) -> None:
    """Verdict on one format."""
    largest = float(miss_px.max())
    judge_largest(f"export {name} read back: largest", largest, 0.01, "px", len(miss_px))


def main() -> int:
    """Print all figures; 1 where a limit is missed."""
    real = real_folder(__doc__) / "sentinel2"
    head("What leaves: places and exports of Sentinel-2A, detectors that begin at different times")
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        (work / "bulletin.csv").write_text(BULLETIN)
        print("1. `geolocate` against the operator's location grids")
        for band in ("B02", "B04"):
            result = against_grid(work, real, band, "taylor", 0.005)
            against_grid(work, real, band, "lagrange", 0.4)
            by_raw_trackers(work, real, band, gyro=True)
            by_raw_trackers(work, real, band, gyro=False)
        print("\n2. exports of B04 read back, against `geolocate`")
        read_back(work, result, band)
    return exit_status()


if __name__ == "__main__":
    sys.exit(main())
