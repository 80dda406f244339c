"""Single star images named: file -> stars found -> which they are, with the camera known, roughly known
or unknown.

One image's fault is one line of the outcome; the others go on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from geometry.star_camera import StarCamera
from pipeline.dump import star_camera_of
from pipeline.dump_schema import StarCameraFile
from pipeline.errors import RawDataError
from pipeline.image_files import read_star_image
from pipeline.text_files import read_toml
from pipeline.unit_store import fixed_list, write_whole
from star_id.catalogue import hipparcos_stars
from star_id.field import LARGEST_FOV_RAD, SMALLEST_FOV_RAD, FieldSolution, solve_field
from star_id.identify import NotIdentified
from star_id.settings import StarSettings
from star_id.triangles import StarIndex, build_index, equivalent_fov

__all__ = ["Line", "identify_images"]

CATALOGUE_YEAR = 2020.0  # proper motion since then is far below a pixel of any camera with so wide a field


@dataclass(frozen=True, slots=True)
class Line:
    """What there is to say about one image."""

    text: str
    identified: bool


def identify_images(
    images: Sequence[Path],
    camera_file: Path | None,
    fov_deg: float | None,
    out: Path | None,
    settings: StarSettings,
) -> Iterator[Line]:
    """One line an image, as it is done; the named stars go to `out` at the end."""
    camera = None
    if camera_file is not None:
        name = str(camera_file)
        camera = star_camera_of(read_toml(camera_file, StarCameraFile, name), name)
    if fov_deg is not None and not 0.5 < fov_deg < 90.0:
        raise RawDataError("--fov-deg", "value", f"{fov_deg}", "between 0.5 and 90 degrees")
    index = _index(camera, fov_deg, settings)
    width = max(len(str(path)) for path in images)
    tables = []
    for path in images:
        try:
            image = read_star_image(path, str(path))
            if camera is not None and image.shape != (camera.height_px, camera.width_px):
                found = f"{image.shape[1]} x {image.shape[0]} px"
                expected = f"{camera.width_px} x {camera.height_px} px, as in {camera_file}"
                raise RawDataError(str(path), "image size", found, expected)
            fov = None if fov_deg is None else float(np.radians(fov_deg))
            outcome = solve_field(image, index, settings, camera=camera, fov_x_rad=fov)
        except RawDataError as error:
            yield Line(f"{path!s:{width}s}   not read: {error}", False)
            continue
        if isinstance(outcome, NotIdentified):
            yield Line(f"{path!s:{width}s}   not identified: {outcome.reason}", False)
            continue
        tables.append(_table(path, outcome))
        yield Line(f"{path!s:{width}s}   {_facts(outcome)}", True)
    if out is not None:
        whole = pa.concat_tables(tables) if tables else _table_of_nothing()
        write_whole(out, lambda target: pq.write_table(whole, target, compression="zstd"))


def _facts(found: FieldSolution) -> str:
    return (
        f"{found.matches:4d} stars   rms {found.rms_arcsec:.1f} arcsec   "
        f"RA {np.degrees(found.ra_rad):.4f}  Dec {np.degrees(found.dec_rad):+.4f}  "
        f"roll {np.degrees(found.roll_rad):.3f}  FOV {np.degrees(found.fov_x_rad):.3f} deg   "
        f"wrong with probability < 1e{found.log_false_alarm_probability / np.log(10.0):.0f}"
    )


def _index(camera: StarCamera | None, fov_deg: float | None, settings: StarSettings) -> StarIndex:
    if camera is not None:
        return _built(equivalent_fov(camera.width_px, camera.height_px, camera.focal_m / camera.pixel_m))
    if fov_deg is None:
        return _built((float(SMALLEST_FOV_RAD), float(LARGEST_FOV_RAD)))
    spread = 1.0 + 2.0 * settings.fov_tolerance
    fov = float(np.radians(fov_deg))
    return _built((0.5 * fov / spread, 1.2 * fov * spread))  # the area may be that of a tall or a wide image


@lru_cache(maxsize=1)
def _built(fov_rad: float | tuple[float, float]) -> StarIndex:
    return build_index(hipparcos_stars().places, CATALOGUE_YEAR, fov_rad)


def _table(path: Path, found: FieldSolution) -> pa.Table:
    n = found.matches
    return pa.table(
        {
            "file": pa.array([str(path)] * n, pa.string()),
            "hip": pa.array(found.hip),
            "xy_px": fixed_list(found.xy_px),
            "residual_px": fixed_list(found.residual_px),
            "quaternion_si": fixed_list(np.tile(found.R_si.as_quat(canonical=True), (n, 1))),
        }
    )


def _table_of_nothing() -> pa.Table:
    pairs = fixed_list(np.zeros((0, 2)))
    return pa.table(
        {
            "file": pa.array([], pa.string()),
            "hip": pa.array([], pa.int64()),
            "xy_px": pairs,
            "residual_px": pairs,
            "quaternion_si": fixed_list(np.zeros((0, 4))),
        }
    )
