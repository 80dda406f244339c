"""A dump made of arrays and tables in memory, or of what is computed when it is asked for.

It is written as a folder, one image at a time, and opened like any other dump (docs/design.md says why).
"""

from __future__ import annotations

import atexit
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
import rasterio
from numpy.typing import ArrayLike, NDArray
from rasterio.crs import CRS
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import Affine

from boresight.accepted import (
    PathLike,
    RotationLike,
    count_of,
    floats_of,
    instance_of,
    listed,
    new_folder_of,
    number_of,
    rotation_of,
    utc_of,
    wrong,
)
from boresight.geometry.line_camera import LineCamera
from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.dump_schema import FILES, head_of_dump
from boresight.pipeline.files.oem_text import orbit_message
from boresight.pipeline.files.remote_camera import remote_camera_table
from boresight.pipeline.files.star_side import star_camera_table
from boresight.pipeline.files.text_tables import write_csv, write_toml
from boresight.pipeline.files.whole_file import is_vacant
from boresight.version import __version__

__all__ = ["Table", "dump_from_arrays"]

Table: TypeAlias = pd.DataFrame | Iterable[Mapping[str, Any]]

PLACE = ("lat_deg", "lon_deg", "height_m", "height_kind", "sigma_east_m", "sigma_north_m", "sigma_up_m")
MEASURED = ("id", "strip", "ccd", "sample", "line", "sigma_sample_px", "sigma_line_px", *PLACE)
ORBIT = ("time", "x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")
FRAMES = ("ITRF", "GCRF", "EME2000")
DEGREE = 7  # of the polynomial between states of the orbit
FEWEST_STATES = 8
HEIGHT_KINDS = ("ellipsoidal", "egm96")


def dump_from_arrays(
    *,
    star_camera: StarCamera,
    remote_camera: LineCamera,
    R_cs0: RotationLike,
    sigma_R_cs0_rad: ArrayLike,
    orbit: Table,
    exposures: Table,
    strips: Table,
    targets: Table | None = None,
    points: Table | None = None,
    errors: Mapping[str, float],
    terrain: tuple[ArrayLike, Sequence[float], str] | None = None,
    terrain_height_kind: str = "ellipsoidal",
    terrain_sigma_m: float = 0.0,
    orbit_frame: str = "ITRF",
    star_bits: int | None = None,
    remote_bits: int | None = None,
    mission: str = "arrays",
    out: PathLike | None = None,
) -> Dump:
    """A dump of images, strips, targets and orbit given as arrays and tables, ready for `calibrate`.

    Tables are DataFrames or sequences of mappings, with columns as in docs/dump-format.md; times are UTC
    texts, datetimes or astropy Times. An image is an array of uint8 or uint16, anything that NumPy can make
    one of (dask, xarray), or a function without arguments that returns one; images are written one at a time.

    Parameters
    ----------
    star_camera, remote_camera : StarCamera, LineCamera
        Models of the two cameras.
    R_cs0 : Rotation, or (3, 3) matrix
        Installation matrix before launch, star camera to remote-sensing camera.
    sigma_R_cs0_rad : (3,) array or float
        1-sigma of its error about the axes of the remote-sensing camera, rad: targets are searched within 3.
    orbit : table
        At least 8 rows of time, x_m, y_m, z_m, vx_m_s, vy_m_s, vz_m_s in `orbit_frame`.
    exposures : table
        Rows of time (middle), exposure_s, image (height, width), and id (default: e0001, e0002, ...).
    strips : table
        Rows of id, ccd, time (of line 0), row_period_s, image (lines, samples), and kind (default: ground).
    targets : table, optional
        Rows of id, lat_deg, lon_deg, height_m, height_kind, sigma_east_m, sigma_north_m, sigma_up_m, chip (an
        image, also floating), chip_affine (a, b, c, d, e, f of x = a column + b row + c, y = d column + e row
        + f, from the corner of the first pixel) and chip_crs ("EPSG:32648").
    points : table, optional
        Measured image points, columns as points.csv; strips may then have an image of None and `lines`.
    errors : mapping
        1-sigma errors of the mission: position_m, clock_s, vibration_arcsec, look_distortion_px,
        look_distortion_length_px.
    terrain : (heights, affine, crs), optional
        Heights (rows, columns) in m, their affine transform and reference system, as for chips.
    terrain_height_kind : str
        "ellipsoidal" or "egm96".
    terrain_sigma_m : float
        1-sigma of the heights, m.
    orbit_frame : str
        "ITRF" (velocities relative to the rotating Earth), "GCRF" or "EME2000".
    star_bits, remote_bits : int, optional
        Bits in use of a count, 8 to 16; default: 8 for images of uint8. To be given for uint16.
    mission : str
        Name of the mission.
    out : path, optional
        Folder of the dump, new or empty; default: a temporary one that ends with the process.

    Returns
    -------
    Dump
        What `open_dump` gives; `dump.root` is the folder.

    Raises
    ------
    ValueError
        If an argument or a cell of a table is not as described.
    RawDataError
        If a value is outside its range; the message names the file of the dump, field, found and expected.

    Examples
    --------
    See docs/bring-your-own-mission.md.
    """
    folder = _new_folder(out)
    camera = instance_of(star_camera, StarCamera, "star_camera")
    line_camera = instance_of(remote_camera, LineCamera, "remote_camera")
    R_cs = rotation_of(R_cs0, "R_cs0")
    sigma = _three(sigma_R_cs0_rad)
    if not isinstance(errors, Mapping):
        raise wrong("errors", errors, "a mapping of 1-sigma errors")
    if orbit_frame not in FRAMES:
        raise wrong("orbit_frame", orbit_frame, " or ".join(FRAMES))
    if targets is None and points is None and not _has_sky(strips):
        raise wrong("targets, points", "neither of them", "targets, points or strips of kind sky")
    for name in ("exposures", "strips", "chips", "terrain"):
        (folder / name).mkdir(parents=True)
    files = dict(FILES)
    bits = _write_exposures(folder, _rows(exposures, "exposures"), star_bits)
    write_toml(folder / files["star_camera"], star_camera_table(camera, bits))
    bits = _write_strips(folder, _rows(strips, "strips"), remote_bits)
    write_toml(folder / files["remote_camera"], remote_camera_table(line_camera, bits))
    mounting = {"quaternion_cs": R_cs.as_quat(canonical=True).tolist(), "sigma_rad": sigma}
    write_toml(folder / files["installation"], mounting)
    name = instance_of(mission, str, "mission")
    (folder / files["orbit"]).write_text(_orbit_text(name, orbit_frame, orbit), encoding="utf-8")
    if targets is not None:
        files["targets"] = "targets.csv"
        _write_targets(folder, _rows(targets, "targets"))
    if points is not None:
        files["points"] = "points.csv"
        rows = [[_cell(row, key, "points", n) for key in MEASURED] for n, row in _numbered(points, "points")]
        write_csv(folder / "points.csv", MEASURED, rows)
    head = head_of_dump(name, f"boresight {__version__}: dump_from_arrays")
    if terrain is not None:
        files["terrain"] = "terrain/dem.tif"
        head["terrain"] = _terrain(folder, terrain, terrain_height_kind, terrain_sigma_m)
    stated = {str(key): number_of(v, f"errors, {key}") for key, v in errors.items()}
    head |= {"files": files, "errors": stated}
    write_toml(folder / "dump.toml", head)  # last: a dump with a dump.toml is complete
    return open_dump(folder)


def _new_folder(out: PathLike | None) -> Path:
    if out is None:
        folder = Path(tempfile.mkdtemp(prefix="boresight-dump-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        return folder
    folder = new_folder_of(out, "out")
    if not is_vacant(folder):
        raise wrong("out", f"{folder}, which holds files", "a new or empty folder")
    return folder


def _three(sigma: ArrayLike) -> list[float]:
    values = floats_of(sigma, "sigma_R_cs0_rad", "(3,)")
    if values.shape not in ((), (3,)) or not (np.isfinite(values).all() and (values > 0.0).all()):
        raise wrong("sigma_R_cs0_rad", sigma, "a number or three, above 0, rad")
    return [float(value) for value in np.broadcast_to(values, 3)]


def _rows(table: Table, name: str) -> list[Mapping[str, Any]]:
    """A table as mappings, one a row."""
    if isinstance(table, pd.DataFrame):
        rows: list[Any] = [dict(zip(table.columns, values)) for values in table.itertuples(index=False)]
    elif isinstance(table, str | bytes | Mapping):
        raise wrong(name, table, "a DataFrame or a sequence of mappings")
    else:
        rows = listed(table, name, "mappings, or a DataFrame")
    for n, row in enumerate(rows):
        if not isinstance(row, Mapping):
            raise wrong(f"{name}, row {n}", row, "a mapping of columns")
    if not rows:
        raise wrong(name, "no rows", "at least one")
    return rows


def _numbered(table: Table, name: str) -> Iterable[tuple[int, Mapping[str, Any]]]:
    return enumerate(_rows(table, name))


def _cell(row: Mapping[str, Any], key: str, name: str, n: int) -> Any:
    if key not in row:
        raise wrong(f"{name}, row {n}", f"columns {', '.join(map(str, row))}", f"also {key}")
    return row[key]


def _has_sky(strips: Table) -> bool:
    return not isinstance(strips, pd.DataFrame) or bool((strips.get("kind", pd.Series()) == "sky").any())


def _image(value: Any, name: str) -> NDArray[Any]:
    """An image (H, W) of integers, computed now where it is a function."""
    pixels = np.asarray(value() if isinstance(value, Callable) else value)  # type: ignore[arg-type]
    if pixels.ndim != 2 or pixels.dtype not in (np.uint8, np.uint16) or not pixels.size:
        raise wrong(name, pixels, "raw counts (rows, columns) of type uint8 or uint16")
    return pixels


def _bits(stated: int | None, types: set[Any], name: str) -> int:
    if stated is not None:
        return count_of(stated, name, 8, 16)
    if types - {np.dtype(np.uint8)}:
        raise wrong(name, "None", "the bits in use, 9 to 16, of images of uint16")
    return 8 if types else 0


def _write_tiff(path: Path, pixels: NDArray[Any], **options: Any) -> None:
    height, width = pixels.shape
    tiles = {"tiled": True, "blockxsize": 256, "blockysize": 256} if min(pixels.shape) > 256 else {}
    profile = {"driver": "GTiff", "height": height, "width": width, "count": 1, "dtype": pixels.dtype.name}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", **profile, **tiles, compress="deflate", **options) as file:
            file.write(pixels, 1)


def _stored(pixels: NDArray[Any], bits: int) -> NDArray[Any]:
    """Counts in the type that the format has for their bits."""
    return pixels.astype(np.uint16) if bits > 8 else pixels


def _write_exposures(folder: Path, rows: Sequence[Mapping[str, Any]], stated: int | None) -> int:
    lines, types = [], set()
    for n, row in enumerate(rows):
        at = f"exposures, row {n}"
        name = str(row.get("id", f"e{n + 1:04d}"))
        file = f"exposures/{n + 1:05d}.tif"
        pixels = _image(_cell(row, "image", "exposures", n), f"{at}, image")
        types.add(pixels.dtype)
        _write_tiff(folder / file, _stored(pixels, stated or 8))
        instant = utc_of(_cell(row, "time", "exposures", n), f"{at}, time")
        lines.append([name, file, instant, number_of(_cell(row, "exposure_s", "exposures", n), at)])
    write_csv(folder / "exposures.csv", ["id", "file", "utc_mid", "exposure_s"], lines)
    return _bits(stated, types, "star_bits")


def _write_strips(folder: Path, rows: Sequence[Mapping[str, Any]], stated: int | None) -> int:
    lines, types = [], set()
    for n, row in enumerate(rows):
        at = f"strips, row {n}"
        ccd = count_of(_cell(row, "ccd", "strips", n), f"{at}, ccd")
        file, image = "", _cell(row, "image", "strips", n)
        if image is None:
            count = count_of(_cell(row, "lines", "strips", n), f"{at}, lines")
        else:
            file = f"strips/{n + 1:05d}.tif"
            pixels = _image(image, f"{at}, image")
            types.add(pixels.dtype)
            count = len(pixels)
            _write_tiff(folder / file, _stored(pixels, stated or 8))
        instant = utc_of(_cell(row, "time", "strips", n), f"{at}, time")
        period = number_of(_cell(row, "row_period_s", "strips", n), f"{at}, row_period_s")
        name, kind = str(_cell(row, "id", "strips", n)), str(row.get("kind", "ground"))
        lines.append([name, ccd, file, instant, repr(period), count, kind])
    columns = ["id", "ccd", "file", "utc_first_row", "row_period_s", "lines", "kind"]
    write_csv(folder / "strips.csv", columns, lines)
    return _bits(stated, types, "remote_bits")


def _write_targets(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    lines = []
    for n, row in enumerate(rows):
        at, file = f"targets, row {n}", f"chips/{n + 1:05d}.tif"
        given = _cell(row, "chip", "targets", n)
        pixels = np.asarray(given() if isinstance(given, Callable) else given)  # type: ignore[arg-type]
        if pixels.ndim != 2 or pixels.dtype.kind not in "uif" or not pixels.size:
            raise wrong(f"{at}, chip", pixels, "grey values (rows, columns)")
        if pixels.dtype not in (np.uint8, np.uint16):
            pixels = pixels.astype(np.float32)
        affine, crs = _cell(row, "chip_affine", "targets", n), _cell(row, "chip_crs", "targets", n)
        _write_tiff(folder / file, pixels, **_georeference(affine, crs, at))
        lines.append([_cell(row, "id", "targets", n), *(_cell(row, k, "targets", n) for k in PLACE), file])
    write_csv(folder / "targets.csv", ["id", *PLACE, "chip"], lines)


def _georeference(affine: Any, crs: Any, at: str) -> dict[str, Any]:
    numbers = floats_of(listed(affine, f"{at}, affine", "six numbers")[:6], f"{at}, affine", "(6,)")
    if numbers.shape != (6,) or not np.isfinite(numbers).all():
        raise wrong(f"{at}, affine", affine, "six finite numbers a, b, c, d, e, f")
    try:
        return {"transform": Affine(*numbers.tolist()), "crs": CRS.from_user_input(crs)}
    except Exception as error:  # of PROJ and GDAL
        raise wrong(f"{at}, crs", crs, f'a reference system such as "EPSG:32648" ({error})') from error


def _terrain(folder: Path, terrain: Any, height_kind: str, sigma_m: float) -> dict[str, Any]:
    """Write the heights; the table [terrain] of the dump."""
    if not isinstance(terrain, Sequence) or isinstance(terrain, str) or len(terrain) != 3:
        raise wrong("terrain", terrain, "(heights, affine, crs)")
    if height_kind not in HEIGHT_KINDS:
        raise wrong("terrain_height_kind", height_kind, " or ".join(HEIGHT_KINDS))
    heights = floats_of(terrain[0], "terrain, heights", "(rows, columns)")
    if heights.ndim != 2 or not heights.size:
        raise wrong("terrain, heights", heights, "shape (rows, columns)")
    place = _georeference(terrain[1], terrain[2], "terrain")
    _write_tiff(folder / "terrain" / "dem.tif", heights.astype(np.float32), nodata=float("nan"), **place)
    return {"height_kind": height_kind, "sigma_m": number_of(sigma_m, "terrain_sigma_m", 0.0)}


def _orbit_text(mission: str, frame: str, orbit: Table) -> str:
    rows = _rows(orbit, "orbit")
    if len(rows) < FEWEST_STATES:
        raise wrong("orbit", f"{len(rows)} states", f"at least {FEWEST_STATES}")
    utc = [utc_of(_cell(row, "time", "orbit", n), f"orbit, row {n}, time") for n, row in enumerate(rows)]
    states = [
        [number_of(_cell(row, key, "orbit", n), f"orbit, row {n}, {key}") for key in ORBIT[1:]]
        for n, row in enumerate(rows)
    ]
    numbers = np.array(states)
    name = "".join(letter if letter.isalnum() else "-" for letter in mission.upper()) or "ARRAYS"
    return orbit_message(name, frame, ("lagrange", DEGREE), utc, numbers[:, :3], numbers[:, 3:])
