"""Ground points of pixels of a Sentinel-2 datastrip, by the operator's model or with our interpolation, and
how far they are from the operator's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from boresight.features.operators.sentinel2_product import AttitudeRecord, Sentinel2
from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.earth_orientation import EarthOrientationTable
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.geodesy import ecef_from_geodetic
from boresight.geometry.groundlight import LightEffects
from boresight.geometry.line_camera import LookAngleCamera, LookTable
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import Pushbroom, RowClock
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.text_files import read_table
from boresight.records.record import Floats

__all__ = [
    "GridRow",
    "operator_orbit",
    "operator_pushbroom",
    "read_grid_rows",
    "refined_attitudes",
    "refined_camera",
    "sentinel2_grid_differences",
]

_DEGREE = 7  # of the Hermite polynomial, four states of 1 Hz; others agree to 0.1 mm


class GridRow(BaseModel):
    """A pixel of a detector and where the operator puts it. Lines count from 1, samples from 0, both at the
    centre of pixels.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)
    granule: str = ""
    band: str = ""
    detector: Annotated[int, Field(ge=1, le=64)]
    line: float
    sample: float
    lon: Annotated[float, Field(ge=-180.0, le=360.0)]
    lat: Annotated[float, Field(ge=-90.0, le=90.0)]
    alt: float


def read_grid_rows(path: Path) -> list[GridRow]:
    """The rows of an operator's location grid in CSV; `RawDataError` names line and column."""
    return read_table(path, GridRow, str(path), "pixels with their places")


def sentinel2_grid_differences(
    strip: Sentinel2, rows: Sequence[GridRow], table: EarthOrientationTable | None
) -> Floats:
    """Distances (N,), m, of our places of pixels from the operator's. `RawDataError` for another detector."""
    orbit = operator_orbit(strip, table or strip.earth_orientation)
    detector = np.array([row.detector for row in rows])
    if (most := int(detector.max())) > strip.camera.n_ccds:
        raise RawDataError("grid", "detector", most, f"1 to {strip.camera.n_ccds}")
    line, sample, lon, lat, height = np.array(
        [[row.line - 1.0, row.sample, row.lon, row.lat, row.alt] for row in rows]
    ).T
    places = ecef_from_geodetic(np.radians(lat), np.radians(lon), height)
    off = np.empty(len(rows))
    for one in np.unique(detector).tolist():
        model = operator_pushbroom(strip, one - 1, orbit)
        for n in np.flatnonzero(detector == one).tolist():
            level = ConstantHeight(float(height[n]))
            ours = model.ground_points(one - 1, sample[n : n + 1], line[n : n + 1], level)[0]
            off[n] = np.linalg.norm(ours - places[n])
    return np.where(np.isfinite(off), off, np.inf)


def operator_orbit(strip: Sentinel2, table: EarthOrientationTable) -> Orbit:
    """The orbit of a datastrip, with Earth rotation by a table (the operator's own is in the record)."""
    first, last = float(strip.t_orbit_s[0]), float(strip.t_orbit_s[-1])
    return Orbit(
        epoch=strip.epoch,
        t_s=strip.t_orbit_s,
        positions_m=strip.positions_m,
        velocities_m_s=strip.velocities_m_s,
        frame="ITRF",
        degree=_DEGREE,
        earth=EarthRotation.over(strip.epoch, first, last, table),
        method="hermite",
    )


def operator_pushbroom(strip: Sentinel2, ccd: int, orbit: Orbit) -> Pushbroom:
    """The model of one detector: corrected attitudes with the operator's refining, where there is one, no
    light effects. Frame s is the piloting frame.
    """
    (first, last), attitudes = orbit.span_s, refined_attitudes(strip)
    covered = (attitudes.t_s >= first) & (attitudes.t_s <= last)
    t_s, R_si = attitudes.t_s[covered], attitudes.R_is[covered].inv()
    return Pushbroom(
        camera=refined_camera(strip),
        rows=RowClock(float(strip.t_first_row_s[ccd]), strip.row_period_s),
        orbit=orbit,
        earth=orbit.earth,
        attitude=AttitudeTrack(t_s, R_si, orbit, interpolation="taylor"),  # as the operator's software
        R_cs=strip.R_cp,
        effects=LightEffects(light_time=False, aberration=False, refraction=False),
    )


def refined_attitudes(strip: Sentinel2) -> AttitudeRecord:
    """The corrected attitudes with the operator's refining, where there is one."""
    t_s, R_is = strip.corrected.t_s, strip.corrected.R_is
    if strip.refining is not None:
        R_is = R_is * strip.refining.rotations(t_s).inv()
    return AttitudeRecord(t_s, R_is)


def refined_camera(strip: Sentinel2) -> LookAngleCamera:
    """The camera with the operator's homothety, which scales z of the piloting frame."""
    if strip.refining is None:
        return strip.camera
    P = strip.R_cp.as_matrix()
    M = P @ np.diag([1.0, 1.0, 1.0 + strip.refining.homothety]) @ P.T
    ccds = []
    for table in strip.camera.ccds:
        v = np.column_stack([table.tan_x, table.tan_y, np.ones(len(table.samples))]) @ M.T
        ccds.append(LookTable(table.n_px, table.samples, v[:, 0] / v[:, 2], v[:, 1] / v[:, 2]))
    return LookAngleCamera(tuple(ccds))
