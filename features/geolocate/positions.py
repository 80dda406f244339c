"""Image points to latitude, longitude and height, with 1-sigma errors along and across the track.

The 1-sigma includes the errors of the installation matrix and of predicted Earth orientation, of the star
exposures' attitudes and of their interpolation, and those that the mission states: position, clock,
vibration, look distortion, heights of the terrain (`pipeline.results.place_errors`).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.terrain import Surface
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump_schema import PixelRow
from boresight.pipeline.files.text_files import read_table
from boresight.pipeline.results.place_errors import PassErrors, rest_of_common, variance_of_places
from boresight.pipeline.results.strip_model import Calibrated, StripModel
from boresight.records.record import Floats, Ints, array, record

__all__ = ["GroundPlaces", "Pixels", "ground_places", "places_csv", "read_pixels"]

AT_ONCE = 4096  # places whose errors are in memory together


@record
class Pixels:
    """N image points of one strip; (0, 0) is the centre of the first pixel."""

    ccd: Ints = array("N", "CCD of the camera, from 0")
    sample: Floats = array("N", "column")
    line: Floats = array("N", "row")


@record
class GroundPlaces:
    """Ground points of N pixels; NaN more than half a step outside the exposures, or where the line of sight
    meets no known ground.
    """

    lat_deg: Floats = array("N", "geodetic latitude")
    lon_deg: Floats = array("N", "longitude")
    height_m: Floats = array("N", "height above the WGS84 ellipsoid")
    sigma_along_m: Floats = array("N", "1-sigma along the track")
    sigma_across_m: Floats = array("N", "1-sigma across the track")


def read_pixels(path: Path, calibrated: Calibrated) -> Pixels:
    """Image points of a CSV file with the columns ccd, sample, line. `RawDataError` names line and column."""
    rows = read_table(path, PixelRow, str(path))
    n_ccds = calibrated.dump.line_camera.n_ccds
    for n, row in enumerate(rows):
        if row.ccd >= n_ccds:
            raise RawDataError(str(path), f"line {n + 2}, ccd", str(row.ccd), f"0 to {n_ccds - 1}")
    return Pixels(
        np.array([row.ccd for row in rows], dtype=np.int64),
        np.array([row.sample for row in rows], dtype=float),
        np.array([row.line for row in rows], dtype=float),
    )


def ground_places(
    calibrated: Calibrated, model: StripModel, pixels: Pixels, surface: Surface
) -> GroundPlaces:
    """Ground points and their 1-sigma. `RawDataError` for a pixel outside its CCD's image."""
    _check_inside(calibrated, model, pixels)
    n = len(pixels.line)
    p_e, sigma = np.full((n, 3), np.nan), np.full((n, 2), np.nan)
    t_s = model.pushbroom.instants_of_lines(pixels.ccd, pixels.line)
    terrain_m = calibrated.sigma_terrain_m
    errors = PassErrors.of(calibrated.result, calibrated.dump, model.strip, model.track, terrain_m)
    first_s, last_s = model.track.span_s  # as in matching: half a step beyond the exposures
    covered = (t_s >= first_s) & (t_s <= last_s)
    for ccd in np.unique(pixels.ccd[covered]).tolist():
        rows = np.flatnonzero(covered & (pixels.ccd == ccd))
        sample, line = pixels.sample[rows], pixels.line[rows]
        p_e[rows] = model.pushbroom.ground_points(ccd, sample, line, surface)
        sigma[rows] = _sigma(errors, t_s[rows], p_e[rows])
    lat, lon, height = geodetic_from_ecef(p_e)
    unknown = ~np.isfinite(p_e).all(axis=1)
    for values in (lat, lon, height):
        values[unknown] = np.nan
    return GroundPlaces(np.degrees(lat), np.degrees(lon), height, sigma[:, 0], sigma[:, 1])


def _check_inside(calibrated: Calibrated, model: StripModel, pixels: Pixels) -> None:
    strip, ccds = model.strip, pixels.ccd.tolist()
    if unknown := [n for n, ccd in enumerate(ccds) if ccd not in strip.ccd_lines]:
        expected = f"a CCD of strip {strip.strip_id}: {', '.join(map(str, sorted(strip.ccd_lines)))}"
        raise RawDataError("pixels", f"point {unknown[0] + 1}, ccd", ccds[unknown[0]], expected)
    samples = np.array([ccd.n_px for ccd in calibrated.dump.line_camera.ccds])[pixels.ccd]
    lines = np.array([strip.ccd_lines[ccd] for ccd in ccds], dtype=np.int64)
    for name, values, counts in (("sample", pixels.sample, samples), ("line", pixels.line, lines)):
        outside = np.flatnonzero(~((values >= -0.5) & (values <= counts - 0.5)))
        if len(outside):
            n = int(outside[0])
            expected = f"-0.5 to {counts[n] - 0.5}, inside the image of CCD {pixels.ccd[n]}"
            raise RawDataError("pixels", f"point {n + 1}, {name}", f"{values[n]:g}", expected)


def places_csv(pixels: Pixels, places: GroundPlaces) -> Iterator[str]:
    """Lines of a CSV file: pixels and their ground points; cells are empty where a value is not known."""
    yield "ccd,sample,line,lat_deg,lon_deg,height_m,sigma_along_m,sigma_across_m\n"
    for n in range(len(pixels.line)):
        cells = [str(pixels.ccd[n]), repr(float(pixels.sample[n])), repr(float(pixels.line[n]))]
        values = (
            (places.lat_deg[n], ".10f"),
            (places.lon_deg[n], ".10f"),
            (places.height_m[n], ".3f"),
            (places.sigma_along_m[n], ".3f"),
            (places.sigma_across_m[n], ".3f"),
        )
        cells += [format(value, form) if np.isfinite(value) else "" for value, form in values]
        yield ",".join(cells) + "\n"


def _sigma(errors: PassErrors, t_s: Floats, p_e: Floats) -> Floats:
    """1-sigma (N, 2) along and across the track, m, of ground points (N, 3) seen at instants (N,)."""
    dump = errors.dump
    rest = rest_of_common(errors.result, dump, [errors.in_matrix])
    parts = [slice(n, n + AT_ONCE) for n in range(0, len(t_s), AT_ONCE)]
    return np.sqrt(np.concatenate([variance_of_places(errors.at(t_s[at], p_e[at]), rest) for at in parts]))
