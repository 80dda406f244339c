"""The star side of a dump made of arrays, as its files: images, lists of stars, or attitudes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from boresight import accepted
from boresight.accepted import Progress, Table
from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.files.attitude_files import COMPONENTS, COVARIANCES, SIGMAS
from boresight.pipeline.files.dump_schema import DIRECTION_LENGTH
from boresight.pipeline.files.images.tiff import TILES, write_tiff
from boresight.pipeline.files.star_side import star_camera_table
from boresight.pipeline.files.text_tables import table_csv, write_csv, write_toml
from boresight.pipeline.files.whole_file import write_text

__all__ = ["attitude_keys", "bits_of", "stored", "write_attitudes", "write_exposures", "write_image"]

STAR = ("x_px", "y_px", "sigma_x_px", "sigma_y_px", "cov_xy_px2", "flux_dn")  # columns of a list of stars
MORE = ("snr", "saturated", "blended", "psf_sigma_px")  # its optional columns
HEAD = {"name": "star-camera", "installation": "installation.toml"}  # keys of the one head in dump.toml
# Values of the three arguments about attitudes, as docs/dump-format.md has them.
FRAMES = ("GCRF", "ICRF", "EME2000")
SENSES = ("head to inertial", "inertial to head")
REMOVED = ("none", "annual", "annual and orbital")
LIST_BITS = 16  # of a camera whose images are not given: not used


def write_exposures(
    folder: Path, camera: StarCamera, table: Table, stated: int | None, told: Progress
) -> dict[str, Any]:
    """Write star_camera.toml and the exposures, as images or lists of stars; what dump.toml says of them.

    For images that is {}, the usual files; for lists a table of [[star_cameras]].
    """
    accepted.instance_of(camera, StarCamera, "star_camera")
    types, lists = set(), []
    rows = accepted.rows_of(table, "exposures")
    of_lists = "stars" in rows[0]
    files = [f"exposures/{n + 1:05d}.tif" for n in range(len(rows))]
    for n, (row, file) in enumerate(zip(accepted.counted(rows, "star images", told), files)):
        at = f"exposures, row {n}"
        if of_lists:
            lists.append(
                _stars(accepted.cell_of(row, "stars", "exposures", n), f"{at}, stars").assign(file=file)
            )
        else:
            pixels = accepted.image_of(accepted.cell_of(row, "image", "exposures", n), f"{at}, image")
            types.add(pixels.dtype)
            write_image(folder / file, stored(pixels, stated or 8))
    rows = [{"id": f"e{n + 1:04d}", **row} for n, row in enumerate(rows)]
    ids, times, lengths = accepted.values_by_column(rows, ("id", "time", "exposure_s"), "exposures")
    lines = list(zip(ids, files, times, lengths))
    write_csv(folder / "exposures.csv", ["id", "file", "utc_mid", "exposure_s"], lines)
    bits = LIST_BITS if of_lists else bits_of(stated, types, "star_bits")
    write_toml(folder / "star_camera.toml", star_camera_table(camera, bits))
    if not of_lists:
        return {}
    if len({tuple(one.columns) for one in lists}) > 1:
        raise accepted.wrong("exposures, stars", "lists with different columns", "the same columns in each")
    write_text(folder / "centroids.csv", table_csv(pd.concat(lists)))
    named = {"camera": "star_camera.toml", "exposures": "exposures.csv", "centroids": "centroids.csv"}
    return HEAD | {"level": "centroids"} | named


def _stars(given: Any, name: str) -> pd.DataFrame:
    """A list of stars as rows of centroids.csv: `Stars`, or a table with its columns."""
    if hasattr(given, "cov_px") and hasattr(given, "xy_px"):  # what `find_stars` returns
        (x, y), cov = given.xy_px.T, given.cov_px
        sigma_x, sigma_y = np.sqrt(cov[:, 0, 0]), np.sqrt(cov[:, 1, 1])
        values = (x, y, sigma_x, sigma_y, cov[:, 0, 1], given.flux_dn)
        return pd.DataFrame(dict(zip(STAR, values)) | {key: getattr(given, key) for key in MORE})
    rows = accepted.rows_of(given, name)
    missing = [key for row in rows for key in STAR if key not in row]
    if missing:
        raise accepted.wrong(name, f"columns {', '.join(map(str, rows[0]))}", f"also {missing[0]}")
    return pd.DataFrame([{key: row[key] for key in (*STAR, *MORE) if key in row} for row in rows])


def write_attitudes(folder: Path, table: Table) -> dict[str, Any]:
    """Write attitudes.csv with its errors; its table of [[star_cameras]] without `attitude_keys`."""
    rows = accepted.rows_of(table, "attitudes")
    errors = COVARIANCES if COVARIANCES[0] in rows[0] else SIGMAS
    columns = accepted.values_by_column(rows, ("time", *COMPONENTS, *errors), "attitudes")
    write_csv(folder / "attitudes.csv", ["utc", *COMPONENTS, *errors], list(zip(*columns)))
    return HEAD | {"level": "attitudes", "attitudes": "attitudes.csv"}


def attitude_keys(
    frame: str, rotation: str, removed: str | None, line_of_sight_s: ArrayLike | None
) -> dict[str, Any]:
    """What attitudes.csv means, as keys of [[star_cameras]]."""
    keys: dict[str, Any] = {"frame": frame, "rotation": rotation, "aberration_removed": removed}
    for (key, value), allowed in zip(keys.items(), (FRAMES, SENSES, REMOVED)):
        if value not in allowed:
            name = key if allowed is REMOVED else f"attitude_{key}"
            raise accepted.wrong(name, value, " or ".join(allowed))
    expected = "a unit vector in the axes of the quaternions, (0, 0, 1) for z"
    if line_of_sight_s is None:
        if removed != "annual and orbital":
            raise accepted.wrong("line_of_sight_s", None, f"{expected}: aberration_removed is {removed!r}")
        return keys
    u_s = accepted.floats_of(line_of_sight_s, "line_of_sight_s", "(3,)", unit="")
    if u_s.shape != (3,) or not abs(np.linalg.norm(u_s) - 1.0) <= DIRECTION_LENGTH:
        raise accepted.wrong("line_of_sight_s", line_of_sight_s, expected)
    return keys | {"line_of_sight": u_s.tolist()}


def bits_of(stated: int | None, types: set[Any], name: str) -> int:
    if stated is not None:
        return stated
    if types - {np.dtype(np.uint8)}:
        raise accepted.wrong(name, "None", "the bits in use, 9 to 16, of images of uint16")
    return 8 if types else 0


def write_image(path: Path, pixels: NDArray[Any], **options: Any) -> None:
    write_tiff(path, pixels, **(TILES if min(pixels.shape) > 256 else {}), **options)


def stored(pixels: NDArray[Any], bits: int) -> NDArray[Any]:
    """Counts in the type that the format has for their bits."""
    return pixels.astype(np.uint16) if bits > 8 else pixels
