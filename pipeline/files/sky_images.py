"""Images of the sky and what is known of each: where it lies, when it was taken, and from where.

Loose images may come with a table of their times and an orbit, or a place on the ground; the exposures of a
dump come with times and orbit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.ground_site import GroundSite
from boresight.geometry.orbit import Orbit, OrbitGapError
from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump, bundled_table, open_dump, orbit_of
from boresight.pipeline.files.dump_schema import SkyImageRow
from boresight.pipeline.files.orbit_file import read_oem
from boresight.pipeline.files.text_files import read_table
from boresight.star_id.observer import Observer

__all__ = ["NOWHERE", "SkyImage", "SkyImages", "Whereabouts", "observers_of", "open_sky_images"]


@dataclass(frozen=True, slots=True)
class Whereabouts:
    """What is known of when and from where loose images were taken."""

    times: Path | None = None  # CSV: file, utc_mid
    orbit: Path | None = None  # OEM of a satellite
    site_deg_m: tuple[float, float, float] | None = None  # latitude, longitude, ellipsoidal height


NOWHERE = Whereabouts()


@dataclass(frozen=True, slots=True, eq=False)
class SkyImage:
    """One image that has not been read yet."""

    name: str
    path: Path
    observer: Observer | None
    bit_depth: int | None  # of its counts, as a dump states it; None: to be seen from the image


@dataclass(frozen=True, slots=True, eq=False)
class SkyImages:
    """Images in the order in which they were named."""

    images: tuple[SkyImage, ...]
    camera: StarCamera | None  # of the first dump, if there is one
    omitted: tuple[tuple[str, str], ...]  # (image, reason)


def open_sky_images(sources: Sequence[Path], known: Whereabouts) -> SkyImages:
    """Images, and folders that are dumps; what is `known` holds for the images."""
    observers = observers_of([source for source in sources if not source.is_dir()], known)
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
    for exposure in dump.exposures:
        name = f"{dump.root.name}/{exposure.file}"
        observer, reason = None, None
        try:
            observer = _aboard(dump.orbit, exposure.t_s)
        except OrbitGapError as error:
            reason = str(error)
        yield SkyImage(name, exposure.path, observer, dump.star_bit_depth), reason


def observers_of(images: Sequence[Path], known: Whereabouts) -> dict[str, Observer]:
    """By the images' file names.

    With times alone an image is taken from the Earth's centre: the aberration of the Earth's motion about
    the Sun (20 arc-seconds) is known then, that of a satellite's own (5) is not.
    """
    where = known.orbit or known.site_deg_m
    if known.times is None:
        if where is None:
            return {}
        found = f"{where} and no times"
        raise RawDataError("--orbit or --site", "use", found, "--times, the times of the images, too")
    if known.orbit is not None and known.site_deg_m is not None:
        raise RawDataError("--orbit", "use", "--site as well", "a satellite or a place on the ground")
    utc = _times(images, known.times)
    path = _path_of(known)
    return {name: _observer(path, known.times, name, time) for name, time in utc.items()}


def _times(images: Sequence[Path], times: Path) -> dict[str, str]:
    """UTC by file name, one for each image."""
    if twice := [name for name, n in Counter(image.name for image in images).items() if n > 1]:
        found = f"images of the name {twice[0]} in several folders"
        raise RawDataError(str(times), "file", found, "images whose names differ: they are known by them")
    rows = read_table(times, SkyImageRow, str(times))
    by_name = {row.file: row.utc_mid for row in rows}
    if len(by_name) < len(rows):
        raise RawDataError(str(times), "file", f"{len(rows) - len(by_name)} names again", "each file once")
    if missing := [image.name for image in images if image.name not in by_name]:
        raise RawDataError(str(times), "file", f"no row for {missing[0]}", "a row for each image")
    return {image.name: by_name[image.name] for image in images}


def _path_of(known: Whereabouts) -> Orbit | GroundSite | None:
    if known.orbit is not None:
        ephemeris = read_oem(known.orbit, str(known.orbit))
        return orbit_of(ephemeris, str(known.orbit), 0.0, bundled_table(), allow_stale_eop=True)
    if known.site_deg_m is None:
        return None
    lat, lon, height = known.site_deg_m
    if not (abs(lat) <= 90.0 and abs(lon) <= 360.0 and -500.0 <= height <= 9000.0):
        expected = "latitude and longitude in degrees, height in metres from -500 to 9000"
        raise RawDataError("--site", "value", f"{lat}, {lon}, {height}", expected)
    return GroundSite.in_standard_weather(float(np.radians(lat)), float(np.radians(lon)), height)


def _observer(path: Orbit | GroundSite | None, times: Path, name: str, utc: str) -> Observer:
    try:
        if isinstance(path, Orbit):
            return _aboard(path, float(path.epoch.seconds_from_utc([utc])[0]))
        epoch = Epoch.from_utc(utc)
        t_s = float(epoch.seconds_from_utc([utc])[0])
        if path is None:
            return Observer(epoch, t_s, np.zeros(3), np.zeros(3))
        earth = EarthRotation.over(epoch, t_s, t_s, bundled_table(), allow_stale_eop=True)
        state = path.at(earth, t_s)
        return Observer(epoch, t_s, state.p_i, state.v_i, state.air)
    except ValueError as error:  # no such time, a gap of the orbit, a date before 1972
        raise RawDataError(
            str(times), f"utc_mid of {name}", f"{utc}: {error}", "a time that is covered"
        ) from error


def _aboard(orbit: Orbit, t_s: float) -> Observer:
    p_i, v_i = orbit.states_i(np.array([t_s]))
    return Observer(orbit.epoch, t_s, p_i[0], v_i[0])
