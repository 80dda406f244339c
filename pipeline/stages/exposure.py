"""One exposure's way: image file -> stars found, named and turned into directions (`StarSightings`).

    raw image -> background -> detection -> centroids -> u_s -> names (HIP) -> apparent directions u_i

A task holds all that one exposure needs and nothing else, so it can be sent to any process; what comes out is
a table for the disk. A night without stars is an outcome, not an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from boresight.geometry.epoch import Epoch
from boresight.geometry.orbit import OrbitGapError
from boresight.geometry.sightings import StarSightings
from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.errors import Omission, RawDataError
from boresight.pipeline.files.dump import Dump, Exposure
from boresight.pipeline.files.image_files import read_exposure
from boresight.pipeline.files.table_files import column, fixed_list, list_values
from boresight.pipeline.work.unit_store import read_meta
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.identification.triangle_index import StarIndex, build_index, equivalent_fov
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import sight_stars

__all__ = [
    "StarTask",
    "exposure_image",
    "sight_exposure",
    "sightings_from_table",
    "star_tasks",
    "stars_table",
]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class StarTask:
    """One exposure and everything its result depends on."""

    exposure: Exposure
    camera: StarCamera
    bit_depth: int
    epoch: Epoch
    p_i: Array  # (3,) satellite at mid-exposure, GCRS, m
    v_i: Array  # (3,) m/s
    settings: StarSettings


def star_tasks(dump: Dump, settings: StarSettings) -> tuple[list[StarTask], list[Omission]]:
    """A task for each exposure of a dump that the orbit covers; the others are named."""
    if settings.saturation_dn is None:
        settings = replace(settings, saturation_dn=float(2**dump.star_bit_depth - 1))
    tasks, omitted = [], []
    for exposure in dump.exposures:
        try:
            p_i, v_i = dump.orbit.states_i(np.array([exposure.t_s]))
        except OrbitGapError as error:
            omitted.append(Omission("exposure", exposure.exposure_id, exposure.file, str(error)))
            continue
        tasks.append(
            StarTask(exposure, dump.star_camera, dump.star_bit_depth, dump.epoch, p_i[0], v_i[0], settings)
        )
    return tasks, omitted


def exposure_image(exposure: Exposure, camera: StarCamera, bit_depth: int) -> NDArray:
    """The raw image of an exposure, of the size and depth that the camera says, or `RawDataError`."""
    return read_exposure(
        exposure.path,
        exposure.file,
        width=camera.width_px,
        height=camera.height_px,
        bit_depth=bit_depth,
    )


def sight_exposure(task: StarTask) -> StarSightings | Omission:
    """The whole chain for one exposure."""
    exposure, camera = task.exposure, task.camera
    try:
        image = exposure_image(exposure, camera, task.bit_depth)
    except RawDataError as error:
        return Omission("exposure", exposure.exposure_id, exposure.file, str(error))
    year = round(float(task.epoch.julian_year(exposure.t_s)))
    index = star_index(_field_of_view(camera), year)
    sightings = sight_stars(
        exposure.exposure_id,
        image,
        camera,
        index,
        task.epoch,
        exposure.t_s,
        task.p_i,
        task.v_i,
        task.settings,
    )
    if isinstance(sightings, NotIdentified):
        return Omission(
            "exposure", exposure.exposure_id, exposure.file, f"not identified: {sightings.reason}"
        )
    return sightings


@lru_cache(maxsize=2)
def star_index(fov_rad: float, year: int) -> StarIndex:
    """The index of catalogue triangles for a field of view, built once in each process."""
    return build_index(hipparcos_stars().places, float(year), fov_rad)


def _field_of_view(camera: StarCamera) -> float:
    return equivalent_fov(camera.width_px, camera.height_px, camera.focal_m / camera.pixel_m)


def stars_table(task: StarTask, outcome: StarSightings | Omission) -> tuple[pa.Table, dict[str, Any]]:
    """An exposure's outcome as a table, one row a star, and what there is to say about the whole of it."""
    meta = {"kind": "exposure", "id": task.exposure.exposure_id, "t_s": task.exposure.t_s}
    if isinstance(outcome, Omission):
        return pa.table({}), meta | {"outcome": "omitted", "file": outcome.file, "reason": outcome.reason}
    table = pa.table(
        {
            "exposure_id": pa.array([outcome.exposure_id] * len(outcome.hip), pa.string()),
            "t_s": pa.array(np.full(len(outcome.hip), outcome.t_s)),
            "hip": pa.array(outcome.hip),
            "xy_px": fixed_list(outcome.xy_px),
            "u_s": fixed_list(outcome.u_s),
            "u_i": fixed_list(outcome.u_i),
            "cov_s": fixed_list(outcome.cov_s),
        }
    )
    return table, meta | {"outcome": "sighted", "stars": len(outcome.hip)}


def sightings_from_table(table: pa.Table) -> StarSightings | Omission:
    """The inverse of `stars_table`, bit for bit."""
    meta = read_meta(table)
    if meta["outcome"] == "omitted":
        return Omission("exposure", meta["id"], meta["file"], meta["reason"])
    return StarSightings(
        exposure_id=meta["id"],
        t_s=meta["t_s"],
        hip=column(table, "hip"),
        xy_px=list_values(table, "xy_px", 2),
        u_s=list_values(table, "u_s", 3),
        u_i=list_values(table, "u_i", 3),
        cov_s=list_values(table, "cov_s", 3, 3),
    )


def in_order(sightings: Sequence[StarSightings]) -> list[StarSightings]:
    """By time, then by id: the order in which sums are made."""
    return sorted(sightings, key=lambda s: (s.t_s, s.exposure_id))
