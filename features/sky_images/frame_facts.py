"""Star images of files and dumps, each with the observer's position and velocity where they are known.

Single images may have a table of times and an orbit or a ground site; a dump has times and orbit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from boresight.features.sky_images.image_time import Whereabouts, time_of_image
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.orbit import Orbit, OrbitGapError
from boresight.geometry.star_camera import StarCamera
from boresight.geometry.starlight import GroundSite
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.dump_schema import SkyImageRow
from boresight.pipeline.files.orbit_and_earth import bundled_table, orbit_of
from boresight.pipeline.files.orbit_file import read_oem
from boresight.pipeline.files.text_files import read_table
from boresight.records.record import record, scalar
from boresight.star_id.observer import Observer

__all__ = ["SkyImage", "SkyImages", "observer_at", "observers_of", "open_sky_images"]


@record
class SkyImage:
    """One image that has not been read yet."""

    name: str = scalar("path as the user knows it")
    path: Path = scalar("image file")
    observer: Observer | None = scalar("time, position and velocity; None if unknown")
    bit_depth: int | None = scalar("bits of a count as a dump states them; None: estimated from the image")


@record
class SkyImages:
    """Images in the order of the command line."""

    images: tuple[SkyImage, ...] = scalar("images that can be used")
    camera: StarCamera | None = scalar("star camera of the first dump, if there is one")
    omitted: tuple[tuple[str, str], ...] = scalar("(image, reason) of those outside the orbit")


def open_sky_images(sources: Sequence[Path], known: Whereabouts) -> SkyImages:
    """The images of files and of dumps (folders); `known` applies to the files. Raises `RawDataError`."""
    observers = observers_of([source for source in sources if not source.is_dir()], known)
    images: list[SkyImage] = []
    omitted: list[tuple[str, str]] = []
    camera = None
    for source in sources:
        if not source.is_dir():
            images.append(SkyImage(str(source), source, observers.get(str(source)), None))
            continue
        dump = open_dump(source, allow_stale_eop=True)  # Earth rotation moves no star by 1e-6 arcsec
        camera = camera or dump.star_camera
        for image, reason in _of_dump(dump):
            if reason is None:
                images.append(image)
            else:
                omitted.append((image.name, reason))
    return SkyImages(tuple(images), camera, tuple(omitted))


def _of_dump(dump: Dump) -> Iterator[tuple[SkyImage, str | None]]:
    """A dump's exposures, each with the reason if the orbit does not cover it, else None."""
    every = [(images, exposure) for images in dump.star_images for exposure in images.exposures]
    for images, exposure in every:
        name = f"{dump.root.name}/{exposure.file}"
        observer, reason = None, None
        try:
            observer = _on_orbit(dump.orbit, exposure.t_s)
        except OrbitGapError as error:
            reason = str(error)
        yield SkyImage(name, exposure.path, observer, images.bit_depth), reason


def observers_of(images: Sequence[Path], known: Whereabouts) -> dict[str, Observer]:
    """The observer of each image by its path; `RawDataError` for contradicting or incomplete input.

    An image's time is that of the table, without one that of its file's header, if it has one. With times
    alone the observer is at the Earth's centre: this accounts for the annual aberration (20
    arc-seconds), not for that of a satellite's orbital velocity (5).
    """
    where, source = known.orbit or known.site_deg_m, known.times or Path("the image's header")
    if known.times is None:
        utc = {str(path): when for path in images if (when := time_of_image(path)) is not None}
        if where is not None and len(utc) < len(images):
            found = f"{where} without times of {len(images) - len(utc)} images"
            raise RawDataError("--orbit or --site", "use", found, "--times as well")
        if not utc:
            return {}
    else:
        by_name = _times(images, known.times)
        utc = {str(path): by_name[path.name] for path in images}
    if known.orbit is not None and known.site_deg_m is not None:
        raise RawDataError("--orbit", "use", "--site as well", "an orbit or a ground site")
    trajectory = _trajectory_of(known)
    return {name: _observer(trajectory, source, name, time) for name, time in utc.items()}


def observer_at(utc: str, site_deg_m: tuple[float, float, float] | None = None) -> Observer:
    """The observer of one image: at the Earth's centre, or at (latitude, longitude, height) on the ground."""
    known = Whereabouts(Path("time"), None, site_deg_m)
    return _observer(_trajectory_of(known), Path("time"), "the image", utc)


def _times(images: Sequence[Path], times: Path) -> dict[str, str]:
    """UTC by file name, one for each image."""
    if twice := [name for name, n in Counter(image.name for image in images).items() if n > 1]:
        found = f"images of the name {twice[0]} in several folders"
        raise RawDataError(str(times), "file", found, "images of different names")
    rows = read_table(times, SkyImageRow, str(times))
    by_name = {row.file: row.utc_mid for row in rows}
    if len(by_name) < len(rows):
        raise RawDataError(str(times), "file", f"{len(rows) - len(by_name)} repeated names", "each file once")
    if missing := [image.name for image in images if image.name not in by_name]:
        raise RawDataError(str(times), "file", f"no row for {missing[0]}", "a row for each image")
    return {image.name: by_name[image.name] for image in images}


def _trajectory_of(known: Whereabouts) -> Orbit | GroundSite | None:
    if known.orbit is not None:
        ephemeris = read_oem(known.orbit, str(known.orbit))
        return orbit_of(ephemeris, str(known.orbit), bundled_table(), allow_stale_eop=True)
    if known.site_deg_m is None:
        return None
    lat, lon, height = known.site_deg_m
    if not (abs(lat) <= 90.0 and abs(lon) <= 360.0 and -500.0 <= height <= 9000.0):
        expected = "latitude and longitude in degrees, height in metres from -500 to 9000"
        raise RawDataError("--site", "value", f"{lat}, {lon}, {height}", expected)
    return GroundSite.in_standard_weather(float(np.radians(lat)), float(np.radians(lon)), height)


def _observer(trajectory: Orbit | GroundSite | None, times: Path, name: str, utc: str) -> Observer:
    try:
        if isinstance(trajectory, Orbit):
            return _on_orbit(trajectory, float(trajectory.epoch.seconds_from_utc([utc])[0]))
        epoch = Epoch.from_utc(utc)
        t_s = float(epoch.seconds_from_utc([utc])[0])
        if trajectory is None:
            return Observer(epoch, t_s, np.zeros(3), np.zeros(3))
        earth = EarthRotation.over(epoch, t_s, t_s, bundled_table(), allow_stale_eop=True)
        state = trajectory.at(earth, t_s)
        return Observer(epoch, t_s, state.p_i, state.v_i, state.air)
    except ValueError as error:  # no such time, a gap of the orbit, a date before 1972
        raise RawDataError(
            str(times),
            f"utc_mid of {name}",
            f"{utc}: {error}",
            "a time within the orbit and the Earth-orientation table",
        ) from error


def _on_orbit(orbit: Orbit, t_s: float) -> Observer:
    p_i, v_i = orbit.states_i(np.array([t_s]))
    return Observer(orbit.epoch, t_s, p_i[0], v_i[0])
