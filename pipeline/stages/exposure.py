"""From one image file to `StarSightings`: stars found, identified and converted to directions.

    raw image -> background -> detection -> centroids -> u_s -> identification (HIP) -> apparent u_i

A task holds all that the outcome of one exposure depends on, so it can be sent to any process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.ledger import Entry, Reason
from boresight.geometry.orbit import OrbitGapError
from boresight.geometry.record import record, scalar
from boresight.geometry.sightings import StarSightings
from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.images.star_images import read_exposure
from boresight.pipeline.files.star_side import Exposure, StarCentroids, StarImages
from boresight.pipeline.run.index_cache import cached_index
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.centroids import Centroids
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.identification.triangle_index import StarIndex, equivalent_fov
from boresight.star_id.observer import Observer
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import sight_centroids, sight_stars

__all__ = [
    "CentroidTask",
    "StarTask",
    "centroid_tasks",
    "exposure_image",
    "in_order",
    "is_identified",
    "sight_exposure",
    "sight_exposure_centroids",
    "star_tasks",
]


@record(kw_only=True)
class StarTask:
    """One exposure and everything that its sightings depend on."""

    exposure: Exposure = scalar("file and time of the exposure")
    camera: StarCamera = scalar("model of the star camera")
    bit_depth: int = scalar("of the raw image")
    observer: Observer = scalar("the satellite at mid-exposure")
    settings: StarSettings = scalar("thresholds of detection and identification")

    @property
    def item(self) -> Entry:
        """Kind, id and file of what is processed, without a reason."""
        return self.exposure.item


def star_tasks(dump: Dump, images: StarImages, settings: StarSettings) -> tuple[list[StarTask], list[Entry]]:
    """A task for each exposure of a head that the orbit covers, and an omission for each other one."""
    if settings.saturation_dn is None:
        settings = replace(settings, saturation_dn=float(2**images.bit_depth - 1))
    tasks, omitted = [], []
    for exposure in images.exposures:
        observer = _observer(dump, exposure)
        if isinstance(observer, Entry):
            omitted.append(observer)
            continue
        tasks.append(
            StarTask(
                exposure=exposure,
                camera=images.camera,
                bit_depth=images.bit_depth,
                observer=observer,
                settings=settings,
            )
        )
    return tasks, omitted


def _observer(dump: Dump, exposure: Exposure) -> Observer | Entry:
    try:
        p_i, v_i = dump.orbit.states_i(np.array([exposure.t_s]))
    except OrbitGapError:
        utc = dump.epoch.utc_from_seconds(exposure.t_s)[0][:23]
        reason = f"{dump.orbit_covers}, not its time {utc} (utc_mid)"
        return exposure.item.because(Reason.NOT_COVERED, reason)
    return Observer(dump.epoch, exposure.t_s, p_i[0], v_i[0])


@record(kw_only=True)
class CentroidTask:
    """The centroids of one exposure and everything that its sightings depend on."""

    exposure: Exposure = scalar("name and time of the exposure")
    stars: Centroids = scalar("what was found in its image")
    camera: StarCamera = scalar("model of the star camera")
    observer: Observer = scalar("the satellite at mid-exposure")
    settings: StarSettings = scalar("thresholds of identification")

    @property
    def item(self) -> Entry:
        """Kind, id and file of what is processed, without a reason."""
        return self.exposure.item


def centroid_tasks(
    dump: Dump, source: StarCentroids, settings: StarSettings
) -> tuple[list[CentroidTask], list[Entry]]:
    """A task for each exposure with centroids that the orbit covers, and an omission for each other one."""
    tasks, omitted = [], []
    for exposure, stars in zip(source.exposures, source.lists):
        if stars is None:
            reason = "the list of centroids has no star of it"
            omitted.append(exposure.item.because(Reason.NOT_IDENTIFIED, reason))
            continue
        observer = _observer(dump, exposure)
        if isinstance(observer, Entry):
            omitted.append(observer)
            continue
        tasks.append(
            CentroidTask(
                exposure=Exposure(
                    exposure.exposure_id, exposure.file, Path(), exposure.t_s, exposure.exposure_s
                ),
                stars=stars,
                camera=source.camera,
                observer=observer,
                settings=settings,
            )
        )
    return tasks, omitted


def sight_exposure_centroids(task: CentroidTask) -> StarSightings | Entry:
    """Directions of the identified stars of a list of centroids; an omission where none are identified."""
    index = _index_of(task.camera, task.observer)
    found = sight_centroids(
        task.exposure.exposure_id, task.stars, task.camera, index, task.observer, task.settings
    )
    if isinstance(found, NotIdentified):
        return task.item.because(Reason.NOT_IDENTIFIED, f"not identified: {found.reason}")
    return found


def exposure_image(exposure: Exposure, camera: StarCamera, bit_depth: int) -> NDArray:
    """Raw image (H, W) of an exposure, counts. `RawDataError` where size or depth are not the camera's."""
    return read_exposure(
        exposure.path,
        exposure.file,
        width=camera.width_px,
        height=camera.height_px,
        bit_depth=bit_depth,
    )


def sight_exposure(task: StarTask) -> StarSightings | Entry:
    """Directions of the identified stars of one exposure; an omission where the image cannot be read or its
    stars are not identified.
    """
    try:
        image = exposure_image(task.exposure, task.camera, task.bit_depth)
    except RawDataError as error:
        return task.item.because(Reason.UNREADABLE, str(error))
    sightings = _sighted(task, image)
    if isinstance(sightings, NotIdentified):
        return task.item.because(Reason.NOT_IDENTIFIED, f"not identified: {sightings.reason}")
    return sightings


def _sighted(task: StarTask, image: NDArray) -> StarSightings | NotIdentified:
    index = _index_of(task.camera, task.observer)
    return sight_stars(task.exposure.exposure_id, image, task.camera, index, task.observer, task.settings)


def is_identified(task: StarTask, image: NDArray) -> bool:
    """Whether the stars of an image in the place of the exposure's own are identified."""
    return not isinstance(_sighted(task, image), NotIdentified)


@lru_cache(maxsize=2)
def star_index(fov_rad: float, year: int) -> StarIndex:
    """Index of catalogue triangles for a field of view (rad), read once in each process."""
    return cached_index(hipparcos_stars().places, float(year), fov_rad)


def _index_of(camera: StarCamera, observer: Observer) -> StarIndex:
    year = round(float(observer.epoch.julian_year(observer.t_s)))
    fov_rad = equivalent_fov(camera.width_px, camera.height_px, camera.focal_m / camera.pixel_m)
    return star_index(fov_rad, year)


def in_order(sightings: Sequence[StarSightings]) -> list[StarSightings]:
    """Sightings sorted by time, then by id: the order in which sums are made."""
    return sorted(sightings, key=lambda s: (s.t_s, s.exposure_id))
