"""Measured image points of other programs as a points.csv: QGIS .points, ASP .gcp, GCPs inside a GeoTIFF.

QGIS and GDAL count from the corner of the first pixel, here and in ASP (0, 0) is its centre. QGIS states
neither heights nor errors, a GeoTIFF no errors; both are given by the caller.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import rasterio
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from boresight.geometry.constants import WGS84
from boresight.pipeline.console.arguments import option
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.content import check_extent, check_regular
from boresight.pipeline.files.dump_schema import PointRow
from boresight.pipeline.files.text_files import check_number, read_text
from boresight.pipeline.files.text_tables import csv_line
from boresight.records.record import Floats, array, record, scalar

__all__ = ["MeasuredPoints", "PointErrors", "asp_images", "points_csv", "read_measured_points"]

# Image coordinates of these formats begin at the corner of the first pixel, ours in its middle: half a
# pixel, px.
CORNER = 0.5
DATUM = "# WKT:"  # what ASP writes before the datum of its points
# Numbers of a point in ASP's order, without the image's name.
ASP_NUMBERS = "latitude,longitude,height,sigma 1,sigma 2,sigma 3,x,y,sigma x,sigma y".split(",")
# Most points of a file.
MOST_POINTS = 500_000


@record(kw_only=True)
class PointErrors:
    """What a file of points does not say."""

    sigma_px: float = option("1-sigma of the image positions, px.", 0.5, min=1e-4)
    sigma_m: tuple[float, float, float] = option(
        "1-sigma of the coordinates, m.", (1.0, 1.0, 1.0), metavar="EAST NORTH UP", min=0.0
    )
    height_m: float | None = option("Height of all points, m (QGIS has none).")


@record(kw_only=True)
class MeasuredPoints:
    """Points measured in one image. Row n of every array is the same point."""

    names: tuple[str, ...] = array("N", "ids")
    xy_px: Floats = array("N, 2", "(sample, line); (0, 0) is the centre of the first pixel")
    sigma_px: Floats = array("N, 2", "1-sigma")
    lat_lon_height: Floats = array("N, 3", "degrees, degrees, m")
    sigma_m: Floats = array("N, 3", "east, north, up")
    n_disabled: int = scalar("points that the file marks as not to be used", default=0)


def read_measured_points(path: Path, errors: PointErrors, image: str | None = None) -> MeasuredPoints:
    """The points of a file, by its ending: .points (QGIS), .gcp (ASP; `image` chooses one of several images),
    .tif or .tiff (GCPs of a GeoTIFF). `RawDataError` for anything missing or damaged.
    """
    readers = {".points": _qgis, ".gcp": _asp, ".tif": _geotiff, ".tiff": _geotiff}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise RawDataError(str(path), "ending", path.suffix or "none", f"one of {', '.join(readers)}")
    found = reader(path, str(path), errors, image)
    if not found.names:
        raise RawDataError(str(path), "points", "none", "at least one point that is to be used")
    return found


def asp_images(path: Path) -> tuple[str, ...]:
    """Names of the images in which the points of an ASP file are measured; none for other files."""
    if path.suffix.lower() != ".gcp":
        return ()
    words = _words(read_text(path, str(path)))
    return tuple(dict.fromkeys(Path(cell).name for _, cells in words for cell in cells[7::5]))


def points_csv(points: MeasuredPoints, strip: str, ccd: int, height_kind: str) -> str:
    """Text of a points.csv with these points in one CCD of a strip."""
    lines = [csv_line(PointRow.model_fields)]
    for n, name in enumerate(points.names):
        measured = [*points.xy_px[n].tolist(), *points.sigma_px[n].tolist()]
        place = [*points.lat_lon_height[n].tolist(), height_kind, *points.sigma_m[n].tolist()]
        lines.append(csv_line([name, strip, ccd, *measured, *place, ""]))  # no ground reference
    return "".join(line + "\n" for line in lines)


def _points(
    rows: Sequence[tuple[str, Sequence[float]]], file: str, errors: PointErrors, disabled: int = 0
) -> MeasuredPoints:
    """Rows of an id and sample, line, latitude, longitude, height; errors as given."""
    values = np.array([numbers for _, numbers in rows], dtype=float).reshape(len(rows), 5)
    if not np.isfinite(values).all():
        raise RawDataError(file, "points", "coordinates that are not finite", "numbers")
    return MeasuredPoints(
        names=tuple(name for name, _ in rows),
        xy_px=values[:, :2],
        sigma_px=np.full((len(rows), 2), errors.sigma_px),
        lat_lon_height=values[:, 2:],
        sigma_m=np.tile(errors.sigma_m, (len(rows), 1)),
        n_disabled=disabled,
    )


def _to_degrees(crs: str | None, file: str) -> Transformer:
    known = _crs(crs or "EPSG:4326", file, "CRS")
    with refusing(file, "CRS", "a system with a transformation to WGS 84", ProjError, found=known.name[:80]):
        return Transformer.from_crs(known, "EPSG:4326", always_xy=True)


def _crs(text: str, file: str, field: str) -> CRS:
    expected = "a coordinate reference system that PROJ knows"
    with refusing(file, field, expected, (CRSError, ProjError, TypeError), found=text[:80]):
        return CRS.from_user_input(text)


def _qgis(path: Path, file: str, errors: PointErrors, image: str | None) -> MeasuredPoints:
    if errors.height_m is None:
        raise RawDataError(file, "heights", "none in a QGIS file", "the option --height-m")
    lines = read_text(path, file).splitlines()
    head = next((line for line in lines if line.startswith("#CRS:")), None)
    to_degrees = _to_degrees(None if head is None else head.removeprefix("#CRS:").strip(), file)
    numbered = [one for one in enumerate(lines, start=1) if one[1].strip() and not one[1].startswith("#")]
    table = csv.DictReader(line for _, line in numbered)
    columns = {"x": ("sourceX", "pixelX"), "y": ("sourceY", "pixelY"), "X": ("mapX",), "Y": ("mapY",)}
    rows, disabled = [], 0
    with refusing(file, "text", "comma-separated values", csv.Error):
        for n, row in enumerate(table, start=1):
            if (row.get("enable") or "1").strip() == "0":
                disabled += 1
                continue
            where, number = f"line {numbered[table.line_num - 1][0]}", {}
            if None in row:  # cells beyond the header
                expected = f"{len(table.fieldnames or ())}, with points in numbers, as the header has"
                found = f"{len(table.fieldnames or ()) + len(row[None])} cells"
                raise RawDataError(file, where, found, expected)
            for key, names in columns.items():
                cell = next((row[name] for name in names if row.get(name) is not None), None)
                if cell is None:
                    raise RawDataError(file, where, f"no {names[0]}", f"a column {' or '.join(names)}")
                number[key] = check_number(cell, file, f"{where}, {names[0]}")
            lon, lat = to_degrees.transform(number["X"], number["Y"])
            place = (number["x"] - CORNER, -number["y"] - CORNER, lat, lon, errors.height_m)
            rows.append((f"p{n:05d}", place))
    return _points(rows, file, errors, disabled)


def _asp(path: Path, file: str, errors: PointErrors, image: str | None) -> MeasuredPoints:
    """Lines of: id, latitude, longitude, height, three sigmas, then image, x, y and their sigmas for each
    image.
    """
    names, numbers = [], []
    images: set[str] = set()
    text = read_text(path, file)
    _check_datum(text, file)
    for line, cells in _words(text):
        if len(cells) < 12 or (len(cells) - 7) % 5:
            raise RawDataError(file, line, f"{len(cells)} words", "7 of the point, then 5 for each image")
        for at in range(7, len(cells), 5):
            images.add(cells[at])
            if image is not None and Path(cells[at]).name != Path(image).name:
                continue
            words = zip(ASP_NUMBERS, (*cells[1:7], *cells[at + 1 : at + 5]))
            names.append(f"p{cells[0]}")
            numbers.append([check_number(word, file, f"{line}, {name}") for name, word in words])
    if len(images) > 1 and image is None:
        raise RawDataError(file, "images", ", ".join(sorted(images)[:4]), "the option --image, to choose one")
    values = np.array(numbers, dtype=float).reshape(len(names), 10)
    return MeasuredPoints(
        names=tuple(names),
        xy_px=values[:, 6:8],
        sigma_px=values[:, 8:10],
        lat_lon_height=values[:, :3],
        sigma_m=values[:, 3:6],
    )


def _check_datum(text: str, file: str) -> None:
    """`RawDataError` where a file's "# WKT:" is not of latitudes and longitudes on WGS 84."""
    for n, line in enumerate(text.splitlines(), start=1):
        if not line.startswith(DATUM):
            continue
        wkt = line.removeprefix(DATUM).strip()
        crs = _crs(wkt, file, f"line {n}, # WKT")
        axis_m = crs.ellipsoid.semi_major_metre if crs.ellipsoid else 0.0
        if not crs.is_geographic or abs(axis_m - WGS84.semi_major_m) > 1.0:
            expected = "latitudes and longitudes on WGS 84"
            raise RawDataError(file, f"line {n}, # WKT", f"{crs.name[:64]}, {crs.type_name}", expected)


def _words(text: str) -> Iterator[tuple[str, list[str]]]:
    for n, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield f"line {n}", line.replace(",", " ").split()


def _geotiff(path: Path, file: str, errors: PointErrors, image: str | None) -> MeasuredPoints:
    expected = "a GeoTIFF with ground control points"
    check_regular(path, file, expected)
    with refusing(file, "file", expected, (rasterio.errors.RasterioError, OSError, ValueError)):
        with rasterio.open(path, driver="GTiff") as opened:
            gcps, crs = opened.gcps
    check_extent(file, "points", (len(gcps),), MOST_POINTS, "points")
    to_degrees = _to_degrees(None if crs is None else crs.to_wkt(), file)
    rows = []
    for n, gcp in enumerate(gcps, start=1):
        lon, lat = to_degrees.transform(gcp.x, gcp.y)
        height = float(gcp.z or 0.0) if errors.height_m is None else errors.height_m
        rows.append((f"p{n:05d}", (gcp.col - CORNER, gcp.row - CORNER, lat, lon, height)))
    return _points(rows, file, errors)
