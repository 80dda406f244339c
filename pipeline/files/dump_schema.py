"""The text files of a dump: keys, types and ranges (docs/dump-format.md gives them with examples).

Units are those of the files and part of the names. Unknown keys are refused, numbers must be finite. The
ranges are wider than any instrument's; they exclude what can only be a wrong unit or a damaged file.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
    model_validator,
)

__all__ = [
    "DIRECTION_LENGTH",
    "LOOK_TABLES",
    "DumpFile",
    "EarthOrientationRow",
    "ExposureRow",
    "HeadFile",
    "InstallationFile",
    "LookCameraFile",
    "LookRow",
    "NoiseFile",
    "PixelRow",
    "PointRow",
    "RemoteCameraFile",
    "StarCameraFile",
    "StripRow",
    "TargetRow",
    "head_of_dump",
]


# Names that Windows gives to no file, whatever follows a point in them.
DEVICES = {"CON", "PRN", "AUX", "NUL", *(f"{port}{n}" for port in ("COM", "LPT") for n in range(1, 10))}
DIRECTION_LENGTH = 1e-3  # tolerated error of a unit vector's length: three decimals


def _one_line(text: str) -> str:
    if not text.isprintable():
        raise ValueError("text must be one line without control characters")
    return text


def _portable(text: str) -> str:
    if text.endswith(".") or text.partition(".")[0].upper() in DEVICES:
        raise ValueError("an id that names a file on every system: no . at the end, no device of Windows")
    return text


def numbers(count: int, meaning: str) -> Any:
    """A list of so many numbers; `meaning` says what they are."""
    return Field(min_length=count, max_length=count, description=meaning)


def within(low: float, high: float, meaning: str) -> Any:
    """A number from `low` to `high`; `meaning` says what it is, and why it cannot be larger."""
    return Field(ge=low, le=high, description=meaning)


Id = Annotated[
    str,
    StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$"),
    AfterValidator(_portable),  # files are named by it
    Field(description="letters, digits, _ - . after a letter or digit, at most 64"),
]
Line = Annotated[str, AfterValidator(_one_line)]  # it is copied into files of other formats
RelativePath = Annotated[str, StringConstraints(min_length=1, max_length=255)]
Utc = Annotated[
    str,
    StringConstraints(pattern=r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d{1,12})?Z?$"),
    Field(description="UTC as 2026-03-20T10:15:30.5Z, with 0 to 12 decimals"),
]
BitDepth = Annotated[int, within(8, 16, "bits of a count")]
Samples = Annotated[int, within(16, 65536, "pixels along one side of a detector")]
PixelPitch = Annotated[float, within(0.1, 1000.0, "side of a pixel, µm")]
# A focal plane and its tables are smaller than 10 m; a sample number has at most seven digits.
FocalPlane = Annotated[float, within(-1e4, 1e4, "coordinate in the focal plane, mm")]
Sample = Annotated[float, within(-1e6, 1e6, "coordinate along the detector, samples")]
ShiftPx = Annotated[float, within(-1e3, 1e3, "displacement of image points, px")]
TargetSigma = Annotated[float, within(0.0, 1e5, "1-sigma error of a target's coordinate, m")]
PointSigma = Annotated[float, within(1e-4, 1e4, "1-sigma error of a measured image position, px")]
HeightKind = Literal["ellipsoidal", "egm96"]
LOOK_TABLES = "look tables"  # `model` of a remote camera


# No other keys, finite numbers; checks are built for the tables that are read.
CLOSED = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, defer_build=True)


class _Strict(BaseModel):
    model_config: ClassVar[ConfigDict] = CLOSED | ConfigDict(strict=True)


class _Row(BaseModel):
    """A row of a CSV file: all cells are text from which numbers are read."""

    model_config: ClassVar[ConfigDict] = CLOSED | ConfigDict(str_strip_whitespace=True)


class Conventions(_Strict):
    """The conventions of the format, stated in the file; no others are accepted."""

    inertial_frame: Literal["GCRS"]
    earth_fixed_frame: Literal["ITRS"]
    time_scale: Literal["UTC"]
    quaternions: Literal["scalar-last"]
    image_origin: Literal["centre of first pixel is (0, 0)"]


FILES = {  # that every written dump has, by their names in it
    "star_camera": "star_camera.toml",
    "remote_camera": "remote_camera.toml",
    "installation": "installation.toml",
    "orbit": "orbit.oem",
    "exposures": "exposures.csv",
    "strips": "strips.csv",
}


def head_of_dump(mission: str, created_by: str) -> dict[str, Any]:
    """First keys of a dump.toml, with the conventions of the format."""
    conventions = {name: get_args(field.annotation)[0] for name, field in Conventions.model_fields.items()}
    about = {"mission": mission, "created_by": created_by}
    return {"format": "boresight-dump", "format_version": 1, **about, "conventions": conventions}


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


class Files(_Strict):
    """Paths of the other files, relative to the dump."""

    remote_camera: RelativePath | None = None  # unless [[cameras]] say it
    orbit: RelativePath
    strips: RelativePath
    targets: RelativePath | None = None
    points: RelativePath | None = None
    terrain: Annotated[
        Annotated[list[RelativePath], Field(min_length=1, max_length=256)] | None, BeforeValidator(_listed)
    ] = None
    earth_orientation: RelativePath | None = None
    star_camera: RelativePath | None = None  # with installation and exposures, unless [[star_cameras]] say it
    installation: RelativePath | None = None
    exposures: RelativePath | None = None
    star_catalogue: RelativePath | None = None  # of strips of the sky; without it the bundled Hipparcos

    @property
    def single(self) -> dict[str, str]:
        """Fields that are stated, without the terrain models, and the file of each."""
        return self.model_dump(exclude_none=True, exclude={"terrain"})


MOUNTING = "mounting between strips, per axis, arc-seconds"
MountingSize = Annotated[float, Field(gt=0.0, le=3600.0, description=MOUNTING)]
MotionSize = Annotated[float, Field(ge=0.0, le=3600.0, description="slow motion, rms per axis, arc-seconds")]
MotionTime = Annotated[float, Field(ge=1e-3, le=1e3, description="time over which it is smooth, s")]
CorrelationTime = Annotated[
    float,
    Field(ge=0.0, le=1e7, description="time after which the error has the correlation 1/e, s; 0: a pass"),
]
OF_LOOK_DISTORTION = 0.2  # a CCD's own shift, slope and bend, where not stated: NEES in band for either kind
OfCcd = Annotated[float, Field(ge=0.0, le=1e3, description="look vectors of one CCD, per axis, rms, pixels")]


class Errors(_Strict):
    """Errors of the mission's own data, each as 1-sigma of a zero-mean error."""

    position_m: float = within(0.0, 1e5, "orbit, per axis and strip, m; a two-line element set has some km")
    position_time_s: CorrelationTime = 0.0
    clock_s: float = within(0.0, 10.0, "time tags of the strips against those of the exposures, s")
    clock_time_s: CorrelationTime = 0.0
    vibration_arcsec: float = within(0.0, 3600.0, "attitude between exposures, per axis, arc-seconds")
    mounting_arcsec: MountingSize = 10.0  # of a structure that warms and cools
    motion_arcsec: MotionSize = 6.0  # oscillations of 3 to 12 arcsec, the paper's Fig. 4
    motion_s: MotionTime = 0.8  # of periods of 3 to 7 s
    look_distortion_px: float = within(0.0, 1e3, "look vectors of the remote-sensing camera, pixels")
    look_distortion_length_px: float = within(1.0, 1e6, "correlation length of that error, pixels")
    look_ccd_shift_px: OfCcd | None = None  # not stated: `OF_LOOK_DISTORTION` of look_distortion_px
    look_ccd_slope_px: OfCcd | None = None
    look_ccd_bend_px: OfCcd | None = None

    @property
    def look_ccd_px(self) -> tuple[float, float, float]:
        """Shift, slope and bend of each CCD by itself, per axis, rms over the CCD, pixels."""
        usual = OF_LOOK_DISTORTION * self.look_distortion_px
        stated = (self.look_ccd_shift_px, self.look_ccd_slope_px, self.look_ccd_bend_px)
        shift, slope, bend = (usual if one is None else one for one in stated)
        return shift, slope, bend

    @property
    def look_px(self) -> float:
        """All of the look vectors' error, per axis, pixels: the curve over the field and the CCDs' own."""
        return math.hypot(self.look_distortion_px, *self.look_ccd_px)


class TerrainHeights(_Strict):
    """What the heights of the terrain model are."""

    height_kind: HeightKind
    sigma_m: float = within(0.0, 1e4, "1-sigma error of a height, m; no mountain is higher")


class Light(_Strict):
    """Which effects on light the mission's own software models, where it leaves some out"""

    light_time: bool = True
    aberration: bool = True
    refraction: bool = True


OfAxis = Annotated[float, Field(ge=0.0, le=36_000.0)]
OfAxes = Annotated[list[OfAxis], numbers(3, "about x, y, z of frame s, arc-seconds, at most 10°")]
OfTime = Annotated[float, Field(ge=1e-3, le=1e5)]
OfAxesTimes = Annotated[list[OfTime], numbers(3, "about x, y, z of frame s, seconds")]


class NoiseFile(_Strict):
    """Errors of a head's attitudes: white, correlated over a time, constant over a strip, periodic"""

    white_arcsec: OfAxes | None = None
    correlated_arcsec: OfAxes | None = None
    correlation_time_s: OfAxesTimes | None = None
    constant_arcsec: OfAxes | None = None
    constant_time_s: OfAxesTimes | None = None
    periodic_arcsec: OfAxes | None = None
    period_s: Annotated[float, Field(ge=60.0, le=1e6, description="of a periodic error, s")] | None = None
    harmonics: Annotated[int, Field(ge=1, le=4, description="terms of its Fourier series")] = 1
    origin: Literal["stated", "estimated", "assumed"] = "stated"

    @model_validator(mode="after")
    def _correlation_is_complete(self) -> Self:
        if (self.correlated_arcsec is None) != (self.correlation_time_s is None):
            raise ValueError("correlated_arcsec and correlation_time_s come together or not at all")
        if self.constant_time_s is not None and self.constant_arcsec is None:
            raise ValueError("constant_time_s comes with constant_arcsec")
        if (self.periodic_arcsec is None) != (self.period_s is None):
            raise ValueError("periodic_arcsec and period_s come together or not at all")
        return self


OfUnit = Annotated[float, Field(ge=-1.01, le=1.01)]  # a component of a unit vector or quaternion
Direction = Annotated[list[OfUnit], numbers(3, "unit vector in the axes of the head's attitudes")]
SpiceName = Annotated[str, StringConstraints(pattern=r"^[A-Z0-9_+\-./]{1,32}$")]


class SpiceFile(_Strict):
    """SPICE kernels beside a CK or an SPK, in the order in which they are loaded"""

    kernels: Annotated[list[RelativePath], Field(max_length=64)] = []
    spacecraft: Annotated[int, Field(ge=-(2**31), lt=2**31, description="NAIF id in the SPK")] | None = None


class HeadFile(_Strict):
    """One table of [[star_cameras]] in dump.toml"""

    name: Id
    level: Literal["images", "centroids", "attitudes"]
    installation: RelativePath
    camera: RelativePath | None = None
    exposures: RelativePath | None = None
    centroids: RelativePath | None = None
    attitudes: RelativePath | None = None
    frame: Literal["GCRF", "ICRF", "EME2000", "ITRF"] | None = None
    rotation: Literal["head to inertial", "inertial to head"] | None = None
    spice_frame: SpiceName | None = None  # of a CK: the head's frame in the FK
    time_scale: Literal["UTC", "TAI", "GPS"] | None = None  # of a CSV file of attitudes; None: UTC
    aberration_removed: Literal["none", "annual", "annual and orbital"] | None = None
    line_of_sight: Direction | None = None  # of a head whose attitudes lack aberration
    interpolation: Literal["lagrange", "taylor"] = "lagrange"  # geometry.attitude.interpolation_weights
    noise: NoiseFile = NoiseFile()

    @model_validator(mode="after")
    def _keys_are_those_of_the_level(self) -> Self:
        of_level = {
            "images": {"camera", "exposures"},
            "centroids": {"camera", "exposures", "centroids"},
            "attitudes": {"attitudes", "aberration_removed"},
        }
        needed = of_level[self.level]
        if missing := sorted(name for name in needed if getattr(self, name) is None):
            raise ValueError(f"level {self.level!r} needs the key {missing[0]}")
        of_file = {"frame", "rotation", "time_scale", "spice_frame"}
        allowed = needed | (of_file | {"line_of_sight"} if self.level == "attitudes" else set())
        for name in set.union(*of_level.values(), of_file, {"line_of_sight"}):
            if name not in allowed and getattr(self, name) is not None:
                raise ValueError(f"level {self.level!r} has no key {name}")
        if self.level != "attitudes" and self.noise.white_arcsec is not None:
            raise ValueError(f"level {self.level!r} has no key noise.white_arcsec: its stars give it")
        self._check_line_of_sight()
        return self

    def _check_line_of_sight(self) -> None:
        line = self.line_of_sight
        if line is None and self.aberration_removed in ("none", "annual"):
            raise ValueError(
                f"aberration_removed = {self.aberration_removed!r} of {self.name} needs line_of_sight, a "
                "unit vector in the axes of the quaternions ([0, 0, 1] for z): it is put right along it"
            )
        if line is not None and abs((length := math.hypot(*line)) - 1.0) > DIRECTION_LENGTH:
            needed = f"1 within {DIRECTION_LENGTH:g} is needed"
            raise ValueError(f"line_of_sight has length {length:.4g}, {needed}")


class GyroFile(_Strict):
    """[gyro] in dump.toml: its file, the axes of its rows, and its errors, the same about every axis"""

    file: RelativePath
    quantity: Literal["rates", "angles"]  # at the instant of a row, or turned since the row before
    unit: Literal["rad", "deg", "arcsec"]  # of angles; of rates: in one second
    time_scale: Literal["UTC", "TAI", "GPS"] = "UTC"
    quaternion_sg: Annotated[list[OfUnit], numbers(4, "axes of its rows to frame s, scalar last")]
    random_walk_arcsec: float = within(1e-6, 1e3, "angle random walk: 1-sigma after one second")
    bias_walk_arcsec_s: float = within(1e-9, 1e3, "1-sigma by which the bias changes in one second")
    bias_arcsec_s: Annotated[
        float | None, Field(ge=1e-9, le=1e4, description="1-sigma of the bias; left out: not known at all")
    ] = None
    white_arcsec: Annotated[float, within(0.0, 1e3, "1-sigma of an angle by itself, its resolution")] = 0.0

    @model_validator(mode="after")
    def _is_rotation(self) -> Self:
        if abs((length := math.hypot(*self.quaternion_sg)) - 1.0) > DIRECTION_LENGTH:
            needed = f"1 within {DIRECTION_LENGTH:g} is needed"
            raise ValueError(f"quaternion_sg has length {length:.6g}, {needed}")
        return self


class CameraFile(_Strict):
    """One table of [[cameras]] in dump.toml: one of several remote-sensing cameras"""

    id: Id
    file: RelativePath
    installation: RelativePath | None = None  # of the reference head; None: that of the star camera's table


class GroundReferenceFile(_Strict):
    """One table of [[ground_references]] in dump.toml: an offset that points of a mosaic or a survey share"""

    id: Id
    sigma_east_m: float = within(0.0, 1e4, "1-sigma of the offset to the east, m")
    sigma_north_m: float = within(0.0, 1e4, "to the north, m")
    sigma_up_m: float = within(0.0, 1e4, "of the heights, m")
    correlation_km: Annotated[
        float, within(0.0, 1e5, "distance at which the offsets' correlation is 1/e; 0: one offset")
    ] = 0.0


class DumpFile(_Strict):
    """dump.toml"""

    format: Literal["boresight-dump"]
    format_version: Literal[1]
    mission: Annotated[Line, StringConstraints(min_length=1, max_length=200)]
    satellite: Annotated[Line, StringConstraints(max_length=200)] = ""
    created_by: Annotated[Line, StringConstraints(max_length=500)] = ""
    conventions: Conventions
    files: Files
    errors: Errors
    terrain: TerrainHeights | None = None
    light: Light = Light()
    spice: SpiceFile | None = None
    star_cameras: Annotated[list[HeadFile], Field(max_length=16)] = []
    gyro: GyroFile | None = None
    cameras: Annotated[list[CameraFile], Field(max_length=64)] = []
    ground_references: Annotated[list[GroundReferenceFile], Field(max_length=1000)] = []

    @property
    def remote_cameras(self) -> dict[str, str]:
        """File of each remote-sensing camera; the only one has no name."""
        return {one.id: one.file for one in self.cameras} or {"": str(self.files.remote_camera)}

    @property
    def paths(self) -> dict[str, str]:
        """Fields of this file that name another file of the dump, with the names."""
        files = {f"files.{key}": name for key, name in self.files.single.items()}
        files |= {f"files.terrain.{n}": name for n, name in enumerate(self.files.terrain or ())}
        keys = {
            "star_cameras": ("installation", "camera", "exposures", "centroids", "attitudes"),
            "cameras": ("file", "installation"),
        }
        of_rows = {
            f"{table}.{n}.{key}": name
            for table, of_table in keys.items()
            for n, row in enumerate(getattr(self, table))
            for key in of_table
            if (name := getattr(row, key)) is not None
        }
        kernels = self.spice.kernels if self.spice else []
        files |= {"gyro.file": self.gyro.file} if self.gyro else {}
        return files | of_rows | {f"spice.kernels.{n}": name for n, name in enumerate(kernels)}

    @model_validator(mode="after")
    def _star_side_is_stated_once(self) -> Self:
        for name in ("star_camera", "installation", "exposures"):
            stated = getattr(self.files, name) is not None
            if stated and self.star_cameras:
                raise ValueError(f"files.{name} and [[star_cameras]] exclude one another")
            if not stated and not self.star_cameras:
                raise ValueError(f"files.{name} is missing (or [[star_cameras]] that say it)")
        names = [head.name for head in self.star_cameras]
        if len(set(names)) < len(names):
            raise ValueError("star_cameras: each name once")
        return self

    @model_validator(mode="after")
    def _cameras_are_stated_once(self) -> Self:
        if (self.files.remote_camera is not None) == bool(self.cameras):
            both = "exclude one another" if self.cameras else "are both missing: one of them says it"
            raise ValueError(f"files.remote_camera and [[cameras]] {both}")
        for name in ("cameras", "ground_references"):
            ids = [one.id.casefold() for one in getattr(self, name)]
            if len(set(ids)) < len(ids):
                raise ValueError(f"{name}: each id once")
        return self

    @model_validator(mode="after")
    def _terrain_is_described(self) -> Self:
        if (self.files.terrain is None) != (self.terrain is None):
            raise ValueError("files.terrain and the table [terrain] come together or not at all")
        return self


class SmoothDistortionFile(_Strict):
    """Displacement by Legendre polynomials, as `star-camera-calibrate` fits it to foreign lenses."""

    degree: Annotated[int, Field(ge=2, le=12, description="largest sum of the orders of a term")]
    columns_px: Annotated[list[ShiftPx], Field(max_length=100, description="coefficients along columns, px")]
    rows_px: Annotated[list[ShiftPx], Field(max_length=100, description="coefficients along rows, px")]


class StarDistortion(_Strict):
    """Coefficients of the lens distortion; 100 would double the distance from the axis at 0.1 mm."""

    p1_per_mm: float = within(-100.0, 100.0, "decentring along x, 1/mm")
    p2_per_mm: float = within(-100.0, 100.0, "decentring along y, 1/mm")
    q1_per_mm2: float = within(-100.0, 100.0, "radial, second order, 1/mm²")
    q2_per_mm4: float = within(-100.0, 100.0, "radial, fourth order, 1/mm⁴")
    q3_per_mm6: Annotated[float, within(-100.0, 100.0, "radial, sixth order, 1/mm⁶; absent: 0")] = 0.0
    smooth: SmoothDistortionFile | None = None


class StarCameraFile(_Strict):
    """star_camera.toml"""

    focal_length_mm: float = within(1.0, 1e5, "focal length, mm; at most 100 m")
    pixel_pitch_um: PixelPitch
    width_px: Samples
    height_px: Samples
    principal_point_px: Annotated[
        list[Sample], numbers(2, "column and row where the optical axis meets the detector")
    ]
    bit_depth: BitDepth
    projection: Annotated[
        Literal["tangent", "equidistant", "stereographic"],
        Field(
            description="distance from the axis at an angle t:"
            ' "tangent": f tan t, "equidistant": f t, "stereographic": 2 f tan(t/2)'
        ),
    ] = "tangent"
    distortion: StarDistortion


Offset = Annotated[float, Field(ge=-1e5, le=1e5)]


class CcdFile(_Strict):
    """One table of [[ccds]] in remote_camera.toml"""

    n_px: Samples
    pixel_pitch_um: PixelPitch
    y_first_mm: FocalPlane
    x_offset_mm: FocalPlane
    rotation_mrad: float = within(-1600.0, 1600.0, "rotation of the line in the focal plane, at most 90°")
    principal_sample: Sample
    distortion_samples: Annotated[list[Sample], Field(max_length=10_000, description="nodes of the table")]
    distortion_offsets_um: Annotated[
        list[Offset],
        Field(max_length=10_000, description="offsets along the line at the nodes, µm, at most 10 cm"),
    ]
    distortion_across_um: Annotated[
        list[Offset],
        Field(max_length=10_000, description="offsets across the line at the nodes, µm, at most 10 cm"),
    ] = []  # none: zero

    @model_validator(mode="after")
    def _table_is_a_table(self) -> Self:
        s, d = self.distortion_samples, self.distortion_offsets_um
        if len(s) != len(d):
            raise ValueError(f"{len(s)} distortion_samples but {len(d)} distortion_offsets_um")
        if (n := len(self.distortion_across_um)) not in (0, len(s)):
            raise ValueError(f"{len(s)} distortion_samples but {n} distortion_across_um")
        if len(s) == 1 or any(b <= a for a, b in pairwise(s)):
            raise ValueError("distortion_samples must be none, or two and more in increasing order")
        return self


class InteriorFile(_Strict):
    """[interior] of remote_camera.toml: what an in-orbit calibration changed, with covariance"""

    parameters: Annotated[list[str], Field(max_length=1000, description="names")]
    values: Annotated[list[float], Field(max_length=1000, description="change by each parameter")]
    covariance: Annotated[list[list[float]], Field(max_length=1000, description="of the values, row by row")]
    gauge: Annotated[list[str], Field(max_length=1000, description="what is zero by constraint, and why")]

    @model_validator(mode="after")
    def _sizes_agree(self) -> Self:
        n = len(self.parameters)
        if len(self.values) != n or [len(row) for row in self.covariance] != [n] * n:
            raise ValueError(f"{n} parameters need {n} values and a covariance of {n} rows of {n}")
        return self


class RemoteCameraFile(_Strict):
    """remote_camera.toml"""

    focal_length_m: float = within(0.001, 1000.0, "focal length, m")
    tdi_stages: Annotated[int, Field(ge=1, le=1024)]
    time_of_row: Literal["start", "middle", "end"]
    bit_depth: BitDepth | None = None  # needed where a strip has an image
    ccds: Annotated[list[CcdFile], Field(min_length=1, max_length=64)]
    interior: InteriorFile | None = None  # written by `remote-camera-calibrate`; not used by `calibrate`


class LookCcdFile(_Strict):
    """One table of [[ccds]] in a remote_camera.toml of look tables"""

    n_px: Samples


class LookCameraFile(_Strict):
    """remote_camera.toml with model = "look tables"; the time of a row is that of its middle"""

    model: Literal["look tables"]
    looks: RelativePath
    directions: Literal["tangents", "angles"]
    bit_depth: BitDepth = 16
    ccds: Annotated[list[LookCcdFile], Field(min_length=1, max_length=64)]


class InstallationFile(_Strict):
    """installation.toml"""

    quaternion_cs: Annotated[
        list[Annotated[float, Field(ge=-2.0, le=2.0)]], numbers(4, "R_cs measured before launch, scalar last")
    ]
    sigma_rad: Annotated[
        list[Annotated[float, Field(ge=1e-9, le=3.15)]],
        numbers(3, "1-sigma rotation about the axes of c, at most 180°"),
    ]

    @model_validator(mode="after")
    def _of_unit_length(self) -> Self:
        length = sum(q * q for q in self.quaternion_cs) ** 0.5
        if abs(length - 1.0) > 1e-6:
            raise ValueError(f"quaternion_cs must have length 1 within 1e-6, it has {length:.9g}")
        return self


class LookRow(_Row):
    """looks.csv: the direction [x, y, 1] of a sample, as tangents or as angles (their tangents are taken)"""

    ccd: Annotated[int, Field(ge=0, le=63)]
    sample: Sample
    x: float = within(-1.5, 1.5, "along x of frame c, tangent or rad, at most 56°")
    y: float = within(-1.5, 1.5, "along y of frame c, tangent or rad, at most 56°")


class EarthOrientationRow(_Row):
    """earth_orientation.csv: values at 0 h UTC of consecutive days"""

    mjd_utc: Annotated[int, Field(ge=41317, le=100_000)]
    ut1_utc_s: float = within(-1.0, 1.0, "UT1 - UTC, s, at most 0.9 by the rule of leap seconds")
    x_arcsec: float = within(-2.0, 2.0, "pole coordinate x, arc-seconds")
    y_arcsec: float = within(-2.0, 2.0, "pole coordinate y, arc-seconds")


class ExposureRow(_Row):
    """exposures.csv"""

    id: Id
    file: RelativePath
    utc_mid: Utc
    exposure_s: float = within(1e-9, 10.0, "exposure time, s; beyond 10 s stars are trails")


class SkyImageRow(_Row):
    """Times of single images: `--times` of identify and star-camera-calibrate"""

    file: Annotated[str, StringConstraints(min_length=1, max_length=255)]
    utc_mid: Utc


class StripRow(_Row):
    """strips.csv: one row for each CCD of a strip"""

    id: Id
    ccd: Annotated[int, Field(ge=0, le=63)]
    file: Annotated[str, StringConstraints(max_length=255)]  # empty: no image, only measured points
    utc_first_row: Utc
    row_period_s: float = within(1e-9, 1.0, "from row to row, s; in 1 s a satellite moves 7 km")
    lines: Annotated[int, Field(ge=1, le=10_000_000)]
    kind: Annotated[Literal["ground", "sky"], Field(description="what the camera looks at")] = "ground"
    camera: Annotated[str, StringConstraints(max_length=64), Field(description="id of [[cameras]]")] = ""


class _Identified(_Row):
    id: Id


class _Surveyed(_Row):
    """Columns of a point on the ground."""

    lat_deg: float = within(-90.0, 90.0, "geodetic latitude, degrees")
    lon_deg: float = within(-180.0, 360.0, "longitude, degrees, positive to the east")
    height_m: float = within(-500.0, 1e4, "height, m, from the Dead Sea to above Everest")
    height_kind: HeightKind
    sigma_east_m: TargetSigma
    sigma_north_m: TargetSigma
    sigma_up_m: TargetSigma
    reference: Annotated[
        str, StringConstraints(max_length=64), Field(description="id of [[ground_references]]")
    ] = ""


class TargetRow(_Surveyed, _Identified):
    """targets.csv"""

    chip: RelativePath


class _Measured(_Identified):
    """Columns of a position in an image."""

    strip: Id
    ccd: Annotated[int, Field(ge=0, le=63)]
    sample: Sample
    line: float = within(-1e7, 1e7, "row of the strip, px; (0, 0) is the centre of the first pixel")
    sigma_sample_px: PointSigma
    sigma_line_px: PointSigma


class PointRow(_Surveyed, _Measured):
    """points.csv: ground points whose image positions are measured"""


class PixelRow(BaseModel):
    """One line of the file of pixels. (0, 0) is the centre of the first pixel."""

    model_config: ClassVar[ConfigDict] = CLOSED
    ccd: Annotated[int, Field(ge=0)]
    sample: float
    line: float
