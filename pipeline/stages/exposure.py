"""From one image file to `StarSightings`: stars found, identified and converted to directions.

    raw image -> background -> detection -> centroids -> u_s -> identification (HIP) -> apparent u_i

A task holds all that the outcome of one exposure depends on, so it can be sent to any process.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.orbit import OrbitGapError
from boresight.geometry.sightings import StarSightings
from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.images.star_images import read_exposure
from boresight.pipeline.files.star_side import Exposure, StarCentroids, StarImages
from boresight.pipeline.run.index_cache import cached_index
from boresight.records.ledger import Entry, Reason
from boresight.records.record import inner, record, scalar
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.centroids import Centroids
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.identification.triangle_index import StarIndex, equivalent_fov
from boresight.star_id.observer import Observer
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import sight_centroids, sight_stars

__all__ = ["StarTask", "exposure_image", "is_identified", "sight_exposure", "star_tasks"]


@record(kw_only=True)
class StarTask:
    """One exposure and everything that its sightings depend on."""

    exposure: Exposure = scalar("name, file and time of the exposure")
    camera: StarCamera = scalar("model of the star camera")
    bit_depth: int = scalar("of the raw image; 0: its centroids are given", default=0)
    centroids: Centroids | None = scalar("what was found in its image; None: the image is read", default=None)
    observer: Observer = scalar("the satellite at mid-exposure")
    settings: StarSettings = scalar("thresholds of detection and identification")

    item = inner[Entry]("exposure.item", "what is processed, without a reason")


def star_tasks(
    dump: Dump, source: StarImages | StarCentroids, settings: StarSettings
) -> tuple[list[StarTask], list[Entry]]:
    """A task for each exposure with image or centroids that the orbit covers, an omission for each other."""
    of_images = isinstance(source, StarImages)
    depth, lists = (source.bit_depth, ()) if isinstance(source, StarImages) else (0, source.lists)
    if of_images and settings.saturation_dn is None:
        settings = replace(settings, saturation_dn=float(2**depth - 1))
    tasks, omitted = [], []
    for exposure, centroids in zip_longest(source.exposures, lists):
        if centroids is None and not of_images:
            reason = "the list of centroids has no star of it"
            omitted.append(exposure.item.because(Reason.NOT_IDENTIFIED, reason))
            continue
        try:
            p_i, v_i = dump.orbit.states_i(np.array([exposure.t_s]))
        except OrbitGapError:
            utc = dump.epoch.utc_from_seconds(exposure.t_s)[0][:23]
            reason = f"{dump.orbit_covers}, not its time {utc} (utc_mid)"
            omitted.append(exposure.item.because(Reason.NOT_COVERED, reason))
            continue
        tasks.append(
            StarTask(
                exposure=exposure if of_images else replace(exposure, path=Path()),
                camera=source.camera,
                bit_depth=depth,
                centroids=centroids,
                observer=Observer(dump.epoch, exposure.t_s, p_i[0], v_i[0]),
                settings=settings,
            )
        )
    return tasks, omitted


def exposure_image(exposure: Exposure, camera: StarCamera, bit_depth: int) -> NDArray:
    """Raw image (H, W) of an exposure, counts. `RawDataError` where size or depth are not the camera's."""
    return read_exposure(
        exposure.path, exposure.file, width=camera.width_px, height=camera.height_px, bit_depth=bit_depth
    )


def sight_exposure(task: StarTask) -> StarSightings | Entry:
    """Directions of identified stars; an omission where the image is unreadable or none are identified."""
    try:
        sightings = _sighted(task)
    except RawDataError as error:
        return task.item.because(Reason.UNREADABLE, str(error))
    if isinstance(sightings, NotIdentified):
        return task.item.because(Reason.NOT_IDENTIFIED, f"not identified: {sightings.reason}")
    return sightings


def _sighted(task: StarTask, image: NDArray | None = None) -> StarSightings | NotIdentified:
    """The sightings of a task's centroids, else of an image (H, W) in the place of the exposure's own."""
    camera, observer = task.camera, task.observer
    fov_rad = equivalent_fov(camera.width_px, camera.height_px, camera.focal_m / camera.pixel_m)
    index = _star_index(fov_rad, round(float(observer.epoch.julian_year(observer.t_s))))
    name = task.exposure.exposure_id
    if task.centroids is not None:
        return sight_centroids(name, task.centroids, camera, index, observer, task.settings)
    image = exposure_image(task.exposure, camera, task.bit_depth) if image is None else image
    return sight_stars(name, image, camera, index, observer, task.settings)


def is_identified(task: StarTask, image: NDArray) -> bool:
    """Whether the stars of an image in the place of the exposure's own are identified."""
    return not isinstance(_sighted(task, image), NotIdentified)


@lru_cache(maxsize=2)
def _star_index(fov_rad: float, year: int) -> StarIndex:
    """Index of catalogue triangles for a field of view (rad), read once in each process."""
    return cached_index(hipparcos_stars().places, float(year), fov_rad)
