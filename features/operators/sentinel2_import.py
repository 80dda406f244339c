"""A Sentinel-2 L1B datastrip as a dump: star trackers or corrected attitudes, look tables, line times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from boresight.features.operators import imported_mission
from boresight.features.operators.sentinel2_grid import operator_orbit, refined_attitudes, refined_camera
from boresight.features.operators.sentinel2_product import Sentinel2
from boresight.geometry.constants import ARCSEC
from boresight.geometry.earth_orientation import EarthOrientationTable

__all__ = ["AttitudeLevel", "sentinel2_mission"]

AttitudeLevel = Literal["raw", "corrected", "refined"]
AXIS_LENGTH, WALK_ARCSEC = 0.01, 0.2  # of a gyro's axis, off by at most; noise of one at most
BIAS_WALK_ARCSEC_S, WHITE_ARCSEC = 1e-3, 1e-3  # assumed: a record of 90 s shows none; one count
SIGMA_INSTALLATION_ARCSEC = 20.0  # SPAMOD has moved by 5 arc-seconds in six years
ERRORS = {  # what the datastrip does not state; the user may state better
    "clock_s": 1e-6,  # QUALITY_INDEX of the time correlation is 0.1 µs, GPS_TIME has microseconds
    "vibration_arcsec": 0.05,
    # bands are specified to register within 0.3 px, 3-sigma (User Handbook): 0.1 px of two, of each
    "look_distortion_px": 0.07,
    "look_distortion_length_px": 500.0,
}


def sentinel2_mission(
    bands: Sequence[Sentinel2],
    created_by: str,
    *,
    attitudes: AttitudeLevel = "raw",
    earth_orientation: EarthOrientationTable | None = None,
) -> imported_mission.ImportedMission:
    """The contents of a dump of one band or of several of a datastrip, each a camera.

    Heads are with the `attitudes` "raw" each star tracker's own quaternions, with "corrected" the operator's
    corrected attitude, whose frame s is the piloting frame; "refined" applies the operator's refining to it,
    and its homothety to the camera. `earth_orientation` stands in place of the datastrip's bulletin, which
    holds the value of one day.
    """
    strip = bands[0]  # orbit and attitudes are those of the datastrip
    table = earth_orientation or strip.earth_orientation
    orbit = operator_orbit(strip, table)
    cameras = [refined_camera(band) if attitudes == "refined" else band.camera for band in bands]
    ids = [band.band if len(bands) > 1 else "" for band in bands]
    if attitudes == "corrected":
        found = {"CORRECTED": (strip.corrected, strip.R_cp)}
    elif attitudes == "refined":
        found = {"REFINED": (refined_attitudes(strip), strip.R_cp)}
    else:
        found = {name: (record, strip.R_cp * strip.R_ps[name]) for name, record in strip.trackers.items()}
    heads_of = []
    for name, (record, R_cs0) in found.items():
        first, last = np.searchsorted(record.t_s, orbit.span_s)  # attitudes outlast the ephemeris
        inside = slice(int(first), int(last))
        t_s, R_is = record.t_s[inside], record.R_is[inside]
        heads_of.append(
            imported_mission.ImportedHead(
                name=name,
                t_s=t_s,
                R_is=R_is,
                R_cs0=R_cs0,
                sigma_installation_rad=np.full(3, SIGMA_INSTALLATION_ARCSEC * ARCSEC),
                white_rad=imported_mission.white_noise_rad(t_s, R_is),
                is_measured=attitudes == "raw",
                interpolation="lagrange" if attitudes == "raw" else "taylor",
            )
        )
    return imported_mission.ImportedMission(
        mission=" ".join([strip.satellite, *(band.band for band in bands)]),
        created_by=created_by,
        epoch=strip.epoch,
        orbit=orbit,
        heads=tuple(heads_of),
        cameras=dict(zip(ids, cameras)),
        strips=tuple(
            imported_mission.ImportedStrip(
                strip_id=band.band,
                ccd=ccd,
                t_first_row_s=float(t),
                row_period_s=band.row_period_s,
                lines=band.lines,
                camera=camera,
            )
            for band, camera in zip(bands, ids)
            for ccd, t in enumerate(band.t_first_row_s)
        ),
        gyro=_gyro(strip, strip.R_ps[heads_of[0].name]) if attitudes == "raw" and heads_of else None,
        errors={"position_m": round(strip.sigma_position_m, 3), **ERRORS},
        earth_orientation=table,
    )


def _gyro(strip: Sentinel2, R_ps: Rotation) -> imported_mission.ImportedGyro | None:
    """The gyros, about the axes of the piloting frame; `R_ps` takes those of the first head to it.

    The datastrip states no axes: they are those with which the angles between rows are the rotations of the
    operator's corrected attitudes, a bias of each gyro apart. What remains of the one combination of four
    gyros that no rotation changes shows their noise. None where that is not as small as a gyro's.
    """
    gyros, corrected = strip.gyros, strip.corrected
    if gyros is None:
        return None
    at = np.flatnonzero((gyros.t_s > corrected.t_s[0]) & (gyros.t_s < corrected.t_s[-1]))
    turned = (corrected.R_is[:-1].inv() * corrected.R_is[1:]).as_rotvec()
    path = CubicSpline(corrected.t_s, np.concatenate([np.zeros((1, 3)), np.cumsum(turned, axis=0)]))
    steps, true = np.diff(gyros.angles_rad[at], axis=0), np.diff(path(gyros.t_s[at]), axis=0)
    dt = np.diff(gyros.t_s[at])[:, None]
    found = np.linalg.lstsq(np.column_stack([true, dt]), steps, rcond=None)[0]
    axes, bias = found[:3].T, found[3]
    unseen = np.linalg.svd(axes)[0][:, 3]
    noise = float(np.std((steps - dt * bias) @ unseen / np.sqrt(dt[:, 0]), ddof=1))
    to_body = np.linalg.pinv(axes)
    if np.abs(np.linalg.norm(axes, axis=1) - 1.0).max() > AXIS_LENGTH or noise > WALK_ARCSEC * ARCSEC:
        return None
    turns = (np.diff(gyros.angles_rad, axis=0) - np.diff(gyros.t_s)[:, None] * bias) @ to_body.T
    return imported_mission.ImportedGyro(
        t_s=gyros.t_s,
        turns_g=np.concatenate([np.zeros((1, 3)), turns]),
        R_sg=R_ps.inv(),
        random_walk_rad=noise * float(np.sqrt(np.mean(np.sum(to_body**2, axis=1)))),
        bias_walk_rad_s=BIAS_WALK_ARCSEC_S * ARCSEC,
        white_rad=WHITE_ARCSEC * ARCSEC,
    )
