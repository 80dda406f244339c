"""Single star images named: file -> stars found -> which they are, with the camera known, roughly known
or unknown.

One image's fault is one line of the outcome; the others go on.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.features.sky_images.image_time import NOWHERE, Whereabouts, time_of_image, with_error_of_focus
from boresight.features.sky_images.planets import Planet, planets_in_view
from boresight.geometry.constants import ARCSEC
from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.images.star_images import read_star_image
from boresight.pipeline.run.index_cache import cached_index
from boresight.pipeline.run.unforeseen import UNFORESEEN, internal_error
from boresight.records.record import Floats, record
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.field import LARGEST_FOV_RAD, SMALLEST_FOV_RAD, FieldSolution, ra_dec_roll, solve_list
from boresight.star_id.finding.star_list import StarList, list_stars
from boresight.star_id.fisheye import FISHEYE_RAD, WIDEST_RAD, is_fisheye
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.identification.triangle_index import StarIndex, equivalent_fov
from boresight.star_id.observer import Observer
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import explained

__all__ = [
    "Line",
    "Request",
    "bound_words",
    "check_field",
    "departure",
    "identify_images",
    "misshapen_in",
    "own_name",
    "read_camera",
    "read_sky_image",
    "sky_index",
    "with_unknown_time",
]

# Least rms displacement, px, by which a given camera is said not to fit: twice what a calibration may leave.
TOLD_PX = 0.02
LEAST_EXPONENT = -30.0  # of ten, of a probability that is stated
_INDICES = 4  # kept in memory, mapped from files: of unknown cameras, and of the known ones asked for last
CATALOGUE_YEAR, EPOCH_ERROR_YEARS = 2020.0, 6.0  # of images without time


@record(by_value=True)
class Line:
    """What there is to say about one image."""

    text: str
    identified: bool
    record: dict[str, Any]  # file, identified, ra_deg, dec_deg, roll_deg, fov_x_deg, matches, rms_arcsec, ...
    found: FieldSolution | None
    image: NDArray[Any] | None = None  # as read; None for a list of centroids, or where it was not read
    stars: StarList | None = None  # found in it
    planets: tuple[Planet, ...] = ()  # in view at the image's time, where that is known


@record(by_value=True)
class Request:
    """What is known of the camera, and what is drawn."""

    camera_file: Path | None = None
    fov_deg: float | None = None
    dark_file: Path | None = None
    size_px: tuple[int, int] | None = None  # of the images of a list of centroids
    known: Whereabouts = NOWHERE
    catalogue_places: bool = False  # times in the images' headers are not used
    overlay: Path | None = None  # PNG; with several images each adds its own name


def identify_images(images: Sequence[Path], request: Request, settings: StarSettings) -> Iterator[Line]:
    """One line per image; `RawDataError` for wrong options."""
    camera = read_camera(request.camera_file)
    check_field(request.fov_deg)
    dark = None if request.dark_file is None else read_star_image(request.dark_file, str(request.dark_file))
    fov = None if request.fov_deg is None else float(np.radians(request.fov_deg))
    observers = {} if request.catalogue_places else _observers(images, request.known)
    settings = with_unknown_time(settings)
    index = sky_index(camera, request.fov_deg, settings)
    width = max(len(str(path)) for path in images)
    for path in images:
        started = time.process_time()
        if path.suffix.lower() == ".csv":
            for name, solved in _of_centroids(path, camera, request, index, settings):
                if isinstance(solved, NotIdentified):
                    yield _unnamed(name, width, "not identified", solved.reason, started)
                    continue
                record = _record(name, solved, _spent_ms(started))
                yield Line(f"{name!s:{width}s}   {_facts(record, solved)}", True, record, solved)
            continue
        try:
            image = read_sky_image(path, camera, request.camera_file)
            if dark is not None and dark.shape != image.shape:
                shapes = (f"{d.shape[1]} x {d.shape[0]} px" for d in (dark, image))
                raise RawDataError(str(request.dark_file), "image size", *shapes)
            observer = observers.get(str(path))
            stars = list_stars(image, settings, dark)
            size = (image.shape[1], image.shape[0])
            solved = solve_list(stars, size, index, settings, camera=camera, fov_x_rad=fov, observer=observer)
        except RawDataError as error:
            yield _unnamed(path, width, "not read", str(error), started)
            continue
        except UNFORESEEN as error:
            reason = internal_error(error, "identify")
            yield _unnamed(path, width, "not identified", reason, started)
            continue
        if isinstance(solved, NotIdentified):
            reason = explained(solved, image, stars.saturation_dn).reason
            line = _unnamed(path, width, "not identified", reason, started)
            yield replace(line, image=image, stars=stars)
            continue
        solved, spent_ms = with_error_of_focus(solved, path), _spent_ms(started)
        planets = () if observer is None else planets_in_view(solved, observer)
        if request.overlay is not None:
            _draw(image, solved, planets, request, own_name(request.overlay, path, len(images)))
        record = _record(path, solved, spent_ms)
        record["planets"] = [
            {"name": p.name, "xy_px": [p.x_px, p.y_px], "detected": p.detection >= 0} for p in planets
        ]
        text = f"{path!s:{width}s}   {_facts(record, solved)}{_named(planets)}"
        yield Line(text, True, record, solved, image, stars, planets)


def _named(planets: Sequence[Planet]) -> str:
    """The planets that are detected, as text."""
    return "".join(f"   {p.name} at ({p.x_px:.0f}, {p.y_px:.0f}) px" for p in planets if p.detection >= 0)


def _of_centroids(
    path: Path, camera: StarCamera | None, request: Request, index: StarIndex, settings: StarSettings
) -> Iterator[tuple[Path, FieldSolution | NotIdentified]]:
    """The images of a list of centroids by their names; `RawDataError` where their size is not known."""
    from boresight.pipeline.files.centroid_files import read_centroids  # with pydantic 0.1 s to load

    size = request.size_px if camera is None else (camera.width_px, camera.height_px)
    if size is None:
        expected = "the option --camera or --size: a list of centroids does not tell the size of the images"
        raise RawDataError(str(path), "camera", "nothing", expected)
    fov = None if request.fov_deg is None else float(np.radians(request.fov_deg))
    for name, centroids in read_centroids(path, str(path)).items():  # brightest first
        ranks = np.arange(len(centroids.xy_px), dtype=np.float64)
        stars = StarList.of_centroids(centroids, -ranks, size)
        yield Path(name), solve_list(stars, size, index, settings, camera=camera, fov_x_rad=fov)


def read_camera(file: Path | None) -> StarCamera | None:
    """The camera of a star_camera.toml. `RawDataError` names file and field where it is not complete."""
    if file is None:
        return None
    from boresight.pipeline.files.dump_schema import StarCameraFile  # 0.1 s to load, as the two below
    from boresight.pipeline.files.star_side import single_camera_of
    from boresight.pipeline.files.text_files import read_toml

    return single_camera_of(read_toml(file, StarCameraFile, str(file)), str(file))


def _observers(images: Sequence[Path], known: Whereabouts) -> dict[str, Observer]:
    """The observer of each image by its path, where the user or the image's header states its time."""
    stated = known.times is not None or known.orbit is not None or known.site_deg_m is not None
    if not stated and not any(time_of_image(path) for path in images):
        return {}
    from boresight.features.sky_images.frame_facts import observers_of  # with orbits, terrain 0.3 s to load

    return observers_of(images, known)


def read_sky_image(path: Path, camera: StarCamera | None, camera_file: Path | None) -> NDArray[Any]:
    """An image (height, width); `RawDataError` if its size is not the camera's."""
    image = read_star_image(path, str(path))
    if camera is not None and image.shape != (camera.height_px, camera.width_px):
        found = f"{image.shape[1]} x {image.shape[0]} px"
        expected = f"{camera.width_px} x {camera.height_px} px, as in {camera_file}"
        raise RawDataError(str(path), "image size", found, expected)
    return image


def _unnamed(path: Path, width: int, what: str, reason: str, started: float) -> Line:
    record = {"file": str(path), "identified": False, "cpu_ms": _spent_ms(started)}
    record["reason"] = f"{what}: {reason}"
    return Line(f"{path!s:{width}s}   {record['reason']}", False, record, None)


def _spent_ms(started: float) -> float:
    return round(1e3 * (time.process_time() - started), 2)


def _record(path: Path, found: FieldSolution, spent_ms: float) -> dict[str, Any]:
    ra_deg, dec_deg, roll_deg = np.degrees(ra_dec_roll(found.camera, found.R_si)).tolist()
    return {
        "file": str(path),
        "identified": True,
        "ra_deg": ra_deg,
        "dec_deg": dec_deg,
        "roll_deg": roll_deg,
        "fov_x_deg": float(np.degrees(found.fov_x_rad)),
        "matches": found.matches,
        "rms_arcsec": found.rms_arcsec,
        "false_alarm_probability": found.false_alarm_probability,
        "cpu_ms": spent_ms,
        "pointing_sigma_arcsec": found.pointing_sigma_rad / ARCSEC,
        "roll_sigma_arcsec": found.roll_sigma_rad / ARCSEC,
        "fov_x_sigma_deg": float(np.degrees(found.fov_x_sigma_rad)),
        "misfit_px": found.misfit_px,
        "mirrored": found.mirrored,
    }


def own_name(path: Path, image: Path, count: int) -> Path:
    """The file of one of `count` images; with several each adds its own name."""
    return path if count == 1 else path.with_name(f"{path.stem}-{image.stem}{path.suffix}")


def misshapen_in(image: NDArray[Any], stars: StarList) -> Floats:
    """Places (M, 2) of detections of no star's shape, without those whose fit left the image."""
    inside = ((stars.misshapen_px > 0.0) & (stars.misshapen_px < image.shape[::-1])).all(axis=1)
    return np.asarray(stars.misshapen_px[inside])


def _draw(
    image: NDArray[Any], found: FieldSolution, planets: Sequence[Planet], request: Request, path: Path
) -> None:
    """Write the image with what is in it named, a mirror image reversed."""
    from boresight.features.sky_images.overlay import named_sky  # with Matplotlib's fonts 0.3 s to load

    picture = named_sky(image[:, ::-1] if found.mirrored else image, found, planets)
    if not cv2.imwrite(str(path), picture[:, :, ::-1]):
        raise RawDataError(str(path), "overlay", "could not be written", "the name of a PNG file in a folder")


def _facts(record: dict[str, Any], found: FieldSolution) -> str:
    """The line of text with the numbers of `record`."""
    return (
        "{matches:4d} stars   rms {rms_arcsec:.1f} arcsec   "
        "RA {ra_deg:.5f}  Dec {dec_deg:+.5f} deg +- {pointing_sigma_arcsec:.2f} arcsec   "
        "roll {roll_deg:.4f} deg +- {roll_sigma_arcsec:.1f} arcsec   FOV {fov_x_deg:.4f} deg   "
    ).format_map(record) + (
        f"wrong with probability {bound_words(found)}"
        + ("" if found.camera.projection == "tangent" else "   fisheye projection")
        + (f"   {departing}" if (departing := departure(found)) else "")
        + ("   MIRROR IMAGE: all is stated for its columns reversed" if found.mirrored else "")
    )


def bound_words(found: FieldSolution) -> str:
    """The bound of the probability of a false answer; one that no experience can tell from 0 is cut short."""
    exponent = found.log_false_alarm_probability / np.log(10.0)
    return f"below 1e{max(exponent, LEAST_EXPONENT):.0f}"


def check_field(fov_deg: float | None) -> None:
    """`RawDataError` for a stated field of view that no camera here has."""
    if fov_deg is not None and not 0.5 < fov_deg <= np.degrees(WIDEST_RAD):
        expected = (
            "between 0.5 and 175 degrees: 90 from the axis a camera has no directions;"
            " state 175, or crop the image"
        )
        raise RawDataError("--fov", "value", f"{fov_deg}", expected)


@lru_cache(maxsize=4)  # every image asks
def with_unknown_time(settings: StarSettings) -> StarSettings:
    """Settings by which stars of images without time have the errors of unknown years."""
    return replace(settings, epoch_error_years=settings.epoch_error_years or EPOCH_ERROR_YEARS)


def departure(found: FieldSolution) -> str:
    """A sentence, where the stars show that a camera is not as it was given; else empty."""
    if found.misfit_px < TOLD_PX or found.fov_x_sigma_rad:
        return ""
    return (
        f"NOT THE CAMERA GIVEN: stars are displaced by {found.misfit_px:.2g} px rms (another focal length or"
        " lens, rolling shutter, refraction); the stated errors include it"
    )


def sky_index(camera: StarCamera | None, fov_deg: float | None, settings: StarSettings) -> StarIndex:
    """Catalogue triangles for what is known of the camera."""
    fov = None if fov_deg is None else float(np.radians(fov_deg))
    if camera is not None and not is_fisheye(camera):
        return _built(equivalent_fov(camera.width_px, camera.height_px, camera.focal_m / camera.pixel_m))
    if fov is None or SMALLEST_FOV_RAD <= fov <= LARGEST_FOV_RAD or fov >= FISHEYE_RAD:
        return _built((float(SMALLEST_FOV_RAD), float(LARGEST_FOV_RAD)))  # of a fisheye its middle is named
    spread = 1.0 + 2.0 * settings.fov_tolerance
    return _built((0.5 * fov / spread, 1.2 * fov * spread))  # the area may be that of a tall or a wide image


@lru_cache(maxsize=_INDICES)
def _built(fov_rad: float | tuple[float, float]) -> StarIndex:
    return cached_index(hipparcos_stars().places, CATALOGUE_YEAR, fov_rad)
