"""All tunables of a run in one record, filled from one TOML file that may name only what exists.

Each section belongs to the package that uses it: `[stars]`, `[match]`, `[calibration]` and `[run]`. What the
file leaves out keeps its default; the error model's defaults in `[calibration]` are what the dump says about
itself.
"""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import field
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from boresight.calib.settings import CalibrationSettings
from boresight.calib.verdict import VerdictSettings
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.constants import ARCSEC
from boresight.geometry.line_camera import LineSensor
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.dump_schema import Errors
from boresight.pipeline.files.text_files import expected_of, toml_tables
from boresight.records.record import check_numbers, record
from boresight.star_id.settings import StarSettings
from boresight.star_id.strip_stars.settings import StripStarSettings

__all__ = ["RunSettings", "Settings", "calibration_settings", "read_settings", "settings_from_tables"]

Record = TypeVar("Record")
RENAMED = {"run.passes": "rounds"}  # keys of before, which are read with a remark
FINITE = ConfigDict(allow_inf_nan=False)  # of pydantic: no setting is infinite or NaN


@record(by_value=True)
class RunSettings:
    """How the stages are put together."""

    exposure_margin_s: float = 1.0  # exposures so far before the first and after the last row are a strip's
    rematch_sigma_rad: float = 5e-6  # 1-sigma of the search in the second matching: position and clock errors
    rounds: int = 2  # matchings: the first from the pre-launch matrix, each later one from the last result
    settled_px: float = 2.0  # a strip whose targets are all predicted so closely is not matched again

    def __post_init__(self) -> None:
        check_numbers(self, zero=("settled_px",))


@record(by_value=True)
class Settings:
    """What the user asked for. `calibration` holds only the values that were given."""

    stars: StarSettings = field(default_factory=StarSettings)
    match: MatchSettings = field(default_factory=MatchSettings)
    calibration: tuple[tuple[str, Any], ...] = ()
    run: RunSettings = field(default_factory=RunSettings)
    verdict: VerdictSettings = field(default_factory=VerdictSettings)
    sky_strips: StripStarSettings = field(default_factory=StripStarSettings)


def read_settings(path: Path | None) -> Settings:
    """Settings from a TOML file; `RawDataError` names an unknown section or key, or a wrong value."""
    if path is None:
        return Settings()
    return settings_from_tables(toml_tables(path, str(path)), str(path))


def settings_from_tables(tables: dict[str, Any], file: str) -> Settings:
    """Settings from parsed tables of `file`; `RawDataError` names an unknown section or key."""
    hints = get_type_hints(Settings)
    for section, content in tables.items():
        if section not in hints:
            raise RawDataError(file, section, "an unknown section", f"one of {', '.join(hints)}")
        if not isinstance(content, dict):
            raise RawDataError(file, section, content, "a table")
    calibration = tables.get("calibration", {})
    settings_from_values(CalibrationSettings, calibration, file, "calibration")
    parts: dict[str, Any] = {
        name: settings_from_values(kind, tables.get(name, {}), file, name)
        for name, kind in hints.items()
        if name != "calibration"
    }
    return Settings(calibration=tuple(sorted(calibration.items())), **parts)


def calibration_settings(settings: Settings, errors: Errors, camera: LineSensor) -> CalibrationSettings:
    """The error model of a dump, with what the user's settings say instead."""
    shift, slope, bend = (one * camera.pixel_rad for one in errors.look_ccd_px)
    stated: dict[str, Any] = {
        "sigma_position_m": errors.position_m,
        "position_time_s": errors.position_time_s,
        "sigma_clock_s": errors.clock_s,
        "clock_time_s": errors.clock_time_s,
        "sigma_vibration_rad": errors.vibration_arcsec * ARCSEC,
        "sigma_mounting_rad": errors.mounting_arcsec * ARCSEC,
        "sigma_motion_rad": errors.motion_arcsec * ARCSEC,
        "motion_time_s": errors.motion_s,
        "sigma_distortion_rad": errors.look_distortion_px * camera.pixel_rad,
        "distortion_length_px": errors.look_distortion_length_px,
        "distortion_pixel_rad": camera.pixel_rad,
        "sigma_ccd_shift_rad": shift,
        "sigma_ccd_slope_rad": slope,
        "sigma_ccd_bend_rad": bend,
        "ccd_px": tuple(camera.n_px(ccd) for ccd in range(camera.n_ccds)),
    }
    return CalibrationSettings(**(stated | dict(settings.calibration)))


def settings_from_values(kind: type[Record], values: dict[str, Any], file: str, section: str) -> Record:
    """A settings record of type `kind` with `values`; `RawDataError` names a wrong key or value."""
    hints = get_type_hints(kind)
    taken: dict[str, Any] = {}
    for key, value in values.items():
        if new := RENAMED.get(f"{section}.{key}"):
            warnings.warn(f"{file}: {section}.{key} is called {section}.{new} now", stacklevel=2)
            key = new
        if key not in hints:
            expected = f"one of {', '.join(sorted(hints))}"
            raise RawDataError(file, f"{section}.{key}", "an unknown key", expected)
        if dataclasses.is_dataclass(hints[key]):
            if not isinstance(value, dict):
                raise RawDataError(file, f"{section}.{key}", value, "a table")
            taken[key] = settings_from_values(hints[key], value, file, f"{section}.{key}")
            continue
        try:
            taken[key] = TypeAdapter(hints[key], config=FINITE).validate_python(
                tuple(value) if isinstance(value, list) else value, strict=True
            )
        except ValidationError as error:
            expected = expected_of(error.errors(include_url=False)[0])
            raise RawDataError(file, f"{section}.{key}", value, expected) from error
    with refusing(file, section, "values that are possible together"):
        return kind(**taken)
