"""A dump made of arrays and tables in memory, or of what is computed when it is asked for.

It is written as a folder, one image at a time, and opened like any other dump (docs/design.md says why).
"""

from __future__ import annotations

import atexit
import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from rasterio.crs import CRS
from rasterio.transform import Affine

from boresight import accepted, array_stars
from boresight.accepted import PathLike, Progress, RotationLike, Table, no_progress
from boresight.geometry.line_camera import LineCamera, LookAngleCamera
from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.dump_schema import FILES, head_of_dump
from boresight.pipeline.files.orbit_file import orbit_message
from boresight.pipeline.files.remote_camera import write_remote_camera
from boresight.pipeline.files.text_tables import write_csv, write_toml
from boresight.version import __version__

__all__ = ["dump_from_arrays", "orbit_text"]

# Columns of tables that are given: place of a target, point that others measured, state of the orbit.
PLACE = ("lat_deg", "lon_deg", "height_m", "height_kind", "sigma_east_m", "sigma_north_m", "sigma_up_m")
MEASURED = ("id", "strip", "ccd", "sample", "line", "sigma_sample_px", "sigma_line_px", *PLACE)
ORBIT = ("time", "x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")
FRAMES = ("ITRF", "GCRF", "EME2000")  # of the orbit's states
DEGREE = 7  # of the polynomial between states of the orbit
FEWEST_STATES = 8  # through which that polynomial passes
# Argument by the file of the dump that holds it.
ARGUMENTS = {file: argument for argument, file in FILES.items()} | {
    "installation.toml": "R_cs0, sigma_R_cs0_rad",
    "targets.csv": "targets",
    "points.csv": "points",
    "dump.toml": "errors",
    "terrain/dem.tif": "terrain",
}
HEIGHT_KINDS = ("ellipsoidal", "egm96")  # above the ellipsoid WGS84, or above this geoid


def dump_from_arrays(
    *,
    star_camera: StarCamera | None = None,
    remote_camera: LineCamera | LookAngleCamera,
    R_cs0: RotationLike,
    sigma_R_cs0_rad: ArrayLike,
    orbit: Table,
    exposures: Table | None = None,
    attitudes: Table | None = None,
    attitude_frame: str = "GCRF",
    attitude_rotation: str = "head to inertial",
    aberration_removed: str | None = None,
    line_of_sight_s: ArrayLike | None = None,
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
    progress: Progress = no_progress,
) -> Dump:
    """A dump of images, strips, targets and orbit given as arrays and tables, ready for `calibrate`.

    Tables are DataFrames or sequences of mappings, with columns as in docs/dump-format.md; times are UTC
    texts, datetimes or astropy Times. An image is an array of uint8 or uint16, anything that NumPy can make
    one of (dask, xarray), or a function without arguments that returns one; images are written one at a time.

    Parameters
    ----------
    star_camera : StarCamera
        Model of the star camera; with `attitudes` it is not used.
    remote_camera : LineCamera or LookAngleCamera
        Model of the remote-sensing camera, by its hardware or by look tables.
    R_cs0 : Rotation, or (3, 3) matrix
        Installation matrix before launch, star camera to remote-sensing camera.
    sigma_R_cs0_rad : (3,) array or float
        1-sigma of its error about the axes of the remote-sensing camera, rad: targets are searched within 3.
    orbit : table
        At least 8 rows of time, x_m, y_m, z_m, vx_m_s, vy_m_s, vz_m_s in `orbit_frame`.
    exposures : table
        Rows of time (middle), exposure_s, image (height, width), and id (default: e0001, e0002, ...). In
        place of images all rows may have `stars`: what `find_stars` returned, or a table of x_px, y_px,
        sigma_x_px, sigma_y_px, cov_xy_px2, flux_dn and, if known, snr, saturated, blended, psf_sigma_px.
    attitudes : table, optional
        In place of exposures: rows of time, qx, qy, qz, qw (scalar last) and the errors about the axes of the
        star camera, independent from row to row: sigma_x_arcsec, sigma_y_arcsec, sigma_z_arcsec, or
        cov_xx_arcsec2, cov_xy_arcsec2, cov_xz_arcsec2, cov_yy_arcsec2, cov_yz_arcsec2, cov_zz_arcsec2.
    attitude_frame : str
        Inertial axes of the quaternions: "GCRF", "ICRF" or "EME2000".
    attitude_rotation : str
        What the quaternions do with vectors: "head to inertial" or "inertial to head".
    aberration_removed : str
        With attitudes: "none", "annual" or "annual and orbital", as docs/dump-format.md says.
    line_of_sight_s : (3,) array, optional
        With attitudes: unit vector along the middle of the head's field of view, axes of the quaternions,
        (0, 0, 1) for z. The rest of the aberration is put right along it: needed where some is left.
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
    progress : callable, optional
        Called with the stage, the tasks done and all tasks; default: a bar in a notebook, else nothing.

    Returns
    -------
    Dump
        What `open_dump` gives; `dump.root` is the folder.

    Raises
    ------
    ValueError
        If an argument or a cell of a table is not as described.
    RawDataError
        If a value is outside its range; the message names the argument, its row, found and expected.

    Examples
    --------
    See docs/bring-your-own-mission.md.
    """
    folder, told = _new_folder(out), accepted.progress_of(progress)
    if not isinstance(remote_camera, LineCamera | LookAngleCamera):
        raise accepted.wrong("remote_camera", remote_camera, "a LineCamera or a LookAngleCamera")
    R_cs = accepted.rotation_of(R_cs0, "R_cs0")
    sigma = _three(sigma_R_cs0_rad)
    if not isinstance(errors, Mapping):
        raise accepted.wrong("errors", errors, "a mapping of 1-sigma errors")
    for key, bits in (("star_bits", star_bits), ("remote_bits", remote_bits)):
        if bits is not None:
            accepted.count_of(bits, key, 8, 16)
    if orbit_frame not in FRAMES:
        raise accepted.wrong("orbit_frame", orbit_frame, " or ".join(FRAMES))
    of_ground = isinstance(strips, pd.DataFrame) and not (strips.get("kind", pd.Series()) == "sky").any()
    if targets is None and points is None and of_ground:
        raise accepted.wrong("targets, points", "neither of them", "targets, points or strips of kind sky")
    if (exposures is None) == (attitudes is None):
        raise accepted.wrong("exposures, attitudes", "neither or both of them", "one of them")
    for name in ("exposures", "strips", "chips", "terrain"):
        (folder / name).mkdir(parents=True)
    if attitudes is not None:
        keys = array_stars.attitude_keys(
            attitude_frame, attitude_rotation, aberration_removed, line_of_sight_s
        )
        head_table = array_stars.write_attitudes(folder, attitudes) | keys
    else:
        head_table = array_stars.write_exposures(folder, star_camera, exposures, star_bits, told)  # type: ignore[arg-type]
    of_head = ("star_camera", "installation", "exposures") if head_table else ()
    files = {key: file for key, file in FILES.items() if key not in of_head}
    bits_used = _write_strips(folder, accepted.rows_of(strips, "strips"), remote_bits, told)
    write_remote_camera(folder, remote_camera, bits_used)
    mounting = {"quaternion_cs": R_cs.as_quat(canonical=True).tolist(), "sigma_rad": sigma}
    write_toml(folder / FILES["installation"], mounting)
    states = orbit_text(accepted.instance_of(mission, str, "mission"), orbit_frame, orbit)
    (folder / files["orbit"]).write_text(states, encoding="utf-8")
    if targets is not None:
        files["targets"] = "targets.csv"
        _write_targets(folder, accepted.rows_of(targets, "targets"), told)
    if points is not None:
        files["points"] = "points.csv"
        columns = accepted.values_by_column(accepted.rows_of(points, "points"), MEASURED, "points")
        write_csv(folder / "points.csv", MEASURED, list(zip(*columns)))
    head = head_of_dump(mission, f"boresight {__version__}: dump_from_arrays")
    if terrain is not None:
        files["terrain"] = "terrain/dem.tif"
        head["terrain"] = _terrain(folder, terrain, terrain_height_kind, terrain_sigma_m)
    stated = {str(key): accepted.number_of(v, f"errors, {key}") for key, v in errors.items()}
    head |= {"files": files, "errors": stated} | ({"star_cameras": [head_table]} if head_table else {})
    write_toml(folder / "dump.toml", head)  # last: a dump with a dump.toml is complete
    try:
        return open_dump(folder)
    except RawDataError as error:  # names the argument and its row, from 0, not the file and its line
        field = re.sub(r"^line (\d+)", lambda line: f"row {int(line[1]) - 2}", error.field)
        argument = ARGUMENTS.get(error.file, error.file)
        raise RawDataError(argument, field, error.found, error.expected) from error


def _new_folder(out: PathLike | None) -> Path:
    if out is None:
        folder = Path(tempfile.mkdtemp(prefix="boresight-dump-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        return folder
    return accepted.vacant_folder_of(out, "out")


def _three(sigma: ArrayLike) -> list[float]:
    values = accepted.floats_of(sigma, "sigma_R_cs0_rad", "(3,)")
    if values.shape not in ((), (3,)) or not ((values > 0.0) & (values <= np.pi)).all():
        raise accepted.wrong("sigma_R_cs0_rad", sigma, "a number or three, above 0 and at most pi, rad")
    return [float(value) for value in np.broadcast_to(values, 3)]


def _write_strips(folder: Path, rows: Sequence[Mapping[str, Any]], stated: int | None, told: Progress) -> int:
    ids, ccds, times, periods = accepted.values_by_column(
        rows, ("id", "ccd", "time", "row_period_s"), "strips"
    )
    kinds = accepted.column_of(rows, "kind", "strips", accepted.label_of, "ground")
    places: list[tuple[str, int]] = []  # file and number of lines
    types = set()
    for n, row in enumerate(accepted.counted(rows, "strips", told)):
        file, image = "", accepted.cell_of(row, "image", "strips", n)
        if image is None:
            count = accepted.count_of(accepted.cell_of(row, "lines", "strips", n), f"strips, row {n}, lines")
        else:
            file = f"strips/{n + 1:05d}.tif"
            pixels = accepted.image_of(image, f"strips, row {n}, image")
            types.add(pixels.dtype)
            count = len(pixels)
            array_stars.write_image(folder / file, array_stars.stored(pixels, stated or 8))
        places.append((file, count))
    columns = ["id", "ccd", "file", "lines", "utc_first_row", "row_period_s", "kind"]
    lines = list(zip(ids, ccds, *zip(*places), times, map(repr, periods), kinds))
    write_csv(folder / "strips.csv", columns, lines)
    return array_stars.bits_of(stated, types, "remote_bits")


def _write_targets(folder: Path, rows: Sequence[Mapping[str, Any]], told: Progress) -> None:
    files = [f"chips/{n + 1:05d}.tif" for n in range(len(rows))]
    for n, (row, file) in enumerate(zip(accepted.counted(rows, "targets", told), files)):
        at = f"targets, row {n}"
        pixels = accepted.pixels_of(
            accepted.cell_of(row, "chip", "targets", n), f"{at}, chip", "grey values (rows, columns)"
        )
        if pixels.dtype not in (np.uint8, np.uint16):
            pixels = _single(pixels, f"{at}, chip")
        affine, crs = (accepted.cell_of(row, name, "targets", n) for name in ("chip_affine", "chip_crs"))
        array_stars.write_image(folder / file, pixels, **_georeference(affine, crs, at))
    lines = zip(*accepted.values_by_column(rows, ("id", *PLACE), "targets"), files)
    write_csv(folder / "targets.csv", ["id", *PLACE, "chip"], list(lines))


def _single(values: np.ndarray, name: str) -> np.ndarray:
    """Values in single precision, as files hold them."""
    with np.errstate(over="ignore"):
        single = values.astype(np.float32)
    if (np.isinf(single) & np.isfinite(values)).any():
        raise accepted.wrong(name, f"values to {np.nanmax(np.abs(values)):.3g}", "at most 3e38")
    return single


def _georeference(affine: Any, crs: Any, at: str) -> dict[str, Any]:
    numbers = accepted.floats_of(
        accepted.listed(affine, f"{at}, affine", "six numbers")[:6], f"{at}, affine", "(6,)"
    )
    if numbers.shape != (6,) or not np.isfinite(numbers).all():
        raise accepted.wrong(f"{at}, affine", affine, "six finite numbers a, b, c, d, e, f")
    try:
        return {"transform": Affine(*numbers.tolist()), "crs": CRS.from_user_input(crs)}
    except Exception as error:  # of PROJ and GDAL
        expected = f'a reference system such as "EPSG:32648" ({accepted.shown(str(error))})'
        raise accepted.wrong(f"{at}, crs", crs, expected) from error


def _terrain(folder: Path, terrain: Any, height_kind: str, sigma_m: float) -> dict[str, Any]:
    """Write the heights; the table [terrain] of the dump."""
    if not isinstance(terrain, Sequence) or isinstance(terrain, str) or len(terrain) != 3:
        raise accepted.wrong("terrain", terrain, "(heights, affine, crs)")
    if height_kind not in HEIGHT_KINDS:
        raise accepted.wrong("terrain_height_kind", height_kind, " or ".join(HEIGHT_KINDS))
    heights = accepted.floats_of(terrain[0], "terrain, heights", "(rows, columns)")
    if heights.ndim != 2 or not heights.size:
        raise accepted.wrong("terrain, heights", heights, "shape (rows, columns)")
    place = _georeference(terrain[1], terrain[2], "terrain")
    array_stars.write_image(
        folder / "terrain" / "dem.tif", _single(heights, "terrain, heights"), nodata=float("nan"), **place
    )
    return {"height_kind": height_kind, "sigma_m": accepted.number_of(sigma_m, "terrain_sigma_m", 0.0)}


def orbit_text(mission: str, frame: str, orbit: Table) -> str:
    """An orbit message of the states of a table."""
    if frame not in FRAMES:
        raise accepted.wrong("orbit_frame", frame, " or ".join(FRAMES))
    rows = accepted.rows_of(orbit, "orbit")
    if len(rows) < FEWEST_STATES:
        raise accepted.wrong("orbit", f"{len(rows)} states", f"at least {FEWEST_STATES}")
    utc, *columns = accepted.values_by_column(rows, ORBIT, "orbit")
    numbers = np.array(columns).T
    radius_m = np.linalg.norm(numbers[:, :3], axis=1)
    for n in np.flatnonzero(~((radius_m > 6.4e6) & (radius_m < 5e7)))[:1]:
        found = f"{radius_m[n]:.6g} m from the centre of the Earth"
        raise accepted.wrong(
            f"orbit, row {n}, x_m, y_m, z_m", found, "6.4e6 to 5e7 m (metres, not kilometres)"
        )
    name = "".join(letter if letter.isalnum() else "-" for letter in mission.upper()) or "ARRAYS"
    return orbit_message(name, frame, ("lagrange", DEGREE), utc, numbers[:, :3], numbers[:, 3:])
