"""The shape of every text file of a dump: keys, types, ranges (docs/dump-format.md says the same in prose).

Units are those of the files, and stand in the names. Unknown keys are refused; numbers must be finite.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator

__all__ = [
    "CcdFile",
    "DumpFile",
    "ExposureRow",
    "InstallationFile",
    "RemoteCameraFile",
    "StarCameraFile",
    "StripRow",
    "TargetRow",
]

Id = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
RelativePath = Annotated[str, StringConstraints(min_length=1, max_length=255)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Utc = Annotated[str, StringConstraints(pattern=r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d{1,12})?Z?$")]
BitDepth = Annotated[int, Field(ge=8, le=16)]
Samples = Annotated[int, Field(ge=16, le=65536)]
HeightKind = Literal["ellipsoidal", "egm96"]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class _Row(BaseModel):
    """A row of a CSV file: all cells are text, numbers are read out of them."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, str_strip_whitespace=True)


class Conventions(_Strict):
    """Stated, so that a writer has to think of them; nothing else is accepted."""

    inertial_frame: Literal["GCRS"]
    earth_fixed_frame: Literal["ITRS"]
    time_scale: Literal["UTC"]
    quaternions: Literal["scalar-last"]
    image_origin: Literal["centre of first pixel is (0, 0)"]


class Files(_Strict):
    star_camera: RelativePath
    remote_camera: RelativePath
    installation: RelativePath
    orbit: RelativePath
    exposures: RelativePath
    strips: RelativePath
    targets: RelativePath
    terrain: RelativePath | None = None


class Errors(_Strict):
    """What the mission knows about its own errors, each as 1-sigma of a zero-mean error."""

    position_m: NotNegative
    clock_s: NotNegative
    vibration_arcsec: NotNegative
    look_distortion_px: NotNegative
    look_distortion_length_px: Positive


class TerrainHeights(_Strict):
    height_kind: HeightKind
    sigma_m: NotNegative


class DumpFile(_Strict):
    """dump.toml"""

    format: Literal["boresight-dump"]
    format_version: Literal[1]
    mission: Annotated[str, StringConstraints(min_length=1, max_length=200)]
    created_by: Annotated[str, StringConstraints(max_length=500)] = ""
    conventions: Conventions
    files: Files
    errors: Errors
    terrain: TerrainHeights | None = None

    @model_validator(mode="after")
    def _terrain_is_described(self) -> Self:
        if (self.files.terrain is None) != (self.terrain is None):
            raise ValueError("files.terrain and the table [terrain] come together or not at all")
        return self


class StarDistortion(_Strict):
    p1_per_mm: float
    p2_per_mm: float
    q1_per_mm2: float
    q2_per_mm4: float


class StarCameraFile(_Strict):
    """star_camera.toml"""

    focal_length_mm: Positive
    pixel_pitch_um: Positive
    width_px: Samples
    height_px: Samples
    principal_point_px: Annotated[list[float], Field(min_length=2, max_length=2)]
    bit_depth: BitDepth
    distortion: StarDistortion


class CcdFile(_Strict):
    """One table of [[ccds]] in remote_camera.toml"""

    n_px: Samples
    pixel_pitch_um: Positive
    y_first_mm: float
    x_offset_mm: float
    rotation_mrad: float
    principal_sample: float
    distortion_samples: Annotated[list[float], Field(max_length=10_000)]
    distortion_offsets_um: Annotated[list[float], Field(max_length=10_000)]

    @model_validator(mode="after")
    def _table_is_a_table(self) -> Self:
        s, d = self.distortion_samples, self.distortion_offsets_um
        if len(s) != len(d):
            raise ValueError(f"{len(s)} distortion_samples but {len(d)} distortion_offsets_um")
        if len(s) == 1 or any(b <= a for a, b in pairwise(s)):
            raise ValueError("distortion_samples must be none, or two and more in increasing order")
        return self


class RemoteCameraFile(_Strict):
    """remote_camera.toml"""

    focal_length_m: Positive
    tdi_stages: Annotated[int, Field(ge=1, le=1024)]
    time_of_row: Literal["start", "middle", "end"]
    bit_depth: BitDepth
    ccds: Annotated[list[CcdFile], Field(min_length=1, max_length=64)]


class InstallationFile(_Strict):
    """installation.toml"""

    quaternion_cs: Annotated[list[float], Field(min_length=4, max_length=4)]
    sigma_rad: Annotated[list[Positive], Field(min_length=3, max_length=3)]

    @model_validator(mode="after")
    def _of_unit_length(self) -> Self:
        length = sum(q * q for q in self.quaternion_cs) ** 0.5
        if abs(length - 1.0) > 1e-6:
            raise ValueError(f"quaternion_cs must have length 1 within 1e-6, it has {length:.9g}")
        return self


class ExposureRow(_Row):
    """exposures.csv"""

    id: Id
    file: RelativePath
    utc_mid: Utc
    exposure_s: Annotated[float, Field(gt=0, le=10)]


class SkyImageRow(_Row):
    """Times of single images: `--times` of identify and star-camera-calibrate"""

    file: Annotated[str, StringConstraints(min_length=1, max_length=255)]
    utc_mid: Utc


class StripRow(_Row):
    """strips.csv: one row for each CCD of a strip"""

    id: Id
    ccd: Annotated[int, Field(ge=0, le=63)]
    file: RelativePath
    utc_first_row: Utc
    row_period_s: Annotated[float, Field(gt=0, le=1)]
    lines: Annotated[int, Field(ge=1, le=10_000_000)]


class TargetRow(_Row):
    """targets.csv"""

    id: Id
    lat_deg: Annotated[float, Field(ge=-90, le=90)]
    lon_deg: Annotated[float, Field(ge=-180, le=360)]
    height_m: Annotated[float, Field(ge=-500, le=10_000)]
    height_kind: HeightKind
    sigma_east_m: NotNegative
    sigma_north_m: NotNegative
    sigma_up_m: NotNegative
    chip: RelativePath
