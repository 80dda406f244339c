"""Images of the sky and what is known of each: where it lies, when it was taken, and from where.

Loose images may come with a table of their times and an orbit; the exposures of a dump come with both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry.epoch import Epoch
from geometry.orbit import Orbit, OrbitGapError
from geometry.star_camera import StarCamera
from pipeline.errors import RawDataError
from pipeline.files.dump import Dump, bundled_table, open_dump, orbit_of
from pipeline.files.dump_schema import SkyImageRow
from pipeline.files.orbit_file import read_oem
from pipeline.files.text_files import read_table
from star_id.observer import Observer

__all__ = ["SkyImage", "SkyImages", "observers_of", "open_sky_images"]


@dataclass(frozen=True, slots=True, eq=False)
class SkyImage:
    """One image that has not been read yet."""

    name: str
    path: Path
    observer: Observer | None
    saturation_dn: float | None  # where a pixel is full; None: to be seen from the image


@dataclass(frozen=True, slots=True, eq=False)
class SkyImages:
    """Images in the order in which they were named."""

    images: tuple[SkyImage, ...]
    camera: StarCamera | None  # of the first dump, if there is one
    omitted: tuple[tuple[str, str], ...]  # (image, reason)


def open_sky_images(
    sources: Sequence[Path], times: Path | None = None, orbit: Path | None = None
) -> SkyImages:
    """Images, and folders that are dumps; `times` and `orbit` as in `observers_of`, for the images."""
    observers = observers_of([source for source in sources if not source.is_dir()], times, orbit)
    images: list[SkyImage] = []
    omitted: list[tuple[str, str]] = []
    camera = None
    for source in sources:
        if not source.is_dir():
            images.append(SkyImage(str(source), source, observers.get(source.name), None))
            continue
        dump = open_dump(source, allow_stale_eop=True)  # the Earth's rotation moves no star by 1e-6 arcsec
        camera = camera or dump.star_camera
        for image, reason in _of_dump(dump):
            if reason is None:
                images.append(image)
            else:
                omitted.append((image.name, reason))
    return SkyImages(tuple(images), camera, tuple(omitted))


def _of_dump(dump: Dump) -> Iterator[tuple[SkyImage, str | None]]:
    """Its exposures, each with the reason why it cannot be used if the orbit does not reach it."""
    full = float(2**dump.star_bit_depth - 1)
    for exposure in dump.exposures:
        name = f"{dump.root.name}/{exposure.file}"
        observer, reason = None, None
        try:
            observer = _aboard(dump.orbit, exposure.t_s)
        except OrbitGapError as error:
            reason = str(error)
        yield SkyImage(name, exposure.path, observer, full), reason


def observers_of(images: Sequence[Path], times: Path | None, orbit_file: Path | None) -> dict[str, Observer]:
    """By the images' file names: `times` is a CSV file (file, utc_mid), `orbit_file` an OEM of the satellite.

    Without an orbit an image with a time is taken from the Earth's centre: the aberration of the Earth's
    motion about the Sun (20 arc-seconds) is known then, that of a satellite's own (5) is not.
    """
    if times is None:
        if orbit_file is not None:
            raise RawDataError(
                str(orbit_file), "use", "--orbit alone", "--times, the times of the images, too"
            )
        return {}
    rows = read_table(times, SkyImageRow, str(times))
    by_name = {row.file: row.utc_mid for row in rows}
    if len(by_name) < len(rows):
        raise RawDataError(str(times), "file", f"{len(rows) - len(by_name)} names again", "each file once")
    if missing := [image.name for image in images if image.name not in by_name]:
        raise RawDataError(str(times), "file", f"no row for {missing[0]}", "a row for each image")
    orbit = None
    if orbit_file is not None:
        ephemeris = read_oem(orbit_file, str(orbit_file))
        orbit = orbit_of(ephemeris, str(orbit_file), 0.0, bundled_table(), allow_stale_eop=True)
    observers = {}
    for image in images:
        utc = by_name[image.name]
        try:
            epoch = orbit.epoch if orbit is not None else Epoch.from_utc(utc)
            t_s = float(epoch.seconds_from_utc([utc])[0])
            observers[image.name] = (
                Observer(epoch, t_s, np.zeros(3), np.zeros(3)) if orbit is None else _aboard(orbit, t_s)
            )
        except OrbitGapError as error:
            raise RawDataError(
                str(times), f"utc_mid of {image.name}", str(error), "a time of the orbit"
            ) from error
        except ValueError as error:
            raise RawDataError(
                str(times), f"utc_mid of {image.name}", str(error), "a UTC time that exists"
            ) from error
    return observers


def _aboard(orbit: Orbit, t_s: float) -> Observer:
    p_i, v_i = orbit.states_i(np.array([t_s]))
    return Observer(orbit.epoch, t_s, p_i[0], v_i[0])
