"""A DIMAP file as a dump: the operator's attitude (polynomial or list) as a head, look tables, line times."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.features.operators.imported_mission import ImportedHead, ImportedMission, ImportedStrip
from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.constants import ARCSEC
from boresight.geometry.line_camera import LookAngleCamera
from boresight.geometry.orbit import Orbit
from boresight.pipeline.files.dimap_metadata import DimapStrip

__all__ = ["dimap_mission"]

HEAD = "OPERATOR"  # name of the head: its attitude is the operator's, not a star camera's
STEP_S = 0.1  # the attitude polynomial of degree 3 is sampled with it and interpolated to 1e-12 rad
SIGMA_ARCSEC = 2.0  # of the operator's attitude: 7 m on the ground from 695 km
MIN_WHITE_ARCSEC = 1e-3  # the polynomial is smooth
# 1-sigma for `[errors]` of the dump; assumed, the product states none.
ERRORS = {
    "position_m": 1.0,
    "clock_s": 1e-6,
    "vibration_arcsec": 0.02,
    "look_distortion_px": 0.1,
    "look_distortion_length_px": 1500.0,
}


def dimap_mission(strip: DimapStrip, created_by: str) -> ImportedMission:
    """The contents of a dump of one strip; frame s is the operator's reference frame of attitude.

    Raises `ValueError` for a strip that is not of `read_dimap`.
    """
    push = strip.pushbroom
    if not (isinstance(push.orbit, Orbit) and isinstance(push.camera, LookAngleCamera)):
        raise ValueError("dimap_mission needs a strip of read_dimap")
    first, last = push.instants(np.array([-0.5, strip.height_px - 0.5]))
    t_s = np.arange(np.floor((first - 0.5) / STEP_S), np.ceil((last + 0.5) / STEP_S) + 1.0) * STEP_S
    if isinstance(push.attitude, AttitudeTrack):
        t_s = push.attitude.t_s
    head = ImportedHead(
        name=HEAD,
        t_s=t_s,
        R_is=push.attitude.R_si(t_s).inv(),
        R_cs0=Rotation.identity(),
        sigma_installation_rad=np.full(3, SIGMA_ARCSEC * ARCSEC),
        white_rad=np.full(3, MIN_WHITE_ARCSEC * ARCSEC),
        is_measured=False,
        interpolation="lagrange",
    )
    row = ImportedStrip(
        strip_id="PAN",
        ccd=0,
        t_first_row_s=push.rows.t_first_row_s,
        row_period_s=push.rows.row_period_s,
        lines=strip.height_px,
    )
    return ImportedMission(
        mission=strip.dataset,
        created_by=created_by,
        epoch=push.orbit.epoch,
        orbit=push.orbit,
        heads=(head,),
        cameras={"": push.camera},
        strips=(row,),
        errors=ERRORS,
        earth_orientation=None,
    )
