"""The star side of a dump: its star cameras (heads), each at the level that the mission downlinks.

A head's source is a list of raw images, of centroids, or of attitudes that the head itself has solved. A dump
without `[[star_cameras]]` has one head of images. Images are not decoded here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import Interpolation, NominalMotion
from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.constants import ARCSEC
from boresight.geometry.earth_orientation import EarthOrientationTable
from boresight.geometry.epoch import Epoch
from boresight.geometry.gyro import GyroRecord, GyroRows
from boresight.geometry.orbit import Orbit, OrbitGapError
from boresight.geometry.star_camera import SmoothDistortion, StarCamera, term_orders
from boresight.geometry.starlight import AberrationRemoved, with_all_aberration
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files import dump_schema as schema
from boresight.pipeline.files.attitude_files import AttitudeRows, read_attitudes
from boresight.pipeline.files.centroid_files import read_centroids
from boresight.pipeline.files.dates import seconds_of
from boresight.pipeline.files.gyro_file import read_gyro
from boresight.pipeline.files.spice_kernels import CK, NO_KERNELS, Kernels, is_kernel, read_ck
from boresight.pipeline.files.text_files import each_once, path_inside, read_table, read_toml
from boresight.pipeline.files.usual_mistakes import AttitudeFault, find_attitude_fault, off_nadir
from boresight.records.ledger import Entry, Kind, Subject
from boresight.records.record import Floats, Ints, array, record, scalar
from boresight.star_id.centroids import Centroids

__all__ = [
    "Exposure",
    "Head",
    "SolvedAttitudes",
    "StarCentroids",
    "StarImages",
    "check_attitudes",
    "open_heads",
    "single_camera_of",
    "star_camera_of",
    "star_camera_table",
]

ONLY_HEAD = "star_camera"  # name of the head of a dump without [[star_cameras]]
Z = (0.0, 0.0, 1.0)  # line of sight of a camera in frame s


@record
class Exposure:
    """One line of exposures.csv."""

    exposure_id: str = scalar("id of the table")
    file: str = scalar("path as the table gives it")
    path: Path = scalar("path of the image")
    t_s: float = scalar("middle of the exposure, TAI seconds since the dump's epoch")
    exposure_s: float = scalar("exposure time, s")

    @property
    def item(self) -> Entry:
        """Kind, id and file of what is processed, without a reason."""
        return Entry(Subject(Kind.EXPOSURE, exposure=self.exposure_id), file=self.file)


@record
class StarImages:
    """Raw images of a star camera."""

    camera: StarCamera = scalar("camera of frame s")
    bit_depth: int = scalar("bits of a count")
    exposures: tuple[Exposure, ...] = scalar("in order of time")


@record
class StarCentroids:
    """Centroids of a star camera's images; the images themselves are not needed."""

    camera: StarCamera = scalar("camera of frame s")
    exposures: tuple[Exposure, ...] = scalar("in order of time")
    file: str = scalar("name of the file of all lists")
    lists: tuple[Centroids | None, ...] = scalar("of each exposure; None: the list has no star of it")


@record
class SolvedAttitudes:
    """Attitudes that a head has solved itself."""

    rows: AttitudeRows = scalar("as the file has them")
    file: str = scalar("name of the file")
    aberration_removed: AberrationRemoved = scalar("by the head")
    line_of_sight_s: Floats = array("3", "unit vector along the middle of its field, axes of s")

    def with_all_aberration(self, at: Ints, epoch: Epoch, orbit: Orbit) -> Rotation:
        """Attitudes (K,) of the rows `at`, which the orbit covers, of apparent directions of stars."""
        t_s = self.rows.t_s[at]
        return with_all_aberration(
            self.rows.R_si[at],
            self.aberration_removed,
            epoch,
            t_s,
            orbit.states_i(t_s)[1],
            line_of_sight_s=self.line_of_sight_s,
        )

    def usual_covariance_s(self, noise: AttitudeNoise) -> Floats:
        """Median covariance (3, 3) of an attitude, rad², axes of s: of the rows, or of the head's `noise`."""
        rows = self.rows.covariance_s
        if rows is None:
            return noise.white_covariance_s
        return np.asarray(rows[np.argsort(np.trace(rows, axis1=1, axis2=2), kind="stable")[len(rows) // 2]])


@record(kw_only=True)
class Head:
    """One star camera. `R_cs0` and its error are those of its own installation file."""

    name: str = scalar("as dump.toml has it")
    R_cs0: Rotation = scalar("installation rotation measured before launch, frame s to frame c")
    sigma_installation_rad: Floats = array("3", "1-sigma error of `R_cs0`: rotation about the axes of c")
    noise: AttitudeNoise = scalar("errors of its attitudes beside those of its stars")
    noise_is_assumed: bool = scalar("that noise is neither stated nor estimated", default=False)
    interpolation: Interpolation = scalar("between its attitudes")
    gyro: GyroRecord | None = scalar("of the reference head: a gyro, about its axes", default=None)
    source: StarImages | StarCentroids | SolvedAttitudes = scalar("what the head delivers")

    @property
    def subject(self) -> Subject:
        """The head as a subject."""
        return Subject(Kind.HEAD, head=self.name)

    @property
    def times_in(self) -> tuple[str, str]:
        """File and field of the dump that state the times of its attitudes, or exposures."""
        source = self.source
        return (source.file, "utc") if isinstance(source, SolvedAttitudes) else ("exposures.csv", "utc_mid")

    @property
    def line_of_sight_s(self) -> Floats:
        """Unit vector (3,) along the middle of its field of view, axes of s: z of a camera."""
        source = self.source
        return source.line_of_sight_s if isinstance(source, SolvedAttitudes) else np.array(Z)

    @property
    def is_smoothed(self) -> bool:
        """Whether its attitudes are smoothed: solved by itself, not interpolated in an operator's way."""
        return isinstance(self.source, SolvedAttitudes) and self.interpolation == "lagrange"

    def gyro_around(self, t_s: Floats, nominal: NominalMotion) -> GyroRows | None:
        """What the gyro tells around attitudes at instants (K,), as `GyroRecord.around`."""
        return None if self.gyro is None else self.gyro.around(t_s, nominal)

    @property
    def t_s(self) -> Floats:
        """Instants (K,) of its exposures, or attitudes, TAI seconds since the dump's epoch."""
        if isinstance(self.source, SolvedAttitudes):
            return self.source.rows.t_s
        return np.array([exposure.t_s for exposure in self.source.exposures])


def open_heads(
    root: Path,
    head: schema.DumpFile,
    epoch: Epoch,
    table: EarthOrientationTable,
    kernels: Kernels = NO_KERNELS,
) -> tuple[Head, ...]:
    """The heads of a dump, the reference head first, with the SPICE kernels that it names for CKs; the table
    of Earth orientation turns Earth-fixed attitudes.

    `RawDataError` for a file that is not valid.
    """
    stated = {f"star_cameras.{n}": one_head for n, one_head in enumerate(head.star_cameras)}
    if not stated:
        stated["files"] = schema.HeadFile(
            name=ONLY_HEAD,
            level="images",
            installation=str(head.files.installation),
            camera=head.files.star_camera,
            exposures=head.files.exposures,
        )
    reads = [partial(_head, root, *item, epoch, table, kernels) for item in stated.items()]
    if head.gyro is None:
        return tuple(_each(*reads))
    path = path_inside(root, head.gyro.file, file="dump.toml", field="gyro.file")
    *heads, gyro = _each(*reads, partial(read_gyro, path, head.gyro, epoch))
    return (replace(heads[0], gyro=gyro), *heads[1:])


def _head(
    root: Path,
    field: str,
    head: schema.HeadFile,
    epoch: Epoch,
    table: EarthOrientationTable,
    kernels: Kernels,
) -> Head:
    def inside(key: str) -> tuple[Path, str]:
        name = str(getattr(head, key))
        return path_inside(root, name, file="dump.toml", field=f"{field}.{key}"), name

    def read_source() -> StarImages | StarCentroids | SolvedAttitudes:
        if head.level == "attitudes":
            return _attitudes(head, *inside("attitudes"), epoch, table, kernels)
        reads: list[Callable[[], Any]] = [
            lambda: _camera(*inside("camera")),
            lambda: _exposures(root, *inside("exposures"), epoch),
        ]
        if head.level == "centroids":
            reads.append(lambda: read_centroids(*inside("centroids")))
        (camera, bits), exposures, *lists = _each(*reads)
        if not lists:
            return StarImages(camera, bits, exposures)
        of_exposures = tuple(lists[0].get(exposure.file) for exposure in exposures)
        return StarCentroids(camera, exposures, str(head.centroids), of_exposures)

    path, file = inside("installation")
    installation, source = _each(lambda: read_toml(path, schema.InstallationFile, file), read_source)
    return Head(
        name=head.name,
        R_cs0=Rotation.from_quat(installation.quaternion_cs),
        sigma_installation_rad=np.array(installation.sigma_rad),
        noise=_noise(head.noise),
        noise_is_assumed=head.noise.origin == "assumed",
        interpolation=head.interpolation,
        source=source,
    )


def _each(*reads: Callable[[], Any]) -> list[Any]:
    """What some functions return; the first `RawDataError` of any of them, with the others."""
    results: list[Any] = []
    faults: list[RawDataError] = []
    for read in reads:
        try:
            results.append(read())
        except RawDataError as error:
            faults += [error, *error.others]
    if faults:
        faults[0].others = tuple(faults[1:])
        raise faults[0]
    return results


def _camera(path: Path, file: str) -> tuple[StarCamera, int]:
    """The camera of a star_camera.toml, and the bits of its counts."""
    camera = read_toml(path, schema.StarCameraFile, file)
    return star_camera_of(camera, file), camera.bit_depth


def check_attitudes(
    heads: Sequence[Head], orbit: Orbit, orbit_file: str, strips: Sequence[tuple[float, float]]
) -> None:
    """`RawDataError` where attitudes of heads during strips of the ground (first and last instant) contradict
    the orbit, or a line of sight that is used meets the Earth. The orbit is named where all of several heads
    contradict it, and no mistake of theirs explains it.
    """
    wrong = [fault for head in heads if (fault := _contradiction(head, orbit, strips)) is not None]
    if 1 < len(heads) == sum(unexplained for _, unexplained in wrong):
        found = "an orbit with which no head's camera sees the Earth"
        expected = "the orbit of this satellite at these dates, in the stated frame"
        raise RawDataError(orbit_file, "positions and velocities", found, expected)
    if wrong:
        raise wrong[0][0]


def _contradiction(
    head: Head, orbit: Orbit, strips: Sequence[tuple[float, float]]
) -> tuple[RawDataError, bool] | None:
    """What is wrong with attitudes or line of sight, and if no usual mistake explains it."""
    source = head.source
    if not isinstance(source, SolvedAttitudes):
        return None
    t_s = source.rows.t_s
    begin, end = orbit.span_s
    during = np.zeros(len(t_s), dtype=bool)
    for first, last in strips:
        during |= (t_s >= max(first - 1.0, begin)) & (t_s <= min(last + 1.0, end))
    R_si = source.rows.R_si[during]
    try:
        fault = find_attitude_fault(t_s[during], R_si, head.R_cs0, orbit)
        blind_rad = _blind_rad(source, t_s[during], R_si, orbit)
    except OrbitGapError:  # strips that the orbit does not cover are not used, and reported as that
        return None
    if fault is not None:
        expected = "attitudes with which the camera sees the Earth"
        error = RawDataError(source.file, "quaternions", str(fault), expected)
        return error, fault.fault is AttitudeFault.UNRELATED
    if blind_rad is not None:
        direction = ", ".join(f"{value:.4g}" for value in source.line_of_sight_s)
        towards = f"[{direction}], which meets the Earth {np.degrees(blind_rad):.0f} deg off nadir"
        expected = "where this head sees stars, in the axes of its quaternions"
        return RawDataError("dump.toml", f"line_of_sight of {head.name}", towards, expected), False
    return None


def _blind_rad(source: SolvedAttitudes, t_s: Floats, R_si: Rotation, orbit: Orbit) -> float | None:
    """Angle to nadir of a line of sight that is used and meets the Earth at most instants (K,), else None."""
    if source.aberration_removed == "annual and orbital" or not len(t_s):
        return None
    on_earth, off_rad = off_nadir(R_si.inv().apply(source.line_of_sight_s), t_s, orbit)
    return float(np.median(off_rad)) if np.mean(on_earth) > 0.5 else None


def _noise(stated: schema.NoiseFile) -> AttitudeNoise:
    def of(values: Sequence[float] | None, unit: float, otherwise: float = 0.0) -> Floats:
        return np.full(3, otherwise) if values is None else np.array(values, dtype=float) * unit

    return AttitudeNoise(
        white_rad=of(stated.white_arcsec, ARCSEC),
        correlated_rad=of(stated.correlated_arcsec, ARCSEC),
        correlation_time_s=of(stated.correlation_time_s, 1.0, otherwise=1.0),
        constant_rad=of(stated.constant_arcsec, ARCSEC),
        constant_time_s=of(stated.constant_time_s, 1.0),
        periodic_rad=of(stated.periodic_arcsec, ARCSEC),
        period_s=stated.period_s or 1.0,
        harmonics=stated.harmonics,
    )


def _attitudes(
    head: schema.HeadFile, path: Path, file: str, epoch: Epoch, table: EarthOrientationTable, kernels: Kernels
) -> SolvedAttitudes:
    """Attitudes with the one statement of their white noise: of each row, or of the head."""
    rows = _rows(head, path, file, epoch, kernels).to_gcrs(epoch, table, file)
    stated = head.noise.white_arcsec
    if (rows.covariance_s is None) == (stated is None):
        found = "neither in the rows nor here" if stated is None else f"{stated} and in the rows of {file}"
        expected = "stated once: in the rows (sigma or covariance columns) or as noise.white_arcsec"
        raise RawDataError("dump.toml", f"noise.white_arcsec of {head.name}", found, expected)
    if stated is not None and min(stated) <= 0.0:
        raise RawDataError("dump.toml", f"noise.white_arcsec of {head.name}", stated, "positive values")
    assert head.aberration_removed is not None  # by the schema
    line_of_sight = np.array(Z if head.line_of_sight is None else head.line_of_sight)
    line_of_sight /= np.linalg.norm(line_of_sight)
    return SolvedAttitudes(rows, file, head.aberration_removed, line_of_sight)


def _rows(head: schema.HeadFile, path: Path, file: str, epoch: Epoch, kernels: Kernels) -> AttitudeRows:
    """Attitudes of a CK, or of a CSV file or a message, by the first bytes of the file."""
    if not is_kernel(path, file, CK):
        if head.spice_frame is not None:
            raise RawDataError(file, "byte 0", "no SPICE CK", f"a CK, for spice_frame of {head.name}")
        return read_attitudes(path, file, epoch, head.frame, head.rotation, head.time_scale)
    if head.spice_frame is None:
        expected = "this key: the name of the head's frame in the FK"
        raise RawDataError("dump.toml", f"spice_frame of {head.name}", "nothing", expected)
    for key in ("frame", "rotation", "time_scale"):
        if (value := getattr(head, key)) is not None:
            raise RawDataError("dump.toml", f"{key} of {file}", value, "no such key: the kernels state it")
    return read_ck(path, file, epoch, head.spice_frame, kernels)


def star_camera_table(camera: StarCamera, bits: int) -> dict[str, Any]:
    """The keys and values of a star_camera.toml, lengths to 14 digits: the inverse of `star_camera_of`."""
    focal_mm, pitch_um = (float(f"{value:.14g}") for value in (camera.focal_m * 1e3, camera.pixel_m * 1e6))
    smooth = {}
    if camera.smooth is not None:
        columns, rows = camera.smooth.coefficients_px.tolist()
        smooth = {"smooth": {"degree": camera.smooth.degree, "columns_px": columns, "rows_px": rows}}
    return {
        "focal_length_mm": focal_mm,
        "pixel_pitch_um": pitch_um,
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "principal_point_px": [float(v) for v in camera.principal_px],
        "bit_depth": bits,
        **({} if camera.projection == "tangent" else {"projection": camera.projection}),
        "distortion": {
            "p1_per_mm": camera.p1,
            "p2_per_mm": camera.p2,
            "q1_per_mm2": camera.q1,
            "q2_per_mm4": camera.q2,
            **({} if camera.q3 == 0.0 else {"q3_per_mm6": camera.q3}),
            **smooth,
        },
    }


def star_camera_of(file: schema.StarCameraFile, name: str) -> StarCamera:
    """The camera of a dump's star_camera.toml; `RawDataError` if a corner has no direction."""
    right, low = file.width_px - 0.5, file.height_px - 0.5
    return _invertible(file, name, np.array([[-0.5, -0.5], [right, -0.5], [-0.5, low], [right, low]]))


def single_camera_of(file: schema.StarCameraFile, name: str) -> StarCamera:
    """The camera of a star_camera.toml for single images: as `star_camera_of`, but of a fisheye all but the
    middle of the detector may lie behind the camera."""
    if file.projection == "tangent":
        return star_camera_of(file, name)
    return _invertible(file, name, np.array([[0.5 * (file.width_px - 1), 0.5 * (file.height_px - 1)]]))


def _invertible(file: schema.StarCameraFile, name: str, places: Floats) -> StarCamera:
    """The camera; `RawDataError` if a pixel of `places` (N, 2) has no direction."""
    x0, y0 = file.principal_point_px
    d = file.distortion
    camera = StarCamera(
        focal_m=file.focal_length_mm * 1e-3,
        pixel_m=file.pixel_pitch_um * 1e-6,
        width_px=file.width_px,
        height_px=file.height_px,
        principal_px=(x0, y0),
        p1=d.p1_per_mm,
        p2=d.p2_per_mm,
        q1=d.q1_per_mm2,
        q2=d.q2_per_mm4,
        q3=d.q3_per_mm6,
        projection=file.projection,
        smooth=_smooth_of(d.smooth, file, name),
    )
    if not np.isfinite(camera.directions_from_pixels(places)).all():
        found = "a distortion that is not invertible within the detector"
        raise RawDataError(name, "distortion", found, "p1, p2 in 1/mm, q1 in 1/mm^2, q2 in 1/mm^4")
    return camera


def _smooth_of(
    smooth: schema.SmoothDistortionFile | None, file: schema.StarCameraFile, name: str
) -> SmoothDistortion | None:
    if smooth is None:
        return None
    terms = len(term_orders(smooth.degree))
    for key, values in (("columns_px", smooth.columns_px), ("rows_px", smooth.rows_px)):
        if len(values) != terms:
            expected = f"{terms} coefficients for degree {smooth.degree}"
            raise RawDataError(name, f"distortion.smooth.{key}", f"{len(values)} coefficients", expected)
    return SmoothDistortion(
        degree=smooth.degree,
        coefficients_px=np.array([smooth.columns_px, smooth.rows_px], dtype=float),
        width_px=file.width_px,
        height_px=file.height_px,
    )


def _exposures(root: Path, path: Path, file: str, epoch: Epoch) -> tuple[Exposure, ...]:
    rows = read_table(path, schema.ExposureRow, file, "at least one exposure")
    each_once([row.id for row in rows], file)
    t_s = seconds_of(epoch, [row.utc_mid for row in rows], file, "utc_mid")
    if len(bad := np.flatnonzero(np.diff(t_s) <= 0)):
        k = int(bad[0])
        found = f"{rows[k + 1].utc_mid} ({rows[k + 1].id}) after {rows[k].utc_mid} ({rows[k].id})"
        raise RawDataError(file, f"line {k + 3}, utc_mid", found, "strictly increasing times")
    exposures = []
    for n, (row, t) in enumerate(zip(rows, t_s.tolist())):
        image = path_inside(root, row.file, file=file, field=f"line {n + 2}, file")
        exposures.append(Exposure(row.id, row.file, image, t, row.exposure_s))
    return tuple(exposures)
