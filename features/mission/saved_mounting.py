"""A finished result as a mission's calibration: matrix and information, when, where in the orbit, of which
cameras, and what it was made from.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.information import InformationPairs
from boresight.geometry.epoch import Epoch
from boresight.geometry.installation import deviation_from_theta
from boresight.pipeline.errors import refusing
from boresight.pipeline.files.table_files import column, list_values, read_parquet
from boresight.pipeline.files.text_files import json_if_there
from boresight.pipeline.results.identity import identity_of_result, saved_about
from boresight.pipeline.results.reading import matrix_in, of_camera, read_installation, read_mounting
from boresight.pipeline.run.digests import rounded_digest
from boresight.records.record import Floats, Texts, array, record, scalar

__all__ = ["ORIGIN", "SavedMounting", "instant_s", "read_saved_mounting", "utc_at"]

# By which the unknowns of the distortion are measured: alike where results share these unknowns.
OF_DISTORTION = (
    *("sigma_distortion_rad", "distortion_length_px", "distortion_pixel_rad"),
    *("sigma_ccd_shift_rad", "sigma_ccd_slope_rad", "sigma_ccd_bend_rad", "ccd_px"),
)
# Zero of a mission's instants: seconds of TAI since 2000-01-01T12:00:00 TAI.
ORIGIN = Epoch.from_utc("2000-01-01T11:59:28Z")


@record(kw_only=True)
class SavedMounting:
    """One finished result of one camera and one star camera."""

    id: str = scalar("id of the result, from the content of its installation.json")
    folder: Path = scalar("where it is")
    t_s: float = scalar("middle of its strips, TAI seconds since 2000-01-01T12:00:00 TAI")
    utc: str = scalar("the same in UTC")
    mission: str = scalar("as the dump or --about names it")
    satellite: str = scalar("as --about or the dump names it; may be empty")
    camera: str = scalar("name of the remote-sensing camera; empty where the dump has one")
    head: str = scalar("name of the star camera whose matrix this is; empty where the dump has one")
    star_camera: str = scalar("digest of the star camera: another one is an exchange")
    model: str = scalar("digest of the remote-sensing camera's model and of how its distortion is measured")
    verdict: str = scalar("outcome of its verdict")
    R_cs: Rotation = scalar("installation matrix")
    R_cs0: Rotation = scalar("pre-launch matrix")
    covariance: Floats = array("3, 3", "of theta, frame c, rad²")
    ground_m_per_rad: Floats = array("3", "metres on the ground for a rotation by 1 rad; NaN: no ground")
    pair: InformationPairs = scalar("information on theta and on the camera's distortion")
    cos_sin: Floats = array("2", "of the argument of latitude, means over the strips")
    beta_rad: float = scalar("height of the Sun over the orbital plane; NaN of earlier versions")
    temperature_c: float = scalar("of the star camera; NaN where not stated")
    strips: Texts = array("N", "ids of the strips")
    strips_utc: Texts = array("N", "their middles")
    track_deg: Floats = array("N, 4", "latitude and longitude below the satellite at begin and end; NaN")
    facts: dict[str, Any] = scalar("program, inputs, settings: what may differ between results")
    of_several: str = scalar("id of the camera, where the result has several; else empty", default="")


def instant_s(utc: str) -> float:
    """TAI seconds since 2000-01-01T12:00:00 TAI of a UTC date; `ValueError` for one that is none."""
    return float(ORIGIN.seconds_from_utc([utc if "T" in utc else f"{utc}T00:00:00Z"])[0])


def utc_at(t_s: float) -> str:
    """The date, UTC, to the second; empty for NaN."""
    return "" if np.isnan(t_s) else f"{ORIGIN.utc_from_seconds(np.array([t_s]))[0][:19]}Z"


def read_saved_mounting(folder: Path, camera: str = "") -> SavedMounting:
    """The result in a folder, of several cameras that of `camera`; `RawDataError` where it is damaged, not
    finished, or of other cameras."""
    content = read_installation(folder)
    camera = camera if content.get("cameras") else ""
    R_cs, theta, covariance = matrix_in(content, camera, folder)
    identity, about = identity_of_result(folder), saved_about(folder)
    context = json_if_there(folder / "evidence" / "context.json")
    path = folder / "sightings" / "passes.parquet"
    passes = read_parquet(path)
    utc = passes.column("utc_middle").to_pylist()  # none of a result from vectors
    with refusing(str(path), "utc_middle", "UTC times of strips"):
        t_s = float(np.mean(ORIGIN.seconds_from_utc(utc))) if utc else np.nan
    u = column(passes, "argument_of_latitude_rad")
    settings = content.get("settings", {}).get("calibration", {})
    cameras = sorted(set(passes.column("camera").to_pylist()))
    known = "beta_rad" in passes.column_names and len(u) > 0
    heads = content.get("heads") or [{"name": ""}]
    ends = [list_values(passes, name, 2) for name in ("begin_deg", "end_deg")] if known else []
    of_ground = of_camera(content, camera, folder).get("ground_m_per_rad") or [None] * 3
    return SavedMounting(
        id=identity.result,
        folder=folder.resolve(),
        t_s=t_s,
        utc=utc_at(t_s),
        mission=str(about.get("mission") or context.get("mission", "")),
        satellite=str(context.get("satellite", "")),
        camera=camera or str(context.get("camera", "")),
        head=str(heads[0]["name"]),
        star_camera=rounded_digest(context.get("star_camera")),
        model=rounded_digest([cameras, [settings.get(key) for key in OF_DISTORTION]]),
        verdict=str(content["verdict"]["outcome"]),
        R_cs=R_cs,
        R_cs0=deviation_from_theta(theta).inv() * R_cs,
        covariance=covariance,
        ground_m_per_rad=np.array(of_ground, dtype=float),
        pair=read_mounting(folder, identity.result, camera=camera),
        cos_sin=np.array([np.cos(u).mean(), np.sin(u).mean()]) if len(u) else np.full(2, np.nan),
        beta_rad=float(column(passes, "beta_rad").mean()) if known else np.nan,
        temperature_c=_temperature_c(folder),
        strips=np.array(passes.column("strip_id").to_pylist(), dtype=str),
        strips_utc=np.array(utc, dtype=str),
        track_deg=np.hstack(ends) if known else np.full((len(u), 4), np.nan),
        facts={
            "version": content.get("version"),
            "program": identity.program,
            "dump": identity.dump,
            "inputs": identity.inputs,
            "packages": json_if_there(folder / "run.json").get("packages", {}),
            "settings": content.get("settings", {}),
        },
        of_several=camera,
    )


def _temperature_c(folder: Path) -> float:
    """Mean over the targets of the star camera's temperature, where a result states it."""
    path = folder / "evidence" / "ground.parquet"
    if not path.is_file():
        return np.nan
    table = read_parquet(path)
    stated = column(table, "temperature_c") if "temperature_c" in table.column_names else np.empty(0)
    stated = stated[np.isfinite(stated)]
    return float(stated.mean()) if len(stated) else np.nan
